"""All frames of a camera solved against the map, again with what the first solution taught."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.geometry import interpolate_pose, invert
from bodycap_batch.model.scene import FrameStatus, Map
from bodycap_batch.registration.poses.batched_pnp import find_inliers
from bodycap_batch.registration.poses.observations import PointReliability, RigMember, RigObservations
from bodycap_batch.registration.poses.pnp import (
    MAP_COVARIANCE_SCALE,
    AcceptanceCriteria,
    FramePose,
    solve_poses,
)
from bodycap_batch.registration.poses.pose_outliers import find_outlier_poses, isolated_poses
from bodycap_batch.registration.tracking.klt import Tracks

_MIN_STATIC_INLIERS = 6
"""Confirmed inliers without which a pose is that of the wearer's sleeve."""
_LONE_EVIDENCE = 4
"""A pose that no neighbouring frame confirms needs so many times the usual inliers."""
_REPEATS = 1
_REPEATS_ROLLING = 2
"""The velocity that moves pixels comes from the poses that the moved pixels give."""


def solve_camera(
    camera: CaptureCamera, scene_map: Map, tracks: Tracks, limits: AcceptanceCriteria
) -> list[FramePose]:
    """Solve every frame of a camera from the map points seen in it; see `solve_rig`."""
    count = len(camera.times_ns)
    alone = RigMember(camera=camera, tracks=tracks, cam_from_rig=np.eye(4), rig_frame=np.arange(count))
    rows = scene_map.keyframes_of(camera.name)
    start = _interpolated_keyframe_poses(scene_map.keyframe_frame[rows], scene_map.map_from_cam[rows], count)
    return solve_rig([alone], scene_map, start, limits)


def solve_rig(
    members: Sequence[RigMember], scene_map: Map, start: FloatArray, limits: AcceptanceCriteria
) -> list[FramePose]:
    """Solve every frame of a rig from the map points that its cameras see at that instant.

    Points that move with the wearer, or were matched wrongly, lie off in most frames whatever the pose:
    once the poses stand, a point counts by the share of frames that agree with it, and all is solved
    again. Pixels of a rolling shutter are moved to the middle row's instant on the way.

    Args:
        members: Its cameras. The first one sits in the rig's origin and has its frames.
        scene_map: The map.
        start: (F,4,4) rig_from_map to start from; NaN where there is none.
        limits: What makes a pose acceptable.

    Returns:
        Poses of the first camera; `FrameStatus.RIG` where it saw too little for one of its own.
    """
    rig = RigObservations.of(members, scene_map)
    solved = _solve(rig, start, limits)
    for _ in range(_REPEATS_ROLLING if rig.rolling else _REPEATS):
        path = pose_array(solved.poses)
        start = np.where(np.isfinite(path), invert(path), start)
        solved = _solve(rig, start, limits, solved.votes, path if rig.rolling else None)
    poses = _require_static_inliers(solved.poses, solved.confirmed)
    times_ns = rig.members[0].camera.times_ns
    return _reject_outliers(_assign_status(poses, rig, solved.own, limits), times_ns, limits)


@dataclass(frozen=True, slots=True)
class _Solution:
    """Poses of all frames and what agrees with them.

    Attributes:
        poses: One a frame.
        votes: What each point's views say.
        confirmed: (F,) confirmed points that agree.
        own: (F,) points of the first camera that agree.
    """

    poses: list[FramePose]
    votes: PointReliability
    confirmed: IntArray
    own: IntArray


def _solve(
    rig: RigObservations,
    start: FloatArray,
    limits: AcceptanceCriteria,
    votes: PointReliability | None = None,
    path: FloatArray | None = None,
) -> _Solution:
    """Poses of all frames, a stretch at a time: what is seen in a long video would fill the memory.

    Args:
        rig: Cameras and map.
        start: (F,4,4) rig_from_map to start from.
        limits: What makes a pose acceptable.
        votes: How far each point is to be trusted.
        path: (F,4,4) map_from_rig with which pixels of a rolling shutter are moved.
    """
    count = len(start)
    out = _Solution(
        [], PointReliability.none(rig.confirmed.size), np.zeros(count, np.int64), np.zeros(count, np.int64)
    )
    for part in rig.stretches():
        px = None if path is None else part.at_mid_row(path)
        views, frames = part.views(px, votes), part.frames
        poses = solve_poses(rig.lenses, views, part.px if px is None else px, start[frames], limits)
        found = pose_array(poses)
        agrees = find_inliers(views, invert(found), limits.max_error_px)
        posed = np.asarray(np.isfinite(found).all(axis=(1, 2)))[part.frame - frames.start]
        out.poses.extend(poses)
        out.votes.add(part.which, posed, agrees)
        out.confirmed[frames] = part.counts(agrees & part.confirmed)
        out.own[frames] = part.counts(agrees & (part.member == 0))
    return out


def _assign_status(
    poses: list[FramePose], rig: RigObservations, own: IntArray, limits: AcceptanceCriteria
) -> list[FramePose]:
    """Tell keyframes, and frames that the rig's other cameras carry; `own` counts the first one's inliers."""
    rows = rig.scene_map.keyframes_of(rig.members[0].camera.name)
    status = dict.fromkeys(rig.scene_map.keyframe_frame[rows].tolist(), FrameStatus.KEYFRAME)
    if len(rig.members) > 1:
        status |= dict.fromkeys(np.flatnonzero(own < limits.min_inliers).tolist(), FrameStatus.RIG)
    return [
        replace(pose, status=status.get(frame, pose.status))
        if pose.status is FrameStatus.REGISTERED
        else pose
        for frame, pose in enumerate(poses)
    ]


def pose_array(poses: Sequence[FramePose]) -> FloatArray:
    """Poses gauge_from_cam (N,4,4), NaN where there is none."""
    none = np.full((4, 4), np.nan)
    found = [none if pose.gauge_from_cam is None else pose.gauge_from_cam for pose in poses]
    return np.array(found).reshape(-1, 4, 4)


def _interpolated_keyframe_poses(keyframes: IntArray, map_from_cam: FloatArray, count: int) -> FloatArray:
    """Poses cam_from_map (count,4,4) interpolated between keyframes; the nearest one's outside them."""
    frames = np.arange(count)
    after = np.clip(np.searchsorted(keyframes, frames), 1, max(1, len(keyframes) - 1))
    after = np.minimum(after, len(keyframes) - 1)
    before = np.maximum(after - 1, 0)
    span = np.maximum(keyframes[after] - keyframes[before], 1)
    alpha = np.clip((frames - keyframes[before]) / span, 0.0, 1.0)
    return invert(interpolate_pose(map_from_cam[before], map_from_cam[after], alpha))


def _require_static_inliers(poses: list[FramePose], confirmed: IntArray) -> list[FramePose]:
    """Refuse the poses that hardly any confirmed point agrees with; `confirmed` counts them by frame."""
    posed = np.array([pose.gauge_from_cam is not None for pose in poses], dtype=bool)
    return _reject(poses, posed & (confirmed < _MIN_STATIC_INLIERS), FrameStatus.UNCONFIRMED)


def _reject_outliers(
    poses: list[FramePose], times_ns: IntArray, limits: AcceptanceCriteria
) -> list[FramePose]:
    """Refuse the poses that jump away from both neighbours and back, and weak ones that stand alone."""
    centres = np.full((len(poses), 3), np.nan)
    sigma = np.full(len(poses), np.nan)
    for frame, pose in enumerate(poses):
        if pose.gauge_from_cam is not None and pose.covariance is not None:
            centres[frame] = pose.gauge_from_cam[:3, 3]
            # Neighbours share the map's error.
            sigma[frame] = np.sqrt(np.trace(pose.covariance[3:, 3:]) / MAP_COVARIANCE_SCALE)
    out = _reject(poses, find_outlier_poses(centres, sigma, times_ns), FrameStatus.POSE_JUMP)
    localised = np.array([pose.gauge_from_cam is not None for pose in out], dtype=bool)
    inliers = np.array([pose.inliers for pose in out], dtype=np.int64)
    lone = isolated_poses(localised, inliers, _LONE_EVIDENCE * limits.min_inliers)
    return _reject(out, lone, FrameStatus.UNCONFIRMED)


def _reject(poses: list[FramePose], which: BoolArray, status: FrameStatus) -> list[FramePose]:
    return [
        FramePose(status=status, inliers=pose.inliers, error_px=pose.error_px) if which[frame] else pose
        for frame, pose in enumerate(poses)
    ]
