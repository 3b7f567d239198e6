"""Remove points and keyframes that may show the wearer's body instead of the room.

A camera on a hand that lies on the chest sees the wearer alone, and does not move relative to what it sees.
Its keyframes agree with each other, for longer than a moment, so that they look like a part of the room.
But the person walks on. So the path of the camera breaks where the hand leaves the chest: the keyframes on
both sides of the break have no point in common. A hand that works at a table sees the room before and after,
and the table connects both.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
from bodycap_batch.mapping.matching.database import ImageRef

if TYPE_CHECKING:
    import pycolmap

_MAX_TOUCH_RATIO = 0.1
"""Depth below which a point is always removed, as a fraction of the usual depth: the median depth at which a
camera sees the points that it shares with other cameras. Evidence: docs/decisions/mapping.md."""
_MAX_REACH_RATIO = 0.2
"""Depth below which a point may be on the wearer, as a fraction of the usual depth. Derivation: a hand that
sees the trunk is at most 0.6 m from it, and a room is seen at 3 m. Evidence: docs/decisions/mapping.md."""
_MIN_ROOM_SHARE = 0.5
"""Minimum share of points of the room in a keyframe whose pose the room determines. Derivation: a robust pose
follows the majority of the points."""
_MIN_ROOM = 6
"""Minimum number of points of the room in such a keyframe. Evidence: none."""
_MIN_SHARED = 30
"""Minimum number of observations of shared points that determine the usual depth of a camera. Evidence:
none."""
_MIN_COMMON = 6
"""Minimum number of common points that connect two keyframes. Evidence: docs/decisions/mapping.md."""


@dataclass(frozen=True, slots=True)
class _Sight:
    """What one keyframe sees.

    Attributes:
        points: Ids of the points.
        near: Depth of the points that no other camera sees, as a fraction of the usual depth of the camera,
            by point id. The values are infinite if the usual depth is unknown.
    """

    points: set[int]
    near: dict[int, float]

    def sees_room(self) -> bool:
        """Return whether none of its points, or at most half of them, may be on the wearer."""
        within_reach = sum(ratio < _MAX_REACH_RATIO for ratio in self.near.values())
        in_room = len(self.points) - within_reach
        return not within_reach or in_room >= max(_MIN_ROOM, _MIN_ROOM_SHARE * len(self.points))


def remove_points_on_wearer(model: pycolmap.Reconstruction) -> int:
    """Remove points and keyframes that may be on the wearer, and return the number of removed points.

    A point that no other camera sees is removed if all its depths are below `_MAX_TOUCH_RATIO`. Successive
    keyframes of a camera whose points are mostly within `_MAX_REACH_RATIO` are removed, unless points that
    are left connect them with the keyframe before them and with the keyframe behind them. Nothing is removed
    for a camera that shares too few points with other cameras: its usual depth is unknown.

    Args:
        model: A reconstruction, changed in place. What is left does not move.
    """
    if not is_on(Mechanism.WEARER_POINTS):
        return 0
    points_before = model.num_points3D()
    refs = {int(image): ImageRef.parse(model.image(image).name) for image in model.reg_image_ids()}
    sights = _sights(model, refs)
    closest = {number for sight in sights.values() for number in sight.near}
    for sight in sights.values():
        closest -= {number for number, ratio in sight.near.items() if ratio >= _MAX_TOUCH_RATIO}
    for number in sorted(closest):
        model.delete_point3D(number)
    for _, images in groupby(sorted(refs, key=refs.__getitem__), key=lambda image: refs[image].camera):
        path = list(images)
        left = [sights[image].points - closest for image in path]
        start = 0
        for sees_room, run in groupby(path, key=lambda image: sights[image].sees_room()):
            stop = start + len(list(run))
            if not sees_room and not (_connected(left, start) and _connected(left, stop)):
                for image in path[start:stop]:
                    model.deregister_frame(model.image(image).frame_id)
            start = stop
    removed = int(points_before - model.num_points3D())
    record_act(Mechanism.WEARER_POINTS, removed)
    return removed


def _connected(points: list[set[int]], index: int) -> bool:
    """Return whether a keyframe and the keyframe before it have points in common."""
    return 0 < index < len(points) and len(points[index - 1] & points[index]) >= _MIN_COMMON


def _sights(model: pycolmap.Reconstruction, refs: Mapping[int, ImageRef]) -> dict[int, _Sight]:
    """Return what each keyframe sees.

    Args:
        model: A reconstruction.
        refs: Keyframe of each registered image, by image id.
    """
    points: dict[int, set[int]] = {image: set() for image in refs}
    own: dict[int, dict[int, float]] = {image: {} for image in refs}
    shared: dict[str, list[float]] = {}
    poses = {image: model.image(image).cam_from_world().matrix() for image in refs}
    for number in sorted(map(int, model.point3D_ids())):
        point = model.point3D(number)
        x_in_map = np.append(point.xyz, 1.0)
        images = {int(element.image_id) for element in point.track.elements}
        is_shared = len({refs[image].camera for image in images}) > 1
        for image in sorted(images):
            points[image].add(number)
            depth = float(poses[image][2] @ x_in_map)
            if is_shared:
                shared.setdefault(refs[image].camera, []).append(depth)
            else:
                own[image][number] = depth
    usual = {
        camera: float(np.median(depths)) for camera, depths in shared.items() if len(depths) >= _MIN_SHARED
    }
    return {
        image: _Sight(
            points[image],
            {
                number: depth / usual[ref.camera] if ref.camera in usual else np.inf
                for number, depth in own[image].items()
            },
        )
        for image, ref in refs.items()
    }
