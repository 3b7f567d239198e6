"""Compute the poses of all joints from the solved bones, and find the joints that the cameras measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.merging.body.bones import Bone
from bodycap_batch.merging.cameras.track import CameraTrack, nearest_times
from bodycap_batch.model.skeleton import SkeletonModel, bend_spine, pose_joint

_MIN_LEVEL_AXIS = 0.3
"""Minimum horizontal length of the forward axis of a trunk that gives its heading. Unit: 1. Derivation: the
axis of a trunk that is bent by 73°."""


def complete_skeleton(
    skeleton: SkeletonModel, bones: Sequence[Bone], world_from_bone: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return the poses of all joints.

    A pelvis that was not solved is upright, with the heading of the first solved bone. The orientations of
    the joints between this pelvis and the first solved bone are interpolated. All joints that are neither
    solved nor above the first solved bone have zero rotation relative to their parent. Legs without cameras
    are therefore in a standing pose.

    Args:
        skeleton: The body.
        bones: The solved bones.
        world_from_bone: (T,B,4,4) poses of the solved bones, z up.

    Returns:
        The poses world_from_joint (T,J,4,4), and a mask (J,) that is True for solved joints.
    """
    ticks, count = len(world_from_bone), len(skeleton.joints)
    out = np.tile(np.eye(4), (ticks, count, 1, 1))
    solved = np.zeros(count, dtype=bool)
    for position, bone in enumerate(bones):
        out[:, bone.joint] = world_from_bone[:, position]
        solved[bone.joint] = True
    first = bones[0].joint
    trunk = out[:, first, :3, :3] @ bones[0].mean_rotation.T
    bend_spine(skeleton, first, trunk, _yaw_only(trunk), out)
    posed = solved.copy()
    posed[skeleton.path_to_root(first)] = True
    for joint in range(count):
        if not posed[joint]:
            pose_joint(skeleton, joint, out)
    return out, solved


def _yaw_only(rotation: FloatArray) -> FloatArray:
    """Return the rotations (T,3,3) about z that have the headings of given rotations (T,3,3).

    The identity has the heading −y.
    """
    forward = -rotation[:, :, 1]
    yaw = np.arctan2(forward[:, 1], forward[:, 0]) + 0.5 * np.pi
    # If the body bends far forward, its forward axis points down, and then backward. The turn about z that is
    # left without the smallest tilt gives the heading of every body that is not upside down.
    bent = (np.hypot(forward[:, 0], forward[:, 1]) < _MIN_LEVEL_AXIS) | (rotation[:, 2, 2] < 0.0)
    twist = np.arctan2(rotation[:, 1, 0] - rotation[:, 0, 1], rotation[:, 0, 0] + rotation[:, 1, 1])
    yaw = np.where(bent, twist, yaw)
    out = np.tile(np.eye(3), (len(rotation), 1, 1))
    out[:, 0, 0] = out[:, 1, 1] = np.cos(yaw)
    out[:, 1, 0] = np.sin(yaw)
    out[:, 0, 1] = -np.sin(yaw)
    return out


def observed_joints(
    skeleton: SkeletonModel,
    bones: Sequence[Bone],
    tracks: Sequence[CameraTrack],
    tick_times_ns: IntArray,
    max_gap_s: float,
) -> BoolArray:
    """Return a mask (T,J) that is True if the cameras measured the joint at the tick.

    A bone with a camera is measured at a tick in two cases: the camera has a frame within half a tick
    interval, or the tick is between two frames that are at most `max_gap_s` seconds apart.

    A bone without a camera is measured if at least one bone below it and at least one other bone outside its
    subtree are measured.
    """
    measured = np.zeros((len(bones), len(tick_times_ns)), dtype=np.bool_)
    half_step = np.median(np.diff(tick_times_ns)) / 2 if len(tick_times_ns) > 1 else 0
    for track in tracks:
        _, valid = track.poses_at(tick_times_ns, max_gap_ns=round(max_gap_s * 1e9))
        near = np.abs(nearest_times(track.times_ns, tick_times_ns) - tick_times_ns) <= half_step
        measured[track.bone] |= valid | near
    # Number of measured bones in the subtree of each bone, which contains the bone itself.
    inside = measured.astype(np.int64)
    for index in range(len(bones) - 1, 0, -1):
        inside[bones[index].parent] += inside[index]
    out = np.zeros((len(tick_times_ns), len(skeleton.joints)), dtype=np.bool_)
    out[:, [bone.joint for bone in bones]] = (measured | ((inside > 0) & (inside < inside[0]))).T
    return out
