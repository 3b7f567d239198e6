"""Which points of a map stand in the room: those that more than one glance of one camera saw."""

from __future__ import annotations

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import BoolArray
from bodycap_batch.model.scene import Map
from bodycap_batch.model.static_span import MIN_STATIC_SPAN_NS

_MIN_KEYFRAME_RATIO = 0.5
_MIN_STATIC_POINTS = 12
"""Unless so large a share of a camera's keyframes sees so many confirmed points the test tells nothing: a
camera alone that always moves on."""


def static_points(camera: CaptureCamera, scene_map: Map) -> BoolArray:
    """(P,) points that another camera saw too, or this one more than a moment apart.

    What moves with a camera, the wearer's own arm first of all, looks like a still room to that camera for a
    while and to no other. True for all where few of the camera's keyframes see confirmed points.
    """
    count = len(scene_map.points)
    rows = scene_map.keyframes_of(camera.name)
    is_own = np.isin(scene_map.obs_keyframe, rows)
    point = scene_map.obs_point[is_own]
    times = camera.times_ns[scene_map.keyframe_frame[scene_map.obs_keyframe[is_own]]]
    first, last = np.full(count, np.iinfo(np.int64).max), np.zeros(count, dtype=np.int64)
    np.minimum.at(first, point, times - camera.times_ns[0])
    np.maximum.at(last, point, times - camera.times_ns[0])
    static = last - np.minimum(first, last) > MIN_STATIC_SPAN_NS
    static[scene_map.obs_point[~is_own]] = True
    static_seen = np.bincount(
        scene_map.obs_keyframe[is_own], weights=static[point], minlength=len(scene_map.keyframe_camera)
    )
    observing = np.intersect1d(rows, scene_map.obs_keyframe)  # a refused one may be kept that sees nothing
    is_usable = len(observing) > 0 and bool(
        (static_seen[observing] >= _MIN_STATIC_POINTS).mean() >= _MIN_KEYFRAME_RATIO
    )
    return static if is_usable else np.ones(count, dtype=bool)
