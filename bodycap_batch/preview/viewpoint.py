"""The camera that looks at the body in its room."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import transform_points

_FIELD_RAD = float(np.deg2rad(42.0))
_ELEVATION_RAD = float(np.deg2rad(17.0))
_SIDES_RAD = tuple(float(np.deg2rad(side)) for side in (35, -35, 75, -75, 110, -110, 145, -145))
"""Where the view may stand at the middle of its sway: best before the body, which starts out towards −Y."""
_ENOUGH = 0.6
"""A side is taken before a better one that shows at most so much more of the room: 1 / 0.6."""
_SWAY_RAD = float(np.deg2rad(22.0))
_SWAY_S = 24.0
_CALM_S = 1.0
"""The view follows the body as smoothed by a Gaussian of this sigma: steps do not shake it."""
_TRIED = 8
_MARGIN = 1.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Viewpoint:
    """A pinhole camera over a picture.

    Attributes:
        size: Width and height, pixels.
        focal_px: Focal length.
        cam_from_room: (4,4), x right, y down, z forward.
        distance: From the camera to what it looks at.
    """

    size: tuple[int, int]
    focal_px: float
    cam_from_room: FloatArray
    distance: float

    def project(self, x_in_room: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixels (...,2) of OpenCV's origin and depths (...); behind the camera pixels mean nothing."""
        x_in_cam = transform_points(self.cam_from_room, x_in_room)
        depth = x_in_cam[..., 2]
        safe = np.where(np.abs(depth) > 1e-9, depth, 1e-9)
        centre = 0.5 * np.array(self.size)
        return x_in_cam[..., :2] / safe[..., None] * self.focal_px + centre, depth


def follow(
    target: FloatArray, seconds: FloatArray, size: tuple[int, int], reach: float, room: FloatArray
) -> list[Viewpoint]:
    """One viewpoint a picture: calm, at a fixed distance that frames the target, swaying to show depth.

    Args:
        target: (F,3) what to look at in each picture, Z up.
        seconds: (F,) when, in the preview's time.
        size: Width and height of the picture.
        reach: What has to be seen around the target.
        room: (P,3) points of the room; the view stands where it sees them behind the target.
    """
    calm = _smoothed(target, seconds)
    focal = 0.5 * min(size) / np.tan(0.5 * _FIELD_RAD)
    astray = float(np.linalg.norm(target - calm, axis=1).max(initial=0.0))
    # A body is higher than wide: so much it may stray to the side and still be whole in the picture.
    distance = _MARGIN * max(reach, 0.6 * reach + astray) / np.tan(0.5 * _FIELD_RAD)
    phase = 2.0 * np.pi * seconds / _SWAY_S

    def view(point: FloatArray, turn_rad: float) -> Viewpoint:
        pose = _looking(point, turn_rad, distance)
        return Viewpoint(size=size, focal_px=focal, cam_from_room=pose, distance=distance)

    some = calm[:: max(1, len(calm) // _TRIED)]
    seen = [sum(_seen_behind(view(point, side), room) for point in some) for side in _SIDES_RAD]
    side = next(side for side, count in zip(_SIDES_RAD, seen, strict=True) if count >= _ENOUGH * max(seen))
    turns = side + _SWAY_RAD * np.sin(phase)
    return [view(point, float(turn)) for point, turn in zip(calm, turns, strict=True)]


def _seen_behind(view: Viewpoint, room: FloatArray) -> int:
    """How many points of the room a view shows behind what it looks at."""
    px, depth = view.project(room)
    inside = (px > 0.0).all(axis=-1) & (px < np.array(view.size)).all(axis=-1)
    return int((inside & (depth > view.distance)).sum())


def _looking(point: FloatArray, turn_rad: float, distance: float) -> FloatArray:
    """Pose (4,4) of a camera that looks down at a point from −Y, turned about Z."""
    level, lift = np.cos(_ELEVATION_RAD), np.sin(_ELEVATION_RAD)
    away = np.array([np.sin(turn_rad) * level, -np.cos(turn_rad) * level, lift])
    forward = -away
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    out = np.eye(4)
    out[:3, :3] = rotation
    out[:3, 3] = -rotation @ (point + distance * away)
    return out


def _smoothed(target: FloatArray, seconds: FloatArray) -> FloatArray:
    """The target's way (F,3) under a Gaussian in time."""
    out = np.empty_like(target)
    for index, now in enumerate(seconds):
        first, stop = np.searchsorted(seconds, [now - 4 * _CALM_S, now + 4 * _CALM_S])
        weight = np.exp(-0.5 * ((seconds[first:stop] - now) / _CALM_S) ** 2)
        out[index] = weight @ target[first:stop] / weight.sum()
    return out
