"""Find pictures that do not change because the recording is frozen or the camera is not on the body."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import combinations

import numpy as np

from bodycap_batch.capture.images import Image
from bodycap_batch.core.arrays import BoolArray, FloatArray

_COLUMNS, _ROWS, _BLOCK_PX = 8, 6, 8
"""Number of block columns and block rows in a reduced picture, and side length of a block.

The side length is in pixels of the reduced picture. Evidence: none.
"""
_MIN_BLOCK_SIGMA = 3.0
"""Minimum standard deviation (grey levels) of a textured block.

A block with a smaller standard deviation has too little texture to show motion. Evidence: none.
"""
_MIN_TEXTURED_BLOCKS, _MAX_GREY_DIFFERENCE = 6, 1.0
"""Minimum number of textured blocks for a comparison by blocks, and bound of the difference of grey levels.

With fewer textured blocks, two pictures are compared pixel by pixel. The two pictures are treated as equal if
the difference of every pixel is below the bound. Evidence: none.
"""
_MIN_CORRELATION = 0.9
"""Minimum normalised correlation of two blocks that are treated as equal. Evidence: none."""
_MIN_STATIC_RATIO = 0.7
"""Minimum fraction of textured blocks that are equal in two pictures of a static camera.

Evidence: docs/decisions/check.md.
"""
_MIN_STEP_S, _MIN_STEP_RATIO = 1.0, 0.125
"""Length of a time step for judging static pictures, in seconds and as a fraction of the recording.

The longer of the two steps is used. Equal pictures that span less than one step are not reported, because a
person may pause or turn slowly.
"""
_MIN_RUN_PICTURES, _MIN_RUN_STEPS = 3, 2
"""Minimum number of successive equal pictures in a static part of a video, and minimum duration of the part.

The duration is given as a number of time steps (`_MIN_STEP_S`, `_MIN_STEP_RATIO`).
"""
_MIN_SPAN_RATIO = 0.7
"""Minimum fraction of a recording that equal pictures must span to call the whole recording static.

Evidence: none.
"""


def reduced_picture(image: Image) -> FloatArray:
    """Reduce a grey picture (H,W) to the size of the grid of blocks. Pixel values are grey levels."""
    import cv2

    size = (_COLUMNS * _BLOCK_PX, _ROWS * _BLOCK_PX)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.float64)


def static_part(
    pictures: Sequence[FloatArray], times_s: FloatArray, length_s: float
) -> tuple[bool, list[str]]:
    """Find pictures of a camera that do not change.

    Args:
        pictures: N reduced pictures in the order of time.
        times_s: (N,) common time of each picture, seconds.
        length_s: Duration of the recording, seconds.

    Returns:
        True if all pictures are equal and span most of the recording; and a note if pictures do not change
        for a long time, otherwise an empty list.
    """
    start, stop = _longest_static_run(_equal_pictures(pictures), times_s)
    first, last = times_s[start], times_s[stop]
    step = max(_MIN_STEP_S, _MIN_STEP_RATIO * length_s)
    count = stop - start + 1
    if count == len(times_s) and last - first >= max(step, _MIN_SPAN_RATIO * length_s):
        return True, [
            "the picture does not change in the whole video: the recording froze, or the camera was not "
            "on the body. This video shows no motion, so record again or leave this camera out"
        ]
    if count < _MIN_RUN_PICTURES or last - first < _MIN_RUN_STEPS * step:
        return False, []
    return False, [
        f"the picture does not change from about {first:.1f} to {last:.1f} s ({count} pictures are equal): "
        "check whether the person stands still, the recording froze, or the camera was not on the body. "
        "To exclude this part, set start_s and end_s"
    ]


def has_one_view(pictures: Iterable[FloatArray]) -> bool:
    """Return True if all pictures of a camera are equal to the first. It stops at the first other picture."""
    rest = iter(pictures)
    first = next(rest, None)
    return first is None or all(_is_same_view(first, picture) for picture in rest)


def _equal_pictures(pictures: Sequence[FloatArray]) -> BoolArray:
    """Return a matrix (N,N) that is True for each pair of equal pictures."""
    same = np.eye(len(pictures), dtype=bool)
    for one, other in combinations(range(len(pictures)), 2):
        same[one, other] = same[other, one] = _is_same_view(pictures[one], pictures[other])
    return same


def _is_same_view(first: FloatArray, second: FloatArray) -> bool:
    """Return True if most textured blocks of two reduced pictures are equal.

    The brightness and the contrast of a block may differ between the two pictures. Pictures with few textured
    blocks are compared pixel by pixel. In this case a picture with too little contrast is not called equal.
    """
    (one, one_shows), (other, other_shows) = _blocks(first), _blocks(second)
    shows = np.maximum(one_shows, other_shows) > _MIN_BLOCK_SIGMA
    if shows.sum() < _MIN_TEXTURED_BLOCKS:
        same = bool(np.abs(first - second).max() < _MAX_GREY_DIFFERENCE)
        return same and float(first.std()) > _MIN_BLOCK_SIGMA
    alike = np.mean(one * other, axis=1) > _MIN_CORRELATION * one_shows * other_shows
    return bool(alike[shows].mean() > _MIN_STATIC_RATIO)


def _blocks(picture: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the B blocks of a reduced picture.

    Returns:
        (B,P) grey levels of each block's P pixels minus the block's mean, and (B,) standard deviation of each
        block.
    """
    blocks = picture.reshape(_ROWS, _BLOCK_PX, _COLUMNS, _BLOCK_PX).swapaxes(1, 2).reshape(-1, _BLOCK_PX**2)
    return blocks - blocks.mean(axis=1, keepdims=True), blocks.std(axis=1)


def _longest_static_run(same: BoolArray, times_s: FloatArray) -> tuple[int, int]:
    """Return the first and the last index of the successive equal pictures that span the longest time.

    Args:
        same: (N,N) True for each pair of equal pictures.
        times_s: (N,) time of each picture, seconds.
    """
    runs = [
        (start, stop)
        for start in range(len(same))
        for stop in range(start, len(same))
        if same[start : stop + 1, start : stop + 1].all()
    ]
    return max(runs, key=lambda run: float(times_s[run[1]] - times_s[run[0]]))
