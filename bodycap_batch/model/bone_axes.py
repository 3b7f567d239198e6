"""Turn the axes of the joints, so that the up axis of every joint points along its bone in the T-pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.skeleton import Motion, SkeletonModel, rest_pose

_TRUNK_ORDER = ("Spine", "Spine1", "Neck", "Head")
"""Roles of the trunk and the head. A bone with several children ends at the child that leads to the last of
these roles."""

_MIN_BONE_M = 1e-3
"""Minimum length (metres) of a bone whose direction is used. Derivation: the floor root's offset to the hips,
which has no meaning as a bone, has this length."""

_MAX_FORWARD = 0.7
"""Maximum cosine between a bone and the forward direction for which the bone's front is forward; else its
front is up. Derivation: cos 45°. Feet point forward; the other bones of a T-pose point up, down or to the
sides."""


def has_floor_root(skeleton: SkeletonModel) -> bool:
    """Return True if the root of the skeleton is a joint on the floor, whose child is the hips."""
    return len(skeleton.joints) > 1 and skeleton.roles[:2] == ("", "Hips")


def main_children(skeleton: SkeletonModel) -> list[int | None]:
    """Return, for each joint, the child at which the joint's bone ends; None for a joint without children.

    The bone of a joint with several children ends at the child towards the head. If no child leads to the
    head, it ends at the first child.
    """
    count = len(skeleton.joints)
    leads_to_head = [role in _TRUNK_ORDER for role in skeleton.roles]
    for joint in range(count - 1, 0, -1):
        if leads_to_head[joint]:
            leads_to_head[int(skeleton.parents[joint])] = True
    out: list[int | None] = [None] * count
    for joint in range(count - 1, 0, -1):
        parent = int(skeleton.parents[joint])
        current = out[parent]
        if current is None or leads_to_head[joint] or not leads_to_head[current]:
            out[parent] = joint
    return out


def bone_ends_m(skeleton: SkeletonModel) -> FloatArray:
    """Return the far end (J,3) of each joint's bone in the T-pose, in the world, metres.

    A joint without a child and without a far end gets the direction of its parent's bone and half the length
    of this bone. The bone of a root on the floor points up.
    """
    rest = rest_pose(skeleton)
    at = rest[:, :3, 3]
    ends = np.array(at)
    for joint, child in enumerate(main_children(skeleton)):
        parent = int(skeleton.parents[joint])
        if joint == 0 and has_floor_root(skeleton):
            ends[joint] = at[joint] + [0.0, 0.0, at[1, 2] / 2.0]
        elif child is not None and np.linalg.norm(at[child] - at[joint]) > _MIN_BONE_M:
            ends[joint] = at[child]
        elif child is None and np.isfinite(skeleton.end_offsets_m[joint]).all():
            ends[joint] = at[joint] + rest[joint, :3, :3] @ skeleton.end_offsets_m[joint]
        if np.linalg.norm(ends[joint] - at[joint]) <= _MIN_BONE_M:
            along = ends[parent] - at[parent] if parent >= 0 else np.array([0.0, 0.0, 0.1])
            ends[joint] = at[joint] + along / 2.0
    return ends


def align_axes_with_bones(motion: Motion) -> Motion:
    """Return the same motion with joint axes that follow the bones.

    In the T-pose, the up axis (Z) of each joint points along its bone, and the front (−Y) of the joint points
    forward, for feet up. So knees and elbows turn about the joints' X axes. Joint centres do not change. The
    axes of a root on the floor do not change.

    Args:
        motion: The motion, in world axes.
    """
    skeleton = motion.skeleton
    rest = rest_pose(skeleton)
    joint_from_new = np.swapaxes(rest[:, :3, :3], -1, -2) @ _axes_along_bones(skeleton)
    above = np.concatenate([np.eye(3)[None], joint_from_new[skeleton.parents[1:]]])
    inverse = np.swapaxes(above, -1, -2)
    count = len(skeleton.joints)
    tpose = np.tile(np.eye(3), (count, 1, 1)) if skeleton.tpose_rotation is None else skeleton.tpose_rotation
    aligned = replace(
        skeleton,
        offsets_m=np.einsum("jab,jb->ja", inverse, skeleton.offsets_m),
        end_offsets_m=np.einsum("jba,jb->ja", joint_from_new, skeleton.end_offsets_m),
        tpose_rotation=inverse @ tpose @ joint_from_new,
        file_rotation=None,
    )
    hips = motion.hips_in_root_m
    return replace(
        motion,
        skeleton=aligned,
        local_rotation=inverse @ motion.local_rotation @ joint_from_new,
        hips_in_root_m=None if hips is None else hips @ joint_from_new[0],
    )


def _axes_along_bones(skeleton: SkeletonModel) -> FloatArray:
    """Return the wanted orientation (J,3,3) of each joint in the world, in the T-pose."""
    rest = rest_pose(skeleton)
    up = bone_ends_m(skeleton) - rest[:, :3, 3]
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    forward, vertical = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    front = np.where((np.abs(up @ forward) > _MAX_FORWARD)[:, None], vertical, forward)
    front = front - np.sum(front * up, axis=1, keepdims=True) * up
    front /= np.linalg.norm(front, axis=1, keepdims=True)
    return np.stack([np.cross(-front, up), -front, up], axis=-1)
