"""What the calibration does not know, as directions of one sigma each, and how the mounts follow them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.body.bones import Bone, Hinge
from bodycap_batch.merging.graph.factors import bone_key
from bodycap_batch.merging.graph.linearisation import LinearisedGraph
from bodycap_batch.model.geometry import invert, make_transform


@dataclass(frozen=True, slots=True, kw_only=True)
class BodyModel:
    """The graph's bones and hinges."""

    bones: Sequence[Bone]
    hinges: Sequence[Hinge]

    @property
    def factors_per_tick(self) -> int:
        """How many factors hold the body together at one tick."""
        return sum(bone.parent >= 0 for bone in self.bones) + 2 * len(self.hinges)


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorModes:
    """Independent directions in which what the motion is solved with may be off, each by one sigma.

    Attributes:
        mounts: By camera, (6,M) change of joint_from_cam, right perturbation, rotation first.
        log_scale: (M,) change of the metric scale's logarithm.
        rest: (B,3,M) turn of each bone's pose at ease, in the bone's own frame.
        offsets_m: (B,3,M) change of each joint's centre in its parent's frame.
    """

    mounts: Mapping[str, FloatArray]
    log_scale: FloatArray
    rest: FloatArray
    offsets_m: FloatArray

    def joint_modes(self, bone: Bone, index: int) -> FloatArray:
        """(6,M) change of where a joint rests, right perturbation of its resting pose."""
        return np.concatenate([self.rest[index], bone.mean_rotation.T @ self.offsets_m[index]])


def stack_modes(parts: Sequence[ErrorModes]) -> ErrorModes:
    """All directions of several, which are independent of each other."""
    return ErrorModes(
        mounts={
            camera: np.concatenate([part.mounts[camera] for part in parts], axis=1)
            for camera in parts[0].mounts
        },
        log_scale=np.concatenate([part.log_scale for part in parts]),
        rest=np.concatenate([part.rest for part in parts], axis=-1),
        offsets_m=np.concatenate([part.offsets_m for part in parts], axis=-1),
    )


def adjoint(poses: FloatArray) -> FloatArray:
    """(...,6,6) that carries right perturbations, rotation first, through poses (...,4,4)."""
    rotation, shift = poses[..., :3, :3], poses[..., :3, 3]
    cross = np.zeros_like(rotation)
    cross[..., 0, 1], cross[..., 0, 2], cross[..., 1, 2] = -shift[..., 2], shift[..., 1], -shift[..., 0]
    cross -= np.swapaxes(cross, -1, -2)
    out = np.zeros((*poses.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = rotation
    out[..., 3:, :3] = cross @ rotation
    return out


def joint_residual_jacobian(
    linear: LinearisedGraph,
    body: BodyModel,
    first_factor: int,
    world_from_bone: FloatArray,
    spread: ErrorModes,
) -> Any:
    """How the residuals of joints and hinges change along each direction: rows (R,M), sparse.

    The sign is that of the right-hand side: the movement that would make up for the change.

    Args:
        linear: Derivatives at the solution.
        body: Bones and hinges.
        first_factor: Index of the first tick's first joint factor; a tick adds its bones', then its hinges'.
        world_from_bone: (T,B,4,4) the solution.
        spread: The directions.
    """
    ticks = np.arange(len(world_from_bone))
    children = [index for index, bone in enumerate(body.bones) if bone.parent >= 0]
    each = body.factors_per_tick
    out = sparse.csr_matrix((linear.matrix.shape[0], len(spread.log_scale)))
    for place, child in enumerate(children):
        bone, factors = body.bones[child], first_factor + place + each * ticks
        at_rest = make_transform(bone.mean_rotation, bone.offset_m)
        turned = invert(world_from_bone[:, child]) @ world_from_bone[:, bone.parent] @ at_rest
        moved = adjoint(turned) @ spread.joint_modes(bone, child)
        derivative = linear.pose_jacobians(factors, 6, [bone_key(tick, child) for tick in ticks.tolist()])
        out = out + linear.sparse_rows(factors, derivative @ moved)
    for number, hinge in enumerate(body.hinges if spread.offsets_m.any() else ()):
        anchor = spread.offsets_m[hinge.lower]
        along = (
            world_from_bone[:, hinge.following, :3, :3].swapaxes(1, 2)
            @ world_from_bone[:, hinge.upper, :3, :3]
        )
        offset = body.bones[hinge.following].offset_m
        longer = offset @ spread.offsets_m[hinge.following] / hinge.range_m
        for side in range(2):
            factors = first_factor + len(children) + 2 * number + side + each * ticks
            keys = [bone_key(tick, hinge.following) for tick in ticks.tolist()]
            derivative = linear.pose_jacobians(factors, 1, keys)[..., 3:]
            stiffness = np.linalg.norm(derivative, axis=-1, keepdims=True)
            out = out + linear.sparse_rows(factors, derivative @ (along @ anchor) + stiffness * longer)
    return out


POSTURE_BIAS_SHARE = 0.5
"""Of a joint's everyday range that is a person's habit over the whole capture; the rest comes and goes within
seconds. Both shares count at any one tick, only the habit bends the mounts."""


def posture_bias_modes(
    bones: Sequence[Bone], cameras: Sequence[str], share: float | FloatArray
) -> ErrorModes:
    """The ways in which joints may be held other than at ease, as a share of their everyday range.

    Args:
        bones: The graph's bones.
        cameras: Names of the cameras, whose mounts stay.
        share: Of the range, one for all or (B,) by bone.
    """
    shares = np.broadcast_to(share, len(bones))
    jointed = [index for index, bone in enumerate(bones) if bone.parent >= 0]
    rest = np.zeros((len(bones), 3, 3 * len(jointed)))
    for place, index in enumerate(jointed):
        half = np.linalg.cholesky(bones[index].rotation_covariance)
        rest[index, :, 3 * place : 3 * place + 3] = shares[index] * half
    return ErrorModes(
        mounts={camera: np.zeros((6, rest.shape[-1])) for camera in cameras},
        log_scale=np.zeros(rest.shape[-1]),
        rest=rest,
        offsets_m=np.zeros_like(rest),
    )


def map_error_modes(bones: Sequence[Bone], sigmas: Mapping[str, FloatArray]) -> ErrorModes:
    """A camera's measured poses off together, for a stretch of its path: to the body, as if its mount were.

    Args:
        bones: The graph's bones.
        sigmas: By camera, rotation (rad) and position (m) per axis.
    """
    count = 6 * len(sigmas)
    mounts = {camera: np.zeros((6, count)) for camera in sigmas}
    for index, (camera, (turn, shift)) in enumerate(sigmas.items()):
        mounts[camera][:, 6 * index : 6 * index + 6] = np.diag(np.repeat([turn, shift], 3))
    nothing = np.zeros((len(bones), 3, count))
    return ErrorModes(mounts=mounts, log_scale=np.zeros(count), rest=nothing, offsets_m=nothing)


def mount_perturbation(joint_from_cam: FloatArray, change: FloatArray) -> FloatArray:
    """Change (4,4) of a mount as its right perturbation (6,), rotation first."""
    turn = joint_from_cam[:3, :3].T @ change[:3, :3]
    turn = 0.5 * (turn - turn.T)
    return np.array([turn[2, 1], turn[0, 2], turn[1, 0], *(joint_from_cam[:3, :3].T @ change[:3, 3])])


def scale_modes(bones: Sequence[Bone], sigma_log: float, slope: Mapping[str, FloatArray]) -> ErrorModes:
    """The metric scale off by a sigma, and the mounts with it.

    Args:
        bones: The graph's bones.
        sigma_log: Sigma of the scale's logarithm.
        slope: By camera (6,), change of the mount per unit of log scale.
    """
    return ErrorModes(
        mounts={camera: sigma_log * change[:, None] for camera, change in slope.items()},
        log_scale=np.array([sigma_log]),
        rest=np.zeros((len(bones), 3, 1)),
        offsets_m=np.zeros((len(bones), 3, 1)),
    )
