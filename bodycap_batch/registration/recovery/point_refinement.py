"""Remove weakly supported poses next to lost intervals, and refine map points from the remaining poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.geometry import invert
from bodycap_batch.model.optical_flow import pixel_scale
from bodycap_batch.model.rotation_path import PosePath
from bodycap_batch.model.scene import FrameStatus, Map, Trajectory
from bodycap_batch.registration.poses.batched_pnp import Observations, linearise, make_observations
from bodycap_batch.registration.poses.keyframe_requests import lost_intervals

_WELL_SUPPORTED_FACTOR = 4
"""Minimum number of inliers of a pose that is kept next to a lost interval, as a multiple of the minimum
number for other poses. Evidence: docs/decisions/registration.md."""
_MAX_BOUNDARY_FRAMES = 8
"""Maximum number of frames whose poses are removed at each end of a lost interval. Without this limit, all
poses of a camera that always sees few points would be removed. Evidence: none."""
_NOISE_PX = 0.8
"""Pixels at 640 px image width: standard deviation of an observation. Evidence: none."""
_LOSS_SIGMAS, _MAX_SIGMAS = 2.0, 5.0
"""Thresholds on the residual of an observation, in standard deviations. At _LOSS_SIGMAS the observation has
half of its weight. Beyond _MAX_SIGMAS it is removed after the refinement. Evidence: none."""
_ITERATIONS, _COARSE_ITERATIONS = 10, 4
"""Number of all Gauss–Newton iterations, and number of strongly damped iterations at the start. Evidence:
none."""
_COARSE_DAMPING, _FINE_DAMPING = 1e-3, 1e-6
"""Damping of the first iterations and damping of the later iterations, as a fraction of a point's mean
information. Evidence: none."""
_MIN_OBSERVATIONS = 2
"""Minimum number of observations of a point: two lines of sight determine it."""
_CHUNK_ROWS = 1 << 15
"""Approximate number of observations in a chunk. Only one chunk is held in memory at a time."""


def remove_weak_boundary_poses(path: Trajectory, min_inliers: int) -> Trajectory:
    """Remove weakly supported poses next to lost intervals: poses with few inliers.

    A keyframe next to a lost interval sees mainly points that it helped to triangulate. These points agree
    with its pose even if the pose is wrong. Recovery searches the frames of the removed poses again, like all
    lost frames. Evidence: docs/decisions/registration.md.

    Args:
        path: The trajectory, from tracking.
        min_inliers: Minimum number of inliers of any pose.

    Returns:
        The trajectory, or `path` itself if no pose is removed. Frames whose pose was removed have the status
        `UNCONFIRMED`.
    """
    weak = path.inliers < _WELL_SUPPORTED_FACTOR * min_inliers
    has_pose = path.localised
    for start, stop in lost_intervals(has_pose):
        has_pose[_first_supported(weak, start - 1, -1) + 1 : start] = False
        has_pose[stop : _first_supported(weak, stop, 1)] = False
    removed = path.localised & ~has_pose
    return path.without(removed, FrameStatus.UNCONFIRMED) if removed.any() else path


def _first_supported(weak: BoolArray, frame: int, step: int) -> int:
    """Return the first frame that is not weak, from `frame` in steps of `step`.

    At most `_MAX_BOUNDARY_FRAMES` frames are tested. If all tested frames are weak, the next frame is
    returned. This frame may be just outside the video.
    """
    last = frame + step * _MAX_BOUNDARY_FRAMES
    while frame != last and 0 <= frame < len(weak) and weak[frame]:
        frame += step
    return frame


def refine_points(scene_map: Map, paths: Sequence[Trajectory]) -> Map:
    """Refine the points of a map from the poses of the frames.

    At the ends of lost intervals, the pose of a keyframe in the map may be far from the pose that was
    estimated from tracks. The points that this keyframe sees are then displaced too. Evidence:
    docs/decisions/registration.md.

    Args:
        scene_map: The map.
        paths: Trajectories of all cameras. Keyframes of cameras in another gauge keep their poses in the map.

    Returns:
        The map in the same gauge, with refined points and with keyframes at the poses of the trajectories.
        If the frame of a keyframe is lost, the keyframe keeps its pose and its observations are removed.
        Observations that disagree with the refined points are removed. Observations of points with fewer than
        two remaining observations are removed too.
    """
    poses, covariance = scene_map.map_from_cam.copy(), np.zeros((len(scene_map.keyframe_frame), 6, 6))
    has_pose = np.ones(len(poses), dtype=bool)
    own_paths = [path for path in paths if path.gauge == scene_map.gauge]
    for path in own_paths:
        rows = scene_map.keyframes_of(path.camera)
        has_pose[rows] = path.localised[scene_map.keyframe_frame[rows]]
        rows = rows[has_pose[rows]]
        frames = scene_map.keyframe_frame[rows]
        poses[rows], covariance[rows] = path.gauge_from_cam[frames], path.covariance[frames]
    posed_map = replace(scene_map, map_from_cam=poses)
    px = _mid_row_px(posed_map, {path.camera: path for path in own_paths})
    order = np.argsort(posed_map.obs_point, kind="stable")
    order = order[has_pose[posed_map.obs_keyframe[order]]]
    points, accepted = posed_map.points.copy(), np.zeros(len(px), dtype=bool)
    for chunk in _split_by_point(posed_map.obs_point[order]):
        rows = order[chunk]
        accepted[rows] = _refine_points_gauss_newton(posed_map, points, rows, px[rows], covariance)
    count = np.bincount(posed_map.obs_point[accepted], minlength=len(points))
    accepted &= count[posed_map.obs_point] >= _MIN_OBSERVATIONS
    return replace(
        posed_map,
        points=points,
        obs_keyframe=posed_map.obs_keyframe[accepted],
        obs_point=posed_map.obs_point[accepted],
        obs_feature=posed_map.obs_feature[accepted],
        obs_px=posed_map.obs_px[accepted],
    )


def _mid_row_px(scene_map: Map, paths: Mapping[str, Trajectory]) -> FloatArray:
    """Return the observed pixels (M,2) moved to the instant of the middle row.

    The poses refer to this instant.
    """
    out = scene_map.obs_px.copy()
    for name, readout_s in sorted(scene_map.readout_s.items()):
        path = paths.get(name)
        if path is None or not readout_s:
            continue
        is_own = np.isin(scene_map.obs_keyframe, scene_map.keyframes_of(name))
        frame = scene_map.keyframe_frame[scene_map.obs_keyframe[is_own]]
        lens, points = scene_map.cameras[name], scene_map.points[scene_map.obs_point[is_own]]
        poses = PosePath.create(path.gauge_from_cam, path.times_ns)
        seen = lens, frame, points, out[is_own], readout_s
        out[is_own] = poses.with_fitted_rates(*seen).px_at_mid_row(*seen)
    return out


def _split_by_point(point: IntArray) -> list[slice]:
    """Split observations (M,), ordered by point, into chunks.

    All observations of a point are in the same chunk.
    """
    starts = np.flatnonzero(np.diff(point, prepend=-1))
    cuts = [0]
    for start in starts.tolist():
        if start - cuts[-1] >= _CHUNK_ROWS:
            cuts.append(start)
    return [slice(*ends) for ends in zip(cuts, [*cuts[1:], len(point)], strict=True)] if len(point) else []


def _refine_points_gauss_newton(
    scene_map: Map, points: FloatArray, rows: IntArray, px: FloatArray, covariance: FloatArray
) -> BoolArray:
    """Refine the points of the given observations in place.

    Args:
        scene_map: The map.
        points: (P,3) points of the map, changed in place.
        rows: (M,) row indices of observations in the map, ordered by point.
        px: (M,2) pixels of these observations.
        covariance: (K,6,6) covariance of the keyframes' poses.

    Returns:
        Mask (M,) of the observations that agree with the refined points.

    Method: Gauss–Newton with a Cauchy loss. The weight of an observation depends on the noise of its pixel
        and on the covariance of its keyframe's pose.
    """
    keyframe = scene_map.obs_keyframe[rows]
    point_index, starts, number = np.unique(scene_map.obs_point[rows], return_index=True, return_inverse=True)
    cam_from_map = invert(scene_map.map_from_cam[keyframe])
    observations, sigma = _single_observations(scene_map, keyframe, px)
    all_rows = np.arange(len(rows))
    for iteration in range(_ITERATIONS + 1):
        current = replace(observations, points=points[point_index][number])
        residual, by_pose, depth = linearise(current, all_rows, cam_from_map)
        by_pose = by_pose.transpose(2, 0, 1)
        noise = by_pose @ covariance[keyframe] @ by_pose.transpose(0, 2, 1)
        information = np.linalg.inv(noise + np.eye(2) * sigma[:, None, None] ** 2)
        squared = np.einsum("in,nij,jn->n", residual, information, residual)
        if iteration == _ITERATIONS:
            break
        by_point = by_pose[:, :, 3:] @ cam_from_map[:, :3, :3]
        weighted = by_point.transpose(0, 2, 1) @ information
        weighted /= 1.0 + squared[:, None, None] / _LOSS_SIGMAS**2
        hessian = np.add.reduceat(weighted @ by_point, starts)
        gradient = np.add.reduceat(np.einsum("nij,jn->ni", weighted, residual), starts)
        damping = _COARSE_DAMPING if iteration < _COARSE_ITERATIONS else _FINE_DAMPING
        mean_information = np.einsum("nii->n", hessian)[:, None, None] * np.eye(3) / 3.0
        hessian += damping * mean_information + np.eye(3) * np.finfo(float).tiny
        points[point_index] -= np.linalg.solve(hessian, gradient[:, :, None])[:, :, 0]
    error_px = np.hypot(*residual)
    return np.asarray((depth > 0.0) & (error_px < _MAX_SIGMAS * sigma))


def _single_observations(
    scene_map: Map, keyframe: IntArray, px: FloatArray
) -> tuple[Observations, FloatArray]:
    """Undistort pixels of keyframes. Each pixel becomes an observation in a separate frame.

    Args:
        scene_map: The map.
        keyframe: (M,) row index of the keyframe that observes each pixel.
        px: (M,2) observed pixels.

    Returns:
        The observations, whose points are zero, and the noise (M,) of each observation in pixels.
    """
    count = len(px)
    out = Observations(
        bounds=np.arange(count + 1),
        points=np.zeros((count, 3)),
        rays=np.empty((count, 2)),
        px_from_ray=np.empty((count, 2, 2)),
        weight=np.ones(count),
    )
    names, sigma = np.array(scene_map.keyframe_camera)[keyframe], np.empty(count)
    for name in np.unique(names).tolist():
        own, lens = np.flatnonzero(names == name), scene_map.cameras[name]
        undistorted = make_observations(lens, np.arange(len(own) + 1), out.points[own], px[own])
        out.rays[own], out.px_from_ray[own] = undistorted.rays, undistorted.px_from_ray
        sigma[own] = _NOISE_PX * pixel_scale(lens.width_px, lens.height_px)
    return out, sigma
