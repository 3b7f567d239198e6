"""The uncertainty of the calibration as independent error modes.

Each error mode is one column of a square root of the calibration's covariance.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import sparse

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.body.bones import Bone, Hinge
from bodycap_batch.merging.graph.factors import bone_key
from bodycap_batch.merging.graph.linearisation import LinearisedGraph
from bodycap_batch.model.geometry import invert, make_transform, se3_adjoint


@dataclass(frozen=True, slots=True, kw_only=True)
class BodyModel:
    """The graph's bones and hinges. They determine the joint and hinge factors of each tick."""

    bones: Sequence[Bone]
    hinges: Sequence[Hinge]

    @property
    def factors_per_tick(self) -> int:
        """Number of joint and hinge factors at one tick."""
        return sum(bone.parent >= 0 for bone in self.bones) + 2 * len(self.hinges)


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorModes:
    """M independent error modes of the calibration, each scaled to one sigma.

    Attributes:
        mounts: By camera, (6,M) change of joint_from_cam: right perturbation, rotation first.
        log_scale: (M,) change of the logarithm of the metric scale.
        rest: (B,3,M) change of each bone's rest pose: rotation vector (radians) in the bone's own frame.
        offsets_m: (B,3,M) change of each joint's centre in the parent bone's frame.
    """

    mounts: Mapping[str, FloatArray]
    log_scale: FloatArray
    rest: FloatArray
    offsets_m: FloatArray

    def joint_modes(self, bone: Bone, index: int) -> FloatArray:
        """Return the change (6,M) of a bone's rest pose on its parent: right perturbation, rotation first."""
        return np.concatenate([self.rest[index], bone.mean_rotation.T @ self.offsets_m[index]])


def no_modes(bones: Sequence[Bone], cameras: Iterable[str], count: int) -> ErrorModes:
    """Return error modes that change nothing.

    Args:
        bones: The graph's bones.
        cameras: Names of the cameras.
        count: Number of modes.
    """
    return ErrorModes(
        mounts={camera: np.zeros((6, count)) for camera in cameras},
        log_scale=np.zeros(count),
        rest=np.zeros((len(bones), 3, count)),
        offsets_m=np.zeros((len(bones), 3, count)),
    )


def stack_modes(parts: Sequence[ErrorModes]) -> ErrorModes:
    """Return the error modes of several parts together. The parts are independent of each other."""
    return ErrorModes(
        mounts={
            camera: np.concatenate([part.mounts[camera] for part in parts], axis=1)
            for camera in parts[0].mounts
        },
        log_scale=np.concatenate([part.log_scale for part in parts]),
        rest=np.concatenate([part.rest for part in parts], axis=-1),
        offsets_m=np.concatenate([part.offsets_m for part in parts], axis=-1),
    )


def joint_residual_jacobian(
    linear: LinearisedGraph,
    body: BodyModel,
    first_factor: int,
    world_from_bone: FloatArray,
    modes: ErrorModes,
) -> Any:
    """Return how each error mode changes the residuals of the joint and hinge factors.

    The change has the sign of the right-hand side of the linearised graph. The least-squares solution for
    this right-hand side is the movement of the bones that the error mode causes.

    Args:
        linear: Linearised graph at the solution.
        body: Bones and hinges of the graph.
        first_factor: Index of the first tick's first joint factor. From this index on, the graph contains the
            factors of one tick after the other: joint factors first, then hinge factors.
        world_from_bone: (T,B,4,4) solved poses of the bones.
        modes: Error modes of the calibration.

    Returns:
        Sparse matrix (R,M): the change of R residuals for each of M error modes.
    """
    ticks = np.arange(len(world_from_bone))
    children = [index for index, bone in enumerate(body.bones) if bone.parent >= 0]
    stride = body.factors_per_tick
    out = sparse.csr_matrix((linear.matrix.shape[0], len(modes.log_scale)))
    for number, child in enumerate(children):
        bone, factors = body.bones[child], first_factor + number + stride * ticks
        at_rest = make_transform(bone.mean_rotation, bone.offset_m)
        bone_from_rest = invert(world_from_bone[:, child]) @ world_from_bone[:, bone.parent] @ at_rest
        change = se3_adjoint(bone_from_rest) @ modes.joint_modes(bone, child)
        derivative = linear.pose_jacobians(factors, 6, [bone_key(tick, child) for tick in ticks.tolist()])
        out = out + linear.sparse_rows(factors, derivative @ change)
    for number, hinge in enumerate(body.hinges if modes.offsets_m.any() else ()):
        anchor = modes.offsets_m[hinge.lower]
        following_from_upper = (
            world_from_bone[:, hinge.following, :3, :3].swapaxes(1, 2)
            @ world_from_bone[:, hinge.upper, :3, :3]
        )
        offset = body.bones[hinge.following].offset_m
        longer = offset @ modes.offsets_m[hinge.following] / hinge.range_m
        for side in range(2):
            factors = first_factor + len(children) + 2 * number + side + stride * ticks
            keys = [bone_key(tick, hinge.following) for tick in ticks.tolist()]
            derivative = linear.pose_jacobians(factors, 1, keys)[..., 3:]
            stiffness = np.linalg.norm(derivative, axis=-1, keepdims=True)
            change = derivative @ (following_from_upper @ anchor) + stiffness * longer
            out = out + linear.sparse_rows(factors, change)
    return out


POSTURE_BIAS_SHARE = 0.5
"""Systematic bias of the posture over the whole capture, as a fraction of a joint's everyday range. The rest
of the range is variation within seconds. At one tick, the bias and the variation both contribute to the
error. Only the bias changes the mounts. Evidence: none."""


def posture_bias_modes(bones: Sequence[Bone], cameras: Sequence[str], share: float) -> ErrorModes:
    """Return the error modes of a biased posture: joints that stay away from the rest pose.

    Args:
        bones: The graph's bones.
        cameras: Names of the cameras. Their mounts do not change.
        share: Fraction of the joint's everyday range.
    """
    jointed = [index for index, bone in enumerate(bones) if bone.parent >= 0]
    out = no_modes(bones, cameras, 3 * len(jointed))
    for number, index in enumerate(jointed):
        half = np.linalg.cholesky(bones[index].rotation_covariance)
        out.rest[index, :, 3 * number : 3 * number + 3] = share * half
    return out


def map_error_modes(bones: Sequence[Bone], sigmas: Mapping[str, FloatArray]) -> ErrorModes:
    """Return the modes of an error that all poses of a camera share for some time, such as a map's error.

    For the body, such an error has the effect of a change of the camera's mount.

    Args:
        bones: The graph's bones.
        sigmas: By camera, (2,) sigmas of rotation (radians) and position (metres) per axis.
    """
    out = no_modes(bones, sigmas, 6 * len(sigmas))
    for index, (camera, sigma) in enumerate(sigmas.items()):
        out.mounts[camera][:, 6 * index : 6 * index + 6] = np.diag(np.repeat(sigma, 3))
    return out


def mount_perturbation(joint_from_cam: FloatArray, change: FloatArray) -> FloatArray:
    """Convert an additive change (4,4) of a mount to a right perturbation (6,), rotation first."""
    rotation = joint_from_cam[:3, :3].T @ change[:3, :3]
    rotation = 0.5 * (rotation - rotation.T)
    translation = joint_from_cam[:3, :3].T @ change[:3, 3]
    return np.array([rotation[2, 1], rotation[0, 2], rotation[1, 0], *translation])


def scale_modes(bones: Sequence[Bone], sigma_log: float, slope: Mapping[str, FloatArray]) -> ErrorModes:
    """Return the error mode of the metric scale, with the changes of the mounts that the scale causes.

    Args:
        bones: The graph's bones.
        sigma_log: Sigma of the scale's logarithm.
        slope: By camera, (6,) change of the mount per unit of log scale.
    """
    return replace(
        no_modes(bones, (), 1),
        mounts={camera: sigma_log * change[:, None] for camera, change in slope.items()},
        log_scale=np.array([sigma_log]),
    )
