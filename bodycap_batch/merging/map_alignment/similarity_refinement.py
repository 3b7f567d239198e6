"""Refinement of the similarities of further maps, by Gauss-Newton steps on the body's calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging.body_calibration.calibration_covariance import (
    PoseSigma,
    measurement_jacobian,
    scale_jacobian,
)
from bodycap_batch.merging.body_calibration.mount_calibration_graph import CalibrationGraph
from bodycap_batch.merging.body_calibration.mount_covariance import LinearisedCalibration
from bodycap_batch.merging.body_calibration.scale import ScaleSource
from bodycap_batch.model.geometry import Similarity, so3_exp

_SLACK_SCHEDULE = (16.0, 4.0, 1.0)
"""Factors on the slack of the joints, one for each successive solution. With a large slack, a joint gap of a
decimetre keeps its full weight, and the robust loss does not treat this gap as a gross error."""
_MAX_STEPS = 8
"""Maximum number of steps of one descent. Evidence: none."""
_CONVERGED = 1e-3
"""Minimum relative change of the cost per step. A step with a smaller change is the last step. Evidence:
none."""


class MapAlignmentProblem:
    """A calibration with the similarities of further maps as unknowns. All other unknowns are eliminated.

    Attributes:
        corrections: For each further map, the similarity from the initial alignment to the solved alignment.

    Args:
        calibration: Graph of the calibration, with all maps at their initial similarities.
        groups: Names of the cameras of each further map.
        scale: Provisional scale, metres per unit of the main map.
        reach_sigma: Sigma of the logarithm of the provisional scale.
        stated: Scales given in the job.
    """

    def __init__(
        self,
        calibration: CalibrationGraph,
        groups: Sequence[tuple[str, ...]],
        scale: float,
        *,
        reach_sigma: float,
        stated: Sequence[ScaleSource] = (),
    ) -> None:
        self._calibration, self._scale = calibration, scale
        self._sources: tuple[ScaleSource, ...] = (
            ScaleSource(name="reach", scale=scale, sigma_log=reach_sigma),
            *stated,
        )
        cameras = calibration.samples.cameras
        self._members = [[cameras.index(name) for name in group] for group in groups]
        self.corrections = [Similarity(1.0, np.eye(3), np.zeros(3)) for _ in groups]
        self._covariance = np.zeros((0, 0))

    def solve(self) -> None:
        """Move the maps until the cost no longer decreases, once for each slack in `_SLACK_SCHEDULE`."""
        for slack in _SLACK_SCHEDULE:
            self._calibration.slack_factor = slack
            self._descend()
        self._calibration.leave_out_map_errors()
        self._descend()
        _, self._covariance = self._step(0.0)

    def scale(self) -> ScaleSource:
        """Return the solved scale of the main map."""
        sigma = float(np.sqrt(self._covariance[0, 0]))
        return ScaleSource(name="body", scale=self._scale, sigma_log=sigma)

    def add_scale_sources(self, sources: Sequence[ScaleSource]) -> None:
        """Solve again with further sources of the scale."""
        if sources:
            self._sources += tuple(sources)
            self._descend()
            _, self._covariance = self._step(0.0)

    def _descend(self) -> None:
        """Take damped steps until the cost hardly changes."""
        cost = self._cost()
        damping = 1e-4
        for _ in range(_MAX_STEPS):
            change, _ = self._step(damping)
            before = self._calibration.samples, self._scale, list(self.corrections)
            self._apply(change)
            trial = self._cost()
            converged = abs(trial - cost) < _CONVERGED * max(cost, 1.0)
            if trial > cost:
                self._calibration.samples, self._scale, self.corrections = before
                self._calibration.solve(self._scale)
                damping = max(100.0 * damping, 1e-2)
            else:
                cost, damping = trial, 0.1 * damping
            if converged:
                break

    def sigmas(self, index: int) -> PoseSigma:
        """Return the sigmas of a map's rotation and of the sampled positions of this map's cameras.

        Args:
            index: Index of the further map.
        """
        centres, middle = self._centres(index)
        unknowns = slice(1 + 7 * index, 8 + 7 * index)
        values, vectors = np.linalg.eigh(self._covariance[unknowns, unknowns])
        modes = vectors * np.sqrt(np.maximum(values, 0.0))
        off = (centres - middle)[:, :, None]
        by_rotation = np.cross(modes[None, :3].swapaxes(1, 2), off.swapaxes(1, 2)).swapaxes(1, 2)
        shifts = by_rotation + off * modes[None, 3:4] + modes[None, 4:]
        position = (shifts**2).sum(axis=(1, 2)).mean()
        return PoseSigma(float(np.sqrt((modes[:3] ** 2).sum() / 3.0)), float(np.sqrt(position / 3.0)))

    def _centres(self, index: int) -> tuple[FloatArray, FloatArray]:
        """Return the sampled centres (N,3) of a further map's cameras, metres, and their mean (3,)."""
        samples, members = self._calibration.samples, self._members[index]
        centres = self._scale * samples.map_from_cam[members][samples.valid[members], :3, 3]
        return centres, centres.mean(axis=0)

    def _step(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """Return the Gauss-Newton step that lowers the cost, with its covariance.

        Args:
            damping: Relative increase of the diagonal of the normal equations.

        Returns:
            For G further maps, (1 + 7 G,) change of the log scale, and of each map's rotation, log scale and
            translation. Then (1 + 7 G, 1 + 7 G) the covariance of this change.
        """
        mounts, derivatives = self._linearised()
        solved = mounts.reduced(derivatives)
        count = derivatives.shape[1]
        source_rows = np.zeros((len(self._sources), solved.jacobian.shape[1]))
        source_rows[:, -count] = [1.0 / source.sigma_log for source in self._sources]
        influence = np.vstack([solved.jacobian, source_rows])
        rhs = np.append(mounts.linear.rhs, -self._source_residuals())
        normal = influence.T @ influence
        variance = np.append(mounts.row_variances(), np.ones(len(source_rows)))
        gain = _solve_normal_equations(normal, influence.T)
        # A systematic bias of the posture changes both mounts and maps.
        by_bias = (mounts.posture_bias_jacobian().T @ gain[:, : -len(source_rows)].T).T
        covariance = (gain * variance) @ gain.T + by_bias @ by_bias.T
        free = np.arange(len(normal) - count, len(normal))
        normal[free, free] *= 1.0 + damping
        change = _solve_normal_equations(normal, influence.T @ rhs)[-count:]
        return np.asarray(change, dtype=np.float64), np.asarray(covariance[-count:, -count:])

    def _linearised(self) -> tuple[LinearisedCalibration, FloatArray]:
        """Linearise the calibration.

        Returns:
            The linearised calibration with derivatives with respect to bones and mounts, and the derivatives
            (R,1 + 7 G) with respect to the log scale and the maps.
        """
        mounts = self._calibration.linearised()
        derivatives = -measurement_jacobian(self._calibration, mounts.linear, self._directions())
        derivatives[:, 0] -= scale_jacobian(self._calibration, mounts)
        return mounts, derivatives

    def _cost(self) -> float:
        """Return the cost at the current scale and corrections.

        Raises:
            EstimationError: The calibration has no finite solution there. The step to it was too large,
                because the movement hardly determines the position of a map.
        """
        try:
            calibration = self._calibration.solve(self._scale)
        except np.linalg.LinAlgError as error:
            raise _undetermined() from error
        return calibration + 0.5 * float((self._source_residuals() ** 2).sum())

    def scale_residual(self) -> float:
        """Return the difference of the log scale from the log scale of the limbs' reach, in sigmas."""
        return float(self._source_residuals()[0])

    def _source_residuals(self) -> FloatArray:
        """Return the difference (S,) of the log scale from the log scale of each source, in sigmas."""
        return np.array([np.log(self._scale / each.scale) / each.sigma_log for each in self._sources])

    def _directions(self) -> FloatArray:
        """Return the derivatives (C,K,P,6) of K poses of each camera with respect to the P unknowns.

        A derivative consists of a rotation (radians) and a translation (metres) in the axes of the main map.
        """
        samples = self._calibration.samples
        centres = self._scale * samples.map_from_cam[..., :3, 3]
        out = np.zeros((*centres.shape[:2], 1 + 7 * len(self._members), 6))
        valid = samples.valid
        out[:, :, 0, 3:] = centres - centres[valid].mean(axis=0)
        for index, members in enumerate(self._members):
            first = 1 + 7 * index
            off = centres[members] - self._centres(index)[1]
            for axis, unit in enumerate(np.eye(3)):
                out[members, :, first + axis, :3] = unit
                out[members, :, first + axis, 3:] = np.cross(unit, off)
                out[members, :, first + 4 + axis, 3 + axis] = 1.0
            out[members, :, first + 3, 3:] = off
        return out

    def _apply(self, change: FloatArray) -> None:
        """Move the samples by a step, and apply the step to the corrections of the maps."""
        samples = self._calibration.samples
        poses = samples.map_from_cam.copy()
        for index, members in enumerate(self._members):
            turn, log_factor, shift = np.split(change[1 + 7 * index : 8 + 7 * index], [3, 4])
            middle = self._centres(index)[1] / self._scale
            rotation, factor = so3_exp(turn), float(np.exp(log_factor[0]))
            update = Similarity(factor, rotation, middle + shift / self._scale - factor * rotation @ middle)
            poses[members] = update.apply_to_poses(poses[members])
            self.corrections[index] = update.after(self.corrections[index])
        self._calibration.samples = replace(samples, map_from_cam=poses)
        self._scale *= float(np.exp(change[0]))


def _solve_normal_equations(normal: FloatArray, right: FloatArray) -> FloatArray:
    """Solve the normal equations of the alignment.

    Raises:
        EstimationError: The equations are singular.
    """
    try:
        return np.asarray(np.linalg.solve(normal, right), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise _undetermined() from error


def _undetermined() -> EstimationError:
    """Return the error of a map whose position relative to the main map is not determined."""
    return EstimationError(
        "the body's movement does not determine the position of this map relative to the main map",
        hint="bend the body, turn while walking, wear a camera on an upper arm, or film one place "
        "with cameras of both maps",
    )
