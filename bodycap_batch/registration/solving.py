"""All frames of a camera solved against the map, again with what the first solution taught."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.capture import CaptureCamera
from bodycap_batch.geometry import interpolate_pose, invert
from bodycap_batch.registration.batch import inliers_of, make_views
from bodycap_batch.registration.confirmed import confirmed_points
from bodycap_batch.registration.jumps import lone_poses, pose_jumps
from bodycap_batch.registration.pose import MAP_VARIANCE_RATIO, FramePose, PoseLimits, solve_poses
from bodycap_batch.registration.tracks import Tracks
from bodycap_batch.rolling_shutter import at_mid_row, image_velocity
from bodycap_batch.scene import FrameStatus, Map

_POINT_VARIANCE = 6.0
"""Variance that a point seen by n keyframes adds to its projections, times n, in units of a track's own.
Without it and with 3, 6, 9: walk131 0.65, 0.59, 0.55, 0.55 cm; room131 3.1, 3.0, 2.9, 2.9; walk12 0.38 for
all; room12 0.55, 0.55, 0.56, 0.56."""
_UNCONFIRMED_WEIGHT = 0.01
"""Weight of points that nothing confirms. With 1, 0.1, 0.03, 0.01: room131 1.86, 1.39, 1.38, 1.36 cm; a
rendered capture with textured sleeves in view 1.00, 0.72, 0.61, 0.58 cm; room12 0.58, 0.60, 0.61, 0.61 cm."""
_LEAST_CONFIRMED = 6
"""Confirmed inliers without which a pose is that of the wearer's sleeve."""
_LONE_EVIDENCE = 4
"""A pose that no neighbouring frame confirms needs so many times the usual inliers."""
_MIN_JUDGED = 4
_AGAIN = 1
_AGAIN_ROLLING = 2
"""The velocity that moves pixels comes from the poses that the moved pixels give."""


@dataclass(frozen=True, slots=True)
class _Seen:
    """Map points seen by a camera, by frame: tracked into it, and in a keyframe the map's own observations.

    Attributes:
        frame: (M,) frame index, increasing.
        point: (M,) point index.
        px: (M,2) where.
    """

    frame: IntArray
    point: IntArray
    px: FloatArray

    @staticmethod
    def by(camera: str, scene_map: Map, tracks: Tracks) -> _Seen:
        point = scene_map.points_of(camera, tracks.keyframe, tracks.feature)
        tracked = point >= 0
        mine = np.isin(scene_map.obs_keyframe, scene_map.keyframes_of(camera))
        own_frame = scene_map.keyframe_frame[scene_map.obs_keyframe[mine]]
        frame = np.concatenate([own_frame, tracks.frame[tracked]])
        order = np.argsort(frame, kind="stable")
        return _Seen(
            frame[order],
            np.concatenate([scene_map.obs_point[mine], point[tracked]])[order],
            np.concatenate([scene_map.obs_px[mine], tracks.px[tracked].astype(np.float64)])[order],
        )


def solve_frames(
    camera: CaptureCamera, scene_map: Map, tracks: Tracks, limits: PoseLimits
) -> list[FramePose]:
    """Solve every frame from the map points seen in it.

    Points that move with the wearer, or were matched wrongly, lie off in most frames whatever the pose:
    once the poses stand, a point counts by the share of frames that agree with it, and all is solved
    again. Pixels of a rolling shutter are moved to the middle row's instant on the way.
    """
    seen = _Seen.by(camera.name, scene_map, tracks)
    lens = scene_map.cameras[camera.name]
    rows = scene_map.keyframes_of(camera.name)
    keyframes, count = scene_map.keyframe_frame[rows], len(camera.times_ns)
    bounds = np.searchsorted(seen.frame, np.arange(count + 1))
    confirmed = confirmed_points(camera, scene_map)
    points, known = scene_map.points[seen.point], _point_weights(scene_map, confirmed)[seen.point]
    start = _between(keyframes, scene_map.map_from_cam[rows], count)
    views = make_views(lens, bounds, points, seen.px, known)
    poses = solve_poses(lens, views, seen.px, start, limits)
    readout_s = scene_map.readout_s.get(camera.name, 0.0)
    for _ in range(_AGAIN_ROLLING if readout_s else _AGAIN):
        path = matrices(poses)
        posed = np.asarray(np.isfinite(path).all(axis=(1, 2)))[seen.frame]
        share = agreement(inliers_of(views, invert(path), limits.max_error_px), posed, seen.point)
        start = np.where(np.isfinite(path), invert(path), start)
        px, weight = seen.px, known * share**2
        if readout_s:
            velocity = image_velocity(lens, path, camera.times_ns, seen.frame, points)
            px = at_mid_row(lens, px, velocity, readout_s)
            views = make_views(lens, bounds, points, px, weight)
        else:
            views = replace(views, weight=weight)
        poses = solve_poses(lens, views, px, start, limits)
    agrees = inliers_of(views, invert(matrices(poses)), limits.max_error_px) & confirmed[seen.point]
    poses = _with_evidence(poses, np.bincount(seen.frame[agrees], minlength=count))
    for index in keyframes.tolist():
        if poses[index].status is FrameStatus.REGISTERED:
            poses[index] = replace(poses[index], status=FrameStatus.KEYFRAME)
    return _without_doubtful(poses, limits)


def _point_weights(scene_map: Map, confirmed: BoolArray) -> FloatArray:
    """(P,) weights of the map's points: where one stands is known the better the more keyframes see it."""
    seen = np.bincount(scene_map.obs_point, minlength=len(scene_map.points))
    return np.asarray(seen / (seen + _POINT_VARIANCE) * np.where(confirmed, 1.0, _UNCONFIRMED_WEIGHT))


def agreement(agrees: BoolArray, posed: BoolArray, point: IntArray) -> FloatArray:
    """Share of a point's views that agree with the poses, for each view.

    Args:
        agrees: (M,) views that do.
        posed: (M,) views in frames that have a pose; the others do not count.
        point: (M,) the point of each.

    Returns:
        (M,) from 0 to 1; 1 where fewer than `_MIN_JUDGED` views tell.
    """
    total = np.bincount(point, weights=posed)
    share = np.bincount(point, weights=posed & agrees) / np.maximum(total, 1.0)
    return np.asarray(np.where(total < _MIN_JUDGED, 1.0, share)[point])


def matrices(poses: Sequence[FramePose]) -> FloatArray:
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


def _with_evidence(poses: list[FramePose], confirmed: IntArray) -> list[FramePose]:
    """Refuse the poses that hardly any confirmed point agrees with; `confirmed` counts them by frame."""
    posed = np.array([pose.gauge_from_cam is not None for pose in poses], dtype=bool)
    return _refused(poses, posed & (confirmed < _LEAST_CONFIRMED), FrameStatus.UNCONFIRMED)


def _without_doubtful(poses: list[FramePose], limits: PoseLimits) -> list[FramePose]:
    """Refuse the poses that jump away from both neighbours and back, and weak ones that stand alone."""
    centres = np.full((len(poses), 3), np.nan)
    sigma = np.full(len(poses), np.nan)
    for frame, pose in enumerate(poses):
        if pose.gauge_from_cam is not None and pose.covariance is not None:
            centres[frame] = pose.gauge_from_cam[:3, 3]
            # Neighbours share the map's error.
            sigma[frame] = np.sqrt(np.trace(pose.covariance[3:, 3:]) / MAP_VARIANCE_RATIO)
    out = _refused(poses, pose_jumps(centres, sigma), FrameStatus.POSE_JUMP)
    localised = np.array([pose.gauge_from_cam is not None for pose in out], dtype=bool)
    inliers = np.array([pose.inliers for pose in out], dtype=np.int64)
    lone = lone_poses(localised, inliers, _LONE_EVIDENCE * limits.min_inliers)
    return _refused(out, lone, FrameStatus.UNCONFIRMED)


def _refused(poses: list[FramePose], which: BoolArray, status: FrameStatus) -> list[FramePose]:
    return [
        FramePose(status=status, inliers=pose.inliers, error_px=pose.error_px) if which[frame] else pose
        for frame, pose in enumerate(poses)
    ]
