"""Estimate the covariance of the calibrated mounts from the residuals of the calibration graph.

The calibration graph assumes sigmas that are larger than the actual errors. The actual uncertainty is
therefore estimated from the residuals at the solution, in two steps:

1. Estimate the actual variance of each type of residual rows from the residuals and redundancies of its rows.
   The redundancy of a row is its contribution to the degrees of freedom, 0 to 1.
2. Propagate these variances to the mounts. Near the solution, the mounts are a linear function of the noise
   in the rows. The resulting covariance has the sandwich form.

Source: estimation of variance components from redundancies, W. Foerstner, "Ein Verfahren zur Schaetzung von
Varianz- und Kovarianzkomponenten", AVN 1979.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np
from scipy import sparse
from scipy.linalg import block_diag

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging.graph.error_modes import (
    POSTURE_BIAS_SHARE,
    BodyModel,
    ErrorModes,
    joint_residual_jacobian,
    posture_bias_modes,
    stack_modes,
)
from bodycap_batch.merging.graph.factors import bone_key, mount_keys
from bodycap_batch.merging.graph.linearisation import LinearisedGraph

_PRIOR_REDUNDANCY = 30.0
"""Weight of the expected variance factor against the residuals. Evidence: none.

For each row type, the expected factor has the same weight as the residuals of 30 fully redundant rows.
"""


class RowType(IntEnum):
    """The types of residual rows. Each type has a separate variance factor."""

    PRIOR = 0
    """Priors of mounts, posture and T-pose. Their assumed sigmas are used unchanged."""
    MEASUREMENT = 1
    """Measured camera poses."""
    JOINT_GAP = 2
    """Gaps of joints, and the distances between the anchors of a hinge and the following joint."""
    JOINT_ROTATION = 3
    """Priors of joint rotations."""


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
        row_types: (R,) `RowType` of each row.
        first_joint_factor: Index of the first joint factor in the graph.
    """

    linear: LinearisedGraph
    body: BodyModel
    world_from_bone: FloatArray
    mount_columns: Mapping[str, IntArray]
    mount_jacobian: Mapping[str, FloatArray]
    row_types: IntArray
    first_joint_factor: int

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

    def variance_factor(self, reduced: ReducedSystem, row_type: RowType, prior: float = 1.0) -> float:
        """Return the variance factor of one row type: the actual variance divided by the assumed variance.

        Args:
            reduced: The reduced system of this linearisation.
            row_type: Type of the rows.
            prior: Expected variance factor. It dominates the result if the redundancy of the rows is low. A
                value below 1 is needed for rows with enlarged sigmas. The graph enlarges sigmas if several
                samples share one error.

        Returns:
            The variance factor of the rows.
        """
        rows = self.row_types == row_type
        # A camera pose has six degrees of freedom. The graph represents it by four points with twelve rows.
        # Six of the twelve rows are therefore superfluous. They add to the redundancy, but their residuals
        # are zero.
        idle = 0.5 * rows.sum() if row_type == RowType.MEASUREMENT else 0.0
        redundancy = max(float(reduced.redundancy[rows].sum()) - idle, 0.0)
        squares = float((self.linear.rhs[rows] ** 2).sum())
        return (_PRIOR_REDUNDANCY * prior + squares) / (_PRIOR_REDUNDANCY + redundancy)

    def posture_bias_jacobian(self) -> Any:
        """Return the change of the residuals that each error mode of the posture bias causes at one sigma.

        Returns:
            (R,M) sparse matrix for M modes.
        """
        modes = posture_bias_modes(self.body.bones, tuple(self.mount_columns), POSTURE_BIAS_SHARE)
        return joint_residual_jacobian(
            self.linear, self.body, self.first_joint_factor, self.world_from_bone, modes
        )

    def error_modes(self, reduced: ReducedSystem, factors: FloatArray, body_modes: ErrorModes) -> ErrorModes:
        """Return the error modes of the mounts.

        Args:
            reduced: The reduced system of this linearisation.
            factors: (4,) variance factor of each `RowType`.
            body_modes: Error modes of the assumed body.

        Returns:
            First, the error modes of the mounts due to noise in the residual rows. Second, the modes of
            `body_modes`, extended by the mount changes that each of these modes causes.
        """
        gain = reduced.covariance @ reduced.jacobian.T
        change = block_diag(*self.mount_jacobian.values())
        noise = change @ (gain * factors[self.row_types]) @ gain.T @ change.T
        values, vectors = np.linalg.eigh(0.5 * (noise + noise.T))
        white = vectors * np.sqrt(np.maximum(values, 0.0))
        count = len(white)
        zero = np.zeros((len(self.body.bones), 3, count))
        noise_modes = ErrorModes(
            mounts=self._by_camera(white), log_scale=np.zeros(count), rest=zero, offsets_m=zero
        )
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
        shifts = sparse.diags_array((self.row_types != RowType.PRIOR).astype(np.float64)) @ shifts
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


def row_types(
    linear: LinearisedGraph,
    first_joint_factor: int,
    end_joint_factor: int,
    t_pose_factors: IntArray,
) -> IntArray:
    """Return the `RowType` of each row of a linearised calibration graph.

    Args:
        linear: Jacobian of the graph, with the columns of all bones before the columns of the mounts.
        first_joint_factor: Index of the first joint factor.
        end_joint_factor: Index of the last joint factor plus one.
        t_pose_factors: Indices of the joint factors at ticks in a T-pose. The assumed sigmas of the rotation
            priors of these factors are used unchanged.

    Returns:
        (R,) the `RowType` of each row.
    """
    height = np.diff(linear.first_row)
    factor = np.repeat(np.arange(len(height)), height)
    row_in_factor = np.arange(len(factor)) - linear.first_row[factor]
    first_mount = linear.columns[mount_keys(0)[0]]
    entries = linear.matrix.tocoo()
    of_bones = np.bincount(entries.row, entries.col < first_mount, len(factor)) > 0
    of_mounts = np.bincount(entries.row, entries.col >= first_mount, len(factor)) > 0
    out = np.full(len(factor), RowType.JOINT_ROTATION, dtype=np.int64)
    out[of_bones & of_mounts] = RowType.MEASUREMENT
    out[of_mounts & ~of_bones] = RowType.PRIOR
    is_joint = (factor >= first_joint_factor) & (factor < end_joint_factor)
    out[(factor >= end_joint_factor) | np.isin(factor, t_pose_factors)] = RowType.PRIOR
    # A joint factor has three rows for the rotation, then three rows for the gap. A hinge factor has one row.
    out[is_joint & ((height[factor] == 1) | (row_in_factor >= 3))] = RowType.JOINT_GAP
    return out
