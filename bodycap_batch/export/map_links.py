"""Measure how well the parts of a map hold together: the weakest link between two parts."""

from __future__ import annotations

from typing import Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray

_MIN_SIDE = 3
"""Minimum number of keyframes on each side of a link. Fewer keyframes are the end of a path."""
_DENSE = 400
"""Number of keyframes up to which all eigenvectors are computed: the time is less than 0.1 s."""


def weakest_link(point: IntArray, keyframe: IntArray) -> float | None:
    """Return the share of the common points that hold the two most loosely connected parts of a map together.

    Two keyframes are linked by the number of points that both see. A cut of the keyframes into two parts has
    a conductance: the links between the parts, divided by all links of the part with fewer links. Parts that
    were joined by few matches have a small one, and their relative pose can be wrong although the
    reprojection error is small. The cut is found in the order of the second eigenvector of the normalised
    links.

    Args:
        point: (M,) index of the point of each observation.
        keyframe: (M,) index of the keyframe of each observation.

    Returns:
        The smallest conductance, from 0 to 1; None if the map has fewer than six keyframes.

    Source: Shi and Malik, Normalized cuts and image segmentation (2000).
    """
    from scipy.sparse import csr_array, diags_array

    used, keyframe = np.unique(keyframe, return_inverse=True)
    if len(used) < 2 * _MIN_SIDE:
        return None
    seen = csr_array((np.ones(len(point)), (point, keyframe)), shape=(point.max() + 1, len(used)))
    seen.data[:] = 1.0  # a keyframe can see a point twice
    links = (seen.T @ seen).tocsr()
    links = links - diags_array(links.diagonal())
    degree: FloatArray = np.asarray(links.sum(axis=1)).ravel()
    root = 1.0 / np.sqrt(np.maximum(degree, 1.0))
    normalised = diags_array(root) @ links @ diags_array(root)
    order = np.argsort(root * _second_eigenvector(normalised), kind="stable")
    ordered = links[order][:, order].tocoo()
    # A link (i, j) crosses every cut between the places of i and j in the order.
    first, last = np.minimum(ordered.row, ordered.col), np.maximum(ordered.row, ordered.col)
    steps = np.zeros(len(used) + 1)
    np.add.at(steps, first + 1, ordered.data / 2.0)
    np.add.at(steps, last + 1, -ordered.data / 2.0)
    crossing, before = np.cumsum(steps)[:-1], np.concatenate([[0.0], np.cumsum(degree[order])[:-1]])
    smaller = np.minimum(before, degree.sum() - before)
    cuts = np.arange(_MIN_SIDE, len(used) - _MIN_SIDE + 1)
    # A part without any link to another keyframe is not held by anything.
    shares = np.where(smaller > 0.0, crossing / np.maximum(smaller, 1.0), 0.0)
    return round(float(shares[cuts].min()), 4)


def _second_eigenvector(normalised: Any) -> FloatArray:
    """Return the eigenvector (K,) of the second largest eigenvalue of a sparse symmetric matrix (K,K)."""
    count = normalised.shape[0]
    if count <= _DENSE:
        return np.asarray(np.linalg.eigh(normalised.toarray())[1][:, -2])
    from scipy.sparse.linalg import eigsh

    # A fixed start makes equal maps give equal results.
    values, vectors = eigsh(normalised, k=2, which="LA", v0=np.linspace(1.0, 2.0, count))
    return np.asarray(vectors[:, int(np.argmin(values))])
