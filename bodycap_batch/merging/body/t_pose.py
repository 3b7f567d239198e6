"""Detection of a T-pose without known axes or scale, and the joint priors during a T-pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, runs
from bodycap_batch.merging.body.bones import Bone, anatomical_axes
from bodycap_batch.merging.cameras.track import MAX_COARSE_GAP_NS, CameraTrack
from bodycap_batch.model.skeleton import SkeletonModel
from bodycap_batch.model.skeleton_presets import split_side

_MIN_ARM_ANGLE_RAD = float(np.radians(140.0))
"""Minimum angle (radians) between the directions from the trunk's camera to the two hands. Evidence: none."""
_MIN_SPAN_RATIO = 0.93
"""Minimum distance between the hands in a T-pose, as a ratio to the largest distance between the hands in the
capture. Evidence: none."""
_MIN_ARM_SPAN_RATIO = 0.75
"""Minimum distance between the hands in a T-pose, as a ratio to the expected distance. The expected distance
is inaccurate, because the scale is provisional. Evidence: none."""
_MAX_SPEED = 0.15
"""Maximum speed of the trunk, and of the hands relative to the trunk, in a T-pose. Unit: largest distance
between the hands in the capture, per second. Evidence: none."""
_MIN_DURATION_S = 0.5
"""Minimum duration (seconds) of a T-pose. Arms that are stretched only in passing are no T-pose. Evidence:
none."""
_SPEED_HALF_WINDOW_NS = 1.5e8
"""Half of the duration (nanoseconds) over which a speed is computed. Noise averages out over 0.3 s."""
_SHOULDER_WIDTH_M = 0.2
"""Distance (metres) between the shoulders. The expected distance between the hands is this distance plus the
lengths of the arms. The value is smaller than the shoulder width of any adult."""

_SIGMA_DEG = {
    "Shoulder": (4.0, 4.0, 4.0), "Arm": (15.0, 6.0, 6.0), "ForeArm": (20.0, 6.0, 6.0),
    "Hand": (8.0, 8.0, 8.0), "Neck": (6.0, 6.0, 6.0), "Head": (8.0, 8.0, 8.0), "UpLeg": (8.0, 5.0, 5.0),
    "Leg": (6.0, 5.0, 6.0), "Foot": (8.0, 8.0, 8.0), "ToeBase": (5.0, 5.0, 8.0),
}  # fmt: skip
"""Sigmas (degrees) of joint rotations in a T-pose, by part of the body. The three sigmas are for rotations
about the along, forward and flexion axes, see `anatomical_axes`. The rotation of the arms about the along
axis has the largest sigma, because palms may face down or forward. Evidence: none."""
_TRUNK_SIGMA_DEG = (4.0, 4.0, 4.0)
"""Sigmas (degrees) of the rotations of trunk joints in a T-pose. These joints are not in `_SIGMA_DEG`. The
three sigmas are for rotations about the along, forward and flexion axes, see `anatomical_axes`."""


def find_t_pose(
    bones: Sequence[Bone], tracks: Sequence[CameraTrack], span_map: float
) -> tuple[int, int] | None:
    """Find the longest T-pose of a capture.

    In a T-pose, the hands lie on opposite sides of the trunk's camera. The distance between the hands is
    nearly the largest in the capture, and the hands hardly move.

    Args:
        bones: The graph's bones.
        tracks: Tracks without outliers, the track of the trunk's camera first.
        span_map: Rough distance (map units) between the hands with the arms stretched out.

    Returns:
        First and last time of the T-pose on the common clock, nanoseconds; None without a T-pose.
    """
    by_role = {split_side(bones[track.bone].role): track for track in reversed(tracks)}
    hands = [by_role.get((side, "Hand")) or by_role.get((side, "ForeArm")) for side in ("Left", "Right")]
    trunk = tracks[0]
    on_limb = bool(split_side(bones[trunk.bone].role)[0])
    if hands[0] is None or hands[1] is None or on_limb or len(trunk.times_ns) < 3:
        return None
    sampled = [
        hand.poses_at(trunk.times_ns, max_gap_ns=MAX_COARSE_GAP_NS) for hand in hands if hand is not None
    ]
    arms = [poses[:, :3, 3] - trunk.map_from_cam[:, :3, 3] for poses, _ in sampled]
    valid = sampled[0][1] & sampled[1][1]
    span = np.linalg.norm(arms[0] - arms[1], axis=1)
    if valid.sum() < 3:
        return None
    widest = float(np.percentile(span[valid], 99.0))
    lengths = np.linalg.norm(arms[0], axis=1) * np.linalg.norm(arms[1], axis=1)
    angle = np.arccos(np.clip((arms[0] * arms[1]).sum(axis=1) / np.maximum(lengths, 1e-12), -1.0, 1.0))
    posed = valid & (angle > _MIN_ARM_ANGLE_RAD)
    posed &= (span > _MIN_SPAN_RATIO * widest) & (span > _MIN_ARM_SPAN_RATIO * span_map)
    for points in (trunk.map_from_cam[:, :3, 3], arms[0], arms[1]):
        posed &= _speed(points, trunk.times_ns) < _MAX_SPEED * widest
    return _longest_run(posed, trunk.times_ns)


def _speed(points: FloatArray, times_ns: IntArray) -> FloatArray:
    """Return the speed (T,), units per second, of points (T,3), computed over about 0.3 s."""
    half = max(1, round(_SPEED_HALF_WINDOW_NS / max(float(np.median(np.diff(times_ns))), 1.0)))
    index = np.arange(len(points))
    low, high = np.maximum(index - half, 0), np.minimum(index + half, len(points) - 1)
    seconds = np.maximum(times_ns[high] - times_ns[low], 1) * 1e-9
    return np.asarray(np.linalg.norm(points[high] - points[low], axis=1) / seconds)


def _longest_run(mask: BoolArray, times_ns: IntArray) -> tuple[int, int] | None:
    """Return the first and last time of the longest run of True in a mask (T,).

    Returns None if this run is shorter than `_MIN_DURATION_S`.
    """
    spans = [(int(times_ns[start]), int(times_ns[stop - 1])) for start, stop in runs(mask)]
    best = max(spans, key=lambda span: span[1] - span[0], default=(0, 0))
    return best if best[1] - best[0] >= _MIN_DURATION_S * 1e9 else None


def arm_span(bones: Sequence[Bone], skeleton: SkeletonModel) -> float:
    """Return the distance (metres) between the wrists in a T-pose.

    Arm bones that are not in the graph add no length.
    """
    index = {bone.role: bone for bone in bones}
    total = 0.0
    for side in ("Left", "Right"):
        for part in ("ForeArm", "Hand"):
            if side + part in index:
                total += float(np.linalg.norm(index[side + part].offset_m))
    shoulders = [skeleton.index_of_role(side + "Arm") for side in ("Left", "Right")]
    return total + (_SHOULDER_WIDTH_M if None not in shoulders else 0.0)


def with_t_pose_prior(skeleton: SkeletonModel, bones: Sequence[Bone]) -> tuple[Bone, ...]:
    """Return the bones with the T-pose as the prior of their joints."""
    out = []
    for bone in bones:
        part = split_side(bone.role)[1]
        axes = anatomical_axes(skeleton, bone.role)
        covariance = np.diag(np.radians(_SIGMA_DEG.get(part, _TRUNK_SIGMA_DEG)) ** 2)
        out.append(
            replace(
                bone,
                mean_rotation=_t_pose_rotation(skeleton, bone, bones),
                rotation_covariance=axes @ covariance @ axes.T,
            )
        )
    return tuple(out)


def _t_pose_rotation(skeleton: SkeletonModel, bone: Bone, bones: Sequence[Bone]) -> FloatArray:
    """Return the rotation parent_from_bone (3,3) in a T-pose.

    The zero pose of the skeleton may differ from a T-pose.
    """
    if bone.parent < 0:
        return np.eye(3)
    above, own = (_t_pose_orientation(skeleton, each.role) for each in (bones[bone.parent], bone))
    return np.asarray(above.T @ own)


def _t_pose_orientation(skeleton: SkeletonModel, role: str) -> FloatArray:
    """Return world_from_bone (3,3) of a person in a T-pose who faces −y."""
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
