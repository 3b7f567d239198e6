"""Determine the field of view in which a lens model is valid."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.camera import Camera

_ANGLE_COUNT, _AZIMUTH_COUNT = 178, 16
"""Number of sampled angles off the optical axis (two per degree), and number of sampled directions around the
axis. Evidence: none."""
_MAX_ANGLE_RAD = float(np.deg2rad(89.0))
"""Radians: maximum sampled angle off the optical axis. The tangent is infinite at 90 degrees."""


def max_field_angle_rad(lens: Camera) -> float:
    """Return the maximum angle off the optical axis, in radians, at which the lens model is valid.

    Up to this angle the distance from the principal point grows with the angle. At larger angles, a
    polynomial lens model may not be monotonic. The model would then project a point outside the field of view
    to a wrong pixel in the image.
    """
    return _max_angle_rad(lens.model, lens.width_px, lens.height_px, tuple(lens.params.tolist()))


@lru_cache(maxsize=64)
def _max_angle_rad(model: str, width_px: int, height_px: int, params: tuple[float, ...]) -> float:
    lens = Camera(model=model, width_px=width_px, height_px=height_px, params=np.array(params))
    angle = np.linspace(0.0, _MAX_ANGLE_RAD, _ANGLE_COUNT)
    azimuth = np.linspace(0.0, 2 * np.pi, _AZIMUTH_COUNT, endpoint=False)
    tangent = np.tan(angle)[:, None]
    rays = np.stack(
        [tangent * np.cos(azimuth), tangent * np.sin(azimuth), np.ones((_ANGLE_COUNT, _AZIMUTH_COUNT))],
        axis=-1,
    ).reshape(-1, 3)
    px = lens.project(rays).reshape(_ANGLE_COUNT, _AZIMUTH_COUNT, 2)
    radius = np.linalg.norm(px - np.array(lens.principal_point_px), axis=-1)
    grows = np.nan_to_num(np.diff(radius, axis=0), nan=-1.0).min(axis=1) > 0.0
    return float(angle[-1] if grows.all() else angle[int(np.argmin(grows))])


def field_margin(x_in_cam: FloatArray, max_angle_rad: float, near: float) -> FloatArray:
    """Return a measure (N,) that is positive for points (N,3) inside the field of view.

    The measure is the smaller of two numbers: the depth minus `near`, and `max_angle_rad` minus the angle off
    the optical axis. Only its sign is meaningful.

    Args:
        x_in_cam: (N,3) points in the camera frame.
        max_angle_rad: Maximum angle off the optical axis, radians.
        near: Minimum depth, in the unit of the points.
    """
    angle = np.arctan2(np.linalg.norm(x_in_cam[:, :2], axis=1), x_in_cam[:, 2])
    return np.asarray(np.minimum(x_in_cam[:, 2] - near, max_angle_rad - angle))
