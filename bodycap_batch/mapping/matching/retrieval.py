"""Retrieve keyframes that show the same: match their largest features alone, among shortlisted pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import BoolArray, IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping.matching.descriptors import (
    DESCRIPTOR_NORM,
    MAX_MATCH_ANGLE_RAD,
    MAX_RATIO,
    ByteDescriptors,
)

RETRIEVAL_FEATURES = 128
"""Features of an image that retrieval matches: the largest ones, which survive blur and distance.
Evidence: docs/decisions/mapping.md."""
_BLOCK_SIZE = 32
"""Images that one matrix product compares; limits memory only."""
_VISUAL_WORDS = 64
"""Visual words of a VLAD descriptor. Evidence: none."""
_SHORTLIST_SIZE = 128
"""Images whose features are matched with those of one image, by VLAD similarity among all images: twice as
many as pair selection takes at most. Evidence: docs/decisions/mapping.md."""
_SHORTLIST_SIZE_PER_CAMERA = 24
"""The same among the images of each camera: three times as many as pair selection takes.
Evidence: docs/decisions/mapping.md."""
_QUANTISATION_STEPS = 2048.0
"""Steps that a component of a unit VLAD vector is rounded to. Sums of products stay below 2^23, which a
float32 holds exactly."""
_EPSILON = 1e-9
"""Added to a norm so that the division is defined for a zero vector."""

MIN_RETRIEVAL_MATCHES = 4
"""Matches below which two images are taken to share nothing. Evidence: docs/decisions/mapping.md."""

LIKELY_RETRIEVAL_MATCHES = 6
"""Matches that nearly all pairs have which verification accepts. Evidence: docs/decisions/mapping.md."""


def largest_descriptors(
    descriptors: ByteDescriptors, keypoints: npt.NDArray[np.float32]
) -> npt.NDArray[np.float32]:
    """Return the descriptors (128,128) of an image's largest features, padded with zeros.

    Args:
        descriptors: (N,128) root-normalised bytes.
        keypoints: (N,4) as in `SiftFeatures`.
    """
    out = np.zeros((RETRIEVAL_FEATURES, 128), dtype=np.float32)
    picked = np.argsort(-keypoints[:, 2], kind="stable")[:RETRIEVAL_FEATURES]
    out[: len(picked)] = descriptors[picked]
    return out


def count_preemptive_matches(
    images: npt.NDArray[np.float32], rows: Sequence[int], cameras: Sequence[str], context: StageContext
) -> npt.NDArray[np.int16]:
    """Count the mutual matches among the largest features of some images and the images on their shortlists.

    Args:
        images: (N,128,128) `largest_descriptors` of every image.
        rows: R rows of `images`.
        cameras: Camera name of each of the N images.
        context: Threads, progress, cancellation. The result does not depend on the number of threads.

    Returns:
        (R,N) number of matches; 0 of an image with itself and with images that are not on its shortlist.

    Source: Wu, "Towards linear-time incremental structure from motion", 3DV 2013 (preemptive matching).
    """
    shortlists = _vlad_shortlists(_vlad_descriptors(images), rows, np.array(cameras), context)
    out = np.zeros((len(rows), len(images)), dtype=np.int16)
    number_of_row = {row: number for number, row in enumerate(rows)}
    partners = _images_to_compare(shortlists, rows, number_of_row)

    def work(number: int) -> IntArray:
        context.check_cancelled()
        return count_ratio_test_matches(images[rows[number]], images[partners[number]])

    with ThreadPoolExecutor(context.threads) as pool:
        for number, counts in enumerate(pool.map(work, range(len(rows)))):
            context.progress(number, len(rows), "keyframes compared")
            out[number, partners[number]] = counts
            for other, count in zip(partners[number].tolist(), counts.tolist(), strict=True):
                if other in number_of_row:
                    out[number_of_row[other], rows[number]] = count
    return out


def _images_to_compare(
    shortlists: BoolArray, rows: Sequence[int], number_of_row: Mapping[int, int]
) -> list[IntArray]:
    """Return the images to compare with each of the rows; a pair of two rows is compared once."""
    left = shortlists.copy()
    for number, row in enumerate(rows):
        listed = np.flatnonzero(left[number]).tolist()
        earlier = (other for other in listed if number_of_row.get(other, number) < number)
        done = (other for other in earlier if left[number_of_row[other], row])
        left[number, [row, *done]] = False
    return [np.flatnonzero(partners) for partners in left]


def count_ratio_test_matches(image: npt.NDArray[np.float32], others: npt.NDArray[np.float32]) -> IntArray:
    """Count the mutual matches (K,) that pass the ratio test, of one image with each of K others.

    Args:
        image: (128,128) `largest_descriptors` of the image.
        others: (K,128,128) those of the other images.
    """
    parts = [np.zeros(0, dtype=np.int64)]
    for start in range(0, len(others), _BLOCK_SIZE):
        block = others[start : start + _BLOCK_SIZE]
        products = image @ block.reshape(-1, 128).T
        parts.append(_count_matches(products.reshape(RETRIEVAL_FEATURES, len(block), RETRIEVAL_FEATURES)))
    return np.concatenate(parts)


def _vlad_shortlists(
    vlad: npt.NDArray[np.float32],
    rows: Sequence[int],
    cameras: npt.NDArray[np.str_],
    context: StageContext,
) -> BoolArray:
    """Return a mask (R,N): the most similar of all images and of each camera's images, for each of R rows."""
    out = np.zeros((len(rows), len(vlad)), dtype=bool)
    groups = [np.flatnonzero(cameras == name) for name in np.unique(cameras)]
    # Sums of whole numbers are exact. The last digits of a sum of other floats depend on the machine.
    whole = np.round(_QUANTISATION_STEPS * vlad)
    for start in range(0, len(rows), _BLOCK_SIZE):
        context.check_cancelled()
        for number, distance in enumerate(-whole[rows[start : start + _BLOCK_SIZE]] @ whole.T, start):
            out[number, np.argsort(distance, kind="stable")[:_SHORTLIST_SIZE]] = True
            for group in groups:
                nearest = np.argsort(distance[group], kind="stable")[:_SHORTLIST_SIZE_PER_CAMERA]
                out[number, group[nearest]] = True
    return out


def _vlad_descriptors(images: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return a VLAD descriptor (N,D) of each image: a unit vector.

    It adds up the differences of the features from their nearest visual words. The words are evenly spaced
    among the features of the images themselves.

    Args:
        images: (N,128,128) `largest_descriptors` of every image.

    Source: Jégou et al., "Aggregating local descriptors into a compact image representation", CVPR 2010, with
        the normalisation of each word of Arandjelović, Zisserman, "All about VLAD", CVPR 2013.
    """
    flat = images.reshape(-1, 128)
    existing = np.flatnonzero(flat.any(axis=1))
    if len(existing) == 0:
        return np.zeros((len(images), 128), dtype=np.float32)
    words = flat[existing[np.linspace(0, len(existing) - 1, _VISUAL_WORDS).astype(int)]]
    out = np.zeros((len(images), *words.shape), dtype=np.float32)
    for vlad, padded in zip(out, images, strict=True):
        features = padded[padded.any(axis=1)]
        nearest = (features @ words.T).argmax(axis=1)
        np.add.at(vlad, nearest, features - words[nearest])
    out /= np.linalg.norm(out, axis=2, keepdims=True) + _EPSILON
    flat = out.reshape(len(images), -1)
    return np.asarray(flat / (np.linalg.norm(flat, axis=1, keepdims=True) + _EPSILON), dtype=np.float32)


def _count_matches(products: npt.NDArray[np.float32]) -> IntArray:
    """Count the matches (B,) in the scalar products (F,B,F) of one image's features with those of B images.

    The products are changed.
    """
    features = np.arange(RETRIEVAL_FEATURES)[:, None]
    others = np.arange(products.shape[1])[None, :]
    nearest = products.argmax(axis=2)
    best = products[features, others, nearest]
    mutual = best >= products.max(axis=0)[others, nearest]
    products[features, others, nearest] = -1.0
    angle, next_angle = (
        np.arccos(np.clip(product / DESCRIPTOR_NORM**2, 0.0, 1.0)) for product in (best, products.max(axis=2))
    )
    clear = (angle < MAX_MATCH_ANGLE_RAD) & (angle < MAX_RATIO * next_angle)
    return np.asarray((mutual & clear).sum(axis=0), dtype=np.int64)
