"""Select lost frames that should become keyframes, so that the map grows where tracking failed."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, evenly_spaced, runs

_WINDOW_FRAMES = 3
"""Frames of which the sharpest one is requested. Evidence: none."""
_END_OFFSET_FRAMES = 1
"""Distance in frames from a lost interval to the frame with a pose that is requested with it: the adjacent
one."""
_MIN_BUDGET = 20
"""Frames that may always be requested at a time. Evidence: none."""
_BUDGET_RATIO = 0.5
"""Most frames requested at a time, as a fraction of those offered before. Origin: it bounds the growth of the
map in one round. Evidence: none."""


def lost_intervals(localised: BoolArray) -> list[tuple[int, int]]:
    """Return the maximal intervals [start, stop) of frames without a pose."""
    return runs(~localised)


def request_keyframes(localised: BoolArray, sharpness: FloatArray, tried: IntArray) -> IntArray:
    """Select lost frames to offer to the mapper, and the frames with poses next to them.

    The sharpest of every few lost frames is taken.

    Args:
        localised: (N,) frames with a pose.
        sharpness: (N,) image sharpness.
        tried: Frames that were offered before.

    Returns:
        Frame indices, increasing; at most half as many as were offered before, but up to 20 in any case.

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
