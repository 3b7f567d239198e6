"""Least squares around a solution: Jacobians out of GTSAM, and a chain of blocks solved tick by tick."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.linalg.lapack import dpotrf, dtrtrs

from bodycap_batch.arrays import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Linear:
    """A graph's whitened Jacobian at a solution, robust weights included.

    Attributes:
        matrix: (R,C) sparse rows, C-contiguous by row (CSR).
        columns: First column of each key.
        first_row: (F+1,) first row of each factor, the number of rows last.
        right: (R,) right-hand side: what the residuals lack to zero.
    """

    matrix: Any
    columns: Mapping[int, int]
    first_row: IntArray
    right: FloatArray

    def blocks(self, factors: IntArray, height: int, keys: Sequence[int]) -> FloatArray:
        """Dense (N,height,6) derivatives of the factors (N,), each of that height, by one pose each."""
        wanted = (self.first_row[factors][:, None] + np.arange(height)).ravel()
        start = np.array([self.columns[key] for key in keys], dtype=np.int64)
        picked = self.matrix[wanted].tocoo()
        which, line = np.divmod(picked.row, height)
        column = picked.col - start[which]
        inside = (column >= 0) & (column < 6)
        out = np.zeros((len(factors), height, 6))
        out[which[inside], line[inside], column[inside]] = picked.data[inside]
        return out

    def shifts(self, factors: IntArray, moved: FloatArray) -> Any:
        """Rows (R,M), sparse, that are `moved` (N,height,M) at the factors (N,) and zero elsewhere."""
        count, height, width = moved.shape
        row = np.repeat((self.first_row[factors][:, None] + np.arange(height)).ravel(), width)
        column = np.tile(np.arange(width), count * height)
        shape = (self.matrix.shape[0], width)
        return sparse.csr_matrix((moved.ravel(), (row, column)), shape=shape)


def linearise(graph: Any, values: Any) -> Linear:
    """Take the derivatives of all factors at `values`."""
    first_row = np.cumsum([0, *(graph.at(index).dim() for index in range(graph.size()))])
    sizes = values.zeroVectors()
    columns, count = {}, 0
    for key in sorted(int(key) for key in values.keys()):  # noqa: SIM118 - GTSAM's Values is no mapping
        columns[key] = count
        count += len(sizes.at(key))
    row, column, entry = graph.linearize(values).sparseJacobian_()
    kept = column <= count
    place = (row[kept].astype(np.int64) - 1, column[kept].astype(np.int64) - 1)
    matrix = sparse.csr_matrix((entry[kept], place), shape=(int(first_row[-1]), count))
    right = np.zeros(matrix.shape[0])
    right[row[~kept].astype(np.int64) - 1] = entry[~kept]
    return Linear(matrix, columns, np.asarray(first_row, dtype=np.int64), right)


def _factor(matrix: FloatArray) -> FloatArray:
    """Lower Cholesky factor of a small block; LAPACK itself, whose wrapper takes longer than the block."""
    lower, failed = dpotrf(matrix, lower=1)
    if failed:
        raise np.linalg.LinAlgError(f"not positive definite at {failed}")
    return np.asarray(lower)


def _solve(lower: FloatArray, right: FloatArray, *, transposed: bool = False) -> FloatArray:
    """Solve with a lower factor, or with its transpose."""
    if not right.size:
        return np.zeros_like(right)
    found, _ = dtrtrs(lower, right, lower=1, trans=int(transposed))
    return np.asarray(found)


class Chain:
    """Normal equations whose unknowns are linked within a block and with the next block only.

    Args:
        information: (C,C) sparse, symmetric.
        order: (C,) its columns block by block.
        bounds: (K+1,) where each block begins in `order`.

    Source: block-tridiagonal Cholesky factorisation; its way back is the Rauch-Tung-Striebel smoother.
    """

    def __init__(self, information: Any, order: IntArray, bounds: IntArray) -> None:
        self._order, self._bounds = order, bounds.tolist()
        ordered = information.tocsr()[order].tocsc()[:, order].tocsr()
        self._lower: list[FloatArray] = []
        self._links: list[FloatArray] = []
        carried: FloatArray | None = None
        for block, (start, end) in enumerate(zip(self._bounds[:-1], self._bounds[1:], strict=True)):
            after = self._bounds[min(block + 2, len(self._bounds) - 1)]
            dense = ordered[start:end, start:after].toarray()
            own = dense[:, : end - start] if carried is None else dense[:, : end - start] - carried
            lower = _factor(own)
            link = _solve(lower, dense[:, end - start :])
            carried = link.T @ link
            self._lower.append(lower)
            self._links.append(link)

    def solve(self, right: FloatArray) -> list[FloatArray]:
        """Solve for right-hand sides (C,M); the answer (n,M) of each block."""
        right = right[self._order]
        below: list[FloatArray] = []
        for block, lower in enumerate(self._lower):
            own = right[self._bounds[block] : self._bounds[block + 1]]
            if below:
                own = own - self._links[block - 1].T @ below[-1]
            below.append(_solve(lower, own))
        out: list[FloatArray] = []
        for lower, link, own in zip(self._lower[::-1], self._links[::-1], below[::-1], strict=True):
            known = own - link @ out[-1] if out else own
            out.append(_solve(lower, known, transposed=True))
        return out[::-1]

    def covariances(self, read: Callable[[int, FloatArray], None]) -> None:
        """Hand out each block's marginal covariance (n,n), the last block's first."""
        later: FloatArray | None = None
        for block in range(len(self._lower) - 1, -1, -1):
            lower, link = self._lower[block], self._links[block]
            spread = np.eye(len(lower)) if later is None else np.eye(len(lower)) + link @ later @ link.T
            half = _solve(lower, spread, transposed=True)
            covariance = _solve(lower, half.T, transposed=True)
            later = 0.5 * (covariance + covariance.T)
            read(block, later)
