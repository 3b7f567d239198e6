"""Solver for symmetric positive definite block-tridiagonal systems, with the marginals of the inverse.

Such systems are the normal equations of problems along time: the unknowns of one block are coupled with each
other and with those of the next block only. Time and memory grow linearly with the number of blocks.

Source: block-tridiagonal Cholesky factorisation. Its way back for the inverse is the smoother of H. E. Rauch,
F. Tung, C. T. Striebel, "Maximum likelihood estimates of linear dynamic systems", AIAA Journal 3, 1965.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtrs

from bodycap_batch.core.arrays import FloatArray, IntArray

_FACTOR_BYTES = 1e7
"""Memory, in bytes, of the factors that are kept: those of 50 ticks with nine bones. With three times as
much, the solver took 20 MB more and was not faster."""


class _BlockRow(NamedTuple):
    """The upper triangle of one row of blocks.

    Attributes:
        diagonal: (n,n) block on the diagonal.
        coupling: (n,m) block right of it; m is 0 in the last row.
    """

    diagonal: FloatArray
    coupling: FloatArray


class _Factor(NamedTuple):
    """One row of blocks of the Cholesky factor.

    Attributes:
        lower: (n,n) lower triangular.
        link: (n,m) coupling with the next block, divided by `lower`.
    """

    lower: FloatArray
    link: FloatArray


def _cholesky(matrix: FloatArray) -> FloatArray:
    """Return the lower Cholesky factor of a small matrix.

    It calls LAPACK itself, because numpy's wrapper takes longer than the factorisation.

    Raises:
        LinAlgError: The matrix is not positive definite.
    """
    lower: FloatArray
    lower, failed = dpotrf(matrix, lower=1)
    if failed:
        raise np.linalg.LinAlgError(f"not positive definite at {failed}")
    return lower


def _solve_triangular(lower: FloatArray, rhs: FloatArray, *, transposed: bool = False) -> FloatArray:
    """Solve with a lower triangular matrix, or with its transpose."""
    if not rhs.size:
        return np.zeros_like(rhs)
    solution: FloatArray = dtrtrs(lower, rhs, 1, int(transposed))[0]
    return solution


class BlockTridiagonal:
    """A symmetric positive definite block-tridiagonal matrix, factorised.

    The factors are dense, even if the matrix is sparse. Of a long one, only the factors of some successive
    blocks are kept; those of others are computed again when they are needed.

    Args:
        block_row: Returns the blocks of a row by its number.
        bounds: (K+1,) first unknown of each block in the order of the blocks, and the number of unknowns.
        order: (C,) the unknown of the caller at each position in the order of the blocks; None if they are
            the same.
        factor_bytes: Memory of the factors that are kept.

    Raises:
        LinAlgError: The matrix is not positive definite.
    """

    def __init__(
        self,
        block_row: Callable[[int], _BlockRow],
        bounds: IntArray,
        order: IntArray | None = None,
        factor_bytes: float = _FACTOR_BYTES,
    ) -> None:
        self._block_row, self._order, self._bounds = block_row, order, bounds.tolist()
        count = len(self._bounds) - 1
        # A block's factor and its link to the next block, eight bytes each number.
        block_bytes = max(16.0 * float(np.square(np.diff(bounds)).max(initial=1)), 1.0)
        step = max(1, int(min(factor_bytes / block_bytes, count)))
        self._segments = [range(first, min(first + step, count)) for first in range(0, count, step)]
        self._schur_updates: list[FloatArray | None] = [None]
        self._kept_segment = -1
        self._factors: list[_Factor] = []
        for number in range(len(self._segments)):
            self._schur_updates.append(self._factorise(number))

    @classmethod
    def from_sparse(
        cls, matrix: Any, order: IntArray, bounds: IntArray, factor_bytes: float = _FACTOR_BYTES
    ) -> BlockTridiagonal:
        """Factorise a sparse matrix.

        Args:
            matrix: (C,C) scipy sparse, symmetric.
            order: (C,) its columns, block by block.
            bounds: (K+1,) where each block begins in `order`, and C.
            factor_bytes: Memory of the factors that are kept.
        """
        ordered = matrix.tocsr()[order].tocsc()[:, order].tocsr()
        edges = bounds.tolist()

        def block_row(block: int) -> _BlockRow:
            start, end = edges[block : block + 2]
            after = edges[min(block + 2, len(edges) - 1)]
            dense = ordered[start:end, start:after].toarray()
            return _BlockRow(dense[:, : end - start], dense[:, end - start :])

        return cls(block_row, bounds, order, factor_bytes)

    @classmethod
    def from_blocks(cls, diagonal: FloatArray, coupling: FloatArray) -> BlockTridiagonal:
        """Factorise a matrix of K blocks of equal size.

        Args:
            diagonal: (K,n,n) the blocks on the diagonal.
            coupling: (K-1,n,n) the blocks right of them.
        """
        count, size = diagonal.shape[:2]
        last = np.zeros((size, 0))

        def block_row(block: int) -> _BlockRow:
            return _BlockRow(diagonal[block], coupling[block] if block + 1 < count else last)

        return cls(block_row, size * np.arange(count + 1), factor_bytes=np.inf)

    def solve(self, rhs: FloatArray) -> list[FloatArray]:
        """Solve for right-hand sides.

        Args:
            rhs: (C,M) in the caller's order.

        Returns:
            The solution (n,M) of each block.
        """
        if self._order is not None:
            rhs = rhs[self._order]
        forward: list[FloatArray] = []
        link: FloatArray | None = None
        for number, blocks in enumerate(self._segments):
            for block, factor in zip(blocks, self._segment_factors(number), strict=True):
                own = rhs[self._bounds[block] : self._bounds[block + 1]]
                if link is not None:
                    own = own - link.T @ forward[-1]
                forward.append(_solve_triangular(factor.lower, own))
                link = factor.link
        solution: list[FloatArray] = []
        for lower, link in self._factors_backward():
            own = forward.pop()
            if solution:
                own = own - link @ solution[-1]
            solution.append(_solve_triangular(lower, own, transposed=True))
        return solution[::-1]

    def marginals(self, read: Callable[[int, FloatArray], None]) -> None:
        """Compute the blocks on the diagonal of the inverse, such as the marginal covariances of states.

        Args:
            read: Called with the number of each block and its (n,n) part of the inverse, the last one first.
        """
        later: FloatArray | None = None
        identity = np.eye(int(np.diff(self._bounds).max(initial=0)))
        block = len(self._bounds) - 1
        for lower, link in self._factors_backward():
            block -= 1
            middle = identity[: len(lower), : len(lower)]
            if later is not None:
                middle = middle + link @ later @ link.T
            half = _solve_triangular(lower, middle, transposed=True)
            inverse = _solve_triangular(lower, half.T, transposed=True)
            later = 0.5 * (inverse + inverse.T)
            read(block, later)

    def _factors_backward(self) -> Iterator[_Factor]:
        """Yield the factor of each block, the last block's first."""
        for number in range(len(self._segments) - 1, -1, -1):
            yield from self._segment_factors(number)[::-1]

    def _segment_factors(self, number: int) -> list[_Factor]:
        """Return the factors of a segment, computed again if they were not kept."""
        if number != self._kept_segment:
            self._factorise(number)
        return self._factors

    def _factorise(self, number: int) -> FloatArray | None:
        """Compute the factors of a segment; return what the Schur complement subtracts from the next one."""
        self._kept_segment, self._factors = number, []
        update = self._schur_updates[number]
        for block in self._segments[number]:
            diagonal, coupling = self._block_row(block)
            lower = _cholesky(diagonal if update is None else diagonal - update)
            link = _solve_triangular(lower, coupling)
            update = link.T @ link
            self._factors.append(_Factor(lower, link))
        return update
