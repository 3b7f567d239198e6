"""A picture that stands still: the recording is frozen, or nobody wears the camera."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from bodycap_batch.arrays import BoolArray, FloatArray
from bodycap_batch.capture.images import Image

_COLUMNS, _ROWS, _BLOCK_PX = 8, 6, 8
_LEAST_CONTRAST = 3.0
"""Grey levels, as a standard deviation, below which a block shows nothing that could be seen to move."""
_LEAST_BLOCKS, _SAME = 6, 1.0
"""With fewer blocks that show something, pictures are alike where they are the same to a grey level."""
_ALIKE = 0.9
_STILL_SHARE = 0.7
"""Of the blocks that show something. Pictures an eighth of a recording apart: at most 0.11 with 15 worn
cameras of five captures, 1.0 with a frozen picture and a camera on a table, sensor noise and all."""
_LEAST_RUN = 3


def outline(image: Image) -> FloatArray:
    """What a grey picture (H,W) shows, coarsely: (R,C) grey levels, of blocks one after the other."""
    import cv2

    size = (_COLUMNS * _BLOCK_PX, _ROWS * _BLOCK_PX)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.float64)


def standing_still(outlines: Sequence[FloatArray], times_s: FloatArray) -> list[str]:
    """Tell of pictures that do not move, if there are any.

    Args:
        outlines: Of pictures in the order of time.
        times_s: (N,) when they were taken, on the common clock.
    """
    same = np.array([_alike(*pair) for pair in pairwise(outlines)], dtype=bool)
    if len(same) and same.all():
        return [
            "the picture stands still throughout: a frozen recording, or a camera that nobody wears; nothing "
            "can be solved from it, record it again or leave the camera out"
        ]
    start, stop = _longest(same)
    if stop - start + 1 < _LEAST_RUN:
        return []
    first, last = times_s[start], times_s[stop]
    return [
        f"the picture stands still from about {first:.1f} to {last:.1f} s ({stop - start + 1} pictures "
        "looked at are alike): does the person stand still, is the recording frozen, or the camera off? "
        "start_s and end_s cut it off"
    ]


def _alike(first: FloatArray, second: FloatArray) -> bool:
    """Whether nearly all that two pictures show is at the same place in both, in whatever light."""
    (one, one_shows), (other, other_shows) = _blocks(first), _blocks(second)
    shows = np.maximum(one_shows, other_shows) > _LEAST_CONTRAST
    if shows.sum() < _LEAST_BLOCKS:
        same = bool(np.abs(first - second).max() < _SAME)
        return same and float(first.std()) > _LEAST_CONTRAST
    alike = np.mean(one * other, axis=1) > _ALIKE * one_shows * other_shows
    return bool(alike[shows].mean() > _STILL_SHARE)


def _blocks(picture: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Blocks (B,P) of mean zero, and the standard deviation (B,) of each."""
    cut = picture.reshape(_ROWS, _BLOCK_PX, _COLUMNS, _BLOCK_PX).swapaxes(1, 2).reshape(-1, _BLOCK_PX**2)
    return cut - cut.mean(axis=1, keepdims=True), cut.std(axis=1)


def _longest(same: BoolArray) -> tuple[int, int]:
    """First and last picture of the longest run of alike ones; twice the same where there is none."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(int)))
    runs = [(0, 0), *zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)]
    return max(runs, key=lambda run: run[1] - run[0])
