"""Find keyframes that show the same part of the room.

Each image is compared only with the images on its shortlist, and only the largest features are matched.
"""

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
"""Maximum number of features of an image that retrieval matches. The largest features are used, because they
are still detected in blurred images and from a distance. Evidence: docs/decisions/mapping.md."""
_BLOCK_SIZE = 32
"""Number of images that one matrix product compares. A larger number needs more memory; the result is the
same."""
_VISUAL_WORDS = 64
"""Number of visual words of a VLAD descriptor. Evidence: none."""
_SHORTLIST_SIZE = 128
"""Number of images on the shortlist of an image: the most similar images of all cameras by VLAD descriptor.
It is twice the maximum number of retrieved partners in pair selection.
Evidence: docs/decisions/mapping.md."""
_SHORTLIST_SIZE_PER_CAMERA = 24
"""Number of images of each camera that are always on the shortlist of an image: of each camera, the most
similar images. It is three times the number of retrieved partners of each camera in pair selection.
Evidence: docs/decisions/mapping.md."""
_QUANTISATION_STEPS = 2048.0
"""Number of rounding steps between 0 and 1. Each component of a unit VLAD vector is rounded to a whole number
of steps. Scalar products of the rounded vectors stay below 2^23, so float32 computes them exactly."""
_EPSILON = 1e-9
"""Small number that is added to a norm, so that a division by the norm of a zero vector is defined."""

MIN_RETRIEVAL_MATCHES = 4
"""Minimum number of matches of two similar images. Two images with fewer matches are treated as unrelated.
Evidence: docs/decisions/mapping.md."""

LIKELY_RETRIEVAL_MATCHES = 6
"""Minimum number of matches of two images that probably pass verification. Nearly all verified pairs have at
least this number of matches. Evidence: docs/decisions/mapping.md."""


def largest_descriptors(
    descriptors: ByteDescriptors, keypoints: npt.NDArray[np.float32]
) -> npt.NDArray[np.float32]:
    """Return the descriptors (128,128) of an image's 128 largest features, padded with rows of zeros.

    Args:
        descriptors: (N,128) root-normalised descriptors as bytes.
        keypoints: (N,4) keypoints of the same features (`SiftFeatures.keypoints`).
    """
    out = np.zeros((RETRIEVAL_FEATURES, 128), dtype=np.float32)
    picked = np.argsort(-keypoints[:, 2], kind="stable")[:RETRIEVAL_FEATURES]
    out[: len(picked)] = descriptors[picked]
    return out


def count_preemptive_matches(
    images: npt.NDArray[np.float32], rows: Sequence[int], cameras: Sequence[str], context: StageContext
) -> npt.NDArray[np.int16]:
    """Count the mutual matches of some images with the images on their shortlists.

    Only the largest features of each image are matched.

    Args:
        images: (N,128,128) `largest_descriptors` of every image.
        rows: Indices of the R images to compare with others.
        cameras: Camera name of each of the N images.
        context: Threads, progress, cancellation. The result does not depend on the number of threads.

    Returns:
        (R,N) number of matches of each of the R images with each of the N images. The number is 0 for images
        that were not compared, and for each image with itself.

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
    """Return, for each of R images, the indices of the images to compare with it.

    If two of the R images are on each other's shortlists, their pair is compared only once.

    Args:
        shortlists: (R,N) True if image n is on the shortlist.
        rows: Indices of the R images.
        number_of_row: Position of an image in `rows`, by image index.
    """
    left = shortlists.copy()
    for number, row in enumerate(rows):
        listed = np.flatnonzero(left[number]).tolist()
        earlier = (other for other in listed if number_of_row.get(other, number) < number)
        done = (other for other in earlier if left[number_of_row[other], row])
        left[number, [row, *done]] = False
    return [np.flatnonzero(partners) for partners in left]


def count_ratio_test_matches(image: npt.NDArray[np.float32], others: npt.NDArray[np.float32]) -> IntArray:
    """Return the number (K,) of matches of one image with each of K other images.

    Two features match if each is the nearest feature of the other one and they pass the ratio test.

    Args:
        image: (128,128) `largest_descriptors` of the image.
        others: (K,128,128) `largest_descriptors` of the other images.
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
    """Return the shortlists of R images as a mask (R,N), True if image n is on the shortlist.

    A shortlist holds the most similar images of all cameras and the most similar images of each camera.

    Args:
        vlad: (N,D) VLAD descriptor of every image.
        rows: Indices of the R images.
        cameras: (N,) camera name of every image.
        context: Cancellation.
    """
    out = np.zeros((len(rows), len(vlad)), dtype=bool)
    groups = [np.flatnonzero(cameras == name) for name in np.unique(cameras)]
    # Float sums of these whole numbers are exact. Without rounding, the last digits of the sums would depend
    # on the machine.
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
    """Return the VLAD descriptors (N,D) of N images, unit vectors.

    A VLAD descriptor has one part for each visual word: the sum of the differences between the word and the
    image's features that are nearest to this word. The visual words are features of the images, taken at
    even spacing from the features of all images.

    Args:
        images: (N,128,128) `largest_descriptors` of every image.

    Source: Jégou et al., "Aggregating local descriptors into a compact image representation", CVPR 2010, with
        the normalisation of each word's sum by Arandjelović, Zisserman, "All about VLAD", CVPR 2013.
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
    """Return the number (B,) of matches of one image with each of B images.

    Args:
        products: (F,B,F) scalar products of the image's F descriptors with the F descriptors of each of the
            B images; changed in place.
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
