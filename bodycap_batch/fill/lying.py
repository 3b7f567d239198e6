"""The legs of a lying person: they continue the trunk, and the feet are pointed."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.fill.leg_geometry import LegGeometry
from bodycap_batch.model.geometry import interpolate_rotation, so3_exp
from bodycap_batch.model.skeleton import SkeletonModel, pose_joint

_POINTED_RAD = (float(np.radians(25.0)), float(np.radians(75.0)))
"""Angles by which the toes of a person who lies on the back, and on the front, are lowered against the
standing foot. Evidence: none."""
_ROOM_M = 0.003
"""Distance (metres) from the floor up to which a raised foot is moved. Derivation: less than 0.5 cm."""
_CORRECTIONS = 4
"""Number of corrections of the height of a foot. Evidence: none."""


def lay_legs(
    skeleton: SkeletonModel, leg: LegGeometry, share: FloatArray, floor_m: float, world: FloatArray
) -> None:
    """Turn the joints of a leg towards a leg that continues the pelvis, by a share of the angle.

    Args:
        skeleton: The skeleton.
        leg: The leg.
        share: (T,) 1 for a lying person, 0 for a person whose legs keep their pose.
        floor_m: Height of the floor, metres. No foot is below it.
        world: (T,J,4,4) poses of the joints in the world; changed in place.
    """
    ticks = np.flatnonzero(share > 0.0)
    if len(ticks) == 0:
        return
    parents = skeleton.parents
    joints = skeleton.subtree(leg.hip)
    poses = world[ticks]
    local = {
        joint: np.swapaxes(poses[:, parents[joint], :3, :3], -1, -2) @ poses[:, joint, :3, :3]
        for joint in joints
    }
    up = poses[:, 0, 2, 1]
    pointed = _POINTED_RAD[0] + (_POINTED_RAD[1] - _POINTED_RAD[0]) * 0.5 * (1.0 + up)
    zero = np.zeros(len(ticks))
    for joint in joints:
        target = np.tile(np.eye(3), (len(ticks), 1, 1))
        if joint == leg.ankle:
            target = so3_exp(np.column_stack([pointed, zero, zero]))
        local[joint] = interpolate_rotation(local[joint], target, share[ticks])
    for _ in range(_CORRECTIONS):
        for joint in joints:
            pose_joint(skeleton, joint, poses, local[joint])
        low = _lowest_m(skeleton, leg, poses) - floor_m
        if low.min() >= 0.0:
            break
        local[leg.hip] = _raised(
            poses, leg, parents, local[leg.hip], np.minimum(low - _ROOM_M, 0.0) * (low < 0.0)
        )
    world[ticks] = poses


def _lowest_m(skeleton: SkeletonModel, leg: LegGeometry, poses: FloatArray) -> FloatArray:
    """Return the height (T,) of the lowest point of the foot."""
    heights = [poses[:, leg.ankle, 2, 3] + poses[:, leg.ankle, 2, :3] @ leg.heel_m]
    for joint in (leg.ankle, *leg.below):
        heights.append(poses[:, joint, 2, 3])
        end = skeleton.end_offsets_m[joint]
        if np.isfinite(end).all():
            heights.append(poses[:, joint, 2, 3] + poses[:, joint, 2, :3] @ end)
    return np.asarray(np.min(heights, axis=0))


def _raised(
    poses: FloatArray, leg: LegGeometry, parents: IntArray, local: FloatArray, low_m: FloatArray
) -> FloatArray:
    """Return the rotation (T,3,3) of the hip that raises a foot which is below the floor by a height."""
    along = poses[:, leg.ankle, :3, 3] - poses[:, leg.hip, :3, 3]
    level = np.hypot(along[:, 0], along[:, 1])
    angle = np.minimum(-low_m / np.maximum(level, 0.1), 0.5)
    axis = (
        np.column_stack([along[:, 1], -along[:, 0], np.zeros(len(along))]) / np.maximum(level, 1e-9)[:, None]
    )
    parent = poses[:, parents[leg.hip], :3, :3]
    turned = so3_exp(axis * angle[:, None]) @ parent @ local
    return np.asarray(np.swapaxes(parent, -1, -2) @ turned)
