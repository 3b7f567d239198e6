"""Fit delay, rotation, bias and rate of a gyroscope to the rotations that the pictures show.

The model: the rotation vector of a pair of frames = focal_ratio · cam_from_sensor · (integral of the rate
from start + delay to end + delay − bias · interval), where delay = delay_s + drift · (time − middle of the
clip). The ratio stands for the lens: with too short a focal length, all rotations look too large.

Source: Li and Mourikis, "Online temporal calibration for camera–IMU systems", IJRR 2014, for the model of the
clock; Kabsch, "A solution for the best rotation to relate two sets of vectors", 1976, for the first solution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, interpolated
from bodycap_batch.model.geometry import nearest_rotation
from bodycap_batch.model.inertial_camera import SensorRelation
from bodycap_batch.telemetry.picture_rotation import PictureRotation
from bodycap_batch.telemetry.streams import Stream

_MAX_DELAY_S = 0.25
"""Largest delay that is tried, seconds: several frames. Evidence: none."""
_DELAY_STEP_S = 0.004
"""Step of the delays that are tried, seconds. Rotations of a hand change little in it. Evidence: none."""
_MIN_PAIRS, _MIN_POSE_PAIRS = 45, 20
"""Minimum number of pairs of frames for a fit: 1.5 s at 30 frames per second, and of pairs of solved poses,
whose rotations are not biased by the translation. Evidence: none."""
_TRIMMED_RATIO = 0.1
"""Fraction of the pairs that is left out of a fit: those with the largest residuals, where the flow failed.
Evidence: none."""
_ROUNDS = 4
"""Number of times that the pairs are selected for the first solution. Evidence: none."""
AXES_SIGMA_RAD = math.radians(10.0)
"""Standard deviation (radians) of the rotation between a sensor and the lens, if the axes of the sensor are
known. Origin: sensors are mounted to some degrees; the estimate must not depend on it where data decide."""
BIAS_SIGMA_RAD_S = 0.05
"""Standard deviation (rad/s) of a gyroscope's bias. Origin: consumer sensors state up to 1 to 3 °/s."""
_DRIFT_SIGMA = 1e-3
"""Standard deviation of the rate of the gyroscope's clock against that of the frames, no unit, after the rate
was fitted to the clip. Evidence: none."""
_LOG_RATIO_SIGMA = 0.25
"""Standard deviation of the natural logarithm of the focal ratio. Origin: without a calibration, focal
lengths are assumed from 0.6 to 1.6 times the true ones."""
_KNOWN_LOG_RATIO_SIGMA = 1e-3
"""The same if the rotations come from the poses of a map, whose focal length was adjusted. Evidence: none."""
_RATIO_RANGE = (0.6, 1.6)
"""Least and largest focal ratio that corrects the size of fast changes. Without an agreement, the fitted
ratio is meaningless. Origin: as for `_LOG_RATIO_SIGMA`."""
_SHAKE_WINDOW_S = 0.5
"""Length (seconds) of the moving mean that is subtracted to get fast changes. Origin: stabilisation follows
slow turns of a second and removes the shaking of steps, 2 Hz and faster. Evidence: none."""
_SHAKE_QUANTILE = 0.75
"""Quantile of the fast changes that is called their typical size. Larger ones may be failures of the flow."""
_MAX_AUTOCORRELATION = 0.98
"""Largest autocorrelation of successive residuals that is believed: at 30 frames per second, residuals that
last for 1.7 s. Evidence: none."""
_GROWTH_BY_TRIMMING = 1.255
"""Factor of the standard deviations because the largest tenth of the residuals is left out, which makes the
others look more exact than they are. Origin: the asymptotic variance of such an estimate for three normally
distributed components, 1 / 0.717, instead of 0.797 / 0.9."""
_DELAY_FLOOR_S = 1e-4
"""Standard deviation that is added to that of the delay, seconds. Evidence: docs/decisions/telemetry.md."""
_LEAST_NOISE_RAD_S = 1e-4
"""Least noise of a rotation per second, rad/s, for data without noise."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GyroFit(SensorRelation):
    """How a gyroscope relates to the pictures.

    The standard deviations contain the autocorrelation of the residuals. Where the camera moves close to
    things, the rotations of the pictures are wrong in common, and the result may be wrong by degrees.

    Attributes:
        middle_s: Time of a frame at which `delay_s` holds without the drift, seconds.
        focal_ratio: True focal length divided by the one that was assumed for the pictures, as a small-angle
            estimate.
        typical_r_squared: Median of `r_squared` over all delays that were tried: high if there is no peak.
        gyro_shake_rad_s: Typical size of the fast changes of the gyroscope's rate, rad/s.
        picture_shake_rad_s: The same of the pictures' rotations, corrected by the focal ratio.
    """

    middle_s: float
    focal_ratio: float
    typical_r_squared: float
    gyro_shake_rad_s: float
    picture_shake_rad_s: float

    def in_camera(self, gyro: Stream) -> tuple[FloatArray, FloatArray]:
        """Return times (N,) on the clock of the frames, seconds, and rates (N,3) in the camera's axes."""
        times_s = gyro.times_s - (self.delay_s + self.drift * (gyro.times_s - self.middle_s))
        return times_s, (gyro.values - self.bias_rad_s) @ self.cam_from_sensor.T


class RateIntegral:
    """The integral of angular rates (N,3), rad/s, at times (N,), seconds."""

    def __init__(self, times_s: FloatArray, rate_rad_s: FloatArray) -> None:
        self.times_s = times_s
        steps = 0.5 * (rate_rad_s[1:] + rate_rad_s[:-1]) * np.diff(times_s)[:, None]
        self.total = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])

    def between(self, start_s: FloatArray, end_s: FloatArray) -> FloatArray:
        """Return the integrals (N,3), radians, between pairs of times."""
        start, end = (interpolated(at_s, self.times_s, self.total) for at_s in (start_s, end_s))
        return np.asarray(end - start)


def fit_gyro(
    picture: PictureRotation, gyro: Stream, *, axes_known: bool, focal_known: bool = False
) -> GyroFit | None:
    """Fit a gyroscope to the rotations of the pictures.

    Args:
        picture: The rotations of the pictures.
        gyro: The gyroscope.
        axes_known: Whether the vectors of the gyroscope are nearly in the axes of the camera.
        focal_known: Whether the rotations come from solved poses, so that the ratio is 1.

    Returns:
        The fit; None if there are too few pairs of frames with samples.
    """
    inside = _pairs_with_samples(picture, gyro)
    if inside.sum() < (_MIN_POSE_PAIRS if focal_known else _MIN_PAIRS):
        return None
    picture = picture.chosen(np.flatnonzero(inside))
    problem = _Problem(
        picture, RateIntegral(gyro.times_s, gyro.values), axes_known=axes_known, focal_known=focal_known
    )
    delays = np.arange(-_MAX_DELAY_S, _MAX_DELAY_S + 1e-9, _DELAY_STEP_S)
    tried = [problem.first_solution(float(delay)) for delay in delays]
    shares = np.array([each.r_squared for each in tried])
    return problem.refined(tried[int(np.argmax(shares))], float(np.median(shares)))


def _pairs_with_samples(picture: PictureRotation, gyro: Stream) -> BoolArray:
    """Return a mask (N,) of the pairs with samples of the gyroscope."""
    inside = picture.start_s >= gyro.times_s[0]
    inside &= picture.end_s <= gyro.times_s[-1]
    for start_s, end_s in gyro.gaps_s:
        inside &= (picture.end_s < start_s) | (picture.start_s > end_s)
    return np.asarray(inside)


@dataclass(frozen=True, slots=True)
class _Solution:
    """A solution for one delay.

    Attributes:
        delay_s: The delay.
        rotation: (3,3) cam_from_sensor.
        ratio: The focal ratio.
        kept: (N,) mask of the pairs that were not left out.
        noise_rad_s: Root mean square of the residuals, rad/s for each axis.
        r_squared: Share of the variance that is explained.
    """

    delay_s: float
    rotation: FloatArray
    ratio: float
    kept: BoolArray
    noise_rad_s: float
    r_squared: float


class _Problem:
    """The rotations of the pictures as rates, and the gyroscope's rates for any delay."""

    def __init__(
        self, picture: PictureRotation, integral: RateIntegral, *, axes_known: bool, focal_known: bool
    ) -> None:
        self._start_s, self._end_s = picture.start_s, picture.end_s
        self._interval_s = (self._end_s - self._start_s)[:, None]
        self._seen = picture.turn_rad / self._interval_s
        self._integral = integral
        self._axes_known = axes_known
        self._log_ratio_sigma = _KNOWN_LOG_RATIO_SIGMA if focal_known else _LOG_RATIO_SIGMA
        self._middle_s = 0.5 * float(self._start_s[0] + self._end_s[-1])

    def measured(self, delay_s: float, drift: float = 0.0) -> FloatArray:
        """Return the mean rates (N,3) of the gyroscope over the pairs, rad/s."""
        late_s = delay_s + drift * (self._start_s - self._middle_s)
        return np.asarray(
            self._integral.between(self._start_s + late_s, self._end_s + late_s) / self._interval_s
        )

    def first_solution(self, delay_s: float) -> _Solution:
        """Return rotation and ratio for one delay, in closed form."""
        measured = self.measured(delay_s)
        kept = np.ones(len(measured), dtype=bool)
        rotation, ratio, noise, share = np.eye(3), 1.0, 1.0, 0.0
        for _ in range(_ROUNDS):
            seen, turned = self._seen[kept], measured[kept]
            seen_mean, turned_mean = seen.mean(axis=0), turned.mean(axis=0)
            cross = (seen - seen_mean).T @ (turned - turned_mean)
            prior = noise**2 / (ratio * AXES_SIGMA_RAD**2) * np.eye(3) if self._axes_known else 0.0
            rotation = nearest_rotation(cross + prior)
            energy = float(((turned - turned_mean) ** 2).sum())
            ratio = max(float((rotation * cross).sum()) / max(energy, 1e-12), 1e-3)
            residual = (self._seen - seen_mean) - ratio * (measured - turned_mean) @ rotation.T
            size = np.linalg.norm(residual, axis=1)
            noise = max(float(np.sqrt((size[kept] ** 2).mean() / 3.0)), _LEAST_NOISE_RAD_S)
            share = 1.0 - float((size[kept] ** 2).sum()) / max(float(((seen - seen_mean) ** 2).sum()), 1e-12)
            kept = size <= np.quantile(size, 1.0 - _TRIMMED_RATIO)
        return _Solution(delay_s, rotation, ratio, kept, noise, share)

    def refined(self, first: _Solution, typical: float) -> GyroFit:
        """Return the fit with all unknowns, started from the best delay."""
        from scipy.optimize import least_squares
        from scipy.spatial.transform import Rotation

        kept = first.kept
        # The error of a rotation does not depend on the time between the frames; that of its rate does.
        weight = self._interval_s / float(np.median(self._interval_s))
        turned = self.measured(first.delay_s)
        bias = turned[kept].mean(axis=0) - first.rotation.T @ self._seen[kept].mean(axis=0) / first.ratio
        prior = np.concatenate(
            [
                np.full(3, 1.0 / AXES_SIGMA_RAD if self._axes_known else 0.0),
                np.full(3, 1.0 / BIAS_SIGMA_RAD_S),
                [0.0, 1.0 / _DRIFT_SIGMA, 1.0 / self._log_ratio_sigma],
            ]
        )
        start_rotation = Rotation.from_matrix(first.rotation)

        def predicted(x: FloatArray) -> FloatArray:
            rotation = (Rotation.from_rotvec(x[:3]) * start_rotation).as_matrix()
            return np.asarray(math.exp(x[8]) * (self.measured(x[6], x[7]) - x[3:6]) @ rotation.T)

        def residuals(x: FloatArray) -> FloatArray:
            own = (weight * (self._seen - predicted(x)))[kept].ravel() / first.noise_rad_s
            deviation = x.copy()
            deviation[:3] = (Rotation.from_rotvec(x[:3]) * start_rotation).as_rotvec()
            return np.concatenate([own, prior * deviation])

        x0 = np.concatenate([np.zeros(3), bias, [first.delay_s, 0.0, math.log(first.ratio)]])
        found = least_squares(residuals, x0, method="lm", max_nfev=400)
        slope = np.asarray(found.jac)
        sigma = np.sqrt(np.maximum(np.diag(np.linalg.pinv(slope.T @ slope)), 0.0))
        error = self._seen - predicted(found.x)
        weighted = weight * error
        noise_rad_s = max(float(np.sqrt((weighted[kept] ** 2).mean())), _LEAST_NOISE_RAD_S)
        sigma *= _GROWTH_BY_TRIMMING * _growth_by_autocorrelation(weighted, kept)
        sigma *= noise_rad_s / first.noise_rad_s
        seen = self._seen[kept]
        ratio = math.exp(float(found.x[8]))
        rate = self.measured(float(found.x[6]), float(found.x[7])) - found.x[3:6]
        plausible = min(max(ratio, _RATIO_RANGE[0]), _RATIO_RANGE[1])
        shakes = [_typical_shake(each, self._start_s, self._end_s) for each in (rate, self._seen / plausible)]
        return GyroFit(
            delay_s=float(found.x[6]),
            delay_sigma_s=float(np.hypot(sigma[6], _DELAY_FLOOR_S)),
            drift=float(found.x[7]),
            middle_s=self._middle_s,
            drift_sigma=float(sigma[7]),
            cam_from_sensor=(Rotation.from_rotvec(found.x[:3]) * start_rotation).as_matrix(),
            rotation_sigma_rad=sigma[:3],
            bias_rad_s=np.asarray(found.x[3:6]),
            bias_sigma_rad_s=sigma[3:6],
            focal_ratio=ratio,
            r_squared=1.0 - float((error[kept] ** 2).sum() / ((seen - seen.mean(axis=0)) ** 2).sum()),
            typical_r_squared=typical,
            gyro_shake_rad_s=shakes[0],
            picture_shake_rad_s=shakes[1],
            pairs=int(kept.sum()),
        )


def _growth_by_autocorrelation(error: FloatArray, kept: BoolArray) -> float:
    """Return the factor by which residuals (N,3) that last for several pairs raise standard deviations.

    A camera that moves close to things has such residuals: its translation looks like a slow rotation.

    Source: the effective number of samples of an autoregressive process of first order.
    """
    both = kept[1:] & kept[:-1]
    energy = float((error[kept] ** 2).sum()) / max(int(kept.sum()), 1)
    product = float((error[1:][both] * error[:-1][both]).sum()) / max(int(both.sum()), 1)
    correlation = min(max(product / max(energy, 1e-18), 0.0), _MAX_AUTOCORRELATION)
    return float(np.sqrt((1.0 + correlation) / (1.0 - correlation)))


def _typical_shake(rates: FloatArray, start_s: FloatArray, end_s: FloatArray) -> float:
    """Return the typical size of the fast changes of rates (N,3), rad/s.

    Args:
        rates: Mean rates over the pairs of frames.
        start_s: (N,) start of each pair, seconds.
        end_s: (N,) end of each pair, seconds.
    """
    width = max(3, round(_SHAKE_WINDOW_S / float(np.median(np.diff(start_s)))))
    breaks = np.flatnonzero(start_s[1:] - end_s[:-1] > 1e-6) + 1
    sizes = [np.zeros(0)]
    for part in np.split(rates, breaks):
        if len(part) >= width:
            slow = np.stack([np.convolve(part[:, axis], np.ones(width) / width, "same") for axis in range(3)])
            inner = slice(width // 2, len(part) - width // 2)
            sizes.append(np.linalg.norm(part - slow.T, axis=1)[inner])
    joined = np.concatenate(sizes)
    return float(np.quantile(joined, _SHAKE_QUANTILE)) if len(joined) else 0.0
