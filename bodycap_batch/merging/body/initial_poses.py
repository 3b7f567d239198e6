"""Initial poses of all bones from the measured bones, by two-bone inverse kinematics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.merging.body.bones import LIMB_CHAINS, Bone, anatomical_axes, bones_to_root
from bodycap_batch.model.geometry import interpolate_pose, invert, make_transform
from bodycap_batch.model.skeleton import SkeletonModel
from bodycap_batch.model.skeleton_presets import split_side


def fill_gaps(poses: FloatArray, valid: BoolArray) -> FloatArray:
    """Interpolate poses (T,4,4) at the ticks where `valid` (T,) is False.

    Before the first valid tick and after the last valid tick, the nearest valid pose is repeated. In contrast
    to `bodycap_batch.model.geometry.poses_at`, this function does not change valid poses by rounding errors.

    Returns:
        The poses (T,4,4), without gaps.
    """
    known = np.flatnonzero(valid)
    ticks = np.arange(len(poses))
    after = known[np.clip(np.searchsorted(known, ticks), 0, len(known) - 1)]
    before = known[np.clip(np.searchsorted(known, ticks, side="right") - 1, 0, len(known) - 1)]
    alpha = np.clip((ticks - before) / np.maximum(after - before, 1), 0.0, 1.0)
    return interpolate_pose(poses[before], poses[after], alpha)


def pose_bones(
    skeleton: SkeletonModel, bones: Sequence[Bone], measured: Mapping[int, FloatArray]
) -> FloatArray:
    """Return a pose for every bone at every tick.

    Args:
        skeleton: The body.
        bones: The graph's bones.
        measured: By bone index, poses world_from_bone (T,4,4) from the bone's camera, at every tick.

    Returns:
        Poses world_from_bone (T,B,4,4). Inverse kinematics gives the poses of limb bones without a
        measurement. In these poses, elbows point outward and backward, and knees point forward. Other bones
        without a measurement have the rest pose relative to their parent bone.
    """
    ticks = len(next(iter(measured.values())))
    out = np.tile(np.eye(4), (ticks, len(bones), 1, 1))
    out[:, 0] = measured[0] if 0 in measured else _first_bone_from_below(bones, measured)
    index = {bone.role: position for position, bone in enumerate(bones)}
    for position, bone in enumerate(bones):
        if position in measured:
            out[:, position] = measured[position]
        elif position > 0:
            out[:, position] = out[:, bone.parent] @ make_transform(bone.mean_rotation, bone.offset_m)
            _aim_limb(skeleton, bones, index, measured, out, position)
    return out


def _first_bone_from_below(bones: Sequence[Bone], measured: Mapping[int, FloatArray]) -> FloatArray:
    """Return poses (T,4,4) of the first bone from the nearest measured bone, with joints in the rest pose."""
    nearest = min(measured)
    pose = measured[nearest]
    for index in bones_to_root(bones, nearest)[:-1]:
        pose = pose @ invert(make_transform(bones[index].mean_rotation, bones[index].offset_m))
    return np.asarray(pose)


def _aim_limb(
    skeleton: SkeletonModel,
    bones: Sequence[Bone],
    index: Mapping[str, int],
    measured: Mapping[int, FloatArray],
    out: FloatArray,
    position: int,
) -> None:
    """Rotate a limb bone without a measurement towards the measured end of its limb.

    Args:
        skeleton: The body.
        bones: The graph's bones.
        index: By role, the position of a bone among the bones.
        measured: By bone index, measured poses world_from_bone (T,4,4).
        out: (T,B,4,4) poses so far. The function writes the rotation of the bone into them.
        position: Index of the bone.
    """
    side, part = split_side(bones[position].role)
    chain = LIMB_CHAINS.get(part)
    if chain is None:
        return
    lower, end = (index.get(side + name) if name else None for name in chain)
    joint = out[:, position, :3, 3]
    axes = anatomical_axes(skeleton, bones[position].role)
    flexion = out[:, position, :3, :3] @ axes[:, 2]
    aim = next((bone for bone in (lower, end if lower is None else None) if bone in measured), None)
    if aim is not None:
        along = measured[aim][:, :3, 3] - joint
    elif lower is not None and end is not None and end in measured:
        lengths = [float(np.linalg.norm(bones[i].offset_m)) for i in (lower, end)]
        trunk = out[:, bones[position].parent, :3, :3]
        to_goal = measured[end][:, :3, 3] - joint
        if part == "Arm":
            elbow = trunk @ [0.5 if side == "Left" else -0.5, 1.0, 0.0]
            along, flexion = _two_bone_ik(to_goal, lengths, elbow)
        else:
            along, extension = _two_bone_ik(to_goal, lengths, trunk @ [0.0, -1.0, 0.0])
            flexion = -extension
    else:
        return
    out[:, position, :3, :3] = _rotation_from_axes(along, flexion) @ axes.T


def _two_bone_ik(
    to_goal: FloatArray, lengths: Sequence[float], pole: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Solve the inverse kinematics of two bones.

    Args:
        to_goal: (N,3) vectors from the upper bone's joint to the end of the lower bone.
        lengths: Lengths of the upper bone and of the lower bone.
        pole: (N,3) directions in which the joint between the bones points.

    Returns:
        Directions (N,3) of the upper bone, and axes (N,3) about which the lower bone is rotated relative to
        the upper bone.
    """
    upper, lower = lengths
    distance = np.linalg.norm(to_goal, axis=1, keepdims=True)
    reach = np.clip(distance, abs(upper - lower) * 1.001 + 1e-6, 0.999 * (upper + lower))
    towards = to_goal / np.maximum(distance, 1e-9)
    side = pole - (pole * towards).sum(axis=1, keepdims=True) * towards
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    cosine = np.clip((upper**2 + reach**2 - lower**2) / (2.0 * upper * reach), -1.0, 1.0)
    along = cosine * towards + np.sqrt(1.0 - cosine**2) * side
    # Relative to the upper bone, the lower bone is rotated towards the goal, about the axis upper × goal.
    return along, np.cross(side, towards)


def _rotation_from_axes(along: FloatArray, third: FloatArray) -> FloatArray:
    """Return rotations (N,3,3) with the columns along, third × along, third.

    Args:
        along: (N,3) directions of the first column. They are normalised.
        third: (N,3) approximate directions of the third column. They are made orthogonal to `along`.
    """
    along = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    third = third - (third * along).sum(axis=1, keepdims=True) * along
    third /= np.maximum(np.linalg.norm(third, axis=1, keepdims=True), 1e-9)
    return np.stack([along, np.cross(third, along), third], axis=-1)
