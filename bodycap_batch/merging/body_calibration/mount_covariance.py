"""Estimate the covariance of the calibrated mounts from the residuals of the calibration graph.

The calibration weighs its residuals with pessimistic sigmas. The uncertainty of its result follows from the
residuals that remain. The variance of each type of residual row is estimated from the rows and their
redundancy. The covariance of the mounts is that of the same estimator under noise of this estimated size.

Source: variance components by redundancy, W. Foerstner, "Ein Verfahren zur Schaetzung von Varianz- und
Kovarianzkomponenten", AVN 1979. The covariance has the sandwich form.
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
"""Weight of the prior variance of a row type, as a number of redundant rows. Evidence: none."""


class RowType(IntEnum):
    """The types of residual rows that have a variance factor of their own."""

    PRIOR = 0
    """Priors that are taken as they stand: mounts, posture, a T-pose."""
    MEASUREMENT = 1
    """Measured camera poses."""
    JOINT_GAP = 2
    """Gaps of joints, and distances of hinges."""
    JOINT_ROTATION = 3
    """Priors of joint rotations."""
    NAMED_MOUNT = 4
    """Priors of mount orientations that rest on the camera's name alone."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearisedCalibration:
    """A calibration graph, linearised at its solution. Only the mounts connect its ticks.

    Attributes:
        linear: The whitened Jacobian.
        body: Bones and hinges.
        world_from_bone: (K,B,4,4) solved poses.
        mount_columns: By camera, (12,) columns of the unknowns that stand for its mount.
        mount_jacobian: By camera, (6,12) derivative of the right perturbation of joint_from_cam (rotation
            first) by these unknowns.
        row_types: (R,) `RowType` of each row.
        first_joint_factor: Index of the first joint factor.
    """

    linear: LinearisedGraph
    body: BodyModel
    world_from_bone: FloatArray
    mount_columns: Mapping[str, IntArray]
    mount_jacobian: Mapping[str, FloatArray]
    row_types: IntArray
    first_joint_factor: int

    def reduced(self, common_jacobian: FloatArray | None = None) -> ReducedSystem:
        """Eliminate the poses of all ticks, so that only the mounts remain as unknowns.

        Args:
            common_jacobian: (R,P) derivatives by further unknowns that all ticks share.

        Raises:
            EstimationError: The equations are singular.
        """
        try:
            return self._reduced(common_jacobian)
        except np.linalg.LinAlgError as error:
            raise EstimationError(
                f"the cameras do not determine how they sit on the body ({error})",
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
        """Return the variance of the rows of one type, relative to the variance they were weighed with.

        Args:
            reduced: The reduced system of this linearisation.
            row_type: Type of the rows.
            prior: Expected factor. It counts if the redundancy is low. It is less than 1 for rows that were
                weighed down because they share their errors.
        """
        rows = self.row_types == row_type
        # A pose has six degrees of freedom, its four points have twelve coordinates. The other six carry no
        # information and never disagree.
        idle = 0.5 * rows.sum() if row_type == RowType.MEASUREMENT else 0.0
        redundancy = max(float(reduced.redundancy[rows].sum()) - idle, 0.0)
        squares = float((self.linear.rhs[rows] ** 2).sum())
        return (_PRIOR_REDUNDANCY * prior + squares) / (_PRIOR_REDUNDANCY + redundancy)

    def posture_bias_jacobian(self) -> Any:
        """Return the change of the residuals per one-sigma mode of the posture bias: rows (R,M), sparse."""
        modes = posture_bias_modes(self.body.bones, tuple(self.mount_columns), POSTURE_BIAS_SHARE)
        return joint_residual_jacobian(
            self.linear, self.body, self.first_joint_factor, self.world_from_bone, modes
        )

    def error_modes(self, reduced: ReducedSystem, factors: FloatArray, body_modes: ErrorModes) -> ErrorModes:
        """Return the error modes of the mounts.

        Args:
            reduced: The reduced system of this linearisation.
            factors: (5,) variance factor of each `RowType`.
            body_modes: Modes in which the body differs from the assumed one.

        Returns:
            The modes that follow from the noise of the residuals, then `body_modes` with the mounts that
            follow them.
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
        """Return modes in which the body differs from the assumed one, with the mounts that follow them."""
        gain = reduced.covariance @ reduced.jacobian.T
        shifts = joint_residual_jacobian(
            self.linear, self.body, self.first_joint_factor, self.world_from_bone, body_modes
        )
        shifts = sparse.diags_array((self.row_types != RowType.PRIOR).astype(np.float64)) @ shifts
        follow = block_diag(*self.mount_jacobian.values()) @ np.asarray(shifts.T @ gain.T).T
        return replace(body_modes, mounts=self._by_camera(follow))

    def _by_camera(self, changes: FloatArray) -> dict[str, FloatArray]:
        """Split changes (6·C,M) of all mounts by camera."""
        return {camera: changes[6 * index : 6 * index + 6] for index, camera in enumerate(self.mount_columns)}


@dataclass(frozen=True, slots=True, kw_only=True)
class ReducedSystem:
    """The linear system of the mounts, after the poses of all ticks were eliminated.

    Attributes:
        jacobian: (R,U) derivatives of the rows by the unknowns of the mounts.
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
    named_factors: IntArray,
) -> IntArray:
    """Return the `RowType` (R,) of each row of a linearised calibration graph.

    Args:
        linear: The graph's Jacobian. The columns of the mounts follow those of all bones.
        first_joint_factor: Index of the first joint factor.
        end_joint_factor: Index after the last joint factor.
        t_pose_factors: Joint factors of ticks in a T-pose. Their prior is taken as it stands.
        named_factors: Factors of mount orientations that rest on the camera's name alone.
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
    out[np.isin(factor, named_factors)] = RowType.NAMED_MOUNT
    # A joint factor has three rows for the rotation, then three for the gap. A hinge factor has one row.
    out[is_joint & ((height[factor] == 1) | (row_in_factor >= 3))] = RowType.JOINT_GAP
    return out
