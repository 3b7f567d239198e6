"""The pose in which the mannequin is shaped, and the way back to the skeleton's own pose.

The surface of a body whose arms hang along the trunk joins hands and thighs. Arms that later rise would then
pull the surface of the hips with them. So the arms are lifted to the side while the surface is made.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.model.bone_axes import bone_ends_m
from bodycap_batch.model.geometry import invert, so3_exp
from bodycap_batch.model.skeleton import SkeletonModel, rest_pose
from bodycap_batch.model.skeleton_presets import split_side

_MIN_ARM_DEG = 40.0
"""Minimum angle (degrees) of an arm to the direction down and to the direction of the trunk's middle plane in
which the mannequin is shaped. Derivation: a hand at the end of an arm of 0.33 statures is then 0.21 statures
outside of the shoulder, so it does not touch trunk or legs. Arms that hang need a small turn only."""


def with_arms_apart(skeleton: SkeletonModel) -> SkeletonModel:
    """Return the skeleton with a T-pose in which no arm hangs along the trunk.

    An arm that does not point outwards by at least `_MIN_ARM_DEG` is turned about its shoulder to this angle.
    The skeleton itself is returned if no arm needs this.
    """
    rest = rest_pose(skeleton)
    ends = bone_ends_m(skeleton)
    local = skeleton.tpose_rotation
    rotation = np.tile(np.eye(3), (len(rest), 1, 1)) if local is None else np.array(local)
    changed = False
    for joint, role in enumerate(skeleton.roles):
        side, part = split_side(role)
        if part != "Arm" or not side:
            continue
        hand = skeleton.index_of_role(f"{side}Hand")
        along = (ends[joint] if hand is None else rest[hand, :3, 3]) - rest[joint, :3, 3]
        length = float(np.linalg.norm(along))
        if length <= 0.0:
            continue
        along = along / length
        outward = np.array([1.0 if side == "Left" else -1.0, 0.0, 0.0])
        if along @ outward >= np.sin(np.radians(_MIN_ARM_DEG)) - 1e-9:
            continue
        level = along - (along @ outward) * outward
        level /= np.linalg.norm(level)
        angle = np.radians(_MIN_ARM_DEG) - np.arcsin(np.clip(along @ outward, -1.0, 1.0))
        turn = so3_exp(angle * np.cross(level, outward))
        parent = rest[int(skeleton.parents[joint]), :3, :3]
        rotation[joint] = parent.T @ turn @ rest[joint, :3, :3]
        changed = True
    return replace(skeleton, tpose_rotation=rotation) if changed else skeleton


def move_to_pose(
    shaped: SkeletonModel,
    skeleton: SkeletonModel,
    surface: tuple[FloatArray, FloatArray],
    followed: tuple[IntArray, FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """Return a surface in the T-pose of `skeleton`, from the surface in the T-pose of `shaped`.

    Args:
        shaped: The skeleton in whose T-pose the surface was made.
        skeleton: The same body with another T-pose.
        surface: Vertices (V,3) in metres and unit normals (V,3) in the T-pose of `shaped`.
        followed: Joints (V,2) that each vertex follows, and their weights (V,2).

    Returns:
        Vertices (V,3) in metres and unit normals (V,3).
    """
    moved = rest_pose(skeleton) @ invert(rest_pose(shaped))
    blended = np.einsum("vk,vkij->vij", followed[1], moved[followed[0]])
    vertices = np.einsum("vij,vj->vi", blended[:, :3, :3], surface[0]) + blended[:, :3, 3]
    normals = np.einsum("vij,vj->vi", blended[:, :3, :3], surface[1])
    return vertices, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
