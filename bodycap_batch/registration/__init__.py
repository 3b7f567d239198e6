"""Stage 3: every frame's pose, by tracking the map's points into it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bodycap_batch.arrays import FloatArray, IntArray
from bodycap_batch.capture import CaptureCamera
from bodycap_batch.config import RegistrationOptions
from bodycap_batch.context import StageContext
from bodycap_batch.geometry import interpolate_pose, invert
from bodycap_batch.registration.batch import make_views
from bodycap_batch.registration.growth import wanted_keyframes
from bodycap_batch.registration.jumps import pose_jumps
from bodycap_batch.registration.pose import MAP_VARIANCE_RATIO, FramePose, PoseLimits, solve_poses
from bodycap_batch.registration.stretches import all_tracks
from bodycap_batch.registration.tracks import Tracks, anchors_of, track_scale
from bodycap_batch.rolling_shutter import at_mid_row, image_velocity
from bodycap_batch.scene import FrameStatus, KeyframeSelection, Map, Registration, Trajectory

__all__ = ["register_frames"]

_MAP_NOISE_PX = 0.6
_THRESHOLD_SIGMAS = 3.5
_POINT_VARIANCE = 6.0
"""Variance that a point seen by n keyframes adds to its projections, times n, in units of a track's own.
Without it and with 3, 6, 9: walk131 0.65, 0.59, 0.55, 0.55 cm; room131 3.1, 3.0, 2.9, 2.9; walk12 0.38 for
all; room12 0.55, 0.55, 0.56, 0.56."""
_BLUR_RATIO = 0.6
_BLUR_WINDOW = 15
_ROLLING_PASSES = 2
"""The velocity that moves pixels comes from the poses that the moved pixels give."""


def register_frames(
    camera: CaptureCamera,
    maps: Sequence[Map],
    selection: KeyframeSelection,
    options: RegistrationOptions,
    context: StageContext,
    previous: Registration | None = None,
) -> Registration:
    """Solve the pose of every frame of one camera against the map.

    The map's points are tracked from both neighbouring keyframes, into them too, and every observation
    counts: two tracks of one point start from two keyframes' independent errors. No new points are made.

    Args:
        camera: The camera's video.
        maps: Models of the room; the one with most of this camera's keyframes is used.
        selection: The camera's keyframes (sharpness and track noise are read from it).
        options: Limits.
        context: Progress, cancellation.
        previous: An earlier registration against a smaller map. Stretches whose keyframes did not
            change keep their observations; every pose is solved again.

    Returns:
        A pose or a reason for every frame, and the frames that should become keyframes.
    """
    tried = _tried(selection, previous)
    scene_map = _own_map(maps, camera.name)
    if scene_map is None:
        return _without_map(camera, tried)
    anchors = anchors_of(scene_map, camera.name)
    tracks = all_tracks(camera, anchors, previous, context)
    poses = _solve_all(camera, scene_map, tracks, _limits(camera, selection, options))
    trajectory = _trajectory(camera, scene_map.gauge, poses, selection.sharpness)
    return Registration(
        trajectory=trajectory,
        obs_frame=tracks.frame,
        obs_keyframe=tracks.keyframe,
        obs_feature=tracks.feature,
        obs_px=tracks.px,
        wanted_keyframes=wanted_keyframes(trajectory.localised, selection.sharpness, tried),
        tried_keyframes=tried,
    )


def _tried(selection: KeyframeSelection, previous: Registration | None) -> IntArray:
    if previous is None:
        return np.asarray(selection.frames)
    return np.union1d(previous.tried_keyframes, previous.wanted_keyframes)


def _own_map(maps: Sequence[Map], camera: str) -> Map | None:
    """The model with most of a camera's keyframes, or None."""
    counts = [len(item.keyframes_of(camera)) for item in maps]
    return maps[int(np.argmax(counts))] if counts and max(counts) > 0 else None


def _limits(camera: CaptureCamera, selection: KeyframeSelection, options: RegistrationOptions) -> PoseLimits:
    noise_px = np.hypot(_MAP_NOISE_PX * track_scale(camera), 2.0 * selection.noise_px)
    return PoseLimits(
        max_error_px=float(_THRESHOLD_SIGMAS * noise_px),
        min_inliers=options.min_inliers,
        max_sigma_depth=options.max_sigma_depth,
    )


def _without_map(camera: CaptureCamera, tried: IntArray) -> Registration:
    none = Tracks.join([])
    poses = [FramePose(status=FrameStatus.NO_MAP)] * len(camera.times_ns)
    return Registration(
        trajectory=_trajectory(camera, "none", poses, np.zeros(len(poses))),
        obs_frame=none.frame,
        obs_keyframe=none.keyframe,
        obs_feature=none.feature,
        obs_px=none.px,
        wanted_keyframes=np.zeros(0, np.int64),
        tried_keyframes=tried,
    )


def _solve_all(camera: CaptureCamera, scene_map: Map, tracks: Tracks, limits: PoseLimits) -> list[FramePose]:
    """Solve every frame from its tracks and, in a keyframe, from the map's own observations."""
    point = scene_map.points_of(camera.name, tracks.keyframe, tracks.feature)
    tracked = point >= 0
    rows = scene_map.keyframes_of(camera.name)
    mine = np.isin(scene_map.obs_keyframe, rows)
    own_frame = scene_map.keyframe_frame[scene_map.obs_keyframe[mine]]
    frame = np.concatenate([own_frame, tracks.frame[tracked]])
    order = np.argsort(frame, kind="stable")
    seen = np.concatenate([scene_map.obs_point[mine], point[tracked]])[order]
    points, weight = scene_map.points[seen], _point_weights(scene_map)[seen]
    px = np.concatenate([scene_map.obs_px[mine], tracks.px[tracked].astype(np.float64)])[order]
    count = len(camera.times_ns)
    lens = scene_map.cameras[camera.name]
    bounds = np.searchsorted(frame[order], np.arange(count + 1))
    keyframes = scene_map.keyframe_frame[rows]
    start = _between(keyframes, scene_map.map_from_cam[rows], count)
    poses = solve_poses(lens, make_views(lens, bounds, points, px, weight), px, start, limits)
    readout_s = scene_map.readout_s.get(camera.name, 0.0)
    for _ in range(_ROLLING_PASSES if readout_s else 0):
        path = _matrices(poses)
        velocity = image_velocity(lens, path, camera.times_ns, frame[order], points)
        moved = at_mid_row(lens, px, velocity, readout_s)
        start = np.where(np.isfinite(path), invert(path), start)
        poses = solve_poses(lens, make_views(lens, bounds, points, moved, weight), moved, start, limits)
    for index in keyframes.tolist():
        if poses[index].status is FrameStatus.REGISTERED:
            poses[index] = replace(poses[index], status=FrameStatus.KEYFRAME)
    return _without_jumps(poses)


def _point_weights(scene_map: Map) -> FloatArray:
    """(P,) weights of the map's points: where one stands is known the better the more keyframes see it."""
    seen = np.bincount(scene_map.obs_point, minlength=len(scene_map.points))
    return np.asarray(seen / (seen + _POINT_VARIANCE))


def _matrices(poses: Sequence[FramePose]) -> FloatArray:
    """Poses gauge_from_cam (N,4,4), NaN where there is none."""
    none = np.full((4, 4), np.nan)
    found = [none if pose.gauge_from_cam is None else pose.gauge_from_cam for pose in poses]
    return np.array(found).reshape(-1, 4, 4)


def _between(keyframes: IntArray, map_from_cam: FloatArray, count: int) -> FloatArray:
    """Poses cam_from_map (count,4,4) interpolated between keyframes; the nearest one's outside them."""
    frames = np.arange(count)
    after = np.clip(np.searchsorted(keyframes, frames), 1, max(1, len(keyframes) - 1))
    after = np.minimum(after, len(keyframes) - 1)
    before = np.maximum(after - 1, 0)
    span = np.maximum(keyframes[after] - keyframes[before], 1)
    alpha = np.clip((frames - keyframes[before]) / span, 0.0, 1.0)
    return invert(interpolate_pose(map_from_cam[before], map_from_cam[after], alpha))


def _without_jumps(poses: list[FramePose]) -> list[FramePose]:
    """Refuse the poses that jump away from both neighbours and back."""
    centres = np.full((len(poses), 3), np.nan)
    sigma = np.full(len(poses), np.nan)
    for frame, pose in enumerate(poses):
        if pose.gauge_from_cam is not None and pose.covariance is not None:
            centres[frame] = pose.gauge_from_cam[:3, 3]
            # Neighbours share the map's error.
            sigma[frame] = np.sqrt(np.trace(pose.covariance[3:, 3:]) / MAP_VARIANCE_RATIO)
    jump = pose_jumps(centres, sigma)
    refused = FramePose(status=FrameStatus.POSE_JUMP)
    return [
        replace(refused, inliers=pose.inliers, error_px=pose.error_px) if jump[frame] else pose
        for frame, pose in enumerate(poses)
    ]


def _trajectory(
    camera: CaptureCamera, gauge: str, poses: Sequence[FramePose], sharpness: FloatArray
) -> Trajectory:
    none6 = np.full((6, 6), np.nan)
    return Trajectory(
        camera=camera.name,
        gauge=gauge,
        frame_numbers=camera.frame_numbers,
        times_ns=camera.times_ns,
        gauge_from_cam=_matrices(poses),
        covariance=np.array(
            [none6 if pose.covariance is None else pose.covariance for pose in poses]
        ).reshape(-1, 6, 6),
        status=tuple(_blamed(poses, sharpness)),
        inliers=np.array([pose.inliers for pose in poses], dtype=np.int64),
        error_px=np.array([pose.error_px for pose in poses]),
    )


def _blamed(poses: Sequence[FramePose], sharpness: FloatArray) -> list[FrameStatus]:
    """Statuses; a frame without tracks that is much less sharp than its surroundings is called blurred."""
    out = []
    for index, pose in enumerate(poses):
        status = pose.status
        if status is FrameStatus.FEW_TRACKS:
            near = sharpness[max(0, index - _BLUR_WINDOW) : index + _BLUR_WINDOW + 1]
            if sharpness[index] < _BLUR_RATIO * np.median(near):
                status = FrameStatus.BLUR
        out.append(status)
    return out
