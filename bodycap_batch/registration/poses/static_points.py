"""Find the static points of a map: points seen by several cameras, or by one camera for a long time."""

from __future__ import annotations

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import BoolArray
from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
from bodycap_batch.model.scene import Map
from bodycap_batch.model.static_span import MIN_STATIC_SPAN_NS

_MIN_KEYFRAME_RATIO = 0.5
"""Minimum fraction of a camera's keyframes that must see enough static points. If the fraction is smaller,
all points are treated as static for this camera. Evidence: none."""
_MIN_STATIC_POINTS = 12
"""Minimum number of static points that a keyframe must see. `_MIN_KEYFRAME_RATIO` is the minimum fraction of
such keyframes. If a single camera never returns to the same place, its keyframes see fewer static points.
Evidence: none."""


def static_points(camera: CaptureCamera, scene_map: Map) -> BoolArray:
    """Return a mask (P,) of the map's static points for a camera.

    A point is static if another camera saw it too, or if this camera saw it for longer than
    MIN_STATIC_SPAN_NS. Things that move with a camera, above all the wearer's own arm, look static to that
    camera for a while. They do not look static to other cameras. If few of the camera's keyframes see static
    points, all points are treated as static.
    """
    count = len(scene_map.points)
    if not is_on(Mechanism.STATIC_POINTS):
        return np.ones(count, dtype=bool)
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
    observing = np.intersect1d(rows, scene_map.obs_keyframe)  # A keyframe without observations is not used.
    is_usable = len(observing) > 0 and bool(
        (static_seen[observing] >= _MIN_STATIC_POINTS).mean() >= _MIN_KEYFRAME_RATIO
    )
    if not is_usable:
        return np.ones(count, dtype=bool)
    record_act(Mechanism.STATIC_POINTS, int((~static).sum()))
    return np.asarray(static)
