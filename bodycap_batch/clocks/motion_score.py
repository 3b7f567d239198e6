"""Compare the motion of two cameras at all offsets of their clocks.

Both cameras are on one body. With the correct offset, the second camera stays near one place in the axes of
the first, and moves and turns with it, except for the movement of the limb. The covariance of what is left is
small, in particular in the directions in which the joints hold the limb. All covariances of all offsets are
sums over products of a signal of the first and a signal of the second camera, so that a Fourier transform
gives them at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bodycap_batch.clocks.motion_signals import STEP_S, MotionSignals
from bodycap_batch.core.arrays import FloatArray

TRUNK_WEIGHTS_HZ = (0.94, 0.17, 1.63, 0.38, 1.19, 0.0, 1.09)
"""Weights of the parts of the score for a camera on the trunk with one on a limb, independent samples per
second: place, distance, velocity in two bands, turn rate in three bands. Evidence:
docs/decisions/clocks.md."""
LIMB_WEIGHTS_HZ = (0.61, 0.0, 0.17, 0.0, 0.48, 0.05, 0.62)
"""The same for two cameras on limbs."""
_FLOOR = 0.02
"""Share of the variance of unrelated motion that is added to each variance. Origin: noise of the poses."""
_PLACE_FLOOR = 0.001
"""The same for the place, where the unrelated variance is that of the whole path."""


@dataclass(frozen=True, slots=True)
class MotionScore:
    """How well the motions of two cameras belong together, for all offsets.

    Attributes:
        lags_s: (L,) offsets: time of the first camera − time of the second, seconds.
        common_s: (L,) time in which both cameras were localised, seconds.
        score: (L,) logarithm of the likelihood, relative to that of a typical offset.
    """

    lags_s: FloatArray
    common_s: FloatArray
    score: FloatArray

    def at(self, lags_s: FloatArray) -> FloatArray:
        """Return the score at offsets (K,), seconds; 0 where it is unknown."""
        from scipy.interpolate import CubicSpline

        out = np.zeros(len(lags_s))
        inside = (lags_s >= self.lags_s[0]) & (lags_s <= self.lags_s[-1])
        out[inside] = CubicSpline(self.lags_s, self.score)(lags_s[inside])
        return out


def motion_score(
    first: MotionSignals,
    second: MotionSignals,
    weights_hz: tuple[float, ...],
    min_common_s: float,
    limits_s: tuple[float, float] | None = None,
    unrelated_square: float | None = None,
) -> MotionScore:
    """Return the score of all offsets with enough common time.

    Args:
        first: Signals of the camera whose axes are used: that of the trunk, if there is one.
        second: Signals of the other camera.
        weights_hz: Weights of the parts.
        min_common_s: Least time in which both cameras were localised, seconds.
        limits_s: Least and greatest offset, seconds; None for all.
        unrelated_square: Mean squared distance of the cameras at unrelated times, map units²; None: that of
            these signals.
    """
    sums = _LagSums(first, second, min_common_s, limits_s)
    if not sums.chosen.any():
        return MotionScore(*np.zeros((3, 0)))
    cam_from_map = first.map_from_cam.transpose(1, 0, 2)
    middle = (first.position * first.present).sum(axis=1) / first.present.sum()
    at, other_at = first.position - middle[:, None], second.position - middle[:, None]
    one = np.ones((1, second.count))
    # Place of the second camera in the axes of the first.
    alpha = np.concatenate([cam_from_map, -_rotated(cam_from_map, at)[:, None]], axis=1)
    beta = np.concatenate([other_at, one])
    square = sums.second_moments(alpha, beta, second.present)
    mean = sums.means(alpha, beta, second.present)
    distance = np.einsum("iil->l", square)
    unrelated = mean_square_distance(first, second) if unrelated_square is None else unrelated_square
    unrelated = max(unrelated, 1e-300)
    place = (square - mean[:, None] * mean[None]) / (unrelated / 3.0)
    parts = [
        -0.5 * _log_det(place + _PLACE_FLOOR * np.eye(3)[:, :, None]),
        -0.5 * np.log(np.maximum(distance / unrelated, 0.0) + _FLOOR),
    ]
    for band in range(2):
        turn = np.einsum("ijn,jkn->ikn", cam_from_map, _cross_matrix(first.turn_rates[band]))
        own = _rotated(cam_from_map, first.velocities[band])
        constant = _rotated(turn, at) - own
        alpha = np.concatenate([cam_from_map, -turn, constant[:, None]], axis=1)
        beta = np.concatenate([second.velocities[band], other_at, one])
        weights = second.velocity_weights[band]
        square = sums.second_moments(alpha, beta, weights)
        parts.append(_ratio(square, sums.unrelated(own, second.velocities[band], weights)))
    for band in range(3):
        own = _rotated(cam_from_map, first.turn_rates[band])
        alpha = np.concatenate([cam_from_map, -own[:, None]], axis=1)
        weights = second.turn_weights[band]
        square = sums.second_moments(alpha, np.concatenate([second.turn_rates[band], one]), weights)
        parts.append(_ratio(square, sums.unrelated(own, second.turn_rates[band], weights)))
    stacked = np.array(parts)
    # An offset with a long common time is not better for the only reason that motions resemble each other.
    stacked = np.asarray((stacked - np.median(stacked, axis=1)[:, None]) * sums.common)
    return MotionScore(sums.lags_s, sums.common, np.asarray(np.array(weights_hz) @ stacked))


def mean_square_distance(first: MotionSignals, second: MotionSignals) -> float:
    """Return the mean squared distance of two cameras at unrelated times, map units²."""
    means, total = [], 0.0
    for signals in (first, second):
        mean = np.average(signals.position, axis=1, weights=signals.present)
        away = ((signals.position - mean[:, None]) ** 2).sum(axis=0)
        means.append(mean)
        total += float(np.average(away, weights=signals.present))
    return total + float(((means[0] - means[1]) ** 2).sum())


class _LagSums:
    """Sums over the common time of two cameras, for all offsets at once."""

    def __init__(
        self,
        first: MotionSignals,
        second: MotionSignals,
        min_common_s: float,
        limits_s: tuple[float, float] | None,
    ) -> None:
        from scipy.fft import next_fast_len

        self._size = next_fast_len(first.count + second.count, real=True)
        self._before = second.count - 1
        self._after = first.count
        self._present = first.present
        self._present_hat = self._transform(first.present)
        lags_s = (np.arange(-self._before, self._after) + first.first_step - second.first_step) * STEP_S
        self.chosen = np.ones(len(lags_s), dtype=bool)
        common = STEP_S * np.round(self._sums(self._present_hat, self._transform(second.present)))
        self.chosen = common >= min_common_s
        if limits_s is not None:
            self.chosen &= (lags_s >= limits_s[0]) & (lags_s <= limits_s[1])
        self.lags_s: FloatArray = np.asarray(lags_s[self.chosen], dtype=np.float64)
        self.common = common[self.chosen]

    def _transform(self, values: FloatArray) -> FloatArray:
        from scipy.fft import rfft

        return np.asarray(rfft(values, self._size, axis=-1))

    def _sums(self, first_hat: FloatArray, second_hat: FloatArray) -> FloatArray:
        """Return sums of products for all offsets; leading axes of the transforms are summed."""
        from scipy.fft import irfft

        product = first_hat * np.conj(second_hat)
        if product.ndim > 1:
            product = product.sum(axis=0)
        sums = irfft(product, self._size)
        return np.concatenate([sums[self._size - self._before :], sums[: self._after]])[self.chosen]

    def _counts(self, weights: FloatArray) -> FloatArray:
        return np.maximum(self._sums(self._present_hat, self._transform(weights)), 1e-9)

    def second_moments(self, alpha: FloatArray, beta: FloatArray, weights: FloatArray) -> FloatArray:
        """Return weighted second moments (3,3,L) of the vectors alpha·beta.

        Args:
            alpha: (3,M,N) signals of the first camera.
            beta: (M,K) signals of the second camera.
            weights: (K,) weights of the samples of the second camera.
        """
        alpha = alpha * self._present
        rows, columns = np.triu_indices(len(beta))
        twice = np.where(rows == columns, 0.5, 1.0)[:, None]
        beta_hat = self._transform(beta[rows] * beta[columns] * weights)
        counts = self._counts(weights)

        def moment(i: int, j: int) -> FloatArray:
            products = twice * (alpha[i, rows] * alpha[j, columns] + alpha[i, columns] * alpha[j, rows])
            return self._sums(self._transform(products), beta_hat) / counts

        return _symmetric(moment)

    def means(self, alpha: FloatArray, beta: FloatArray, weights: FloatArray) -> FloatArray:
        """Return weighted means (3,L) of the vectors alpha·beta; arguments as in `second_moments`."""
        beta_hat = self._transform(beta * weights)
        counts = self._counts(weights)
        return np.stack(
            [self._sums(self._transform(row * self._present), beta_hat) / counts for row in alpha]
        )

    def unrelated(self, own: FloatArray, other: FloatArray, weights: FloatArray) -> FloatArray:
        """Return the second moments (3,3,L) of the difference of two vectors, if they were unrelated.

        Args:
            own: (3,N) vectors of the first camera in the axes of the score.
            other: (3,K) vectors of the second camera in the axes of the map.
            weights: (K,) weights of the samples of the second camera.
        """
        weights_hat = self._transform(weights)
        counts = self._counts(weights)
        energy = self._sums(self._present_hat, self._transform((other**2).sum(axis=0) * weights)) / counts
        moments = _symmetric(
            lambda i, j: self._sums(self._transform(own[i] * own[j] * self._present), weights_hat) / counts
        )
        return moments + np.eye(3)[:, :, None] * (energy / 3.0)


def _symmetric(entry: Callable[[int, int], FloatArray]) -> FloatArray:
    """Return symmetric matrices (3,3,L) whose element (i,j) is `entry(i, j)`, (L,), for i ≤ j."""
    upper = {(i, j): entry(i, j) for i in range(3) for j in range(i, 3)}
    return np.array([[upper[min(i, j), max(i, j)] for j in range(3)] for i in range(3)])


def _rotated(target_from_source: FloatArray, vectors: FloatArray) -> FloatArray:
    """Multiply matrices (3,3,N) with vectors (3,N)."""
    return np.asarray(np.einsum("ijn,jn->in", target_from_source, vectors))


def _cross_matrix(vectors: FloatArray) -> FloatArray:
    """Return the matrices (3,3,N) of the cross product with vectors (3,N)."""
    x, y, z = vectors
    zero = np.zeros_like(x)
    return np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]])


def _log_det(matrices: FloatArray) -> FloatArray:
    """Return the logarithms of the determinants of symmetric matrices (3,3,L)."""
    return np.asarray(np.linalg.slogdet(np.moveaxis(matrices, -1, 0))[1])


def _ratio(square: FloatArray, unrelated: FloatArray) -> FloatArray:
    """Return the log-likelihoods (L,) of second moments (3,3,L) relative to those of unrelated motion."""
    size = np.einsum("iil->l", unrelated) / 3.0 + 1e-300
    floor = _FLOOR * np.eye(3)[:, :, None]
    return -0.5 * (_log_det(square / size + floor) - _log_det(unrelated / size + floor))
