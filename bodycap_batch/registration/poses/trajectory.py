"""Solve all frames of a camera or a rig against the map, repeatedly with what the solution before showed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.config import RegistrationOptions
from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.geometry import interpolate_pose, invert
from bodycap_batch.model.optical_flow import BLUR_SHARPNESS_RATIO
from bodycap_batch.model.scene import FrameStatus, KeyframeSelection, Map, Trajectory
from bodycap_batch.registration.poses.batched_pnp import find_inliers
from bodycap_batch.registration.poses.observations import PointReliability, RigMember, RigObservations
from bodycap_batch.registration.poses.pnp import (
    MAP_COVARIANCE_SCALE,
    AcceptanceCriteria,
    FramePose,
    solve_poses,
)
from bodycap_batch.registration.poses.pose_outliers import (
    ISOLATED_INLIER_FACTOR,
    find_outlier_poses,
    isolated_poses,
)
from bodycap_batch.registration.tracking.klt import Tracks, camera_pixel_scale

_MIN_STATIC_INLIERS = 6
"""Inliers on static points below which a pose is taken for one relative to the wearer's sleeve. Evidence:
none."""
_MAP_NOISE_PX = 0.6
"""Pixels at 640 px image width: standard deviation of a map point's projection. Evidence: none."""
_INLIER_SIGMAS = 3.5
"""Inlier limit in standard deviations of an observation. Origin: it covers 99.8 % of a 2D normal
distribution."""
_BLUR_WINDOW_FRAMES = 15
"""Frames on either side with which the sharpness of a frame is compared. Evidence: none."""
_REPEATS = 1
"""Repetitions with weights from the agreement of each point."""
_REPEATS_ROLLING = 2
"""The same with a rolling shutter. Its correction needs poses for the image velocities, so poses and
corrected pixels are solved alternately, twice."""


def acceptance_criteria(
    camera: CaptureCamera, selection: KeyframeSelection, options: RegistrationOptions
) -> AcceptanceCriteria:
    """Return the conditions for poses of a camera, from the noise of its tracks and the options."""
    noise_px = np.hypot(_MAP_NOISE_PX * camera_pixel_scale(camera), 2.0 * selection.noise_px)
    return AcceptanceCriteria(
        max_error_px=float(_INLIER_SIGMAS * noise_px),
        min_inliers=options.min_inliers,
        max_sigma_depth=options.max_sigma_depth,
    )


def solve_camera(
    camera: CaptureCamera, scene_map: Map, tracks: Tracks, criteria: AcceptanceCriteria, threads: int = 1
) -> list[FramePose]:
    """Estimate the pose of every frame of a camera from the observed map points; see `solve_rig`."""
    count = len(camera.times_ns)
    member = RigMember(camera=camera, tracks=tracks, cam_from_rig=np.eye(4), rig_frame=np.arange(count))
    rows = scene_map.keyframes_of(camera.name)
    start = _interpolated_keyframe_poses(scene_map.keyframe_frame[rows], scene_map.map_from_cam[rows], count)
    return solve_rig([member], scene_map, start, criteria, threads)


def solve_rig(
    members: Sequence[RigMember],
    scene_map: Map,
    start: FloatArray,
    criteria: AcceptanceCriteria,
    threads: int = 1,
) -> list[FramePose]:
    """Estimate the pose of every frame of a rig from the map points that its cameras observe at that instant.

    Points that move with the wearer and wrongly matched points disagree with the poses of most frames. After
    a first solution each point is weighted by the ratio of frames that agree with it, and all frames are
    solved again. Observations of a rolling shutter are moved to the instant of the middle row.

    Args:
        members: The cameras. The first one is at the origin of the rig, and its frames are those of the rig.
        scene_map: The map.
        start: (F,4,4) rig_from_map to start from; NaN if there is none.
        criteria: The conditions that a pose must meet.
        threads: Threads that solve chunks of frames. The result does not depend on them.

    Returns:
        Poses of the first camera; their status is `FrameStatus.RIG` if it alone has too few inliers.
    """
    rig = RigObservations.create(members, scene_map)
    solution = _solve(rig, start, criteria, threads)
    for _ in range(_REPEATS_ROLLING if rig.rolling else _REPEATS):
        poses = pose_array(solution.poses)
        start = np.where(np.isfinite(poses), invert(poses), start)
        path = poses if rig.rolling else None
        solution = _solve(rig, start, criteria, threads, solution.reliability, path)
    accepted = _require_static_inliers(solution.poses, solution.static)
    times_ns = rig.members[0].camera.times_ns
    return _reject_outliers(_assign_status(accepted, rig, solution.own_inliers, criteria), times_ns, criteria)


@dataclass(slots=True)
class _Solution:
    """Poses of all frames, and what agrees with them.

    Attributes:
        poses: One for each frame.
        reliability: How often each point agreed.
        static: (F,) number of inliers on static points.
        own_inliers: (F,) number of inliers of the first camera.
    """

    poses: list[FramePose]
    reliability: PointReliability
    static: IntArray
    own_inliers: IntArray


def _solve(
    rig: RigObservations,
    start: FloatArray,
    criteria: AcceptanceCriteria,
    threads: int,
    reliability: PointReliability | None = None,
    path: FloatArray | None = None,
) -> _Solution:
    """Estimate the poses of all frames, one block after another.

    All observations of a long video would fill the memory.

    Args:
        rig: Cameras and map.
        start: (F,4,4) rig_from_map to start from.
        criteria: The conditions that a pose must meet.
        threads: Threads that solve chunks of frames.
        reliability: Agreement of each point in the solution before.
        path: (F,4,4) map_from_rig that corrects the rolling shutter; None for a global shutter.
    """
    count = len(start)
    out = _Solution(
        [], PointReliability.zero(rig.static.size), np.zeros(count, np.int64), np.zeros(count, np.int64)
    )
    for block in rig.blocks():
        px = None if path is None else block.px_at_mid_row(path)
        observations, frames = block.observations(px, reliability), block.frames
        observed_px = block.px if px is None else px
        poses = solve_poses(rig.lenses, observations, observed_px, start[frames], criteria, threads)
        solved = pose_array(poses)
        agrees = find_inliers(observations, invert(solved), criteria.max_error_px, threads)
        has_pose = np.asarray(np.isfinite(solved).all(axis=(1, 2)))[block.frame - frames.start]
        out.poses.extend(poses)
        out.reliability.add(block.point_keys, has_pose, agrees)
        out.static[frames] = block.count_by_frame(agrees & block.static)
        out.own_inliers[frames] = block.count_by_frame(agrees & (block.member == 0))
    return out


def _assign_status(
    poses: list[FramePose], rig: RigObservations, own_inliers: IntArray, criteria: AcceptanceCriteria
) -> list[FramePose]:
    """Set the status of keyframes, and of frames that only other cameras of the rig support.

    Args:
        poses: One for each frame.
        rig: The rig.
        own_inliers: (F,) inliers of the first camera.
        criteria: The least number of inliers.
    """
    rows = rig.scene_map.keyframes_of(rig.members[0].camera.name)
    status = dict.fromkeys(rig.scene_map.keyframe_frame[rows].tolist(), FrameStatus.KEYFRAME)
    if len(rig.members) > 1:
        status |= dict.fromkeys(np.flatnonzero(own_inliers < criteria.min_inliers).tolist(), FrameStatus.RIG)
    return [
        replace(pose, status=status.get(frame, pose.status))
        if pose.status is FrameStatus.REGISTERED
        else pose
        for frame, pose in enumerate(poses)
    ]


def pose_array(poses: Sequence[FramePose]) -> FloatArray:
    """Return the poses gauge_from_cam (N,4,4); NaN if there is none."""
    missing = np.full((4, 4), np.nan)
    matrices = [missing if pose.gauge_from_cam is None else pose.gauge_from_cam for pose in poses]
    return np.array(matrices).reshape(-1, 4, 4)


def build_trajectory(
    camera: CaptureCamera, gauge: str, poses: Sequence[FramePose], sharpness: FloatArray
) -> Trajectory:
    """Return the trajectory of a camera with the status of each frame.

    Args:
        camera: The camera.
        gauge: Gauge of the poses.
        poses: One for each frame.
        sharpness: (F,) sharpness of the frames.
    """
    missing = np.full((6, 6), np.nan)
    return Trajectory(
        camera=camera.name,
        gauge=gauge,
        frame_numbers=camera.frame_numbers,
        times_ns=camera.times_ns,
        gauge_from_cam=pose_array(poses),
        covariance=np.array(
            [missing if pose.covariance is None else pose.covariance for pose in poses]
        ).reshape(-1, 6, 6),
        status=tuple(_frame_statuses(poses, sharpness)),
        inliers=np.array([pose.inliers for pose in poses], dtype=np.int64),
        error_px=np.array([pose.error_px for pose in poses]),
    )


def _frame_statuses(poses: Sequence[FramePose], sharpness: FloatArray) -> list[FrameStatus]:
    """Return the statuses of the frames.

    A frame without tracks that is much less sharp than the frames around it gets the status BLUR.
    """
    statuses = []
    for index, pose in enumerate(poses):
        status = pose.status
        if status is FrameStatus.FEW_TRACKS:
            nearby = sharpness[max(0, index - _BLUR_WINDOW_FRAMES) : index + _BLUR_WINDOW_FRAMES + 1]
            if sharpness[index] < BLUR_SHARPNESS_RATIO * np.median(nearby):
                status = FrameStatus.BLUR
        statuses.append(status)
    return statuses


def _interpolated_keyframe_poses(keyframes: IntArray, map_from_cam: FloatArray, count: int) -> FloatArray:
    """Return cam_from_map (count,4,4), interpolated between keyframes.

    Frames outside all keyframes get the pose of the nearest one.
    """
    frames = np.arange(count)
    after = np.clip(np.searchsorted(keyframes, frames), 1, max(1, len(keyframes) - 1))
    after = np.minimum(after, len(keyframes) - 1)
    before = np.maximum(after - 1, 0)
    span = np.maximum(keyframes[after] - keyframes[before], 1)
    alpha = np.clip((frames - keyframes[before]) / span, 0.0, 1.0)
    return invert(interpolate_pose(map_from_cam[before], map_from_cam[after], alpha))


def _require_static_inliers(poses: list[FramePose], static_inliers: IntArray) -> list[FramePose]:
    """Reject the poses with few inliers on static points.

    Args:
        poses: One for each frame.
        static_inliers: (F,) inliers on static points.
    """
    has_pose = np.array([pose.gauge_from_cam is not None for pose in poses], dtype=bool)
    return _reject(poses, has_pose & (static_inliers < _MIN_STATIC_INLIERS), FrameStatus.UNCONFIRMED)


def _reject_outliers(
    poses: list[FramePose], times_ns: IntArray, criteria: AcceptanceCriteria
) -> list[FramePose]:
    """Reject poses that deviate from their neighbours, and isolated poses with few inliers."""
    centres = np.full((len(poses), 3), np.nan)
    sigma = np.full(len(poses), np.nan)
    for frame, pose in enumerate(poses):
        if pose.gauge_from_cam is not None and pose.covariance is not None:
            centres[frame] = pose.gauge_from_cam[:3, 3]
            # Neighbouring frames share the error of the map.
            sigma[frame] = np.sqrt(np.trace(pose.covariance[3:, 3:]) / MAP_COVARIANCE_SCALE)
    accepted = _reject(poses, find_outlier_poses(centres, sigma, times_ns), FrameStatus.POSE_JUMP)
    localised = np.array([pose.gauge_from_cam is not None for pose in accepted], dtype=bool)
    inliers = np.array([pose.inliers for pose in accepted], dtype=np.int64)
    isolated = isolated_poses(localised, inliers, ISOLATED_INLIER_FACTOR * criteria.min_inliers)
    return _reject(accepted, isolated, FrameStatus.UNCONFIRMED)


def _reject(poses: list[FramePose], rejected: BoolArray, status: FrameStatus) -> list[FramePose]:
    """Replace the poses selected by `rejected` (F,) by the status."""
    return [
        FramePose(status=status, inliers=pose.inliers, error_px=pose.error_px) if rejected[frame] else pose
        for frame, pose in enumerate(poses)
    ]
