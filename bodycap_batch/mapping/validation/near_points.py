"""Remove points close before the lens that no other camera sees: they are on the wearer's body.

A camera on a hand that lies on the chest sees the wearer alone, and does not move relative to what it sees.
Its keyframes agree with each other, for longer than a moment, so that they look like a part of the room.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bodycap_batch.mapping.matching.database import ImageRef

if TYPE_CHECKING:
    import pycolmap

_MAX_DEPTH_RATIO = 0.1
"""Maximum depth of a near point, as a fraction of the usual depth: the median depth at which a camera sees
the points that it shares with other cameras. Evidence: docs/decisions/mapping.md."""
_MIN_SHARED = 30
"""Minimum number of observations of shared points that determine the usual depth of a camera. Evidence:
none."""
_MIN_POINTS = 6
"""Minimum number of points of a keyframe that stays in the model after near points were removed from it.
Evidence: none."""


def remove_near_points(model: pycolmap.Reconstruction) -> int:
    """Remove near points that only one camera sees, and return the number of removed points.

    Keyframes that are left with hardly any points are removed as well. Nothing is removed for a camera that
    shares too few points with other cameras: its usual depth is unknown.

    Args:
        model: A reconstruction, changed in place. The caller adjusts it afterwards.
    """
    cameras = {int(i): ImageRef.parse(model.image(i).name).camera for i in model.reg_image_ids()}
    poses = {number: model.image(number).cam_from_world().matrix() for number in cameras}
    shared: dict[str, list[float]] = {}
    largest: dict[int, tuple[str, float]] = {}
    for number in sorted(map(int, model.point3D_ids())):
        point = model.point3D(number)
        x_in_map = np.append(point.xyz, 1.0)
        images = [int(element.image_id) for element in point.track.elements]
        depths = [float(poses[image][2] @ x_in_map) for image in images]
        seen_by = {cameras[image] for image in images}
        if len(seen_by) == 1:
            largest[number] = (seen_by.pop(), max(depths))
            continue
        for image, depth in zip(images, depths, strict=True):
            shared.setdefault(cameras[image], []).append(depth)
    usual = {name: float(np.median(depths)) for name, depths in shared.items() if len(depths) >= _MIN_SHARED}
    near = [
        number
        for number, (camera, depth) in largest.items()
        if camera in usual and depth < _MAX_DEPTH_RATIO * usual[camera]
    ]
    touched = {int(element.image_id) for number in near for element in model.point3D(number).track.elements}
    for number in near:
        model.delete_point3D(number)
    for image in sorted(touched):
        if model.image(image).num_points3D < _MIN_POINTS:
            model.deregister_frame(model.image(image).frame_id)
    return len(near)
