"""Place the virtual camera that shows the body in its room."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import transform_points

_FIELD_RAD = float(np.deg2rad(42.0))
"""Radians: field of view over the shorter side of the image. Evidence: none."""
_ELEVATION_RAD = float(np.deg2rad(17.0))
"""Radians: downward tilt of the camera's viewing direction, measured from the horizontal plane. Evidence:
none."""
_AZIMUTHS_RAD = tuple(float(np.deg2rad(side)) for side in (35, -35, 75, -75, 110, -110, 145, -145))
"""Radians: candidate azimuths of the camera, the preferred azimuths first.

At azimuth zero the camera is in front of a body that faces -Y. A body starts to walk towards -Y."""
_MIN_SHARE_OF_BEST = 0.6
"""Minimum number of visible points of the selected azimuth, as a fraction of the maximum over all azimuths.
The first candidate with at least this number of points is selected. Evidence: none."""
_SWAY_RAD = float(np.deg2rad(22.0))
"""Radians: amplitude of the camera's slow rotation about the body. The rotation makes depth visible.
Evidence: none."""
_SWAY_PERIOD_S = 24.0
"""Seconds of the preview: period of the camera's slow rotation. Evidence: none."""
_SMOOTHING_SIGMA_S = 1.0
"""Seconds: sigma of the Gaussian that smooths the target's path. A step of a walking body takes less time
than this sigma, so steps do not shake the camera."""
_SAMPLED_TARGETS = 8
"""Approximate number of target positions at which an azimuth's visible points are counted. Evidence: none."""
_MARGIN = 1.1
"""Factor on the distance of the camera. It leaves free space around the body. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Viewpoint:
    """A virtual pinhole camera.

    Attributes:
        size: Width and height of the image, pixels.
        focal_px: Focal length, pixels.
        cam_from_room: (4,4) transform from the room to the camera (x right, y down, z forward).
        distance: Distance between the camera and the target, in the room's unit.
    """

    size: tuple[int, int]
    focal_px: float
    cam_from_room: FloatArray
    distance: float

    def project(self, x_in_room: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return pixels (...,2) with OpenCV's origin, and depths (...), of points in the room.

        The pixels of points behind the camera are meaningless.
        """
        x_in_cam = transform_points(self.cam_from_room, x_in_room)
        depth = x_in_cam[..., 2]
        divisor = np.where(np.abs(depth) > 1e-9, depth, 1e-9)
        centre = 0.5 * np.array(self.size)
        return x_in_cam[..., :2] / divisor[..., None] * self.focal_px + centre, depth


def follow_target(
    target: FloatArray, seconds: FloatArray, size: tuple[int, int], reach: float, points: FloatArray
) -> list[Viewpoint]:
    """Return a smoothly moving viewpoint for each frame of the preview.

    The camera follows the smoothed path of the target at a constant distance. At this distance the
    whole body is visible. The camera rotates slowly about the target to show depth.

    Args:
        target: (F,3) position to look at in each frame, Z up.
        seconds: (F,) time of each frame in the preview, seconds.
        size: Width and height of the image, pixels.
        reach: Radius around the target that must be visible, in the room's unit.
        points: (P,3) points of the room. The azimuth is chosen so that many of them are visible behind the
            target.
    """
    smooth_target = _smooth_path(target, seconds)
    focal_px = 0.5 * min(size) / np.tan(0.5 * _FIELD_RAD)
    deviation = float(np.linalg.norm(target - smooth_target, axis=1).max(initial=0.0))
    # A body is taller than wide: its sideways extent is at most 0.6 of the reach. A sideways deviation of up
    # to 0.4 of the reach therefore does not increase the distance.
    distance = _MARGIN * max(reach, 0.6 * reach + deviation) / np.tan(0.5 * _FIELD_RAD)
    phase = 2.0 * np.pi * seconds / _SWAY_PERIOD_S

    def viewpoint(position: FloatArray, azimuth_rad: float) -> Viewpoint:
        pose = _look_at(position, azimuth_rad, distance)
        return Viewpoint(size=size, focal_px=focal_px, cam_from_room=pose, distance=distance)

    samples = smooth_target[:: max(1, len(smooth_target) // _SAMPLED_TARGETS)]
    visible = [
        sum(_count_points_behind_target(viewpoint(position, azimuth), points) for position in samples)
        for azimuth in _AZIMUTHS_RAD
    ]
    azimuth = next(
        azimuth
        for azimuth, count in zip(_AZIMUTHS_RAD, visible, strict=True)
        if count >= _MIN_SHARE_OF_BEST * max(visible)
    )
    azimuths = azimuth + _SWAY_RAD * np.sin(phase)
    return [
        viewpoint(position, float(angle)) for position, angle in zip(smooth_target, azimuths, strict=True)
    ]


def _count_points_behind_target(view: Viewpoint, points: FloatArray) -> int:
    """Count the points of the room that are visible and farther away than the target."""
    px, depth = view.project(points)
    inside = (px > 0.0).all(axis=-1) & (px < np.array(view.size)).all(axis=-1)
    return int((inside & (depth > view.distance)).sum())


def _look_at(position: FloatArray, azimuth_rad: float, distance: float) -> FloatArray:
    """Return cam_from_room (4,4) of a camera that looks down at a position.

    At azimuth zero the camera is displaced from the position towards -Y.

    Args:
        position: (3,) position to look at.
        azimuth_rad: Azimuth of the camera, radians.
        distance: Distance between the camera and the position.
    """
    level, lift = np.cos(_ELEVATION_RAD), np.sin(_ELEVATION_RAD)
    to_camera = np.array([np.sin(azimuth_rad) * level, -np.cos(azimuth_rad) * level, lift])
    forward = -to_camera
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    cam_from_room = np.eye(4)
    cam_from_room[:3, :3] = rotation
    cam_from_room[:3, 3] = -rotation @ (position + distance * to_camera)
    return cam_from_room


def _smooth_path(target: FloatArray, seconds: FloatArray) -> FloatArray:
    """Smooth the target's path (F,3) with a Gaussian in time."""
    smooth = np.empty_like(target)
    for index, now in enumerate(seconds):
        first, stop = np.searchsorted(seconds, [now - 4 * _SMOOTHING_SIGMA_S, now + 4 * _SMOOTHING_SIGMA_S])
        weight = np.exp(-0.5 * ((seconds[first:stop] - now) / _SMOOTHING_SIGMA_S) ** 2)
        smooth[index] = weight @ target[first:stop] / weight.sum()
    return smooth
