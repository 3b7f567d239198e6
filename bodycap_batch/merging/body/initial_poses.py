"""Start values: a provisional scale from the body's reach, bone poses by two-bone inverse kinematics."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging.body.bones import LIMB_CHAINS, Bone, anatomical_axes
from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.model.geometry import interpolate_pose, invert, make_transform
from bodycap_batch.model.skeleton import Mount, SkeletonModel
from bodycap_batch.model.skeleton_presets import split_side

_REACH_QUANTILE = 0.9
_MAX_EXTENSION = 0.96
"""A limb's extension over its length when nearly straight: walking elbows keep 15 to 30° of flexion."""


def provisional_scale(
    bones: Sequence[Bone],
    tracks: Sequence[CameraTrack],
    mounts: Mapping[str, Mount],
    guessed: Collection[str] = (),
) -> float:
    """Estimate metres per map unit from how far apart the cameras of linked bones come.

    Every pair of cameras gives, for a scale, the distance between two points of the body that the bones'
    lengths bound; the scale that makes the largest distances equal the stretched limb wins.

    Args:
        bones: The graph's bones.
        tracks: All cameras, in one map's gauge.
        mounts: Where cameras sit, by camera.
        guessed: Cameras whose distance from their relative up the tree does not count.

    Raises:
        EstimationError: No two cameras were localised at the same time, or they never moved apart.
    """
    links = [
        distance_constraint(bones, track, other, mounts)
        for track, other in kinematic_neighbours(bones, tracks)
        if track.camera not in guessed
    ]
    pairs = [link for link in links if link is not None]
    if not pairs:
        raise EstimationError(
            "no two cameras whose distance the body knows were localised at the same time",
            hint="metric scale comes from a camera on the trunk and one on a limb (or the head) in one map",
        )
    typical = [
        (reach + np.linalg.norm(fixed, axis=1).mean())
        / max(float(np.median(np.linalg.norm(apart, axis=1))), 1e-12)
        for apart, fixed, reach in pairs
    ]
    scales = float(np.median(typical)) * np.geomspace(0.2, 5.0, 320)
    costs = np.array([sum(_reach_cost(scale, *pair) for pair in pairs) for scale in scales])
    best = int(np.argmin(costs))
    if best in (0, len(scales) - 1):
        raise EstimationError(
            f"the cameras' distances fit no person: {scales[best]:.3g} m per map unit is out of bounds",
            hint="check which camera sits where (the job's mounts)",
        )
    return float(scales[best])


def _reach_cost(scale: float, apart: FloatArray, fixed: FloatArray, reach: float) -> float:
    distance = np.linalg.norm(scale * apart + fixed, axis=1)
    if reach > 0.0:
        return abs(float(np.quantile(distance, _REACH_QUANTILE)) - _MAX_EXTENSION * reach)
    return float(np.median(distance))


def kinematic_neighbours(
    bones: Sequence[Bone], tracks: Sequence[CameraTrack]
) -> list[tuple[CameraTrack, CameraTrack]]:
    """Each camera with its nearest measured relative up the tree, else with the one nearest to the root."""
    out = []
    by_bone = {track.bone: track for track in reversed(tracks)}
    root = next((track for track in tracks if track.bone == min(by_bone)), tracks[0])
    for track in tracks:
        above = bones[track.bone].parent
        while above >= 0 and above not in by_bone:
            above = bones[above].parent
        other = by_bone.get(above, root)
        if other is not track:
            out.append((track, other))
    return out


def distance_constraint(
    bones: Sequence[Bone], track: CameraTrack, other: CameraTrack, mounts: Mapping[str, Mount]
) -> tuple[FloatArray, FloatArray, float] | None:
    """Centre differences (N,3) in map units, mount parts (N,3) in metres, and reach of two cameras.

    None where the body does not know their distance, or they were hardly localised at the same time.
    """
    geometry = reach_constraint(bones, track.bone, other.bone)
    if geometry is None:
        return None
    anchor, reach = geometry
    poses, valid = other.poses_at(track.times_ns, max_gap_ns=200_000_000)
    if valid.sum() < 10:
        return None
    mine, theirs = track.map_from_cam[valid], poses[valid]
    cam_from_joint = invert(mounts[track.camera].joint_from_cam)
    cam_from_other = invert(mounts[other.camera].joint_from_cam)
    tip = mine[:, :3, :3] @ cam_from_joint[:3, 3]
    base = theirs[:, :3, :3] @ (cam_from_other[:3, :3] @ anchor + cam_from_other[:3, 3])
    return mine[:, :3, 3] - theirs[:, :3, 3], tip - base, reach


def reach_constraint(bones: Sequence[Bone], bone: int, other: int) -> tuple[FloatArray, float] | None:
    """Point in the other bone's frame from which `bone`'s joint is at most `reach` away.

    None where a second limb lies between them: then the distance says nothing about either's length.
    """
    up, down = _bones_to_root(bones, other), _bones_to_root(bones, bone)
    shared = next(index for index in down if index in up)
    above = up[: up.index(shared)]
    if above and split_side(bones[other].role)[1] == "Arm":
        # An upper arm swings about every axis: where the trunk is from there it does not tell.
        return None
    if any(split_side(bones[bones[index].parent].role)[1] in LIMB_CHAINS for index in above):
        return None
    anchor, reach = -np.sum([bones[index].offset_m for index in above], axis=0) + np.zeros(3), 0.0
    for index in down[: down.index(shared)]:
        parent = bones[index].parent
        if split_side(bones[parent].role)[1] in LIMB_CHAINS and parent != other:
            reach += float(np.linalg.norm(bones[index].offset_m))
        else:
            anchor += bones[index].offset_m
    return anchor, reach


def _bones_to_root(bones: Sequence[Bone], bone: int) -> list[int]:
    chain = [bone]
    while bones[chain[-1]].parent >= 0:
        chain.append(bones[chain[-1]].parent)
    return chain


def fill_gaps(poses: FloatArray, valid: BoolArray) -> FloatArray:
    """Interpolate poses (T,4,4) on SE(3) over ticks where `valid` (T,) is False; ends are held."""
    known = np.flatnonzero(valid)
    ticks = np.arange(len(poses))
    after = known[np.clip(np.searchsorted(known, ticks), 0, len(known) - 1)]
    before = known[np.clip(np.searchsorted(known, ticks, side="right") - 1, 0, len(known) - 1)]
    alpha = np.clip((ticks - before) / np.maximum(after - before, 1), 0.0, 1.0)
    return interpolate_pose(poses[before], poses[after], alpha)


def pose_bones(
    skeleton: SkeletonModel, bones: Sequence[Bone], measured: Mapping[int, FloatArray]
) -> FloatArray:
    """Give every bone a pose at every tick.

    Args:
        skeleton: The body.
        bones: The graph's bones.
        measured: By bone index, world_from_bone (T,4,4) from its camera, without gaps.

    Returns:
        (T,B,4,4). Unmeasured limb bones by two-bone inverse kinematics with the elbow out and back (the knee
        forward), everything else at ease on its parent.
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
            _aim_limb(skeleton, bones, index, out, (position, measured))
    return out


def _first_bone_from_below(bones: Sequence[Bone], measured: Mapping[int, FloatArray]) -> FloatArray:
    """Pose of the first bone from the nearest measured one, every joint between at ease."""
    nearest = min(measured)
    pose, current = measured[nearest], nearest
    while current > 0:
        bone = bones[current]
        pose = pose @ invert(make_transform(bone.mean_rotation, bone.offset_m))
        current = bone.parent
    return np.asarray(pose)


def _aim_limb(
    skeleton: SkeletonModel,
    bones: Sequence[Bone],
    index: Mapping[str, int],
    out: FloatArray,
    target: tuple[int, Mapping[int, FloatArray]],
) -> None:
    """Turn an unmeasured limb bone towards the measured end of its limb."""
    position, measured = target
    side, part = split_side(bones[position].role)
    links = LIMB_CHAINS.get(part)
    if links is None:
        return
    lower, end = (index.get(side + name) if name else None for name in links)
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
            along, flexion = _two_bone_ik(
                to_goal, lengths, trunk @ [0.5 if side == "Left" else -0.5, 1.0, 0.0]
            )
        else:
            along, extension = _two_bone_ik(to_goal, lengths, trunk @ [0.0, -1.0, 0.0])
            flexion = -extension
    else:
        return
    out[:, position, :3, :3] = _rotation_from_axes(along, flexion) @ axes.T


def _two_bone_ik(
    to_goal: FloatArray, lengths: Sequence[float], pole: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Direction (N,3) of the upper bone that reaches a goal with the middle joint at the pole's side.

    Also the axis (N,3) about which the lower bone is turned against it.
    """
    upper, lower = lengths
    distance = np.linalg.norm(to_goal, axis=1, keepdims=True)
    reach = np.clip(distance, abs(upper - lower) * 1.001 + 1e-6, 0.999 * (upper + lower))
    towards = to_goal / np.maximum(distance, 1e-9)
    side = pole - (pole * towards).sum(axis=1, keepdims=True) * towards
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    cosine = np.clip((upper**2 + reach**2 - lower**2) / (2.0 * upper * reach), -1.0, 1.0)
    along = cosine * towards + np.sqrt(1.0 - cosine**2) * side
    # The lower bone turns from the upper one's direction towards the goal: about upper × goal.
    return along, np.cross(side, towards)


def _rotation_from_axes(along: FloatArray, third: FloatArray) -> FloatArray:
    """Rotations (N,3,3) with columns along, third × along, third (made orthogonal to along)."""
    along = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    third = third - (third * along).sum(axis=1, keepdims=True) * along
    third /= np.maximum(np.linalg.norm(third, axis=1, keepdims=True), 1e-9)
    return np.stack([along, np.cross(third, along), third], axis=-1)
