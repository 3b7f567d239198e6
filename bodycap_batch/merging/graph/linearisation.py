"""Least squares around a solution: Jacobians out of GTSAM, and a chain of blocks solved tick by tick."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from bodycap_batch.core.arrays import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class LinearisedGraph:
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
    rhs: FloatArray

    def pose_jacobians(self, factors: IntArray, height: int, keys: Sequence[int]) -> FloatArray:
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

    def sparse_rows(self, factors: IntArray, moved: FloatArray) -> Any:
        """Rows (R,M), sparse, that are `moved` (N,height,M) at the factors (N,) and zero elsewhere."""
        count, height, width = moved.shape
        row = np.repeat((self.first_row[factors][:, None] + np.arange(height)).ravel(), width)
        column = np.tile(np.arange(width), count * height)
        shape = (self.matrix.shape[0], width)
        return sparse.csr_matrix((moved.ravel(), (row, column)), shape=shape)


def linearise(graph: Any, values: Any) -> LinearisedGraph:
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
    return LinearisedGraph(matrix, columns, np.asarray(first_row, dtype=np.int64), right)
