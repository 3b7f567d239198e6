"""Keyframes that the video itself contradicts: tracks that run on where the map makes the camera leap."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert, transform_points
from bodycap_batch.model.scene import Map
from bodycap_batch.registration.poses.pnp import AcceptanceCriteria, ransac_pose
from bodycap_batch.registration.tracking.klt import Tracks

_MIN_TRACKS = 15
_MAX_MEDIAN_ERROR = 4.0
"""Median distance of tracks from where the map expects them, in inlier limits. Between keyframes in their
right place it stays below 2.5 limits (walk131, room131, a rendered brown-lens walk); a keyframe 24 cm off
makes 4.5, one 146 cm off 60."""
_UNSEEN_ERROR_PX = 1e5


_MIN_OTHER_POSE_RATIO = 0.5
"""Share of the tracks into a keyframe that lead to one other pose: of those that contradict a misplaced
keyframe 75 to 97 % (at least one way), of tracks that slipped on a fast turn 35 and 44 %. Tracks that end
where the map expects them lead to its own pose: half of those behind a sleeve did, and the others slipped."""


@dataclass(frozen=True, slots=True)
class _Interval:
    """Two neighbouring keyframes of a camera.

    Attributes:
        whole: Tracks between them confirm their places.
        torn: They contradict them.
    """

    whole: bool
    torn: bool


@dataclass(frozen=True, slots=True)
class _ArrivingTracks:
    """Tracks that arrive in the next keyframe.

    Attributes:
        to: (N,) which of the camera's keyframes they arrive in.
        source: (N,) which they come from.
        point: (N,) the map's points.
        px: (N,2) where they arrive.
        error_px: (N,) how far from where the map expects them.
    """

    to: IntArray
    source: IntArray
    point: IntArray
    px: FloatArray
    error_px: FloatArray


def find_misplaced_keyframes(
    camera: str, scene_map: Map, tracks: Tracks, limits: AcceptanceCriteria
) -> IntArray:
    """Rows of a camera's keyframes that stand apart from neighbours which tracking ties them to.

    Points tracked from one keyframe to the next must arrive where the map expects them. Where they do not,
    one side of the gap is in the wrong place: the one whose keyframes, as far as tracks tie them together,
    see fewer of the map's points that others see too.

    Args:
        camera: Camera name.
        scene_map: The map.
        tracks: Observations tracked from keyframes into the frames around them, the next keyframe included.
        limits: What makes an observation agree with a pose.

    Source: the loop of tracking and map as a check is Zach, Klopschitz, Pollefeys, "Disambiguating visual
        relations using loop constraints", CVPR 2010, in its simplest form.
    """
    rows = scene_map.keyframes_of(camera)
    arrivals = _arriving_tracks(camera, scene_map, rows, tracks)
    lens = scene_map.cameras.get(camera)
    gaps = [
        _check_interval(lens, scene_map, arrivals, number, limits) for number in range(len(rows) - 1) if lens
    ]
    whole = np.array([gap.whole for gap in gaps], dtype=bool)
    piece = np.concatenate([[0], np.cumsum(~whole)]) if len(rows) else np.zeros(0, np.int64)
    ties = np.bincount(piece, weights=_count_shared_points(scene_map)[rows]) if len(rows) else np.zeros(0)
    blamed = set()
    for number, gap in enumerate(gaps):
        if gap.torn:
            before, after = int(piece[number]), int(piece[number + 1])
            blamed.add(before if ties[before] < ties[after] else after)
    return rows[np.isin(piece, sorted(blamed))]


def _arriving_tracks(camera: str, scene_map: Map, rows: IntArray, tracks: Tracks) -> _ArrivingTracks:
    frames = scene_map.keyframe_frame[rows]
    here = np.flatnonzero(np.isin(tracks.frame, frames))
    point = scene_map.points_of(camera, tracks.keyframe[here], tracks.feature[here])
    here, point = here[point >= 0], point[point >= 0]
    to, source = (np.searchsorted(frames, each[here]) for each in (tracks.frame, tracks.keyframe))
    px = tracks.px[here].astype(np.float64)
    return _ArrivingTracks(to, source, point, px, _arrival_errors(scene_map, camera, rows[to], point, px))


def _check_interval(
    lens: Camera, scene_map: Map, arrivals: _ArrivingTracks, number: int, limits: AcceptanceCriteria
) -> _Interval:
    """What the tracks between a keyframe and the next, both ways, say of their places."""
    ways = [
        np.flatnonzero((arrivals.source == source) & (arrivals.to == to))
        for source, to in ((number, number + 1), (number + 1, number))
    ]
    both = np.concatenate(ways)
    if len(both) < _MIN_TRACKS:
        return _Interval(whole=False, torn=False)
    if np.median(arrivals.error_px[both]) <= _MAX_MEDIAN_ERROR * limits.max_error_px:
        return _Interval(whole=True, torn=False)
    torn = False
    for way in ways:
        points, px = scene_map.points[arrivals.point[way]], arrivals.px[way]
        pose = ransac_pose(lens, points, px, limits) if len(way) >= _MIN_TRACKS else None
        if pose is not None:
            seen = transform_points(pose[None], points)
            close = np.linalg.norm(lens.project(seen) - px, axis=1) < limits.max_error_px
            elsewhere = close & (seen[:, 2] > 0.0) & (arrivals.error_px[way] >= limits.max_error_px)
            torn = torn or bool(elsewhere.mean() >= _MIN_OTHER_POSE_RATIO)
    return _Interval(whole=False, torn=torn)


def _arrival_errors(
    scene_map: Map, camera: str, row: IntArray, point: IntArray, px: FloatArray
) -> FloatArray:
    """Distances (N,) of pixels from where keyframes (rows) see points; far where they cannot."""
    if len(row) == 0:
        return np.zeros(0)
    seen = transform_points(invert(scene_map.map_from_cam[row]), scene_map.points[point])
    expected = scene_map.cameras[camera].project(seen)
    error_px = np.linalg.norm(expected - px, axis=1)
    return np.where((seen[:, 2] > 0.0) & np.isfinite(error_px), error_px, _UNSEEN_ERROR_PX)


def _count_shared_points(scene_map: Map) -> IntArray:
    """(K,) how many of its points each keyframe shares with another camera or three keyframes and more."""
    seen = np.bincount(scene_map.obs_point, minlength=len(scene_map.points))
    return np.bincount(
        scene_map.obs_keyframe[seen[scene_map.obs_point] > 2], minlength=len(scene_map.keyframe_camera)
    )


def map_without_keyframes(scene_map: Map, rows: IntArray) -> Map:
    """The same map in the same gauge without some of its keyframes and what they see."""
    keep = np.ones(len(scene_map.keyframe_camera), dtype=bool)
    keep[rows] = False
    kept: BoolArray = keep[scene_map.obs_keyframe]
    new_row = np.cumsum(keep) - 1
    return replace(
        scene_map,
        keyframe_camera=tuple(
            name for name, here in zip(scene_map.keyframe_camera, keep, strict=True) if here
        ),
        keyframe_frame=scene_map.keyframe_frame[keep],
        map_from_cam=scene_map.map_from_cam[keep],
        obs_keyframe=new_row[scene_map.obs_keyframe[kept]],
        obs_point=scene_map.obs_point[kept],
        obs_feature=scene_map.obs_feature[kept],
        obs_px=scene_map.obs_px[kept],
    )
