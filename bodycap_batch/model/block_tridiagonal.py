"""Solver for symmetric positive definite block-tridiagonal systems, with the marginals of the inverse.

Such systems are the normal equations of estimation problems along time. The unknowns of one block are coupled
only with each other and with the unknowns of the two neighbouring blocks. Time and memory grow linearly with
the number of blocks.

Source: block-tridiagonal Cholesky factorisation. The backward pass that computes the inverse is the smoother
of H. E. Rauch, F. Tung, C. T. Striebel, "Maximum likelihood estimates of linear dynamic systems", AIAA
Journal 3, 1965.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtrs

from bodycap_batch.core.arrays import FloatArray, IntArray

_FACTOR_BYTES = 1e7
"""Maximum memory, bytes, for the Cholesky factors that are kept. This memory holds the factors of 50 ticks
with nine bones. With a limit three times as large, the solver needed 20 MB more and was not faster."""


class _BlockRow(NamedTuple):
    """The upper triangle of one row of blocks.

    Attributes:
        diagonal: (n,n) block on the diagonal.
        coupling: (n,m) block to the right of the diagonal block; m is 0 in the last row.
    """

    diagonal: FloatArray
    coupling: FloatArray


class _Factor(NamedTuple):
    """One row of blocks of the Cholesky factor.

    Attributes:
        lower: (n,n) lower triangular factor of the block on the diagonal.
        link: (n,m) coupling with the next block, multiplied from the left by the inverse of `lower`.
    """

    lower: FloatArray
    link: FloatArray


def _cholesky(matrix: FloatArray) -> FloatArray:
    """Return the lower Cholesky factor of a small matrix.

    The function calls LAPACK directly, because numpy's wrapper takes longer than the factorisation.

    Raises:
        LinAlgError: The matrix is not positive definite.
    """
    lower: FloatArray
    lower, failed = dpotrf(matrix, lower=1)
    if failed:
        raise np.linalg.LinAlgError(f"not positive definite at {failed}")
    return lower


def _solve_triangular(lower: FloatArray, rhs: FloatArray, *, transposed: bool = False) -> FloatArray:
    """Solve a linear system whose matrix is lower triangular, or the transpose of a lower triangular matrix.

    Args:
        lower: (n,n) lower triangular matrix.
        rhs: (n,M) right-hand sides.
        transposed: True to solve with the transpose of `lower`.

    Returns:
        The solution (n,M).
    """
    if not rhs.size:
        return np.zeros_like(rhs)
    solution: FloatArray = dtrtrs(lower, rhs, 1, int(transposed))[0]
    return solution


class BlockTridiagonal:
    """A factorised matrix, for solving linear systems and for computing blocks of the inverse matrix.

    The matrix is symmetric, positive definite and block-tridiagonal. The factors are dense, even for a
    sparse matrix. For a large matrix, only the factors of one segment of successive blocks are kept. The
    factors of the other segments are computed again when they are needed.

    Args:
        block_row: Function that returns the blocks of a row, given the number of the row.
        bounds: (K+1,) index of the first unknown of each block in the order of the blocks, followed by the
            number of unknowns.
        order: (C,) the caller's index of each unknown, listed in the order of the blocks. None if the caller
            numbers the unknowns in the order of the blocks.
        factor_bytes: Maximum memory, bytes, for the factors that are kept.

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
        # Each block has a factor and a link to the next block; each number takes eight bytes.
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
            matrix: (C,C) symmetric matrix, scipy sparse.
            order: (C,) column indices of the matrix, block by block.
            bounds: (K+1,) position in `order` at which each block begins, followed by C.
            factor_bytes: Maximum memory, bytes, for the factors that are kept.
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
            diagonal: (K,n,n) blocks on the diagonal.
            coupling: (K-1,n,n) blocks to the right of the diagonal blocks.
        """
        count, size = diagonal.shape[:2]
        last = np.zeros((size, 0))

        def block_row(block: int) -> _BlockRow:
            return _BlockRow(diagonal[block], coupling[block] if block + 1 < count else last)

        return cls(block_row, size * np.arange(count + 1), factor_bytes=np.inf)

    def solve(self, rhs: FloatArray) -> list[FloatArray]:
        """Solve the system for M right-hand sides.

        Args:
            rhs: (C,M) right-hand sides, with the unknowns in the caller's order.

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
        """Compute the blocks on the diagonal of the inverse matrix.

        If the matrix is the information matrix of states, these blocks are the marginal covariances.

        Args:
            read: Function that is called once for each block, with the number of the block and the (n,n)
                block of the inverse. The last block comes first.
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
        """Yield the factor of each block, starting with the last block."""
        for number in range(len(self._segments) - 1, -1, -1):
            yield from self._segment_factors(number)[::-1]

    def _segment_factors(self, number: int) -> list[_Factor]:
        """Return the factors of a segment. Factors that were not kept are computed again."""
        if number != self._kept_segment:
            self._factorise(number)
        return self._factors

    def _factorise(self, number: int) -> FloatArray | None:
        """Compute the factors of a segment and keep them.

        Returns:
            The matrix to subtract from the first diagonal block of the next segment (Schur complement).
        """
        self._kept_segment, self._factors = number, []
        update = self._schur_updates[number]
        for block in self._segments[number]:
            diagonal, coupling = self._block_row(block)
            lower = _cholesky(diagonal if update is None else diagonal - update)
            link = _solve_triangular(lower, coupling)
            update = link.T @ link
            self._factors.append(_Factor(lower, link))
        return update
