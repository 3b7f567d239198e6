"""Estimate the poses of all frames, and repeat the estimation with weights from the previous solution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.config import RegistrationOptions
from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.geometry import interpolate_pose, invert
from bodycap_batch.model.optical_flow import BLUR_SHARPNESS_RATIO
from bodycap_batch.model.rotation_path import RotationPath
from bodycap_batch.model.scene import FrameStatus, KeyframeSelection, Map, Trajectory
from bodycap_batch.registration.poses.batched_pnp import find_inliers
from bodycap_batch.registration.poses.contradicted import find_folded_poses
from bodycap_batch.registration.poses.observations import CameraObservations, PointReliability
from bodycap_batch.registration.poses.pnp import AcceptanceCriteria, FramePose, solve_poses
from bodycap_batch.registration.poses.pose_outliers import (
    ISOLATED_INLIER_FACTOR,
    find_outlier_poses,
    isolated_poses,
)
from bodycap_batch.registration.tracking.klt import Tracks, camera_pixel_scale

_MIN_STATIC_INLIERS = 6
"""Minimum number of inliers on static points. A pose with fewer such inliers is rejected. It was probably
estimated from points on the wearer's sleeve. Evidence: none."""
_MAP_NOISE_PX = 0.6
"""Pixels at 640 px image width: standard deviation of a map point's projection. Evidence: none."""
_INLIER_SIGMAS = 3.5
"""Maximum reprojection error of an inlier, in standard deviations of an observation. Origin: it covers 99.8 %
of a 2D normal distribution."""
_BLUR_WINDOW_FRAMES = 15
"""Number of frames on each side of a frame, for the detection of blur. The sharpness of the frame is compared
with the median sharpness of this window. Evidence: none."""
_REPEATS = 1
"""Number of repeated solutions for a global shutter. Each repetition weights the points by their agreement
with the previous poses."""
_REPEATS_ROLLING = 2
"""Number of repeated solutions for a rolling shutter. Each repetition first corrects the pixels. The
correction needs the velocities of points in the image, which are computed from the previous poses."""


def acceptance_criteria(
    camera: CaptureCamera, selection: KeyframeSelection, options: RegistrationOptions
) -> AcceptanceCriteria:
    """Return the conditions for poses of a camera, from the noise of its tracks and the options.

    Args:
        camera: The camera.
        selection: The keyframes of the camera. Only the noise of its tracks is used.
        options: Minimum number of inliers and maximum relative sigma.
    """
    noise_px = np.hypot(_MAP_NOISE_PX * camera_pixel_scale(camera), 2.0 * selection.noise_px)
    return AcceptanceCriteria(
        max_error_px=float(_INLIER_SIGMAS * noise_px),
        min_inliers=options.min_inliers,
        max_sigma_depth=options.max_sigma_depth,
    )


def solve_camera(
    camera: CaptureCamera,
    scene_map: Map,
    tracks: Tracks,
    criteria: AcceptanceCriteria,
    threads: int = 1,
    rotation: RotationPath | None = None,
) -> list[FramePose]:
    """Estimate the pose of every frame of a camera from the map points that it observes.

    The solution starts from poses that are interpolated between the keyframes. Wrongly matched points, and
    points that move with the wearer, disagree with the poses of most frames. After a first solution, all
    frames are solved again with new weights. The weight of each point is multiplied by the squared fraction
    of its observations that agree with a pose. Observations of a rolling shutter are moved to the instant of
    the middle row.

    Args:
        camera: The camera.
        scene_map: The map.
        tracks: Tracked observations in the frames of the camera, ordered by frame.
        criteria: The conditions that a pose must meet.
        threads: Number of threads that solve chunks of frames. The result does not depend on it.
        rotation: The rotation of a camera with a rolling shutter from matches between adjacent frames; None
            if it is unknown.
    """
    rows = scene_map.keyframes_of(camera.name)
    start = _interpolated_keyframe_poses(
        scene_map.keyframe_frame[rows], scene_map.map_from_cam[rows], len(camera.times_ns)
    )
    seen = CameraObservations(camera, tracks, scene_map, rotation)
    is_rolling = bool(seen.readout_s)
    solution = _solve(
        seen, start, criteria, threads, path=np.full_like(start, np.nan) if is_rolling else None
    )
    for _ in range(_REPEATS_ROLLING if is_rolling else _REPEATS):
        poses = pose_array(solution.poses)
        start = np.where(np.isfinite(poses), invert(poses), start)
        path = poses if is_rolling else None
        solution = _solve(seen, start, criteria, threads, solution.reliability, path)
    accepted = _require_static_inliers(solution.poses, solution.static)
    return _reject_outliers(_with_keyframe_status(accepted, scene_map, rows), camera, criteria)


@dataclass(slots=True)
class _Solution:
    """Poses of all frames, and the observations that agree with them.

    Attributes:
        poses: Pose of each frame.
        reliability: How often each point agreed with a pose.
        static: (F,) number of inliers on static points.
    """

    poses: list[FramePose]
    reliability: PointReliability
    static: IntArray


def _solve(
    seen: CameraObservations,
    start: FloatArray,
    criteria: AcceptanceCriteria,
    threads: int,
    reliability: PointReliability | None = None,
    path: FloatArray | None = None,
) -> _Solution:
    """Estimate the poses of all frames, block by block.

    The observations of a long video do not fit into memory together.

    Args:
        seen: The observations of the camera.
        start: (F,4,4) initial poses cam_from_map; NaN for a frame without an initial pose.
        criteria: The conditions that a pose must meet.
        threads: Number of threads that solve chunks of frames.
        reliability: Reliability of each point in the previous solution; None for the first solution.
        path: (F,4,4) poses map_from_cam for the correction of the rolling shutter; None for a global shutter.
    """
    out = _Solution([], PointReliability.zero(seen.static.size), np.zeros(len(start), np.int64))
    for block in seen.blocks():
        px, rates = (None, None) if path is None else block.px_at_mid_row(path)
        observations, frames = block.observations(px, reliability, rates), block.frames
        observed_px = block.px if px is None else px
        poses = solve_poses(seen.lens, observations, observed_px, start[frames], criteria, threads)
        solved = pose_array(poses)
        agrees = find_inliers(observations, invert(solved), criteria.max_error_px, threads)
        has_pose = np.asarray(np.isfinite(solved).all(axis=(1, 2)))[block.frame - frames.start]
        out.poses.extend(poses)
        out.reliability.add(block.point, has_pose, agrees)
        out.static[frames] = block.count_by_frame(agrees & block.static)
    return out


def _with_keyframe_status(poses: list[FramePose], scene_map: Map, rows: IntArray) -> list[FramePose]:
    """Set the status of the keyframes.

    Args:
        poses: Pose of each frame.
        scene_map: The map.
        rows: (K,) row indices of the camera's keyframes in the map.
    """
    keyframes = frozenset(scene_map.keyframe_frame[rows].tolist())
    return [
        replace(pose, status=FrameStatus.KEYFRAME)
        if frame in keyframes and pose.status is FrameStatus.REGISTERED
        else pose
        for frame, pose in enumerate(poses)
    ]


def pose_array(poses: Sequence[FramePose]) -> FloatArray:
    """Return the poses gauge_from_cam (N,4,4); NaN for frames without a pose."""
    missing = np.full((4, 4), np.nan)
    matrices = [missing if pose.gauge_from_cam is None else pose.gauge_from_cam for pose in poses]
    return np.array(matrices).reshape(-1, 4, 4)


def build_trajectory(
    camera: CaptureCamera, gauge: str, poses: Sequence[FramePose], selection: KeyframeSelection
) -> Trajectory:
    """Return the trajectory of a camera with the status of each frame.

    Args:
        camera: The camera.
        gauge: Identifier of the gauge of the poses.
        poses: Pose of each frame.
        selection: The keyframes of the camera. Only the sharpness of each frame, and the damaged and frozen
            frames are used.
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
        status=tuple(_frame_statuses(poses, selection)),
        inliers=np.array([pose.inliers for pose in poses], dtype=np.int64),
        error_px=np.array([pose.error_px for pose in poses]),
    )


def _frame_statuses(poses: Sequence[FramePose], selection: KeyframeSelection) -> list[FrameStatus]:
    """Return the status of each frame.

    The status is DAMAGED if a frame without a pose is damaged, and FROZEN if it is frozen. It is BLUR if a
    frame has too few tracks, and is much less sharp than the frames around it.
    """
    statuses, sharpness = [], selection.sharpness
    damaged = frozenset(selection.damaged.tolist())
    for index, pose in enumerate(poses):
        status = pose.status
        if index in damaged and not status.localised:
            status = FrameStatus.DAMAGED
        elif selection.frozen[index] and status is not FrameStatus.NO_MAP:
            status = FrameStatus.FROZEN
        elif status is FrameStatus.FEW_TRACKS:
            nearby = sharpness[max(0, index - _BLUR_WINDOW_FRAMES) : index + _BLUR_WINDOW_FRAMES + 1]
            if sharpness[index] < BLUR_SHARPNESS_RATIO * np.median(nearby):
                status = FrameStatus.BLUR
        statuses.append(status)
    return statuses


def _interpolated_keyframe_poses(keyframes: IntArray, map_from_cam: FloatArray, count: int) -> FloatArray:
    """Return poses cam_from_map (count,4,4) of all frames, interpolated between keyframes.

    Frames before the first and after the last keyframe get the pose of the nearest keyframe.
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
        poses: Pose of each frame.
        static_inliers: (F,) number of inliers on static points.
    """
    has_pose = np.array([pose.gauge_from_cam is not None for pose in poses], dtype=bool)
    return _reject(poses, has_pose & (static_inliers < _MIN_STATIC_INLIERS), FrameStatus.UNCONFIRMED)


def _reject_outliers(
    poses: list[FramePose], camera: CaptureCamera, criteria: AcceptanceCriteria
) -> list[FramePose]:
    """Reject poses that the video or their neighbours contradict, and isolated poses with few inliers."""
    folded = find_folded_poses(camera.rotation_chain, pose_array(poses))
    poses = _reject(poses, folded, FrameStatus.CONTRADICTED)
    centres = np.full((len(poses), 3), np.nan)
    sigma = np.full(len(poses), np.nan)
    for frame, pose in enumerate(poses):
        if pose.gauge_from_cam is not None:
            centres[frame] = pose.gauge_from_cam[:3, 3]
            sigma[frame] = pose.scatter
    accepted = _reject(poses, find_outlier_poses(centres, sigma, camera.times_ns), FrameStatus.POSE_JUMP)
    localised = np.array([pose.gauge_from_cam is not None for pose in accepted], dtype=bool)
    inliers = np.array([pose.inliers for pose in accepted], dtype=np.int64)
    isolated = isolated_poses(localised, inliers, ISOLATED_INLIER_FACTOR * criteria.min_inliers)
    return _reject(accepted, isolated, FrameStatus.UNCONFIRMED)


def _reject(poses: list[FramePose], rejected: BoolArray, status: FrameStatus) -> list[FramePose]:
    """Remove the poses that the mask `rejected` (F,) selects, and give these frames the status `status`."""
    return [
        FramePose(status=status, inliers=pose.inliers, error_px=pose.error_px) if rejected[frame] else pose
        for frame, pose in enumerate(poses)
    ]
