"""A picture that stands still: the recording is frozen, or nobody wears the camera."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from bodycap_batch.capture.images import Image
from bodycap_batch.core.arrays import BoolArray, FloatArray

_COLUMNS, _ROWS, _BLOCK_PX = 8, 6, 8
_MIN_BLOCK_SIGMA = 3.0
"""Grey levels, as a standard deviation, below which a block shows nothing that could be seen to move."""
_MIN_TEXTURED_BLOCKS, _MAX_GREY_DIFFERENCE = 6, 1.0
"""With fewer blocks that show something, pictures are alike where they are the same to a grey level."""
_MIN_CORRELATION = 0.9
_MIN_STATIC_RATIO = 0.7
"""Of the blocks that show something. Pictures an eighth of a recording apart: at most 0.11 with 15 worn
cameras of five captures, 1.0 with a frozen picture and a camera on a table, sensor noise and all."""
_MIN_STEP_S, _MIN_STEP_RATIO = 1.0, 0.125
"""Pictures less than a second or an eighth of the recording apart may well be alike: nobody moves all the
time, and a slow turn of the body does not show in a few frames."""
_MIN_RUN_PICTURES, _MIN_RUN_STEPS = 3, 2
"""A part of a recording stands still with so many pictures alike, over so many of those steps of time."""
_MIN_SPAN_RATIO = 0.7
"""Share of a recording that pictures have to span to tell of all of it."""


def block_means(image: Image) -> FloatArray:
    """What a grey picture (H,W) shows, coarsely: (R,C) grey levels, of blocks one after the other."""
    import cv2

    size = (_COLUMNS * _BLOCK_PX, _ROWS * _BLOCK_PX)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.float64)


def static_notes(outlines: Sequence[FloatArray], times_s: FloatArray, length_s: float) -> list[str]:
    """Tell of pictures that do not move, if there are any.

    Where all pictures lie close together in a longer recording, nothing is known of the rest of it.

    Args:
        outlines: Of pictures in the order of time.
        times_s: (N,) when they were taken, on the common clock.
        length_s: How long the recording is, seconds.
    """
    same = np.eye(len(outlines), dtype=bool)
    for one, other in combinations(range(len(outlines)), 2):
        same[one, other] = same[other, one] = _is_same_view(outlines[one], outlines[other])
    start, stop = _longest_static_run(same, times_s)
    first, last = times_s[start], times_s[stop]
    step = max(_MIN_STEP_S, _MIN_STEP_RATIO * length_s)
    pictures = stop - start + 1
    if pictures == len(outlines) and last - first >= max(step, _MIN_SPAN_RATIO * length_s):
        return [
            "the picture stands still throughout: a frozen recording, or a camera that nobody wears; nothing "
            "can be solved from it, record it again or leave the camera out"
        ]
    if pictures < _MIN_RUN_PICTURES or last - first < _MIN_RUN_STEPS * step:
        return []
    return [
        f"the picture stands still from about {first:.1f} to {last:.1f} s ({pictures} pictures "
        "looked at are alike): does the person stand still, is the recording frozen, or the camera off? "
        "start_s and end_s cut it off"
    ]


def _is_same_view(first: FloatArray, second: FloatArray) -> bool:
    """Whether nearly all that two pictures show is at the same place in both, in whatever light."""
    (one, one_shows), (other, other_shows) = _blocks(first), _blocks(second)
    shows = np.maximum(one_shows, other_shows) > _MIN_BLOCK_SIGMA
    if shows.sum() < _MIN_TEXTURED_BLOCKS:
        same = bool(np.abs(first - second).max() < _MAX_GREY_DIFFERENCE)
        return same and float(first.std()) > _MIN_BLOCK_SIGMA
    alike = np.mean(one * other, axis=1) > _MIN_CORRELATION * one_shows * other_shows
    return bool(alike[shows].mean() > _MIN_STATIC_RATIO)


def _blocks(picture: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Blocks (B,P) of mean zero, and the standard deviation (B,) of each."""
    cut = picture.reshape(_ROWS, _BLOCK_PX, _COLUMNS, _BLOCK_PX).swapaxes(1, 2).reshape(-1, _BLOCK_PX**2)
    return cut - cut.mean(axis=1, keepdims=True), cut.std(axis=1)


def _longest_static_run(same: BoolArray, times_s: FloatArray) -> tuple[int, int]:
    """First and last of those successive pictures, each alike to each (N,N), that span the longest time."""
    runs = [
        (start, stop)
        for start in range(len(same))
        for stop in range(start, len(same))
        if same[start : stop + 1, start : stop + 1].all()
    ]
    return max(runs, key=lambda run: float(times_s[run[1]] - times_s[run[0]]))
