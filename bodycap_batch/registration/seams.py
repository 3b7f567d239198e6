"""Keyframes that the video itself contradicts: tracks that run on where the map makes the camera leap."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.geometry import invert, transform_points
from bodycap_batch.registration.tracks import Tracks
from bodycap_batch.scene import Map

_MIN_TRACKS = 15
_TORN_LIMITS = 4.0
"""Median distance of tracks from where the map expects them, in inlier limits. Between keyframes in their
right place it stays below 2.5 limits (walk131, room131, a rendered brown-lens walk); a keyframe 24 cm off
makes 4.5, one 146 cm off 60."""
_FAR_PX = 1e5


@dataclass(frozen=True, slots=True)
class _Gap:
    """Two neighbouring keyframes of a camera.

    Attributes:
        tracks: Tracks from one into the other, both ways.
        median_px: How far off the map expects them.
    """

    tracks: int
    median_px: float

    def whole(self, limit_px: float) -> bool:
        """The tracks confirm the two places."""
        return self.tracks >= _MIN_TRACKS and self.median_px <= _TORN_LIMITS * limit_px

    def torn(self, limit_px: float) -> bool:
        """The tracks contradict the two places."""
        return self.tracks >= _MIN_TRACKS and self.median_px > _TORN_LIMITS * limit_px


def misplaced(camera: str, scene_map: Map, tracks: Tracks, limit_px: float) -> IntArray:
    """Rows of a camera's keyframes that stand apart from neighbours which tracking ties them to.

    Points tracked from one keyframe to the next must arrive where the map expects them. Where they do not,
    one side of the gap is in the wrong place: the one whose keyframes, as far as tracks tie them together,
    see fewer of the map's points that others see too.

    Args:
        camera: Camera name.
        scene_map: The map.
        tracks: Observations tracked from keyframes into the frames around them, the next keyframe included.
        limit_px: Distance up to which an observation agrees with a pose.

    Source: the loop of tracking and map as a check is Zach, Klopschitz, Pollefeys, "Disambiguating visual
        relations using loop constraints", CVPR 2010, in its simplest form.
    """
    rows = scene_map.keyframes_of(camera)
    gaps = _gaps(camera, scene_map, rows, tracks)
    whole = np.array([gap.whole(limit_px) for gap in gaps], dtype=bool)
    piece = np.concatenate([[0], np.cumsum(~whole)]) if len(rows) else np.zeros(0, np.int64)
    ties = np.bincount(piece, weights=_ties(scene_map)[rows]) if len(rows) else np.zeros(0)
    blamed = set()
    for number, gap in enumerate(gaps):
        if gap.torn(limit_px):
            before, after = int(piece[number]), int(piece[number + 1])
            blamed.add(before if ties[before] < ties[after] else after)
    return rows[np.isin(piece, sorted(blamed))]


def _gaps(camera: str, scene_map: Map, rows: IntArray, tracks: Tracks) -> list[_Gap]:
    frames = scene_map.keyframe_frame[rows]
    arriving = np.flatnonzero(np.isin(tracks.frame, frames))
    point = scene_map.points_of(camera, tracks.keyframe[arriving], tracks.feature[arriving])
    arriving, point = arriving[point >= 0], point[point >= 0]
    to, source = (np.searchsorted(frames, each[arriving]) for each in (tracks.frame, tracks.keyframe))
    error_px = _errors(scene_map, camera, rows[to], point, tracks.px[arriving].astype(np.float64))
    out = []
    for number in range(len(rows) - 1):
        between = (np.minimum(to, source) == number) & (np.maximum(to, source) == number + 1)
        count = int(between.sum())
        out.append(_Gap(count, float(np.median(error_px[between])) if count else 0.0))
    return out


def _errors(scene_map: Map, camera: str, row: IntArray, point: IntArray, px: FloatArray) -> FloatArray:
    """Distances (N,) of pixels from where keyframes (rows) see points; far where they cannot."""
    if len(row) == 0:
        return np.zeros(0)
    seen = transform_points(invert(scene_map.map_from_cam[row]), scene_map.points[point])
    expected = scene_map.cameras[camera].project(seen)
    error_px = np.linalg.norm(expected - px, axis=1)
    return np.where((seen[:, 2] > 0.0) & np.isfinite(error_px), error_px, _FAR_PX)


def _ties(scene_map: Map) -> IntArray:
    """(K,) how many of its points each keyframe shares with another camera or three keyframes and more."""
    seen = np.bincount(scene_map.obs_point, minlength=len(scene_map.points))
    return np.bincount(
        scene_map.obs_keyframe[seen[scene_map.obs_point] > 2], minlength=len(scene_map.keyframe_camera)
    )


def without_keyframes(scene_map: Map, rows: IntArray) -> Map:
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
