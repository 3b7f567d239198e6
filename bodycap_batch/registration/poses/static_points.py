"""Find the static points of a map: those that one camera did not see only for a moment."""

from __future__ import annotations

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import BoolArray
from bodycap_batch.model.scene import Map
from bodycap_batch.model.static_span import MIN_STATIC_SPAN_NS

_MIN_KEYFRAME_RATIO = 0.5
"""Least ratio of a camera's keyframes that must see enough static points. Evidence: none."""
_MIN_STATIC_POINTS = 12
"""Static points that a keyframe must see to support the test. A single camera that always moves on sees
fewer; the test is then not applied. Evidence: none."""


def static_points(camera: CaptureCamera, scene_map: Map) -> BoolArray:
    """Return which points (P,) another camera saw too, or this camera over more than MIN_STATIC_SPAN_NS.

    Things that move with a camera, above all the wearer's own arm, look static to that camera for a while but
    to no other camera. All points count as static if few of the camera's keyframes see static ones.
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
    observing = np.intersect1d(
        rows, scene_map.obs_keyframe
    )  # A keyframe without observations does not count.
    is_usable = len(observing) > 0 and bool(
        (static_seen[observing] >= _MIN_STATIC_POINTS).mean() >= _MIN_KEYFRAME_RATIO
    )
    return static if is_usable else np.ones(count, dtype=bool)
