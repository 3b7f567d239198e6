"""Which keyframes look alike: a match of their largest features alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import BoolArray, IntArray
from bodycap_batch.core.context import StageContext

RETRIEVAL_FEATURES = 128
"""Features of an image that are looked at. Large ones survive blur and distance; with 64 and the threshold of
`MIN_RETRIEVAL_MATCHES` one pair in forty is missed that the full match would hold, with 128 one in a hundred."""
_MAX_RATIO = 0.8
_MAX_ANGLE_RAD = 0.7
_NORM = 512.0
_BLOCK_SIZE = 32
_VISUAL_WORDS = 64
_SHORTLIST_SIZE = 128
_SHORTLIST_SIZE_PER_CAMERA = 24
"""Images that are looked at closely, of all and of each camera: two and three times what may be matched. On
walk131 (288 keyframes, 48 % of the pairs looked at) 96 % as many of the chosen pairs hold as when all are;
with 96 and 16 91 %, with 64 and 16 80 %. Pooling and ranking cost a hundredth of looking."""
_QUANTISATION_STEPS = 2048.0
"""Of a pooled feature's unit vector: products stay below 2^23, which a float32 holds exactly."""
_EPSILON = 1e-9

MIN_RETRIEVAL_MATCHES = 4
"""Likeness below which two images share nothing: of pairs that hold, 97 to 99.3 % reach it (walk131, room131
and a rendered walk), of those with 30 matches or more 99.6 to 100 %."""

LIKELY_RETRIEVAL_MATCHES = 6
"""Likeness of which most hold: 96 to 98 % of the pairs that hold have it (92 % on the rendered walk)."""

Descriptors = npt.NDArray[np.uint8]


def largest_descriptors(
    descriptors: Descriptors, keypoints: npt.NDArray[np.float32]
) -> npt.NDArray[np.float32]:
    """Descriptors (128,128) of an image's largest features, zeros where it has fewer.

    Args:
        descriptors: (N,128) root-normalised bytes.
        keypoints: (N,4) as `Features` has them.
    """
    out = np.zeros((RETRIEVAL_FEATURES, 128), dtype=np.float32)
    picked = np.argsort(-keypoints[:, 2], kind="stable")[:RETRIEVAL_FEATURES]
    out[: len(picked)] = descriptors[picked]
    return out


def count_preemptive_matches(
    images: npt.NDArray[np.float32], rows: Sequence[int], cameras: Sequence[str], context: StageContext
) -> npt.NDArray[np.int16]:
    """Clear mutual matches among the largest features of some images and those that could be alike.

    Args:
        images: (N,128,128) `largest_descriptors` of every image.
        rows: R of them.
        cameras: N images' cameras.
        context: Threads (what is found is the same with any number of them), progress, cancellation.

    Returns:
        (R,N); 0 with itself and with those whose pooled features already say that others are more alike.

    Source: Wu, "Towards linear-time incremental structure from motion", 3DV 2013 (preemptive matching).
    """
    short = _vlad_shortlists(_vlad_descriptors(images), rows, np.array(cameras), context)
    out = np.zeros((len(rows), len(images)), dtype=np.int16)
    place = {row: number for number, row in enumerate(rows)}
    todo = _images_to_compare(short, rows, place)

    def work(number: int) -> IntArray:
        context.check_cancelled()
        return count_ratio_test_matches(images[rows[number]], images[todo[number]])

    with ThreadPoolExecutor(context.threads) as pool:
        for number, found in enumerate(pool.map(work, range(len(rows)))):
            context.progress(number, len(rows), "keyframes compared")
            out[number, todo[number]] = found
            for other, count in zip(todo[number].tolist(), found.tolist(), strict=True):
                if other in place:
                    out[place[other], rows[number]] = count
    return out


def _images_to_compare(short: BoolArray, rows: Sequence[int], place: Mapping[int, int]) -> list[IntArray]:
    """For each of the rows the images it is held against: a pair of two of them is looked at once."""
    left = short.copy()
    for number, row in enumerate(rows):
        listed = np.flatnonzero(left[number]).tolist()
        done = (other for other in listed if place.get(other, number) < number)
        left[number, [row, *(other for other in done if left[place[other], row])]] = False
    return [np.flatnonzero(each) for each in left]


def count_ratio_test_matches(image: npt.NDArray[np.float32], others: npt.NDArray[np.float32]) -> IntArray:
    """Clear mutual matches (K,) of an image's `largest_descriptors` features with those (K,F,128) of some others."""
    parts = [np.zeros(0, dtype=np.int64)]
    for start in range(0, len(others), _BLOCK_SIZE):
        some = others[start : start + _BLOCK_SIZE]
        alike = image @ some.reshape(-1, 128).T
        parts.append(_count_matches(alike.reshape(RETRIEVAL_FEATURES, len(some), RETRIEVAL_FEATURES)))
    return np.concatenate(parts)


def _vlad_shortlists(
    pooled: npt.NDArray[np.float32],
    rows: Sequence[int],
    cameras: npt.NDArray[np.str_],
    context: StageContext,
) -> BoolArray:
    """(R,N) the most alike of all images, and of each camera's, for each of the rows."""
    out = np.zeros((len(rows), len(pooled)), dtype=bool)
    groups = [np.flatnonzero(cameras == name) for name in np.unique(cameras)]
    # Whole numbers, whose sums are exact: the last digits of a sum of floats depend on the machine.
    whole = np.round(_QUANTISATION_STEPS * pooled)
    for start in range(0, len(rows), _BLOCK_SIZE):
        context.check_cancelled()
        for number, far in enumerate(-whole[rows[start : start + _BLOCK_SIZE]] @ whole.T, start):
            out[number, np.argsort(far, kind="stable")[:_SHORTLIST_SIZE]] = True
            for group in groups:
                out[number, group[np.argsort(far[group], kind="stable")[:_SHORTLIST_SIZE_PER_CAMERA]]] = True
    return out


def _vlad_descriptors(every: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """One unit vector (N,D) an image: its features' differences from the nearest of some words, added up.

    The words are features of the images themselves, evenly spaced among them.

    Source: Jégou et al., "Aggregating local descriptors into a compact image representation", CVPR 2010, with
        the normalisation of each word of Arandjelović, Zisserman, "All about VLAD", CVPR 2013.
    """
    flat = every.reshape(-1, 128)
    there = np.flatnonzero(flat.any(axis=1))
    if len(there) == 0:
        return np.zeros((len(every), 128), dtype=np.float32)
    words = flat[there[np.linspace(0, len(there) - 1, _VISUAL_WORDS).astype(int)]]
    out = np.zeros((len(every), *words.shape), dtype=np.float32)
    for image, features in zip(out, every, strict=True):
        mine = features[features.any(axis=1)]
        nearest = (mine @ words.T).argmax(axis=1)
        np.add.at(image, nearest, mine - words[nearest])
    out /= np.linalg.norm(out, axis=2, keepdims=True) + _EPSILON
    flat = out.reshape(len(every), -1)
    return np.asarray(flat / (np.linalg.norm(flat, axis=1, keepdims=True) + _EPSILON), dtype=np.float32)


def _count_matches(alike: npt.NDArray[np.float32]) -> IntArray:
    """Matches (B,) in products (F,B,F) of one image's features with those of B images."""
    features = np.arange(RETRIEVAL_FEATURES)[:, None]
    others = np.arange(alike.shape[1])[None, :]
    nearest = alike.argmax(axis=2)
    best = alike[features, others, nearest]
    mutual = best >= alike.max(axis=0)[others, nearest]
    alike[features, others, nearest] = -1.0
    angle, next_angle = (np.arccos(np.clip(each / _NORM**2, 0.0, 1.0)) for each in (best, alike.max(axis=2)))
    clear = (angle < _MAX_ANGLE_RAD) & (angle < _MAX_RATIO * next_angle)
    return np.asarray((mutual & clear).sum(axis=0), dtype=np.int64)
