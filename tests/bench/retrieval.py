"""Image retrieval for the peers: VLAD vectors over a vocabulary learnt from the capture itself."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import FloatArray

_WORDS = 64
_SAMPLE = 30_000
_ROUNDS = 12

Descriptors = npt.NDArray[np.uint8]


def similarity(descriptors: Sequence[Descriptors], seed: int) -> FloatArray:
    """Return the similarity (K,K) in [−1, 1] of images with descriptors (N,128) uint8.

    Source: Jégou et al., "Aggregating local descriptors into a compact image representation", CVPR 2010, with
        the per-word normalisation of Arandjelović, Zisserman, "All about VLAD", CVPR 2013.
    """
    words = _vocabulary(descriptors, seed)
    vectors = np.array([_vlad(each, words) for each in descriptors])
    return np.asarray(vectors @ vectors.T, dtype=np.float64)


def _vocabulary(descriptors: Sequence[Descriptors], seed: int) -> npt.NDArray[np.float32]:
    """Cluster a sample of all descriptors into words (W,128)."""
    import cv2

    rng = np.random.default_rng(seed)
    stacked = np.concatenate(list(descriptors))
    picked = rng.choice(len(stacked), min(_SAMPLE, len(stacked)), replace=False)
    sample = stacked[np.sort(picked)].astype(np.float32)
    if len(sample) <= _WORDS:
        return sample
    cv2.setRNGSeed(seed + 1)
    criteria = (cv2.TERM_CRITERIA_MAX_ITER, _ROUNDS, 0.0)
    _, _, centres = cv2.kmeans(sample, _WORDS, None, criteria, 1, cv2.KMEANS_RANDOM_CENTERS)
    return np.asarray(centres, dtype=np.float32)


def _vlad(descriptors: Descriptors, words: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the sum of residuals to the nearest word, normalised per word and as a whole."""
    values = descriptors.astype(np.float32)
    total = np.zeros_like(words)
    if len(values):
        nearest = np.argmax(values @ words.T - 0.5 * (words**2).sum(axis=1), axis=1)
        np.add.at(total, nearest, values - words[nearest])
    total /= np.linalg.norm(total, axis=1, keepdims=True) + 1e-9
    flat = total.ravel()
    return np.asarray(flat / (np.linalg.norm(flat) + 1e-9), dtype=np.float32)
