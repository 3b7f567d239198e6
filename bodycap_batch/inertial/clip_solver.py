"""Solve stretches of one camera's clip from its poses and the samples of its inertial sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray
from bodycap_batch.inertial.gap_solver import LOG_SCALE, Constants, SolvedStretch, Stretch, solve_stretch
from bodycap_batch.inertial.preintegration import SensorNoise
from bodycap_batch.inertial.samples import InertialSamples
from bodycap_batch.model.scene import FrameStatus, Trajectory

_NOISE = SensorNoise(gyro=4e-4, force=1e-2)
"""Noise densities, rad/s/√Hz and m/s²/√Hz: those of consumer's sensors; that of the force contains errors of
its scale. Held-out stretches correct the sigmas of gaps."""
_MIN_SIGMA_RAD, _MIN_SIGMA_M = float(np.radians(0.1)), 0.001
"""Minimum sigmas of a localised pose per axis: the error that neighbouring poses do not share. Evidence:
none."""
MAX_FIX_SIGMAS = 8.0
"""Maximum residual of a localised pose, in sigmas of six axes. A pose with a larger one is wrong. Evidence:
none."""

_MEDIAN_SIGMAS, _LEAST_RATIO = 2.3, 1.3
"""First: median length of six independent normally distributed residuals, in sigmas. Derivation: the square
root of the median of a chi-squared variable with six degrees of freedom, 5.35. Second: ratio of the median to
it above which the covariances of the poses are enlarged. Evidence: none."""
_GROWTH_ROUNDS, _MAX_GROWTH = 3, 25.0
"""Maximum number of times that they are enlarged, and maximum factor of the covariances: poses that rest on
few points were wrong by up to four of their sigmas in common. Evidence: docs/decisions/telemetry.md."""


class ClipSolver:
    """The poses and the samples of one clip.

    Attributes:
        trajectory: The poses of the camera.
        samples: The samples of its sensor, without those before and after the accelerometer's.
        constants: What the whole clip gives.
        times_s: (N,) times of the frames.
        known: (N,) True for localised frames whose time is later than that of the frame before.
        metres_per_unit: Scale of the gauge.
        covariance: (N,6,6) covariances of the poses, with the error of each single pose.
    """

    def __init__(self, trajectory: Trajectory, samples: InertialSamples, constants: Constants) -> None:
        self.trajectory, self.constants = trajectory, constants
        usable = np.isfinite(samples.force_m_s2).all(axis=1)
        first, last = (int(index) for index in np.flatnonzero(usable)[[0, -1]]) if usable.any() else (0, 0)
        inside = slice(first, last + 1)
        self.samples = replace(
            samples,
            times_s=samples.times_s[inside],
            rate_rad_s=samples.rate_rad_s[inside],
            force_m_s2=samples.force_m_s2[inside],
        )
        self.times_s = trajectory.seconds
        self.known = trajectory.localised & np.asarray(np.diff(self.times_s, prepend=-np.inf) > 0.0)
        self.metres_per_unit = float(np.exp(constants.mean[LOG_SCALE][0]))
        floor = np.repeat([_MIN_SIGMA_RAD**2, (_MIN_SIGMA_M / self.metres_per_unit) ** 2], 3)
        self.covariance = trajectory.covariance + np.diag(floor)

    def without(self, left_out: BoolArray) -> ClipSolver:
        """Return a solver in which some frames (N,) count as lost."""
        if not left_out.any():
            return self
        path = self.trajectory.without(left_out, FrameStatus.CONTRADICTED)
        return ClipSolver(path, self.samples, self.constants)

    def solve(self, start: int, end: int, known: BoolArray, growth: float = 1.0) -> SolvedStretch | None:
        """Solve the frames [start, end); None if the equations have no finite solution.

        Args:
            start: First frame. It must be known, like the last one.
            end: One past the last frame.
            known: (N,) True for the frames whose pose is used.
            growth: Factor of the covariances of these poses.
        """
        stretch = slice(start, end)
        try:
            solved = solve_stretch(
                Stretch(
                    times_s=self.times_s[stretch],
                    gauge_from_cam=self.trajectory.gauge_from_cam[stretch],
                    covariance=growth * self.covariance[stretch],
                    known=known[stretch],
                ),
                self.samples,
                self.constants,
                _NOISE,
            )
        except np.linalg.LinAlgError:
            return None
        is_finite = np.isfinite(solved.gauge_from_cam).all() and np.isfinite(solved.covariance).all()
        return solved if is_finite else None

    def solve_grown(self, start: int, end: int, known: BoolArray) -> tuple[SolvedStretch, float] | None:
        """Solve the frames [start, end) with larger covariances of the poses, if most of them need it.

        Args:
            start: As in `solve`.
            end: As in `solve`.
            known: As in `solve`.

        Returns:
            The solution and the factor of the covariances; None if there is no finite solution.
        """
        growth, solved = 1.0, self.solve(start, end, known)
        for _ in range(_GROWTH_ROUNDS):
            if solved is None:
                return None
            ratio = float(np.median(solved.fix_sigmas)) / _MEDIAN_SIGMAS
            if ratio < _LEAST_RATIO or growth * ratio**2 > _MAX_GROWTH:
                break
            growth *= ratio**2
            solved = self.solve(start, end, known, growth)
        return None if solved is None else (solved, growth)
