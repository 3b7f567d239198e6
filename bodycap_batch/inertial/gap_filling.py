"""Fill short gaps of a trajectory with poses from the inertial sensor, with honest sigmas.

Stretches of localised frames are solved as if they were gaps of the same length. The errors there scale the
stated sigmas, since neither the noise of a sensor nor the common errors of neighbouring poses are known.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, evenly_spaced
from bodycap_batch.inertial.clip_solver import MAX_FIX_SIGMAS, ClipSolver
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
)
from bodycap_batch.model.geometry import so3_log
from bodycap_batch.model.gravity import GravityFit, prior_sigmas
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.telemetry.gyro_fit import GyroFit

MAX_GAP_S = 1.0
"""Maximum time (seconds) between the two localised frames around a gap that is filled. The error grows with
the square of the time."""
_ROUNDING_S = 1e-3
"""Rounding of times of frames, seconds."""
_MARGIN_S, _LEAST_MARGIN_S, _MIN_FIXES = 0.6, 0.1, 4
"""First: time (seconds) on each side of a gap whose poses are used. Second and third: minimum of this time,
and of the number of localised frames in it, on one of the sides. They give the velocity at this end of the
gap. Evidence: none."""
_MIN_FIXES_OF_ONE_SIDE = 2
"""Minimum number of localised frames on the other side. Its velocity follows from the sensor. A single pose
could be wrong without a contradiction."""
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
_CHI2_MEDIAN = 2.366
"""Median of the same distribution."""
_FACTOR_RANGE = (0.01, 100.0)
"""Smallest and largest factor of the variances. Beyond the largest one, the sensor does not describe the
motion, and nothing is filled."""
_MAX_SIGMA_M, _MAX_SIGMA_DEG = 0.05, 2.0
"""Maximum sigmas, per axis, of a pose that is used. Evidence: none."""
_MAX_WRONG, _MAX_WRONG_RATIO = 2, 0.25
"""Maximum number of wrong poses beside a gap that are left out: this number, or this share of the poses if
that is more. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FilledGaps:
    """The poses of lost frames in short gaps.

    Attributes:
        filled: (N,) True for the frames that got a pose.
        gauge_from_cam: (N,4,4) their poses; any values elsewhere.
        covariance: (N,6,6) the covariances of these poses.
        refused: Number of frames in short gaps that were not filled, because their poses were too uncertain
            or contradicted the poses beside them.
    """

    filled: BoolArray
    gauge_from_cam: FloatArray
    covariance: FloatArray
    refused: int

    def added_to(self, path: Trajectory) -> Trajectory:
        """Return a trajectory with the filled frames, which have the status `FrameStatus.INERTIAL`."""
        filled = self.filled
        if not filled.any():
            return path
        status = [
            FrameStatus.INERTIAL if is_filled else old
            for old, is_filled in zip(path.status, filled.tolist(), strict=True)
        ]
        return replace(
            path,
            gauge_from_cam=np.where(filled[:, None, None], self.gauge_from_cam, path.gauge_from_cam),
            covariance=np.where(filled[:, None, None], self.covariance, path.covariance),
            status=tuple(status),
            inliers=np.where(filled, 0, path.inliers),
            error_px=np.where(filled, np.nan, path.error_px),
        )


@dataclass(frozen=True, slots=True)
class _Gap:
    """Frames first to last − 1 are lost; the stretch has the frames start to end − 1."""

    first: int
    last: int
    start: int
    end: int


def constants_of_clip(fit: GyroFit, gravity: GravityFit, *, has_windows: bool = True) -> Constants | None:
    """Return the constants that the whole clip gives; None if they are too uncertain for positions.

    Args:
        fit: How the gyroscope relates to the camera.
        gravity: What the windows of all cameras of the map determine. Those of this camera are the first
            ones.
        has_windows: False if this camera has no windows. Its own bias, distance and turn then have only
            their priors.
    """
    if not gravity.scale_sigma < _MAX_SCALE_SIGMA:
        return None
    mean, change = np.zeros(CONSTANTS), np.zeros((CONSTANTS, len(gravity.solution)))
    own_places = ((FORCE_BIAS, slice(4, 7), 1.0), (LEVER, slice(7, 10), 1.0), (TURN, slice(10, 13), -1.0))
    for own, other, sign in ((GRAVITY, slice(0, 3), 1.0), *(own_places if has_windows else ())):
        mean[own] = sign * gravity.solution[other]
        change[own, other] = sign * np.eye(3)
    mean[LOG_SCALE] = np.log(gravity.metres_per_unit)
    change[LOG_SCALE, 3] = 1.0 / gravity.metres_per_unit
    covariance = change @ gravity.covariance @ change.T
    if not has_windows:
        for place, sigma in zip((FORCE_BIAS, LEVER, TURN), prior_sigmas(fit.rotation_sigma_rad), strict=True):
            covariance[place, place] = np.diag(sigma**2)
    covariance[GYRO_BIAS, GYRO_BIAS] = np.eye(3) * _BIAS_SIGMA_RAD_S**2
    covariance[DELAY, DELAY] = max(fit.delay_sigma_s, _DELAY_SIGMA_S) ** 2
    return Constants(mean=mean, covariance=covariance + 1e-12 * np.eye(CONSTANTS))


def fill_gaps(solver: ClipSolver, others: Sequence[ClipSolver] = ()) -> FilledGaps:
    """Fill the short gaps of a trajectory.

    Args:
        solver: The poses of the camera and the samples of its sensor.
        others: The same of other cameras of the map. Their held-out stretches give the sigmas if those of
            this camera do not.
    """
    filler = _Filler(solver, [_Filler(other) for other in others])
    poses, covariance = solver.trajectory.gauge_from_cam.copy(), solver.trajectory.covariance.copy()
    filled, refused = np.zeros(len(poses), dtype=bool), 0
    for gap in filler.gaps():
        lost, found = slice(gap.first, gap.last), filler.fill(gap)
        if found is None:
            refused += gap.last - gap.first
        else:
            poses[lost], covariance[lost] = found
            filled[lost] = True
    return FilledGaps(filled=filled, gauge_from_cam=poses, covariance=covariance, refused=refused)


class _Filler:
    """Solves gaps and held-out stretches of one trajectory."""

    def __init__(self, solver: ClipSolver, others: Sequence[_Filler] = ()) -> None:
        self._solver, self._others = solver, others
        self._times_s, self._known = solver.times_s, solver.known
        self._unit = np.repeat([1.0, solver.metres_per_unit], 3)
        self._errors: dict[float, list[FloatArray]] = {}

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
        found = self._solve_without_wrong(gap)
        if found is None:
            return None
        gap, solved = found
        lost = slice(gap.first - gap.start, gap.last - gap.start)
        grown = np.repeat(np.sqrt(factors), 3)
        covariance = solved.covariance[lost] * np.outer(grown, grown)
        variance = np.diagonal(covariance, axis1=1, axis2=2) * self._unit**2
        if np.degrees(np.sqrt(variance[:, :3].max())) > _MAX_SIGMA_DEG:
            return None
        if np.sqrt(variance[:, 3:].max()) > _MAX_SIGMA_M:
            return None
        return solved.gauge_from_cam[lost], covariance

    def _solve_without_wrong(self, gap: _Gap) -> tuple[_Gap, SolvedStretch] | None:
        """Return a gap with its solution; None if too many poses beside it are wrong.

        Wrong poses are left out. The stretch may become shorter by them.
        """
        known = self._known.copy()
        most = max(_MAX_WRONG, int(_MAX_WRONG_RATIO * known[gap.start : gap.end].sum()))
        for _ in range(most + 1):
            found = self._solver.solve_grown(gap.start, gap.end, known)
            if found is None:
                return None
            solved, _ = found
            if solved.worst_fix <= MAX_FIX_SIGMAS:
                return gap, solved
            known[gap.start + solved.worst_frame] = False
            shorter = self._with_margins(gap.first, gap.last, known)
            if shorter is None:
                return None
            gap = shorter
        return None

    def _with_margins(self, first: int, last: int, known: BoolArray) -> _Gap | None:
        """Return a gap with the frames beside it; None if there are too few, or samples are missing."""
        times_s = self._times_s
        start_s, end_s = self._solver.samples.times_s[[0, -1]]  # the other frames have no samples
        start = int(np.searchsorted(times_s, max(times_s[first - 1] - _MARGIN_S, start_s)))
        end = int(np.searchsorted(times_s, min(times_s[last] + _MARGIN_S, end_s), side="right"))
        inside = np.flatnonzero(known[start:end]) + start
        if not len(inside):
            return None
        start, end = int(inside[0]), int(inside[-1]) + 1
        sides = (inside[inside < first], inside[inside >= last])
        counts = sorted(len(side) for side in sides)
        if counts[0] < _MIN_FIXES_OF_ONE_SIDE or counts[1] < _MIN_FIXES:
            return None
        if max(times_s[side[-1]] - times_s[side[0]] for side in sides) < _LEAST_MARGIN_S:
            return None
        if (np.diff(times_s[start:end]) <= 0.0).any():
            return None
        measured = self._solver.samples.covers(times_s[[first - 1]], times_s[[last]])
        return _Gap(first, last, start, end) if measured[0] else None

    def _factors_of(self, length_s: float) -> tuple[float, float] | None:
        """Return the factors of the variances of rotation and position for gaps of a length.

        They come from stretches of this camera. If these are too few, or if wrong poses are among them, they
        come from the other cameras, unless most stretches of this camera have larger errors.

        None if there are too few stretches to hold out, or if the sensor does not describe the motion.
        """
        length_s = next((each for each in _LENGTHS_S if each >= length_s - _ROUNDING_S), _LENGTHS_S[-1])
        own = self._own_factors(length_s)
        return self._factors_with_others(length_s) if own is None else own

    def _own_factors(self, length_s: float) -> tuple[float, float] | None:
        """Return the factors that the stretches of this camera give."""
        errors = self._held_out_errors(length_s)
        if len(errors) < _MIN_HELD_OUT:
            return None
        factors = np.quantile(np.concatenate(errors), _QUANTILE, axis=0) / _CHI2_QUANTILE
        factors = np.maximum(factors, _FACTOR_RANGE[0])
        return None if (factors > _FACTOR_RANGE[1]).any() else (float(factors[0]), float(factors[1]))

    def _factors_with_others(self, length_s: float) -> tuple[float, float] | None:
        """Return the largest factors of the other cameras, and at least the typical ones of this camera."""
        found = [each for each in (other._own_factors(length_s) for other in self._others) if each]
        if not found:
            return None
        errors = self._held_out_errors(length_s)
        if errors:
            typical = np.median(np.concatenate(errors), axis=0) / _CHI2_MEDIAN
            if (typical > _FACTOR_RANGE[1]).any():
                return None
            found.append((float(typical[0]), float(typical[1])))
        return max(each[0] for each in found), max(each[1] for each in found)

    def _held_out_errors(self, length_s: float) -> list[FloatArray]:
        """Return the normalised squared errors (G,2) of each held-out stretch."""
        if length_s in self._errors:
            return self._errors[length_s]
        errors = self._errors[length_s] = []
        for gap in self._held_out(length_s):
            known = self._known.copy()
            known[gap.first : gap.last] = False
            solution = self._solver.solve_grown(gap.start, gap.end, known)
            if solution is None or solution[0].worst_fix > MAX_FIX_SIGMAS:
                continue  # wrong poses beside it say nothing about the sensor
            solved, growth = solution
            inner = slice(gap.first - gap.start, gap.last - gap.start)
            held_out = slice(gap.first, gap.last)
            # The errors of the held-out poses are as much larger than stated as those beside them.
            excess = (growth - 1.0) * self._solver.covariance[held_out]
            errors.append(
                self._normalised_errors(
                    self._solver.trajectory.gauge_from_cam[held_out],
                    solved.gauge_from_cam[inner],
                    solved.covariance[inner] + excess,
                )
            )
        return errors

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
