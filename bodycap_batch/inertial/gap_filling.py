"""Fill short gaps of a trajectory with poses from the inertial sensor, with honest sigmas.

Stretches of localised frames are solved as if they were gaps of the same length. The errors there scale the
stated sigmas, since neither the noise of a sensor nor the common errors of neighbouring poses are known.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, evenly_spaced
from bodycap_batch.inertial.gap_solver import (
    CONSTANTS,
    DELAY,
    FORCE_BIAS,
    GRAVITY,
    GYRO_BIAS,
    LEVER,
    LOG_SCALE,
    TURN,
    Constants,
    SolvedStretch,
    Stretch,
    solve_stretch,
)
from bodycap_batch.inertial.preintegration import SensorNoise
from bodycap_batch.inertial.samples import InertialSamples
from bodycap_batch.model.geometry import so3_log
from bodycap_batch.model.gravity import GravityFit
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.telemetry.gyro_fit import GyroFit

MAX_GAP_S = 1.0
"""Maximum time (seconds) between the two localised frames around a gap that is filled. The error grows with
the square of the time."""
_ROUNDING_S = 1e-3
"""Rounding of times of frames, seconds."""
_MARGIN_S, _LEAST_MARGIN_S, _MIN_FIXES = 0.6, 0.1, 4
"""First: time (seconds) on each side of a gap whose poses are used. Second: minimum of this time. Third:
minimum number of localised frames in it on each side. They give the velocity at the ends of the gap.
Evidence: none."""
_NOISE = SensorNoise(gyro=4e-4, force=1e-2)
"""Noise densities, rad/s/√Hz and m/s²/√Hz: those of consumer's sensors; that of the force contains errors of
its scale. Held-out stretches correct the sigmas."""
_MIN_SIGMA_RAD, _MIN_SIGMA_M = float(np.radians(0.1)), 0.001
"""Minimum sigmas of a localised pose per axis: the error that neighbouring poses do not share. Evidence:
none."""
_BIAS_SIGMA_RAD_S, _DELAY_SIGMA_S = 0.003, 0.0005
"""Minimum sigmas of the remaining bias of the gyroscope and of the remaining delay. Evidence: none."""
_MAX_SCALE_SIGMA = 0.1
"""Maximum sigma of the logarithm of the scale. With a larger one, the accelerometer gives no positions."""
_HELD_OUT, _MIN_HELD_OUT = 12, 4
"""Number of stretches that are held out for one length of gaps, and minimum number. Evidence: none."""
_LENGTHS_S = (0.1, 0.2, 0.35, 0.5, 0.75, 1.0)
"""Lengths of held-out gaps, seconds. A gap is compared with the next longer one."""
_QUANTILE, _CHI2_QUANTILE = 0.9, 6.251
"""Quantile of the normalised squared errors that determines the sigmas, and this quantile of χ² with three
degrees of freedom."""
_FACTOR_RANGE = (0.01, 100.0)
"""Smallest and largest factor of the variances. Beyond the largest one, the sensor does not describe the
motion, and nothing is filled."""
_MAX_SIGMA_M, _MAX_SIGMA_DEG = 0.05, 2.0
"""Maximum sigmas, per axis, of a pose that is used. Evidence: none."""
_MAX_WRONG = 2
"""Maximum number of wrong poses beside a gap that are left out. Evidence: none."""
_MAX_WORST_FIX = 8.0
"""Maximum residual of a localised pose beside a gap, in sigmas of six axes. With a larger one, poses beside
the gap are wrong. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FilledGaps:
    """A trajectory whose short gaps were filled.

    Attributes:
        trajectory: The trajectory; filled frames have the status `FrameStatus.INERTIAL`.
        filled: Number of filled frames.
        refused: Number of frames in short gaps that were not filled, because their poses were too uncertain
            or contradicted the poses beside them.
    """

    trajectory: Trajectory
    filled: int
    refused: int


@dataclass(frozen=True, slots=True)
class _Gap:
    """Frames first to last − 1 are lost; the stretch has the frames start to end − 1."""

    first: int
    last: int
    start: int
    end: int


def constants_of_clip(fit: GyroFit, gravity: GravityFit) -> Constants | None:
    """Return the constants that the whole clip gives; None if they are too uncertain for positions.

    Args:
        fit: How the gyroscope relates to the camera.
        gravity: What the windows of this camera alone determine.
    """
    if not gravity.scale_sigma < _MAX_SCALE_SIGMA:
        return None
    mean, change = np.zeros(CONSTANTS), np.zeros((CONSTANTS, len(gravity.solution)))
    places = ((GRAVITY, slice(0, 3), 1.0), (FORCE_BIAS, slice(4, 7), 1.0), (LEVER, slice(7, 10), 1.0))
    for own, other, sign in (*places, (TURN, slice(10, 13), -1.0)):
        mean[own] = sign * gravity.solution[other]
        change[own, other] = sign * np.eye(3)
    mean[LOG_SCALE] = np.log(gravity.metres_per_unit)
    change[LOG_SCALE, 3] = 1.0 / gravity.metres_per_unit
    covariance = change @ gravity.covariance @ change.T
    covariance[GYRO_BIAS, GYRO_BIAS] = np.eye(3) * _BIAS_SIGMA_RAD_S**2
    covariance[DELAY, DELAY] = max(fit.delay_sigma_s, _DELAY_SIGMA_S) ** 2
    return Constants(mean=mean, covariance=covariance + 1e-12 * np.eye(CONSTANTS))


def fill_gaps(trajectory: Trajectory, samples: InertialSamples, constants: Constants) -> FilledGaps:
    """Fill the short gaps of a trajectory.

    Args:
        trajectory: The poses of the camera.
        samples: The samples of its sensor.
        constants: What the whole clip gives.
    """
    filler = _Filler(trajectory, samples, constants)
    poses, covariance = trajectory.gauge_from_cam.copy(), trajectory.covariance.copy()
    status = list(trajectory.status)
    filled = refused = 0
    for gap in filler.gaps():
        found = filler.fill(gap)
        if found is None:
            refused += gap.last - gap.first
            continue
        lost = slice(gap.first, gap.last)
        poses[lost], covariance[lost] = found
        status[lost] = [FrameStatus.INERTIAL] * (gap.last - gap.first)
        filled += gap.last - gap.first
    if not filled:
        return FilledGaps(trajectory=trajectory, filled=0, refused=refused)
    is_filled = np.array([each is FrameStatus.INERTIAL for each in status], dtype=bool)
    return FilledGaps(
        trajectory=replace(
            trajectory,
            gauge_from_cam=poses,
            covariance=covariance,
            status=tuple(status),
            inliers=np.where(is_filled, 0, trajectory.inliers),
            error_px=np.where(is_filled, np.nan, trajectory.error_px),
        ),
        filled=filled,
        refused=refused,
    )


class _Filler:
    """Solves gaps and held-out stretches of one trajectory."""

    def __init__(self, trajectory: Trajectory, samples: InertialSamples, constants: Constants) -> None:
        self._trajectory, self._constants = trajectory, constants
        usable = np.isfinite(samples.force_m_s2).all(axis=1)
        first, last = (int(index) for index in np.flatnonzero(usable)[[0, -1]]) if usable.any() else (0, 0)
        inside = slice(first, last + 1)
        self._samples = replace(
            samples,
            times_s=samples.times_s[inside],
            rate_rad_s=samples.rate_rad_s[inside],
            force_m_s2=samples.force_m_s2[inside],
        )
        self._times_s = trajectory.seconds
        self._known = trajectory.localised & np.asarray(np.diff(self._times_s, prepend=-np.inf) > 0.0)
        scale = float(np.exp(constants.mean[LOG_SCALE][0]))
        self._unit = np.repeat([1.0, scale], 3)
        floor = np.repeat([_MIN_SIGMA_RAD**2, (_MIN_SIGMA_M / scale) ** 2], 3)
        self._covariance = trajectory.covariance + np.diag(floor)
        self._factors: dict[float, tuple[float, float] | None] = {}

    def gaps(self) -> Iterator[_Gap]:
        """Yield the short gaps with enough localised frames on both sides."""
        edges = np.flatnonzero(np.diff(self._known.astype(np.int8)))
        for before, last in zip(edges.tolist(), edges.tolist()[1:], strict=False):
            length_s = float(self._times_s[last + 1] - self._times_s[before])
            if self._known[before] and length_s <= MAX_GAP_S + _ROUNDING_S:
                gap = self._with_margins(before + 1, last + 1, self._known)
                if gap is not None:
                    yield gap

    def fill(self, gap: _Gap) -> tuple[FloatArray, FloatArray] | None:
        """Return poses (G,4,4) and covariances (G,6,6) of the lost frames; None if they cannot be used."""
        factors = self._factors_of(float(self._times_s[gap.last] - self._times_s[gap.first - 1]))
        if factors is None:
            return None
        solved = self._solve_without_wrong(gap)
        if solved is None:
            return None
        lost = slice(gap.first - gap.start, gap.last - gap.start)
        grown = np.repeat(np.sqrt(factors), 3)
        covariance = solved.covariance[lost] * np.outer(grown, grown)
        variance = np.diagonal(covariance, axis1=1, axis2=2) * self._unit**2
        if np.degrees(np.sqrt(variance[:, :3].max())) > _MAX_SIGMA_DEG:
            return None
        if np.sqrt(variance[:, 3:].max()) > _MAX_SIGMA_M:
            return None
        return solved.gauge_from_cam[lost], covariance

    def _solve_without_wrong(self, gap: _Gap) -> SolvedStretch | None:
        """Return the solution of a gap; None if poses beside it are wrong.

        A few isolated wrong poses are left out. They must not be at the ends of the stretch.
        """
        known = self._known.copy()
        for _ in range(_MAX_WRONG + 1):
            solved = self._solve(gap, known)
            if solved is None or solved.worst_fix <= _MAX_WORST_FIX:
                return solved
            known[gap.start + solved.worst_frame] = False
            if self._with_margins(gap.first, gap.last, known) is None:
                return None
            inside = np.flatnonzero(known[gap.start : gap.end])
            if inside[0] != 0 or inside[-1] != gap.end - gap.start - 1:
                return None
        return None

    def _with_margins(self, first: int, last: int, known: BoolArray) -> _Gap | None:
        """Return a gap with the frames beside it; None if there are too few, or samples are missing."""
        times_s = self._times_s
        start = int(np.searchsorted(times_s, times_s[first - 1] - _MARGIN_S))
        end = int(np.searchsorted(times_s, times_s[last] + _MARGIN_S, side="right"))
        inside = np.flatnonzero(known[start:end]) + start
        if not len(inside):
            return None
        start, end = int(inside[0]), int(inside[-1]) + 1
        sides = (inside[inside < first], inside[inside >= last])
        if min(len(side) for side in sides) < _MIN_FIXES:
            return None
        if min(times_s[side[-1]] - times_s[side[0]] for side in sides) < _LEAST_MARGIN_S:
            return None
        if (np.diff(times_s[start:end]) <= 0.0).any():
            return None
        covered = self._samples.covers(times_s[[start]], times_s[[end - 1]])
        return _Gap(first, last, start, end) if covered[0] else None

    def _solve(self, gap: _Gap, known: BoolArray) -> SolvedStretch | None:
        stretch = slice(gap.start, gap.end)
        try:
            solved = solve_stretch(
                Stretch(
                    times_s=self._times_s[stretch],
                    gauge_from_cam=self._trajectory.gauge_from_cam[stretch],
                    covariance=self._covariance[stretch],
                    known=known[stretch],
                ),
                self._samples,
                self._constants,
                _NOISE,
            )
        except np.linalg.LinAlgError:
            return None
        is_finite = np.isfinite(solved.gauge_from_cam).all() and np.isfinite(solved.covariance).all()
        return solved if is_finite else None

    def _factors_of(self, length_s: float) -> tuple[float, float] | None:
        """Return the factors of the variances of rotation and position for gaps of a length.

        None if there are too few stretches to hold out, or if the sensor does not describe the motion.
        """
        length_s = next((each for each in _LENGTHS_S if each >= length_s - _ROUNDING_S), _LENGTHS_S[-1])
        if length_s not in self._factors:
            self._factors[length_s] = self._held_out_factors(length_s)
        return self._factors[length_s]

    def _held_out_factors(self, length_s: float) -> tuple[float, float] | None:
        worst = []
        for gap in self._held_out(length_s):
            known = self._known.copy()
            known[gap.first : gap.last] = False
            solved = self._solve(gap, known)
            if solved is None or solved.worst_fix > _MAX_WORST_FIX:
                continue  # wrong poses beside it say nothing about the sensor
            inner = slice(gap.first - gap.start, gap.last - gap.start)
            worst.append(
                self._normalised_errors(
                    self._trajectory.gauge_from_cam[gap.first : gap.last],
                    solved.gauge_from_cam[inner],
                    solved.covariance[inner],
                )
            )
        if len(worst) < _MIN_HELD_OUT:
            return None
        squared = np.concatenate(worst)
        factors = np.maximum(np.quantile(squared, _QUANTILE, axis=0) / _CHI2_QUANTILE, _FACTOR_RANGE[0])
        return None if (factors > _FACTOR_RANGE[1]).any() else (float(factors[0]), float(factors[1]))

    def _held_out(self, length_s: float) -> list[_Gap]:
        """Return stretches of localised frames that are as long as a gap, spread over the clip."""
        frames: IntArray = np.flatnonzero(self._known)
        ends = np.searchsorted(self._times_s, self._times_s[frames] + length_s - _ROUNDING_S)
        found = []
        for before, last in zip(frames.tolist(), ends.tolist(), strict=True):
            if last >= len(self._known) or last <= before + 1 or not self._known[before : last + 1].all():
                continue
            known = self._known.copy()
            known[before + 1 : last] = False
            gap = self._with_margins(before + 1, last, known)
            if gap is not None:
                found.append(gap)
        return [found[index] for index in evenly_spaced(len(found), _HELD_OUT).tolist()]

    @staticmethod
    def _normalised_errors(truth: FloatArray, found: FloatArray, covariance: FloatArray) -> FloatArray:
        """Return the squared errors (G,2) of rotation and position, divided by their covariance."""
        found_t = np.swapaxes(found[:, :3, :3], 1, 2)
        errors = (
            so3_log(found_t @ truth[:, :3, :3]),
            np.einsum("nij,nj->ni", found_t, truth[:, :3, 3] - found[:, :3, 3]),
        )
        parts = (covariance[:, :3, :3], covariance[:, 3:, 3:])
        squared = [
            np.einsum("ni,ni->n", error, np.linalg.solve(part, error[..., None])[..., 0])
            for error, part in zip(errors, parts, strict=True)
        ]
        return np.stack(squared, axis=1)
