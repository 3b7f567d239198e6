"""A T-pose in the capture: found without axes or scale, then a strong prior of the joints while it stands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.merging.body.bones import Bone, anatomical_axes
from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.model.skeleton import SkeletonModel
from bodycap_batch.model.skeleton_presets import split_side

_MIN_ARM_ANGLE_RAD = float(np.radians(140.0))
_MIN_SPAN_RATIO = 0.93
_MAX_SPEED = 0.15
_MIN_DURATION_S = 0.5
"""A T-pose, without axes or scale: the two hands seen from the trunk's camera are this far apart in angle,
about as far from each other as they ever come, and hardly move (spans per second) for at least so long."""

# What people who stand in a T-pose are off: the arms' twist most, since palms may face down or forward.
_SIGMA_DEG = {
    "Shoulder": (4.0, 4.0, 4.0), "Arm": (15.0, 6.0, 6.0), "ForeArm": (20.0, 6.0, 6.0),
    "Hand": (8.0, 8.0, 8.0), "Neck": (6.0, 6.0, 6.0), "Head": (8.0, 8.0, 8.0), "UpLeg": (8.0, 5.0, 5.0),
    "Leg": (6.0, 5.0, 6.0), "Foot": (8.0, 8.0, 8.0), "ToeBase": (5.0, 5.0, 8.0),
}  # fmt: skip
_TRUNK_SIGMA_DEG = (4.0, 4.0, 4.0)


def find_t_pose(
    bones: Sequence[Bone], tracks: Sequence[CameraTrack], span_map: float
) -> tuple[int, int] | None:
    """Find the longest T-pose on the common clock (ns), or None.

    Args:
        bones: The graph's bones.
        tracks: Cleaned tracks, the trunk's first.
        span_map: Distance of the two cameras with the arms stretched out, map units, roughly.
    """
    parts = {split_side(bones[track.bone].role): track for track in reversed(tracks)}
    ends = [parts.get((side, "Hand")) or parts.get((side, "ForeArm")) for side in ("Left", "Right")]
    trunk = tracks[0]
    if ends[0] is None or ends[1] is None or split_side(bones[trunk.bone].role)[0] or len(trunk.times_ns) < 3:
        return None
    looks = [end.poses_at(trunk.times_ns, max_gap_ns=200_000_000) for end in ends if end is not None]
    arms = [poses[:, :3, 3] - trunk.map_from_cam[:, :3, 3] for poses, _ in looks]
    valid = looks[0][1] & looks[1][1]
    apart = np.linalg.norm(arms[0] - arms[1], axis=1)
    if valid.sum() < 3:
        return None
    widest = float(np.percentile(apart[valid], 99.0))
    lengths = np.linalg.norm(arms[0], axis=1) * np.linalg.norm(arms[1], axis=1)
    angle = np.arccos(np.clip((arms[0] * arms[1]).sum(axis=1) / np.maximum(lengths, 1e-12), -1.0, 1.0))
    good = (
        valid & (angle > _MIN_ARM_ANGLE_RAD) & (apart > _MIN_SPAN_RATIO * widest) & (apart > 0.75 * span_map)
    )
    for points in (trunk.map_from_cam[:, :3, 3], arms[0], arms[1]):
        good &= _speed(points, trunk.times_ns) < _MAX_SPEED * widest
    return _longest_run(good, trunk.times_ns)


def _speed(points: FloatArray, times_ns: IntArray) -> FloatArray:
    """Speed (T,) over about a third of a second, so that noise does not count."""
    reach = max(1, round(1.5e8 / max(float(np.median(np.diff(times_ns))), 1.0)))
    index = np.arange(len(points))
    low, high = np.maximum(index - reach, 0), np.minimum(index + reach, len(points) - 1)
    seconds = np.maximum(times_ns[high] - times_ns[low], 1) * 1e-9
    return np.asarray(np.linalg.norm(points[high] - points[low], axis=1) / seconds)


def _longest_run(mask: BoolArray, times_ns: IntArray) -> tuple[int, int] | None:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    stretches = [
        (int(times_ns[a]), int(times_ns[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)
    ]
    best = max(stretches, key=lambda span: span[1] - span[0], default=(0, 0))
    return best if best[1] - best[0] >= _MIN_DURATION_S * 1e9 else None


def arm_span(bones: Sequence[Bone], skeleton: SkeletonModel) -> float:
    """Distance of the two wrists in a T-pose (m), 0 where the graph lacks an arm."""
    index = {bone.role: bone for bone in bones}
    total = 0.0
    for side in ("Left", "Right"):
        for part in ("ForeArm", "Hand"):
            if side + part in index:
                total += float(np.linalg.norm(index[side + part].offset_m))
    shoulders = [skeleton.index_of_role(side + "Arm") for side in ("Left", "Right")]
    return total + (0.2 if None not in shoulders else 0.0)


def with_t_pose_prior(skeleton: SkeletonModel, bones: Sequence[Bone]) -> tuple[Bone, ...]:
    """The bones with the T-pose as their joints' prior."""
    out = []
    for bone in bones:
        part = split_side(bone.role)[1]
        axes = anatomical_axes(skeleton, bone.role)
        spread = np.diag(np.radians(_SIGMA_DEG.get(part, _TRUNK_SIGMA_DEG)) ** 2)
        out.append(
            replace(
                bone,
                mean_rotation=_t_pose_rotation(skeleton, bone, bones),
                rotation_covariance=axes @ spread @ axes.T,
            )
        )
    return tuple(out)


def _t_pose_rotation(skeleton: SkeletonModel, bone: Bone, bones: Sequence[Bone]) -> FloatArray:
    """parent_from_bone in a T-pose, whatever the rig's zero pose is."""
    if bone.parent < 0:
        return np.eye(3)
    above, own = (_t_pose_axes(skeleton, each.role) for each in (bones[bone.parent], bone))
    return np.asarray(above.T @ own)


def _t_pose_axes(skeleton: SkeletonModel, role: str) -> FloatArray:
    """world_from_bone (3,3) of someone in a T-pose who faces −Y."""
    side, part = split_side(role)
    axes = anatomical_axes(skeleton, role)
    if part in ("Arm", "ForeArm", "Hand"):
        along = np.array([1.0 if side == "Left" else -1.0, 0.0, 0.0])
    elif part in ("UpLeg", "Leg"):
        along = np.array([0.0, 0.0, -1.0])
    else:
        return np.eye(3)
    forward = np.array([0.0, -1.0, 0.0])
    return np.asarray(np.column_stack([along, forward, np.cross(along, forward)]) @ axes.T)
