"""Find pictures that do not change: the recording is frozen, or the camera is not on the body."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from bodycap_batch.capture.images import Image
from bodycap_batch.core.arrays import BoolArray, FloatArray

_COLUMNS, _ROWS, _BLOCK_PX = 8, 6, 8
"""Number of blocks in a reduced picture, and the side of a block in its pixels. Evidence: none."""
_MIN_BLOCK_SIGMA = 3.0
"""Standard deviation of a block in grey levels. A block with less has no texture that shows motion. Evidence:
none."""
_MIN_TEXTURED_BLOCKS, _MAX_GREY_DIFFERENCE = 6, 1.0
"""If fewer blocks have texture, two pictures are the same if they differ by less than this grey level.
Evidence: none."""
_MIN_CORRELATION = 0.9
"""Normalised correlation of two equal blocks. Evidence: none."""
_MIN_STATIC_RATIO = 0.7
"""Fraction of textured blocks that are equal in two views of a static camera. Evidence:
docs/decisions/check.md."""
_MIN_STEP_S, _MIN_STEP_RATIO = 1.0, 0.125
"""Least time between compared pictures, in seconds and as a fraction of the recording. Pictures closer in
time may be equal: a person may pause or turn slowly."""
_MIN_RUN_PICTURES, _MIN_RUN_STEPS = 3, 2
"""A part of a recording is static if at least this many successive pictures are equal and span this many
steps."""
_MIN_SPAN_RATIO = 0.7
"""Fraction of a recording that pictures must span to decide about all of it. Evidence: none."""


def reduced_picture(image: Image) -> FloatArray:
    """Return a grey picture (H,W) reduced to a grid of blocks, in grey levels."""
    import cv2

    size = (_COLUMNS * _BLOCK_PX, _ROWS * _BLOCK_PX)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.float64)


def static_notes(pictures: Sequence[FloatArray], times_s: FloatArray, length_s: float) -> list[str]:
    """Return a note if pictures do not change; empty otherwise.

    If all pictures are from a short part of a longer recording, the rest is unknown and there is no note.

    Args:
        pictures: Reduced pictures in the order of time.
        times_s: (N,) their times on the common clock.
        length_s: Duration of the recording, seconds.
    """
    same = np.eye(len(pictures), dtype=bool)
    for one, other in combinations(range(len(pictures)), 2):
        same[one, other] = same[other, one] = _is_same_view(pictures[one], pictures[other])
    start, stop = _longest_static_run(same, times_s)
    first, last = times_s[start], times_s[stop]
    step = max(_MIN_STEP_S, _MIN_STEP_RATIO * length_s)
    count = stop - start + 1
    if count == len(pictures) and last - first >= max(step, _MIN_SPAN_RATIO * length_s):
        return [
            "the picture stands still throughout: a frozen recording, or a camera that is not on the body; "
            "it gives no motion, so record it again or leave the camera out"
        ]
    if count < _MIN_RUN_PICTURES or last - first < _MIN_RUN_STEPS * step:
        return []
    return [
        f"the picture stands still from about {first:.1f} to {last:.1f} s ({count} pictures "
        "are equal): does the person stand still, is the recording frozen, or the camera off the body? "
        "start_s and end_s cut it off"
    ]


def _is_same_view(first: FloatArray, second: FloatArray) -> bool:
    """Return True if nearly all textured blocks of two pictures are equal, regardless of the light."""
    (one, one_shows), (other, other_shows) = _blocks(first), _blocks(second)
    shows = np.maximum(one_shows, other_shows) > _MIN_BLOCK_SIGMA
    if shows.sum() < _MIN_TEXTURED_BLOCKS:
        same = bool(np.abs(first - second).max() < _MAX_GREY_DIFFERENCE)
        return same and float(first.std()) > _MIN_BLOCK_SIGMA
    alike = np.mean(one * other, axis=1) > _MIN_CORRELATION * one_shows * other_shows
    return bool(alike[shows].mean() > _MIN_STATIC_RATIO)


def _blocks(picture: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the blocks (B,P) without their mean, and the standard deviation (B,) of each."""
    blocks = picture.reshape(_ROWS, _BLOCK_PX, _COLUMNS, _BLOCK_PX).swapaxes(1, 2).reshape(-1, _BLOCK_PX**2)
    return blocks - blocks.mean(axis=1, keepdims=True), blocks.std(axis=1)


def _longest_static_run(same: BoolArray, times_s: FloatArray) -> tuple[int, int]:
    """Return the first and last index of the successive equal pictures that span the longest time.

    Args:
        same: (N,N) which pictures are equal.
        times_s: (N,) their times.
    """
    runs = [
        (start, stop)
        for start in range(len(same))
        for stop in range(start, len(same))
        if same[start : stop + 1, start : stop + 1].all()
    ]
    return max(runs, key=lambda run: float(times_s[run[1]] - times_s[run[0]]))
