"""Which keyframes look alike: a match of their largest features alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from bodycap_batch.arrays import IntArray

_LARGEST = 128
"""Features of an image that are looked at. Large ones survive blur and distance; with 64 and the threshold of
`CHANCE` one pair in forty is missed that the full match would hold, with 128 one in a hundred."""
_MAX_RATIO = 0.8
_MAX_ANGLE_RAD = 0.7
_NORM = 512.0
_BLOCK = 32

CHANCE = 4
"""Likeness below which two images share nothing: of pairs that hold, 97 to 99.3 % reach it (walk131, room131
and a rendered walk), of those with 30 matches or more 99.6 to 100 %."""

LIKELY = 6
"""Likeness of which most hold: 96 to 98 % of the pairs that hold have it (92 % on the rendered walk)."""

Descriptors = npt.NDArray[np.uint8]


def largest(descriptors: Descriptors, keypoints: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Descriptors (128,128) of an image's largest features, zeros where it has fewer.

    Args:
        descriptors: (N,128) root-normalised bytes.
        keypoints: (N,4) as `Features` has them.
    """
    out = np.zeros((_LARGEST, 128), dtype=np.float32)
    picked = np.argsort(-keypoints[:, 2], kind="stable")[:_LARGEST]
    out[: len(picked)] = descriptors[picked]
    return out


def likeness(images: Sequence[npt.NDArray[np.float32]], rows: Sequence[int]) -> IntArray:
    """Clear mutual matches among the largest features of some images and all.

    Args:
        images: N images' `largest`.
        rows: R of them.

    Returns:
        (R,N); 0 with itself.

    Source: Wu, "Towards linear-time incremental structure from motion", 3DV 2013 (preemptive matching).
    """
    every = np.array(images, dtype=np.float32).reshape(-1, _LARGEST, 128)
    out = np.zeros((len(rows), len(every)), dtype=np.int64)
    place = {row: number for number, row in enumerate(rows)}
    for number, row in enumerate(rows):
        # A pair of two of these images is looked at once.
        todo = np.array([other for other in range(len(every)) if place.get(other, number + 1) > number])
        for start in range(0, len(todo), _BLOCK):
            some = todo[start : start + _BLOCK]
            alike = every[row] @ every[some].reshape(-1, 128).T
            out[number, some] = _clear(alike.reshape(_LARGEST, len(some), _LARGEST))
        for other in todo.tolist():
            if other in place:
                out[place[other], row] = out[number, other]
    return out


def _clear(alike: npt.NDArray[np.float32]) -> IntArray:
    """Matches (B,) in products (F,B,F) of one image's features with those of B images."""
    features = np.arange(_LARGEST)[:, None]
    others = np.arange(alike.shape[1])[None, :]
    nearest = alike.argmax(axis=2)
    best = alike[features, others, nearest]
    mutual = best >= alike.max(axis=0)[others, nearest]
    alike[features, others, nearest] = -1.0
    angle, next_angle = (np.arccos(np.clip(each / _NORM**2, 0.0, 1.0)) for each in (best, alike.max(axis=2)))
    clear = (angle < _MAX_ANGLE_RAD) & (angle < _MAX_RATIO * next_angle)
    return np.asarray((mutual & clear).sum(axis=0), dtype=np.int64)
