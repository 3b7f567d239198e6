"""How far off the calibration's mounts may be: every residual's own variance, carried through the estimator.

The calibration weighs its residuals by what they might be at worst; how far off its result is follows from
what they are. Each kind's variance is estimated from the residuals and their redundancy, and the mounts'
covariance is that of an estimator with those weights under noise of that size.

Source: variance components by redundancy, W. Foerstner, "Ein Verfahren zur Schaetzung von Varianz- und
Kovarianzkomponenten", AVN 1979; the covariance is the sandwich form.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
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

PRIOR, MEASURED, JOINED, POSED, NAMED = range(5)
"""Kinds of rows: what is believed beforehand, camera points, gaps of joints and hinges, joint rotations, and
how a camera is turned whose name alone says it."""
_BELIEF = 30.0
"""Redundant residuals that the variance believed beforehand counts as much as."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SolvedMounts:
    """A calibration graph at its solution: ticks that are linked through the mounts alone.

    Attributes:
        linear: Its derivatives.
        body: Bones and hinges.
        world_from_bone: (K,B,4,4) the solution.
        mount_columns: By camera, the columns of the unknowns that stand for its mount.
        mount_change: By camera, (6,12) from those unknowns to joint_from_cam's right perturbation.
        kinds: (R,) kind of each row.
        first_joint: Index of the first joint factor.
    """

    linear: LinearisedGraph
    body: BodyModel
    world_from_bone: FloatArray
    mount_columns: Mapping[str, IntArray]
    mount_change: Mapping[str, FloatArray]
    kinds: IntArray
    first_joint: int

    def eliminated(self, further: FloatArray | None = None) -> Eliminated:
        """Solve every tick's body for given mounts, and keep what the residuals then say of the mounts.

        Args:
            further: (R,P) derivatives by unknowns that all ticks share beside the mounts.

        Raises:
            EstimationError: The equations are singular.
        """
        try:
            return self._eliminated(further)
        except np.linalg.LinAlgError as error:
            raise EstimationError(
                f"the cameras do not determine how they sit on the body ({error})",
                hint="a longer capture with more movement, or fewer cameras, helps",
            ) from error

    def _eliminated(self, further: FloatArray | None) -> Eliminated:
        matrix = self.linear.matrix
        mounts = np.concatenate(list(self.mount_columns.values()))
        influence = matrix[:, mounts].toarray()
        if further is not None:
            influence = np.hstack([influence, further])
        own = np.zeros(matrix.shape[0])
        by_column = matrix.tocsc()
        for tick in range(len(self.world_from_bone)):
            start = self.linear.columns[bone_key(tick, 0)]
            columns = by_column[:, start : start + 6 * len(self.body.bones)]
            rows = np.unique(columns.indices)
            dense = columns[rows].toarray()
            normal = np.linalg.inv(dense.T @ dense)
            half = dense @ normal
            influence[rows] -= half @ (dense.T @ influence[rows])
            own[rows] = (half * dense).sum(axis=1)
        covariance = np.linalg.inv(influence.T @ influence)
        taken = own + np.einsum("ri,ij,rj->r", influence, covariance, influence)
        return Eliminated(influence=influence, covariance=covariance, redundancy=1.0 - taken)

    def variance(self, solved: Eliminated, kind: int, believed: float = 1.0) -> float:
        """Variance factor of a kind of rows, of what they were weighed with.

        Args:
            solved: The mounts' share of the graph.
            kind: Of the rows.
            believed: The factor believed beforehand, where little redundancy contradicts it: less than 1 for
                rows that were weighed down because they share their errors.
        """
        mine = self.kinds == kind
        # Four points hold twelve coordinates of a pose that has six: the others never disagree.
        idle = 0.5 * mine.sum() if kind == MEASURED else 0.0
        redundancy = max(float(solved.redundancy[mine].sum()) - idle, 0.0)
        return (_BELIEF * believed + float((self.linear.rhs[mine] ** 2).sum())) / (_BELIEF + redundancy)

    def posture_bias_jacobian(self) -> Any:
        """How the residuals change with the wearer's habits: rows (R,M), sparse, one sigma each."""
        bias = posture_bias_modes(self.body.bones, tuple(self.mount_columns), POSTURE_BIAS_SHARE)
        return joint_residual_jacobian(self.linear, self.body, self.first_joint, self.world_from_bone, bias)

    def spread(self, solved: Eliminated, factors: FloatArray, bias: ErrorModes) -> ErrorModes:
        """How far off the mounts may be.

        Args:
            solved: The mounts' share of the graph.
            factors: (5,) variance of each kind of rows, as a factor on what the graph believes.
            bias: Directions in which the body differs from what the calibration believed.

        Returns:
            The directions of the residuals' noise, and `bias` with the mounts that follow it.
        """
        gain = solved.covariance @ solved.influence.T
        change = block_diag(*self.mount_change.values())
        noise = change @ (gain * factors[self.kinds]) @ gain.T @ change.T
        values, vectors = np.linalg.eigh(0.5 * (noise + noise.T))
        white = vectors * np.sqrt(np.maximum(values, 0.0))
        count = len(white)
        nothing = np.zeros((len(self.body.bones), 3, count))
        noisy = ErrorModes(
            mounts=self._by_camera(white), log_scale=np.zeros(count), rest=nothing, offsets_m=nothing
        )
        return stack_modes([noisy, self.followed(solved, bias)])

    def followed(self, solved: Eliminated, bias: ErrorModes) -> ErrorModes:
        """Directions in which the body differs from what was believed, with the mounts that follow it."""
        gain = solved.covariance @ solved.influence.T
        shifts = joint_residual_jacobian(self.linear, self.body, self.first_joint, self.world_from_bone, bias)
        shifts = sparse.diags_array((self.kinds != PRIOR).astype(np.float64)) @ shifts
        follow = block_diag(*self.mount_change.values()) @ np.asarray(shifts.T @ gain.T).T
        return replace(bias, mounts=self._by_camera(follow))

    def _by_camera(self, changes: FloatArray) -> dict[str, FloatArray]:
        return {camera: changes[6 * index : 6 * index + 6] for index, camera in enumerate(self.mount_columns)}


@dataclass(frozen=True, slots=True, kw_only=True)
class Eliminated:
    """What the rows say of the mounts once every tick's body follows them.

    Attributes:
        influence: (R,U) derivatives by the mounts' unknowns.
        covariance: (U,U) of those unknowns where every row's variance is 1.
        redundancy: (R,) share of each row that is left over after the fit, 0 to 1.
    """

    influence: FloatArray
    covariance: FloatArray
    redundancy: FloatArray


def kinds_of(linear: LinearisedGraph, joints: tuple[int, int], stated: IntArray, named: IntArray) -> IntArray:
    """Kind of each row (R,) from what it touches.

    Args:
        linear: A calibration graph; its mounts' columns follow all bones'.
        joints: First joint factor and the one after the last.
        stated: Joint factors of postures that are believed as they stand (a T-pose), not widened habits.
        named: Factors of how cameras are turned of which nothing but the name is known.
    """
    height = np.diff(linear.first_row)
    factor = np.repeat(np.arange(len(height)), height)
    place = np.arange(len(factor)) - linear.first_row[factor]
    first_mount = linear.columns[mount_keys(0)[0]]
    touches = linear.matrix.tocoo()
    of_bones = np.bincount(touches.row, touches.col < first_mount, len(factor)) > 0
    of_mounts = np.bincount(touches.row, touches.col >= first_mount, len(factor)) > 0
    kinds = np.full(len(factor), POSED, dtype=np.int64)
    kinds[of_bones & of_mounts] = MEASURED
    kinds[of_mounts & ~of_bones] = PRIOR
    inside = (factor >= joints[0]) & (factor < joints[1])
    kinds[(factor >= joints[1]) | np.isin(factor, stated)] = PRIOR
    kinds[np.isin(factor, named)] = NAMED
    kinds[inside & ((height[factor] == 1) | (place >= 3))] = JOINED
    return kinds
