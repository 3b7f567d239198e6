"""How far off its axis a lens model can be believed."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.camera import Camera

_STEPS, _AZIMUTHS = 178, 16
_WIDEST_RAD = float(np.deg2rad(89.0))


def field_limit_rad(lens: Camera) -> float:
    """Largest angle off the optical axis up to which pixels move outwards.

    A polynomial lens model turns back somewhere outside of the picture it was fitted to: what lies further
    out would be drawn inside the picture, on its wrong side.
    """
    return _limit(lens.model, lens.width_px, lens.height_px, tuple(lens.params.tolist()))


@lru_cache(maxsize=64)
def _limit(model: str, width_px: int, height_px: int, params: tuple[float, ...]) -> float:
    lens = Camera(model=model, width_px=width_px, height_px=height_px, params=np.array(params))
    angle = np.linspace(0.0, _WIDEST_RAD, _STEPS)
    azimuth = np.linspace(0.0, 2 * np.pi, _AZIMUTHS, endpoint=False)
    off = np.tan(angle)[:, None]
    rays = np.stack(
        [off * np.cos(azimuth), off * np.sin(azimuth), np.ones((_STEPS, _AZIMUTHS))], axis=-1
    ).reshape(-1, 3)
    px = lens.project(rays).reshape(_STEPS, _AZIMUTHS, 2)
    radius = np.linalg.norm(px - np.array(lens.principal_point_px), axis=-1)
    outwards = np.nan_to_num(np.diff(radius, axis=0), nan=-1.0).min(axis=1) > 0.0
    return float(angle[-1] if outwards.all() else angle[int(np.argmin(outwards))])


def in_field(x_in_cam: FloatArray, limit_rad: float, near: float) -> FloatArray:
    """(N,) how far inside the field points (N,3) are: negative behind `near` or beyond `limit_rad`."""
    off_axis = np.arctan2(np.linalg.norm(x_in_cam[:, :2], axis=1), x_in_cam[:, 2])
    return np.asarray(np.minimum(x_in_cam[:, 2] - near, limit_rad - off_axis))
