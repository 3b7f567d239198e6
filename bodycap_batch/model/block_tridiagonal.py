"""Solve a symmetric block-tridiagonal system, and read the blocks of its inverse."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtrs

from bodycap_batch.core.arrays import FloatArray, IntArray

_HELD_BYTES = 1e7
"""Of a chain's factors: those of 50 ticks with nine bones. With three times as many 20 MB more, no faster."""


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


class BlockTridiagonal:
    """Normal equations whose unknowns are linked within a block and with the next block only.

    Of a long chain factors are held for a stretch of blocks at a time, and made again when they are needed:
    they are dense, and the equations are not.

    Args:
        information: (C,C) sparse, symmetric.
        order: (C,) its columns block by block.
        bounds: (K+1,) where each block begins in `order`.
        held: Bytes of factors that may be held.

    Source: block-tridiagonal Cholesky factorisation; its way back is the Rauch-Tung-Striebel smoother.
    """

    def __init__(
        self, information: Any, order: IntArray, bounds: IntArray, held: float = _HELD_BYTES
    ) -> None:
        self._order, self._bounds = order, bounds.tolist()
        self._ordered = information.tocsr()[order].tocsc()[:, order].tocsr()
        count = len(self._bounds) - 1
        # A block's factor and its link to the next one.
        size = max(16.0 * float(np.square(np.diff(bounds)).max(initial=1)), 1.0)
        step = max(1, int(held / size))
        self._stretches = [range(first, min(first + step, count)) for first in range(0, count, step)]
        self._carried: list[FloatArray | None] = [None]
        self._at = -1
        self._factors: list[tuple[FloatArray, FloatArray]] = []
        for number in range(len(self._stretches)):
            self._carried.append(self._factorise(number))

    def solve(self, right: FloatArray) -> list[FloatArray]:
        """Solve for right-hand sides (C,M); the answer (n,M) of each block."""
        right = right[self._order]
        below: list[FloatArray] = []
        link: FloatArray | None = None
        for number, blocks in enumerate(self._stretches):
            for block, (lower, following) in zip(blocks, self._stretch(number), strict=True):
                own = right[self._bounds[block] : self._bounds[block + 1]]
                if link is not None:
                    own = own - link.T @ below[-1]
                below.append(_solve(lower, own))
                link = following
        out: list[FloatArray] = []
        for lower, link in self._backwards():
            own = below.pop()
            known = own - link @ out[-1] if out else own
            out.append(_solve(lower, known, transposed=True))
        return out[::-1]

    def marginals(self, read: Callable[[int, FloatArray], None]) -> None:
        """Hand out each block's marginal covariance (n,n), the last block's first."""
        later: FloatArray | None = None
        block = len(self._bounds) - 1
        for lower, link in self._backwards():
            block -= 1
            spread = np.eye(len(lower)) if later is None else np.eye(len(lower)) + link @ later @ link.T
            half = _solve(lower, spread, transposed=True)
            covariance = _solve(lower, half.T, transposed=True)
            later = 0.5 * (covariance + covariance.T)
            read(block, later)

    def _backwards(self) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Every block's factor and link, the last block's first."""
        for number in range(len(self._stretches) - 1, -1, -1):
            yield from self._stretch(number)[::-1]

    def _stretch(self, number: int) -> list[tuple[FloatArray, FloatArray]]:
        """Factor and link of each block of a stretch."""
        if number != self._at:
            self._factorise(number)
        return self._factors

    def _factorise(self, number: int) -> FloatArray | None:
        """Make the factors of a stretch; what it carries into the next one."""
        self._at, self._factors = number, []
        carried = self._carried[number]
        for block in self._stretches[number]:
            start, end = self._bounds[block : block + 2]
            after = self._bounds[min(block + 2, len(self._bounds) - 1)]
            dense = self._ordered[start:end, start:after].toarray()
            own = dense[:, : end - start] if carried is None else dense[:, : end - start] - carried
            lower = _factor(own)
            link = _solve(lower, dense[:, end - start :])
            carried = link.T @ link
            self._factors.append((lower, link))
        return carried
