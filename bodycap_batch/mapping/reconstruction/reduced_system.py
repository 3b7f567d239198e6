"""Solve the normal equations of keyframes and points, with the points eliminated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray

POINT_DAMPING = 1e-9
"""Damping of a point, as a fraction of the trace of its information. It only prevents a singular matrix."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CommonPoints:
    """The points that two keyframes, or a keyframe and itself, have in common.

    The reduced system has a block for each pair of keyframes with common points. It is a product of two
    matrices with three rows for each common point, which BLAS computes fast.

    Attributes:
        first: (Q,) observation of the first keyframe of a pair.
        second: (Q,) observation of the same point in the second keyframe of the pair, which is not earlier.
        pairs: (B,2) keyframes of each pair.
        bounds: (B+1,) range of the rows of each pair in `first` and `second`.
    """

    first: IntArray
    second: IntArray
    pairs: IntArray
    bounds: IntArray

    @staticmethod
    def of(keyframe: IntArray, point: IntArray) -> CommonPoints:
        """Return the common points of keyframes.

        Args:
            keyframe: (M,) keyframe of each observation.
            point: (M,) point of each observation.
        """
        order = np.lexsort((keyframe, point))
        sizes = np.bincount(point, minlength=1)
        starts = np.cumsum(sizes) - sizes
        # Each observation is paired with itself and with the later observations of its point.
        place = np.arange(len(order))
        partners = sizes[point[order]] - (place - starts[point[order]])
        left = np.repeat(place, partners)
        right = left + np.arange(len(left)) - np.repeat(np.cumsum(partners) - partners, partners)
        first, second = order[left], order[right]
        # A keyframe that observes a point twice needs the pair in both orders.
        twice = (keyframe[first] == keyframe[second]) & (first != second)
        first, second = np.append(first, second[twice]), np.append(second, first[twice])
        number = keyframe[first] * (int(keyframe.max(initial=0)) + 1) + keyframe[second]
        by_pair = np.argsort(number, kind="stable")
        first, second, number = first[by_pair], second[by_pair], number[by_pair]
        begin = np.flatnonzero(np.diff(number, prepend=-1))
        return CommonPoints(
            first=first,
            second=second,
            pairs=np.stack([keyframe[first[begin]], keyframe[second[begin]]], axis=1),
            bounds=np.append(begin, len(first)),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class NormalEquations:
    """The normal equations of one step.

    K is the number of keyframes, U the number of unknowns of each, R the number of unknowns that keyframes
    have in common, P the number of points, M the number of observations.

    Attributes:
        keyframe: (M,) keyframe of each observation, not decreasing.
        point: (M,) point of each observation.
        common_points: The points that pairs of keyframes have in common.
        common: (K,) number of the common unknown of each keyframe.
        own: (K,U+1,U+1) blocks of the keyframes and their common unknowns, with the prior of the keyframes.
        gradient: (UK+R,) gradient of half the cost with respect to keyframes and common unknowns.
        by_common: (R,) weights of the prior of the common unknowns.
        by_point: (P,3,3) blocks of the points.
        point_gradient: (P,3) gradient with respect to the points.
        mixed: (M,3,U+1) blocks of each observation: of its point with keyframe and common unknown.
    """

    keyframe: IntArray
    point: IntArray
    common_points: CommonPoints
    common: IntArray
    own: FloatArray
    gradient: FloatArray
    by_common: FloatArray
    by_point: FloatArray
    point_gradient: FloatArray
    mixed: FloatArray

    def places(self) -> IntArray:
        """Return the unknowns (K,U+1) of the reduced system that belong to each keyframe."""
        count, size = len(self.own), self.own.shape[1] - 1
        first = size * np.arange(count)[:, None] + np.arange(size)
        return np.concatenate([first, size * count + self.common[:, None]], axis=1)

    def factored(self, damping: float) -> FactoredSystem | None:
        """Return the system of keyframes and common unknowns, factored; None if it is singular.

        Args:
            damping: Damping of keyframes and points, as a ratio of the diagonal.
        """
        from scipy.linalg.lapack import dpotrf

        axes = np.arange(3)
        diagonal = self.by_point[:, axes, axes]
        damped = self.by_point.copy()
        trace = diagonal.sum(axis=1, keepdims=True)
        damped[:, axes, axes] += damping * diagonal + POINT_DAMPING * np.maximum(trace, 1.0)
        half = np.linalg.cholesky(np.linalg.inv(damped))
        mixed = np.swapaxes(half, 1, 2)[self.point] @ self.mixed
        matrix = self._eliminated(mixed)
        self._add_own(matrix, damping)
        # LAPACK stores matrices by columns, so the lower triangle here is the upper one there.
        factor, failed = dpotrf(matrix.T, lower=0, overwrite_a=1)
        if failed:
            return None
        return FactoredSystem(
            factor=factor,
            keyframe=self.keyframe,
            point=self.point,
            places=self.places(),
            mixed=mixed,
            half=half,
        )

    def _eliminated(self, mixed: FloatArray) -> FloatArray:
        """Return the lower triangle of the matrix (UK+R,UK+R) that the eliminated points subtract, negated.

        Args:
            mixed: (M,3,U+1) blocks of the observations, times the roots of the inverse blocks of the points.
        """
        count, size, common = len(self.own), self.own.shape[1] - 1, len(self.by_common)
        out = np.zeros((size * count + common, size * count + common))
        blocks = out[: size * count, : size * count].reshape(count, size, count, size)
        own = np.ascontiguousarray(mixed[:, :, :size])
        bounds = self.common_points.bounds.tolist()
        for (a, b), start, stop in zip(self.common_points.pairs.tolist(), bounds, bounds[1:], strict=False):
            left = own[self.common_points.second[start:stop]].reshape(-1, size)
            right = own[self.common_points.first[start:stop]].reshape(-1, size)
            np.negative(left.T @ right, out=blocks[b, :, a])
        # The common unknowns are few, so their coupling with the points is dense.
        by_point = np.zeros((common, len(self.by_point), 3))
        np.add.at(by_point, (self.common[self.keyframe], self.point), mixed[:, :, size])
        for number, each in enumerate(by_point):
            row = np.einsum("mij,mi->mj", own, each[self.point])
            out[size * count + number, : size * count] = -self._sum(row).ravel()
        last = slice(size * count, None)
        out[last, last] = -np.einsum("api,bpi->ab", by_point, by_point)
        return out

    def _sum(self, rows: FloatArray) -> FloatArray:
        """Return the sums (K,U) of rows (M,U) over the observations of each keyframe."""
        out = np.zeros((len(self.own), rows.shape[1]))
        seen, starts = np.unique(self.keyframe, return_index=True)
        if len(seen):
            out[seen] = np.add.reduceat(rows, starts, axis=0)
        return out

    def _add_own(self, matrix: FloatArray, damping: float) -> None:
        """Add the blocks of the keyframes and the priors to the lower triangle of a matrix, with damping."""
        size, first = self.own.shape[1] - 1, len(matrix) - len(self.by_common)
        for number, block in enumerate(self.own):
            part = slice(size * number, size * number + size)
            common = first + self.common[number]
            own = np.diag(block)[:size]
            matrix[part, part] += block[:size, :size]
            matrix[part, part] += np.diag(damping * own + POINT_DAMPING * max(own.max(), 1.0))
            matrix[common, part] += block[size, :size]
            matrix[common, common] += block[size, size]
        last = np.arange(first, len(matrix))
        matrix[last, last] += self.by_common


@dataclass(frozen=True, slots=True, kw_only=True)
class FactoredSystem:
    """The system of keyframes and common unknowns after the points are eliminated, factored.

    Attributes:
        factor: Upper triangular factor of the matrix (UK+R,UK+R).
        keyframe: (M,) keyframe of each observation.
        point: (M,) point of each observation.
        places: (K,U+1) unknowns that belong to each keyframe.
        mixed: (M,3,U+1) blocks of the observations, times `half`.
        half: (P,3,3) roots of the inverse blocks of the points.
    """

    factor: FloatArray
    keyframe: IntArray
    point: IntArray
    places: IntArray
    mixed: FloatArray
    half: FloatArray

    def solve(self, keyframes: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the solution (UK+R,) and (P,3) for right sides (UK+R,) and (P,3)."""
        from scipy.linalg import cho_solve

        from_points = np.einsum("pij,pi->pj", self.half, points)
        by_points = np.einsum("mij,mi->mj", self.mixed, from_points[self.point])
        places = self.places[self.keyframe]
        right = keyframes - np.bincount(places.ravel(), by_points.ravel(), minlength=len(keyframes))
        own = np.asarray(cho_solve((self.factor, False), right, check_finite=False))
        by_own = np.einsum("mij,mj->mi", self.mixed, own[places])
        left = from_points.copy()
        for axis in range(3):
            left[:, axis] -= np.bincount(self.point, by_own[:, axis], minlength=len(left))
        return own, np.einsum("pij,pj->pi", self.half, left)
