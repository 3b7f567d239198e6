"""Remove points that only one camera observed, and only for a moment.

Many of these points are not in the room, but on the wearer's sleeve.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
from bodycap_batch.mapping.matching.database import ImageRef
from bodycap_batch.model.static_span import MIN_STATIC_SPAN_NS

if TYPE_CHECKING:
    import pycolmap

_MIN_STATIC_POINTS = 100
"""Minimum number of static points that determine the pose of a keyframe. If a keyframe has fewer static
points, its transient points are kept. Evidence: docs/decisions/mapping.md."""


def remove_transient_points(model: pycolmap.Reconstruction, times_ns: Mapping[str, IntArray]) -> int:
    """Remove points that only one camera observed for a short time, and return the number of removed points.

    An object that moves with a camera looks static to this camera for a moment. Points on such an object
    deform the map. Such a point is kept if one of its keyframes observes fewer than `_MIN_STATIC_POINTS`
    static points. Evidence: docs/decisions/mapping.md.

    Args:
        model: A reconstruction, changed in place. The caller adjusts it afterwards.
        times_ns: Time (nanoseconds) of every frame, by camera name.
    """
    if not is_on(Mechanism.TRANSIENT_POINTS):
        return 0
    refs = {int(i): ImageRef.parse(model.image(i).name) for i in model.reg_image_ids()}
    images_of = {
        int(point): [int(element.image_id) for element in model.point3D(point).track.elements]
        for point in model.point3D_ids()
    }
    transient = [
        point for point, images in sorted(images_of.items()) if not _is_static(images, refs, times_ns)
    ]
    static_points = dict.fromkeys(refs, 0)
    for point in images_of.keys() - set(transient):
        for image in set(images_of[point]):
            static_points[image] += 1
    removed = [
        point
        for point in transient
        if all(static_points[image] >= _MIN_STATIC_POINTS for image in images_of[point])
    ]
    for point in removed:
        model.delete_point3D(point)
    record_act(Mechanism.TRANSIENT_POINTS, len(removed))
    return len(removed)


def _is_static(images: list[int], refs: Mapping[int, Any], times_ns: Mapping[str, IntArray]) -> bool:
    """Return whether a point is static: several cameras observe it, or one camera observes it for long.

    If only one camera observes the point, the time from the first to the last observation must be longer than
    `MIN_STATIC_SPAN_NS`.

    Args:
        images: Ids of the images that observe the point.
        refs: Keyframe of each registered image, by image id.
        times_ns: Time (nanoseconds) of every frame, by camera name.
    """
    if len({refs[image].camera for image in images}) > 1:
        return True
    times = [int(times_ns[refs[image].camera][refs[image].frame]) for image in images]
    return max(times) - min(times) > MIN_STATIC_SPAN_NS
