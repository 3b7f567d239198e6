"""Which lost frames should become keyframes, so that the map grows where tracking failed."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, evenly_spaced, runs

_WINDOW_FRAMES = 3
_END_OFFSET_FRAMES = 1
_MIN_BUDGET = 20
_BUDGET_RATIO = 0.5


def lost_intervals(localised: BoolArray) -> list[tuple[int, int]]:
    """Maximal runs [start, stop) of frames without a pose."""
    return runs(~localised)


def request_keyframes(localised: BoolArray, sharpness: FloatArray, tried: IntArray) -> IntArray:
    """Frames to offer to the map: the sharpest of every few lost ones, and the ends they hang on.

    Args:
        localised: (N,) frames with a pose.
        sharpness: (N,) image sharpness.
        tried: Frames that were offered before.

    Returns:
        Frame indices, increasing; at most half as many as were tried before (and 20).

    Source: Algorithm 1 of Vo, Kim, Choudhary, "Motion capture using body mounted cameras in an
        unknown environment".
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
