"""Find misregistered keyframes: their poses in the map contradict the tracks between keyframes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert, transform_points
from bodycap_batch.model.scene import Map
from bodycap_batch.registration.poses.pnp import AcceptanceCriteria, ransac_pose
from bodycap_batch.registration.tracking.klt import Tracks

_MIN_TRACKS = 15
"""Minimum number of tracks between two keyframes. With fewer tracks, the poses of the two keyframes are not
tested. Origin: about the minimum number of inliers of a pose. Evidence: none."""
_MAX_MEDIAN_ERROR = 4.0
"""Maximum median distance between tracked and predicted pixels, as a multiple of the inlier limit. If the
median between two keyframes is larger, the tracks may contradict the poses. Evidence:
docs/decisions/registration.md."""
_UNSEEN_ERROR_PX = 1e5
"""Error of a point that is behind the keyframe's camera or cannot be projected. Unit: pixels. The value
exceeds every limit."""


_MIN_OTHER_POSE_RATIO = 0.5
"""Minimum fraction of the tracks arriving in a keyframe that must agree on another pose of this keyframe.
With a smaller fraction, the tracks have probably moved to wrong points, and the pose in the map is not
treated as wrong. Evidence: docs/decisions/registration.md."""


@dataclass(frozen=True, slots=True)
class _Interval:
    """Result of testing the poses of two successive keyframes with the tracks between them.

    Both attributes are False in two cases: there are too few tracks, or the tracks disagree with the poses
    but no other pose explains them.

    Attributes:
        consistent: True if the tracks between the keyframes agree with their poses.
        inconsistent: True if the tracks contradict the poses and agree on another pose of one keyframe.
    """

    consistent: bool
    inconsistent: bool


@dataclass(frozen=True, slots=True)
class _ArrivingTracks:
    """Tracks that start in one keyframe and arrive in another, with their deviation from the map.

    Attributes:
        target: (N,) index of the keyframe that the track arrives in, among the camera's keyframes.
        source: (N,) index of the keyframe that the track starts from, among the camera's keyframes.
        point: (N,) index of the tracked map point.
        px: (N,2) pixel at which the track arrives.
        error_px: (N,) distance between this pixel and the pixel that the map predicts.
    """

    target: IntArray
    source: IntArray
    point: IntArray
    px: FloatArray
    error_px: FloatArray


def find_misplaced_keyframes(
    camera: str, scene_map: Map, tracks: Tracks, criteria: AcceptanceCriteria
) -> IntArray:
    """Find misregistered keyframes: keyframes whose pose contradicts the tracks from their neighbours.

    Points tracked from one keyframe to the next must arrive at the pixels that the map predicts. If the
    points arrive elsewhere, the keyframes on one side of the interval are misregistered. A side is a group of
    keyframes that are connected by consistent intervals. The side that shares fewer points with other
    keyframes is treated as misregistered.

    Args:
        camera: Camera name.
        scene_map: The map.
        tracks: Observations tracked from keyframes into the frames around them, including the next keyframe.
        criteria: The inlier limit of an observation.

    Returns:
        Row indices of the misregistered keyframes in the map.

    Source: Zach, Klopschitz, Pollefeys, "Disambiguating visual relations using loop constraints", CVPR 2010.
        Here each loop is as short as possible: the tracks from one keyframe to the next, and the poses of
        both keyframes in the map.
    """
    if not is_on(Mechanism.MISPLACED_KEYFRAMES):
        return np.zeros(0, np.int64)
    rows = scene_map.keyframes_of(camera)
    arriving = _arriving_tracks(camera, scene_map, rows, tracks)
    lens = scene_map.cameras.get(camera)
    intervals = [
        _check_interval(lens, scene_map, arriving, number, criteria)
        for number in range(len(rows) - 1)
        if lens
    ]
    consistent = np.array([interval.consistent for interval in intervals], dtype=bool)
    group = np.concatenate([[0], np.cumsum(~consistent)]) if len(rows) else np.zeros(0, np.int64)
    shared = np.bincount(group, weights=_count_shared_points(scene_map)[rows]) if len(rows) else np.zeros(0)
    misplaced = set()
    for number, interval in enumerate(intervals):
        if interval.inconsistent:
            before, after = int(group[number]), int(group[number + 1])
            misplaced.add(before if shared[before] < shared[after] else after)
    found = rows[np.isin(group, sorted(misplaced))]
    record_act(Mechanism.MISPLACED_KEYFRAMES, len(found))
    return found


def _arriving_tracks(camera: str, scene_map: Map, rows: IntArray, tracks: Tracks) -> _ArrivingTracks:
    """Select the tracks that arrive in a keyframe, with their distance from the predicted pixel."""
    frames = scene_map.keyframe_frame[rows]
    arrived = np.flatnonzero(np.isin(tracks.frame, frames))
    point = scene_map.points_of(camera, tracks.keyframe[arrived], tracks.feature[arrived])
    arrived, point = arrived[point >= 0], point[point >= 0]
    target, source = (
        np.searchsorted(frames, frame_of[arrived]) for frame_of in (tracks.frame, tracks.keyframe)
    )
    px = tracks.px[arrived].astype(np.float64)
    return _ArrivingTracks(
        target, source, point, px, _arrival_errors(scene_map, camera, rows[target], point, px)
    )


def _check_interval(
    lens: Camera, scene_map: Map, arriving: _ArrivingTracks, number: int, criteria: AcceptanceCriteria
) -> _Interval:
    """Compare the tracks between two successive keyframes with the poses of these keyframes.

    Tracks in both directions are compared.

    Args:
        lens: The camera model.
        scene_map: The map.
        arriving: Tracks that arrive in a keyframe.
        number: Index of the first of the two keyframes, among the camera's keyframes.
        criteria: The inlier limit of an observation.
    """
    directions = [
        np.flatnonzero((arriving.source == source) & (arriving.target == target))
        for source, target in ((number, number + 1), (number + 1, number))
    ]
    both = np.concatenate(directions)
    if len(both) < _MIN_TRACKS:
        return _Interval(consistent=False, inconsistent=False)
    if np.median(arriving.error_px[both]) <= _MAX_MEDIAN_ERROR * criteria.max_error_px:
        return _Interval(consistent=True, inconsistent=False)
    inconsistent = False
    for rows in directions:
        points, px = scene_map.points[arriving.point[rows]], arriving.px[rows]
        pose = ransac_pose(lens, points, px, criteria) if len(rows) >= _MIN_TRACKS else None
        if pose is not None:
            x_in_cam = transform_points(pose[None], points)
            close = np.linalg.norm(lens.project(x_in_cam) - px, axis=1) < criteria.max_error_px
            agrees_elsewhere = (
                close & (x_in_cam[:, 2] > 0.0) & (arriving.error_px[rows] >= criteria.max_error_px)
            )
            inconsistent = inconsistent or bool(agrees_elsewhere.mean() >= _MIN_OTHER_POSE_RATIO)
    return _Interval(consistent=False, inconsistent=inconsistent)


def _arrival_errors(
    scene_map: Map, camera: str, row: IntArray, point: IntArray, px: FloatArray
) -> FloatArray:
    """Return the distances (N,) in pixels between observed and predicted pixels.

    Args:
        scene_map: The map.
        camera: Camera name.
        row: (N,) row index of a keyframe in the map.
        point: (N,) index of the point that the keyframe observes.
        px: (N,2) observed pixel.
    """
    if len(row) == 0:
        return np.zeros(0)
    x_in_cam = transform_points(invert(scene_map.map_from_cam[row]), scene_map.points[point])
    expected = scene_map.cameras[camera].project(x_in_cam)
    error_px = np.linalg.norm(expected - px, axis=1)
    return np.where((x_in_cam[:, 2] > 0.0) & np.isfinite(error_px), error_px, _UNSEEN_ERROR_PX)


def _count_shared_points(scene_map: Map) -> IntArray:
    """Return the number (K,) of points that each keyframe shares with at least two other keyframes."""
    keyframe_count = np.bincount(scene_map.obs_point, minlength=len(scene_map.points))
    return np.bincount(
        scene_map.obs_keyframe[keyframe_count[scene_map.obs_point] > 2],
        minlength=len(scene_map.keyframe_camera),
    )


def map_without_keyframes(scene_map: Map, rows: IntArray) -> Map:
    """Return the map without the keyframes `rows` and their observations, in the same gauge."""
    keep = np.ones(len(scene_map.keyframe_camera), dtype=bool)
    keep[rows] = False
    obs_kept: BoolArray = keep[scene_map.obs_keyframe]
    new_row = np.cumsum(keep) - 1
    return replace(
        scene_map,
        keyframe_camera=tuple(
            name for name, is_kept in zip(scene_map.keyframe_camera, keep, strict=True) if is_kept
        ),
        keyframe_frame=scene_map.keyframe_frame[keep],
        map_from_cam=scene_map.map_from_cam[keep],
        keyframe_covariance=scene_map.keyframe_covariance[keep[: len(scene_map.keyframe_covariance)]],
        obs_keyframe=new_row[scene_map.obs_keyframe[obs_kept]],
        obs_point=scene_map.obs_point[obs_kept],
        obs_feature=scene_map.obs_feature[obs_kept],
        obs_px=scene_map.obs_px[obs_kept],
    )
