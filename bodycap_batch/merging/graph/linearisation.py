"""The linearised factor graph: the Jacobian and residuals of GTSAM at a solution, as sparse arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from bodycap_batch.core.arrays import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class LinearisedGraph:
    """The whitened Jacobian of a graph at a solution, with robust weights.

    Attributes:
        matrix: (R,C) sparse Jacobian, stored by row (CSR).
        columns: By key, the index of the key's first column.
        first_row: (F+1,) index of each factor's first row, and the number of rows at the end.
        rhs: (R,) right-hand side: the negative residuals.
    """

    matrix: Any
    columns: Mapping[int, int]
    first_row: IntArray
    rhs: FloatArray

    def pose_jacobians(self, factors: IntArray, height: int, keys: Sequence[int]) -> FloatArray:
        """Return the derivatives (N,height,6) of N factors, each with respect to one pose.

        Args:
            factors: (N,) indices of the factors.
            height: Number of rows of each factor.
            keys: N keys of the poses.
        """
        rows = (self.first_row[factors][:, None] + np.arange(height)).ravel()
        start = np.array([self.columns[key] for key in keys], dtype=np.int64)
        entries = self.matrix[rows].tocoo()
        number, line = np.divmod(entries.row, height)
        column = entries.col - start[number]
        inside = (column >= 0) & (column < 6)
        out = np.zeros((len(factors), height, 6))
        out[number[inside], line[inside], column[inside]] = entries.data[inside]
        return out

    def sparse_rows(self, factors: IntArray, values: FloatArray) -> Any:
        """Return a sparse matrix (R,M) with values in the rows of some factors, and zeros elsewhere.

        Args:
            factors: (N,) indices of the factors.
            values: (N,height,M) values in the rows of these factors.
        """
        count, height, width = values.shape
        row = np.repeat((self.first_row[factors][:, None] + np.arange(height)).ravel(), width)
        column = np.tile(np.arange(width), count * height)
        shape = (self.matrix.shape[0], width)
        return sparse.csr_matrix((values.ravel(), (row, column)), shape=shape)


def linearise(graph: Any, values: Any) -> LinearisedGraph:
    """Linearise all factors of a graph at the given values."""
    first_row = np.cumsum([0, *(graph.at(index).dim() for index in range(graph.size()))])
    sizes = values.zeroVectors()
    columns, count = {}, 0
    for key in sorted(int(key) for key in values.keys()):  # noqa: SIM118 - GTSAM's Values is no mapping
        columns[key] = count
        count += len(sizes.at(key))
    row, column, entry = graph.linearize(values).sparseJacobian_()
    in_matrix = column <= count
    position = (row[in_matrix].astype(np.int64) - 1, column[in_matrix].astype(np.int64) - 1)
    matrix = sparse.csr_matrix((entry[in_matrix], position), shape=(int(first_row[-1]), count))
    rhs = np.zeros(matrix.shape[0])
    rhs[row[~in_matrix].astype(np.int64) - 1] = entry[~in_matrix]
    return LinearisedGraph(matrix, columns, np.asarray(first_row, dtype=np.int64), rhs)
