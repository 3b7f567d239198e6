"""Add the error of the map to the covariances of poses that were estimated as if the map were exact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.scene import Map, Trajectory


def with_map_error(path: Trajectory, maps: Sequence[Map]) -> Trajectory:
    """Return a trajectory whose covariances contain the error of the map that its poses refer to.

    A frame sees the points of the keyframes of its camera around it, so it has their error.

    Args:
        path: Trajectory with the covariances that follow from an exact map.
        maps: The maps. The map in the gauge of the trajectory is used.
    """
    return replace(path, covariance=path.covariance + _map_covariance(path, maps))


def without_map_error(path: Trajectory, maps: Sequence[Map]) -> Trajectory:
    """Return a trajectory with the covariances that follow from an exact map: undo `with_map_error`.

    Frames that are near each other have the error of the map in common. Their poses are compared with these
    covariances.
    """
    return replace(path, covariance=path.covariance - _map_covariance(path, maps))


def _map_covariance(path: Trajectory, maps: Sequence[Map]) -> FloatArray:
    """Return the covariances (N,6,6) that the keyframes of the camera give its frames.

    Between two keyframes they are interpolated linearly. Before the first and after the last keyframe, they
    are those of the nearest keyframe. They are zero if the map states none.
    """
    count = len(path.status)
    scene_map = next((scene for scene in maps if scene.gauge == path.gauge), None)
    rows = np.zeros(0, np.int64) if scene_map is None else scene_map.keyframes_of(path.camera)
    if scene_map is None or len(rows) == 0 or len(scene_map.keyframe_covariance) == 0:
        return np.zeros((count, 6, 6))
    keyframes, covariance = scene_map.keyframe_frame[rows], scene_map.keyframe_covariance[rows]
    place = np.interp(np.arange(count), keyframes, np.arange(len(rows)))
    before = np.floor(place).astype(np.int64)
    after, share = np.minimum(before + 1, len(rows) - 1), (place - before)[:, None, None]
    return np.asarray((1.0 - share) * covariance[before] + share * covariance[after])
