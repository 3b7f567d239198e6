"""Select lost frames as new keyframes, so that the map grows where tracking failed."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, evenly_spaced, runs

_WINDOW_FRAMES = 3
"""Number of successive lost frames in a window. Only the sharpest frame of each window is requested.
Evidence: none."""
_END_OFFSET_FRAMES = 1
"""Distance from each end of a lost interval to a frame outside the interval. Unit: frames. This frame has a
pose and is requested too. A distance of 1 means the frame adjacent to the interval."""
_MIN_BUDGET = 20
"""Number of frames that may always be requested in a round, even if few frames were offered before. Evidence:
none."""
_BUDGET_RATIO = 0.5
"""Maximum number of frames requested in one round, as a fraction of the number of frames offered to the
mapper before. The limit bounds the growth of the map. Evidence: none."""


def lost_intervals(localised: BoolArray) -> list[tuple[int, int]]:
    """Return the lost intervals [start, stop): the longest possible runs of frames without a pose."""
    return runs(~localised)


def request_keyframes(localised: BoolArray, sharpness: FloatArray, tried: IntArray) -> IntArray:
    """Select lost frames that the mapper should try as keyframes, and the frames with poses next to them.

    Lost intervals are divided into windows of three frames. The sharpest frame of each window is selected,
    unless a frame of the window was offered before.

    Args:
        localised: (N,) True for frames with a pose.
        sharpness: (N,) image sharpness of each frame.
        tried: Indices of the frames that were offered to the mapper before.

    Returns:
        Indices of the selected frames, increasing. At most 20 frames are selected. If more than 40 frames
        were offered before, at most half this number of frames are selected.

    Source: Algorithm 1 of Vo, Kim, Choudhary, "Motion capture using body mounted cameras in an unknown
        environment".
    """
    was_tried = np.zeros(len(localised), dtype=bool)
    was_tried[tried] = True
    chosen: list[int] = []
    for start, stop in lost_intervals(localised):
        untried: list[int] = []
        for window_start in range(start, stop, _WINDOW_FRAMES):
            window = np.arange(window_start, min(window_start + _WINDOW_FRAMES, stop))
            if not was_tried[window].any():
                untried.append(int(window[np.argmax(sharpness[window])]))
        if not untried:
            continue
        ends = [
            frame
            for frame in (start - _END_OFFSET_FRAMES, stop - 1 + _END_OFFSET_FRAMES)
            if 0 <= frame < len(localised)
        ]
        chosen += untried + [frame for frame in ends if not was_tried[frame]]
    budget = max(_MIN_BUDGET, int(_BUDGET_RATIO * len(tried)))
    unique = np.unique(np.array(chosen, dtype=np.int64))
    if len(unique) > budget:
        unique = unique[evenly_spaced(len(unique), budget)]
    return unique
