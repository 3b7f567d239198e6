"""Points that one glance of one camera saw: the wearer's sleeve, and room that bends a map like it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.mapping.matching.database import ImageRef
from bodycap_batch.model.static_span import MIN_STATIC_SPAN_NS

if TYPE_CHECKING:
    import pycolmap

_MIN_STATIC_POINTS = 20
"""Confirmed points that carry a keyframe without the others. With 15 and 30 the first capture told of below
has 0.93 and 0.99 cm."""


def remove_transient_points(model: pycolmap.Reconstruction, times_ns: Mapping[str, IntArray]) -> int:
    """Take points out of a model that no other camera and no other time confirms; how many.

    What moves with a camera is a still room to that camera, for a moment, and pulls its keyframes along.
    Points stay where a keyframe that sees them has too few others. Without them two rendered captures with
    textured sleeves in view went from 1.21 and 0.41 to 0.66 and 0.41 cm (all frames), the worst frame of the
    first from 8.3 to 4.3; room12 from 0.54 to 0.55, a rendered brown-lens walk from 0.28 to 0.29. Putting
    back what agrees with the poses found without them changed none of it by more than 0.01.

    Args:
        model: A reconstruction, changed in place; to be refined afterwards.
        times_ns: Time of every frame, by camera.
    """
    refs = {int(i): ImageRef.parse(model.image(i).name) for i in model.reg_image_ids()}
    seen = {
        int(point): [int(each.image_id) for each in model.point3D(point).track.elements]
        for point in model.point3D_ids()
    }
    doubted = [point for point, images in sorted(seen.items()) if not _is_static(images, refs, times_ns)]
    carrying = dict.fromkeys(refs, 0)
    for point in seen.keys() - set(doubted):
        for image in set(seen[point]):
            carrying[image] += 1
    dropped = [
        point for point in doubted if all(carrying[image] >= _MIN_STATIC_POINTS for image in seen[point])
    ]
    for point in dropped:
        model.delete_point3D(point)
    return len(dropped)


def _is_static(images: list[int], refs: Mapping[int, Any], times_ns: Mapping[str, IntArray]) -> bool:
    if len({refs[image].camera for image in images}) > 1:
        return True
    times = [int(times_ns[refs[image].camera][refs[image].frame]) for image in images]
    return max(times) - min(times) > MIN_STATIC_SPAN_NS
