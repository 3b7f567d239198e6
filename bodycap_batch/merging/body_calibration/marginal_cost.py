"""The cost of a metric scale, if all other unknowns of the calibration are eliminated by integration.

The lowest cost of the calibration graph at a scale is that of the most likely body poses and mounts. As a
measure of the scale it is biased: a smaller body has shorter distances to explain, and a bent arm reaches a
given palm with smaller changes of its angles. Most of the bias disappears if the unknowns are integrated
instead (Laplace's approximation): half the logarithm of the determinant of the information matrix is added to
the cost, in units of the map, in which the camera poses were measured.

The posture has two parts. The bias is constant over the capture. The variation differs between gestures, and
the samples of one gesture together count as one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging.body_calibration.mount_calibration_graph import POINTS_PER_MOUNT, CalibrationGraph
from bodycap_batch.merging.body_calibration.mount_covariance import LinearisedCalibration, RowType
from bodycap_batch.merging.graph.error_modes import POSTURE_BIAS_SHARE, ErrorModes, joint_residual_jacobian
from bodycap_batch.merging.graph.joint_priors import samples_per_gesture
from bodycap_batch.model.geometry import so3_exp

_VARIATION_SHARE = 0.2
"""Variance of a joint's rotation within a capture, as a fraction of the variance of its everyday range.

Evidence: docs/decisions/body_calibration.md.
"""
_MAX_ROUNDS = 5
"""Maximum number of changes of the bias at one scale. Evidence: none."""
_MAX_STEP_RAD = 0.5
"""Maximum change of a bias in one round, radians per axis. Evidence: none."""
_CONVERGED_RAD = 0.01
"""The bias is final if no axis changes by more than this angle, radians. Evidence: none."""
_CONVERGED_COST = 0.005
"""The bias is final if the cost changes by less than this value, half a squared sigma. Evidence: none."""


class MarginalCost:
    """The cost of a scale without bone poses, mounts and posture.

    Each evaluation starts from the solution of the previous one.

    Args:
        graph: The calibration graph, solved once. Its joint priors are the priors of the bias of the posture.
            The graph is not changed.
    """

    def __init__(self, graph: CalibrationGraph) -> None:
        samples = graph.samples
        usual = ~samples.posture.t_pose
        repeated = samples_per_gesture(samples.times_ns[usual]) if usual.any() else 1.0
        self._weights = np.where(usual, 1.0 / repeated, 1.0 / max(int(samples.posture.t_pose.sum()), 1))
        self._rest = tuple(
            replace(bone, rotation_covariance=everyday.rotation_covariance)
            for bone, everyday in zip(graph.rest_bones, graph.bones, strict=True)
        )
        self._jointed = [index for index, bone in enumerate(self._rest) if bone.parent >= 0]
        self._precision = np.array(
            [
                np.linalg.inv(POSTURE_BIAS_SHARE**2 * graph.rest_bones[index].rotation_covariance)
                for index in self._jointed
            ]
        ).reshape(-1, 3, 3)
        self._bias = np.zeros((len(self._jointed), 3))
        self._graph = graph.with_joint_priors(self._rest, float(np.sqrt(_VARIATION_SHARE * repeated)))

    def __call__(self, scale: float) -> float:
        """Return the cost of a scale.

        Args:
            scale: Metres per map unit.

        Returns:
            The negative logarithm of the probability density of log scale, without a constant.

        Raises:
            EstimationError: The equations are singular.
        """
        try:
            return self._cost(scale)
        except np.linalg.LinAlgError as error:
            raise EstimationError(
                f"the data do not determine the poses of the cameras on the body ({error})",
                hint="record a longer capture with more movement, or use fewer cameras",
            ) from error

    def _cost(self, scale: float) -> float:
        before = np.inf
        for _ in range(_MAX_ROUNDS):
            bias_cost = 0.5 * np.einsum("ji,jik,jk->", self._bias, self._precision, self._bias)
            cost = self._graph.solve(scale) + float(bias_cost)
            linearised = self._graph.linearised()
            poses = linearised.eliminate_poses(self._bias_jacobian(linearised))
            information = poses.jacobian.T @ poses.jacobian
            gradient = poses.jacobian.T @ linearised.linear.rhs
            first = len(information) - self._bias.size
            for joint, precision in enumerate(self._precision):
                part = slice(first + 3 * joint, first + 3 * joint + 3)
                information[part, part] += precision
                gradient[part] -= precision @ self._bias[joint]
            step = np.linalg.solve(information, gradient)[first:].reshape(-1, 3)
            if abs(before - cost) < _CONVERGED_COST or np.abs(step).max(initial=0.0) < _CONVERGED_RAD:
                break
            before = cost
            self._move_bias(np.clip(step, -_MAX_STEP_RAD, _MAX_STEP_RAD))
        return cost + self._volume(scale, poses.half_log_det, information)

    def _volume(self, scale: float, half_log_det: FloatArray, information: FloatArray) -> float:
        """Return half the logarithm of the determinant of the information matrix, in units of the map.

        The constants of the normal distributions whose sigmas are lengths in the map are included: gaps of
        the joints, distances of the hinges, axis points of the mounts.

        Args:
            scale: Metres per map unit.
            half_log_det: (K,) half the logarithm of the determinant of each tick's information matrix.
            information: (U,U) information matrix of the unknowns that all ticks share.
        """
        lengths = 3.0 * len(self._rest) * np.log(scale)
        hinges = 2.0 * np.log(self._graph.hinge_sigmas_m(scale)).sum()
        axis_points = 3.0 * (POINTS_PER_MOUNT - 1) * len(self._graph.samples.cameras) * np.log(scale)
        common = 0.5 * np.linalg.slogdet(information)[1] + axis_points
        return float(self._weights @ (half_log_det + lengths + hinges) + common)

    def _bias_jacobian(self, linearised: LinearisedCalibration) -> FloatArray:
        """Return the derivative (R,3·J) of the residuals with respect to the bias of J joints."""
        rows, count = len(linearised.row_types), self._bias.size
        if not count:
            return np.zeros((rows, 0))
        turns = np.zeros((len(self._rest), 3, count))
        for joint, bone in enumerate(self._jointed):
            turns[bone, :, 3 * joint : 3 * joint + 3] = np.eye(3)
        modes = ErrorModes(
            mounts={camera: np.zeros((6, count)) for camera in linearised.mount_columns},
            log_scale=np.zeros(count),
            rest=turns,
            offsets_m=np.zeros_like(turns),
        )
        # The result has the sign of the right-hand side.
        shifts = joint_residual_jacobian(
            linearised.linear,
            linearised.body,
            linearised.first_joint_factor,
            linearised.world_from_bone,
            modes,
        )
        # In a T-pose, the posture has a prior of its own.
        return np.where((linearised.row_types == RowType.PRIOR)[:, None], 0.0, -shifts.toarray())

    def _move_bias(self, step: FloatArray) -> None:
        """Add a change (J,3), radians, to the bias of the J joints."""
        self._bias += step
        bones = list(self._rest)
        for index, bias in zip(self._jointed, self._bias, strict=True):
            bone = self._rest[index]
            bones[index] = replace(bone, mean_rotation=bone.mean_rotation @ so3_exp(bias))
        self._graph.set_joint_priors(bones)
