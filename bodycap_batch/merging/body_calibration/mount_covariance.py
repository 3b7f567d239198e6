"""Estimate the covariance of the calibrated mounts from the assumed errors of the calibration graph.

Near the solution, the mounts are a linear function of the noise in the rows of residuals. The covariance has
the sandwich form, because the graph uses wider joint rotation priors than those that are assumed here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import sparse
from scipy.linalg import block_diag

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging.graph.error_modes import (
    POSTURE_BIAS_SHARE,
    BodyModel,
    ErrorModes,
    joint_residual_jacobian,
    no_modes,
    posture_bias_modes,
    stack_modes,
)
from bodycap_batch.merging.graph.factors import bone_key
from bodycap_batch.merging.graph.linearisation import LinearisedGraph
from bodycap_batch.model.nominal_mounts import NOMINAL_ERROR_RAD, NOMINAL_SIGMA_RAD

JOINT_PRIOR_SCALE = 4.0
"""Factor on the sigmas of the joint rotation priors in the calibration graph.

The graph applies each prior once per sampled tick. Without the factor, these repeated priors would outweigh
the measurements. Evidence: none.
"""
TRANSIENT_SHARE = float(np.sqrt(1.0 - POSTURE_BIAS_SHARE**2))
"""Transient part of the sigma of a joint's rotation prior, as a fraction of this sigma.

The rotation prior has a constant and a transient part. The constant part is one posture bias for the whole
capture. It has the fraction `POSTURE_BIAS_SHARE` of the sigma. The transient part varies within the capture.
The squares of the two fractions add up to 1.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearisedCalibration:
    """A calibration graph, linearised at its solution, to estimate the uncertainty of the mounts.

    Different ticks share only the unknowns of the mounts.

    Attributes:
        linear: The whitened Jacobian, with R rows, and its right-hand side.
        body: Bones and hinges of the graph.
        world_from_bone: (K,B,4,4) solved bone poses at K ticks, metres.
        mount_columns: By camera, indices (12,) of the columns that belong to the camera's mount.
        mount_jacobian: By camera, (6,12) derivative of the right perturbation of joint_from_cam with respect
            to the 12 unknowns of the mount. The perturbation is a rotation, then a translation.
        first_joint_factor: Index of the first joint factor in the graph.
        t_pose: (K,) True for the ticks in a T-pose.
        named_mounts: Indices of the factors of mount rotations that only the camera's name gives.
    """

    linear: LinearisedGraph
    body: BodyModel
    world_from_bone: FloatArray
    mount_columns: Mapping[str, IntArray]
    mount_jacobian: Mapping[str, FloatArray]
    first_joint_factor: int
    t_pose: BoolArray
    named_mounts: IntArray

    def reduced(self, common_jacobian: FloatArray | None = None) -> ReducedSystem:
        """Eliminate the bone poses of all ticks, so that only the unknowns of the mounts remain.

        The unknowns of `common_jacobian` remain as well.

        Args:
            common_jacobian: (R,P) derivatives of the rows with respect to P additional unknowns that all
                ticks share; None without such unknowns.

        Returns:
            The linear system of the remaining unknowns.

        Raises:
            EstimationError: The equations are singular.
        """
        try:
            return self._reduced(common_jacobian)
        except np.linalg.LinAlgError as error:
            raise EstimationError(
                f"the data do not determine the poses of the cameras on the body ({error})",
                hint="record a longer capture with more movement, or use fewer cameras",
            ) from error

    def _reduced(self, common_jacobian: FloatArray | None) -> ReducedSystem:
        matrix = self.linear.matrix
        mounts = np.concatenate(list(self.mount_columns.values()))
        jacobian = matrix[:, mounts].toarray()
        if common_jacobian is not None:
            jacobian = np.hstack([jacobian, common_jacobian])
        pose_leverage = np.zeros(matrix.shape[0])
        by_column = matrix.tocsc()
        for tick in range(len(self.world_from_bone)):
            start = self.linear.columns[bone_key(tick, 0)]
            columns = by_column[:, start : start + 6 * len(self.body.bones)]
            rows = np.unique(columns.indices)
            dense = columns[rows].toarray()
            normal = np.linalg.inv(dense.T @ dense)
            half = dense @ normal
            jacobian[rows] -= half @ (dense.T @ jacobian[rows])
            pose_leverage[rows] = (half * dense).sum(axis=1)
        covariance = np.linalg.inv(jacobian.T @ jacobian)
        leverage = pose_leverage + np.einsum("ri,ij,rj->r", jacobian, covariance, jacobian)
        return ReducedSystem(jacobian=jacobian, covariance=covariance, redundancy=1.0 - leverage)

    def rotation_rows(self, ticks: IntArray) -> IntArray:
        """Return the indices of the rows of all joint rotation priors at some ticks."""
        joints = np.arange(sum(bone.parent >= 0 for bone in self.body.bones))
        factors = self.first_joint_factor + self.body.factors_per_tick * ticks[:, None] + joints
        return np.asarray((self.linear.first_row[factors][..., None] + np.arange(3)).ravel())

    def row_variances(self) -> FloatArray:
        """Return the variance (R,) of each row, as a fraction of the variance that the graph assumes.

        The graph uses joint rotation priors with widened sigmas. The result restores the original sigmas,
        reduced to the transient part, because only this part differs between samples. A T-pose has a prior of
        its own. The rotations of named mounts have wider priors than their expected error, too.
        """
        out = np.ones(self.linear.matrix.shape[0])
        rows = self.rotation_rows(np.flatnonzero(~self.t_pose))
        out[rows] = (TRANSIENT_SHARE / JOINT_PRIOR_SCALE) ** 2
        named = self.linear.first_row[self.named_mounts][:, None] + np.arange(3)
        out[named] = (NOMINAL_ERROR_RAD / NOMINAL_SIGMA_RAD) ** 2
        return out

    def posture_bias_jacobian(self) -> Any:
        """Return the change of the residuals that each error mode of the posture bias causes at one sigma.

        Returns:
            (R,M) sparse matrix for M modes.
        """
        modes = posture_bias_modes(self.body.bones, tuple(self.mount_columns), POSTURE_BIAS_SHARE)
        return joint_residual_jacobian(
            self.linear, self.body, self.first_joint_factor, self.world_from_bone, modes
        )

    def error_modes(self, reduced: ReducedSystem, body_modes: ErrorModes) -> ErrorModes:
        """Return the error modes of the mounts.

        Args:
            reduced: The reduced system of this linearisation.
            body_modes: Error modes of the assumed body.

        Returns:
            First, the error modes of the mounts due to noise in the residual rows. Second, the modes of
            `body_modes`, extended by the mount changes that each of these modes causes.
        """
        gain = reduced.covariance @ reduced.jacobian.T
        change = block_diag(*self.mount_jacobian.values())
        noise = change @ (gain * self.row_variances()) @ gain.T @ change.T
        values, vectors = np.linalg.eigh(0.5 * (noise + noise.T))
        white = vectors * np.sqrt(np.maximum(values, 0.0))
        noise_modes = replace(no_modes(self.body.bones, (), len(white)), mounts=self._by_camera(white))
        return stack_modes([noise_modes, self.propagated(reduced, body_modes)])

    def propagated(self, reduced: ReducedSystem, body_modes: ErrorModes) -> ErrorModes:
        """Extend error modes of the body by the changes of the mounts that these modes cause.

        Args:
            reduced: The reduced system of this linearisation.
            body_modes: Error modes of the assumed body.

        Returns:
            The modes of `body_modes`, each with its changes of the mounts.
        """
        gain = reduced.covariance @ reduced.jacobian.T
        shifts = joint_residual_jacobian(
            self.linear, self.body, self.first_joint_factor, self.world_from_bone, body_modes
        )
        # The prior of a T-pose does not refer to the rest pose.
        counts = np.ones(self.linear.matrix.shape[0])
        counts[self.rotation_rows(np.flatnonzero(self.t_pose))] = 0.0
        shifts = sparse.diags_array(counts) @ shifts
        follow = block_diag(*self.mount_jacobian.values()) @ np.asarray(shifts.T @ gain.T).T
        return replace(body_modes, mounts=self._by_camera(follow))

    def _by_camera(self, changes: FloatArray) -> dict[str, FloatArray]:
        """Split the changes (6·C,M) of the mounts of C cameras into one array (6,M) per camera."""
        return {camera: changes[6 * index : 6 * index + 6] for index, camera in enumerate(self.mount_columns)}


@dataclass(frozen=True, slots=True, kw_only=True)
class ReducedSystem:
    """The linear system of the mounts, after the bone poses of all ticks were eliminated.

    Attributes:
        jacobian: (R,U) derivatives of the rows with respect to U unknowns: the unknowns of all mounts, then
            the additional unknowns that all ticks share.
        covariance: (U,U) covariance of these unknowns if the variance of every row is 1.
        redundancy: (R,) redundancy of each row, 0 to 1.
    """

    jacobian: FloatArray
    covariance: FloatArray
    redundancy: FloatArray
