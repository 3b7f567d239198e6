"""Every joint of the skeleton from the solved bones: trunk upright above the legs, the rest at rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.merging.body.bones import Bone
from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.model.geometry import interpolate_pose, make_transform
from bodycap_batch.model.skeleton import SkeletonModel


def complete_skeleton(
    skeleton: SkeletonModel, bones: Sequence[Bone], world_from_bone: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Pose all joints.

    Above the first solved bone the trunk straightens joint by joint to an upright pelvis that faces where the
    bone faces, so that legs nobody measured stand; below the solved bones joints keep their zero rotation.

    Args:
        skeleton: The body.
        bones: The solved bones.
        world_from_bone: (T,B,4,4), Z up.

    Returns:
        (T,J,4,4) and (J,) which joints were solved.
    """
    ticks, count = len(world_from_bone), len(skeleton.joints)
    out = np.tile(np.eye(4), (ticks, count, 1, 1))
    solved = np.zeros(count, dtype=bool)
    for position, bone in enumerate(bones):
        out[:, bone.joint] = world_from_bone[:, position]
        solved[bone.joint] = True
    placed = solved.copy()
    _straighten_trunk_above(skeleton, bones[0], out, placed)
    for joint in range(count):
        if not placed[joint]:
            parent = out[:, skeleton.parents[joint]]
            out[:, joint] = parent @ make_transform(np.eye(3), skeleton.offsets_m[joint])
    return out, solved


def _straighten_trunk_above(skeleton: SkeletonModel, first: Bone, out: FloatArray, placed: BoolArray) -> None:
    chain = [first.joint]
    while skeleton.parents[chain[-1]] >= 0:
        chain.append(int(skeleton.parents[chain[-1]]))
    trunk = out[:, first.joint].copy()
    trunk[:, :3, :3] = trunk[:, :3, :3] @ first.mean_rotation.T
    pelvis = make_transform(_yaw_only(trunk[:, :3, :3]), np.zeros(3))
    # Joints that play no role (helpers, mostly without length) stay at zero: they turn with their parent.
    last = len(chain) - 1
    bending = [step for step in range(1, len(chain)) if skeleton.roles[chain[step]] or step == last]
    for step in range(1, len(chain)):
        child, joint = chain[step - 1], chain[step]
        share = np.full(len(out), (np.searchsorted(bending, step) + 1) / len(bending))
        rotation = interpolate_pose(trunk, pelvis, share)[:, :3, :3]
        centre = out[:, child, :3, 3] - rotation @ skeleton.offsets_m[child]
        out[:, joint] = make_transform(rotation, centre)
        placed[joint] = True


def _yaw_only(rotation: FloatArray) -> FloatArray:
    """Rotations (T,3,3) about Z alone that face where the given ones face (zero pose faces −Y)."""
    forward, left = -rotation[:, :, 1], rotation[:, :, 0]
    # A body bent over far has its forward pointing down: then its left tells more.
    level = forward + 0.0
    lying = np.hypot(forward[:, 0], forward[:, 1]) < 0.3
    level[lying] = np.cross(left[lying], [0.0, 0.0, 1.0])
    yaw = np.arctan2(level[:, 1], level[:, 0]) + 0.5 * np.pi
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
    """Which joints cameras measured, per tick (T,J).

    A bone with a camera counts while the hole in its measurements is at most `max_gap_s`; a bone without one
    while bones above and below it do.
    """
    seen: dict[int, BoolArray] = {}
    for track in tracks:
        _, valid = track.poses_at(tick_times_ns, max_gap_ns=round(max_gap_s * 1e9))
        half_step = np.median(np.diff(tick_times_ns)) / 2 if len(tick_times_ns) > 1 else 0
        near = np.abs(_nearest_times(track.times_ns, tick_times_ns) - tick_times_ns) <= half_step
        seen[track.bone] = seen.get(track.bone, np.zeros(len(tick_times_ns), dtype=bool)) | valid | near
    below = {bone: mask.copy() for bone, mask in seen.items()}
    none = np.zeros(len(tick_times_ns), dtype=bool)
    for index in range(len(bones) - 1, 0, -1):
        parent = bones[index].parent
        below[parent] = below.get(parent, none) | below.get(index, none)
    out = np.zeros((len(tick_times_ns), len(skeleton.joints)), dtype=bool)
    above: Mapping[int, BoolArray] = _observed_above(bones, seen, below, none)
    for index, bone in enumerate(bones):
        out[:, bone.joint] = seen.get(index, none) | (above[index] & below.get(index, none))
    return out


def _observed_above(
    bones: Sequence[Bone],
    seen: Mapping[int, BoolArray],
    below: Mapping[int, BoolArray],
    none: BoolArray,
) -> dict[int, BoolArray]:
    """Per bone: is a camera measured outside the part of the body that hangs on it?"""
    above: dict[int, BoolArray] = {0: none}
    for index, bone in enumerate(bones[1:], start=1):
        siblings = [
            other for other in range(1, len(bones)) if bones[other].parent == bone.parent and other != index
        ]
        mask = above[bone.parent] | seen.get(bone.parent, none)
        for other in siblings:
            mask = mask | below.get(other, none)
        above[index] = mask
    return above


def _nearest_times(sorted_ns: IntArray, times_ns: IntArray) -> IntArray:
    after = np.clip(np.searchsorted(sorted_ns, times_ns), 0, len(sorted_ns) - 1)
    before = np.maximum(after - 1, 0)
    closer = np.abs(sorted_ns[before] - times_ns) <= np.abs(sorted_ns[after] - times_ns)
    return np.asarray(np.where(closer, sorted_ns[before], sorted_ns[after]))
