"""The undistorted pinhole camera of a lens: square pixels, and the principal point in the centre."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.camera import Camera, with_two_focal_lengths

_BORDER_SAMPLES = 64
"""Number of tested pixels on each side of the picture. Origin: the edge of a distorted picture is smooth."""
_STEPS = 40
"""Number of bisections of the focal length. Derivation: the interval becomes smaller than a millionth."""
_MAX_ZOOM = 8.0
"""Largest ratio of the focal length to that of the lens. Origin: a lens that needs more has no usable
inverse."""
_INVERSE_TOLERANCE_PX = 0.1
"""Largest distance of a pixel from itself after both directions of the lens model. Outside its range, a
model of distortion folds back, and the distance is many pixels."""


def pinhole_of(lens: Camera, width_px: int, height_px: int) -> Camera:
    """Return the pinhole camera whose picture the lens fills, at a picture size.

    The centre of the picture keeps its resolution: the focal length is that of the lens. If the picture would
    then show places that the lens does not see, the focal length is the smallest one without such places.

    Args:
        lens: The lens at any picture size.
        width_px: Width of the picture of the pinhole camera.
        height_px: Height of the picture of the pinhole camera.
    """
    lens = with_two_focal_lengths(lens).scaled(width_px, height_px)
    low, high = lens.focal_px, _MAX_ZOOM * lens.focal_px
    if not _is_filled(lens, low):
        for _ in range(_STEPS):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if _is_filled(lens, middle) else (middle, high)
        low = high
    return Camera(
        model="SIMPLE_PINHOLE",
        width_px=width_px,
        height_px=height_px,
        params=np.array([low, width_px / 2.0, height_px / 2.0]),
    )


def distorted_px(lens: Camera, pinhole: Camera, px: FloatArray) -> FloatArray:
    """Return the pixels (N,2) of a lens that show what the pixels (N,2) of its pinhole camera show."""
    rays = (px - pinhole.principal_point_px) / pinhole.focal_px
    return lens.project(np.concatenate([rays, np.ones((len(rays), 1))], axis=1))


def _is_filled(lens: Camera, focal_px: float) -> bool:
    """Return True if the edge of the pinhole camera's picture lies in the picture of the lens."""
    across = np.linspace(0.0, lens.width_px, _BORDER_SAMPLES)
    down = np.linspace(0.0, lens.height_px, _BORDER_SAMPLES)
    edge = np.concatenate(
        [np.stack(np.broadcast_arrays(across, y), axis=1) for y in (0.0, float(lens.height_px))]
        + [np.stack(np.broadcast_arrays(x, down), axis=1) for x in (0.0, float(lens.width_px))]
    )
    centre = np.array([lens.width_px, lens.height_px]) / 2.0
    rays = (edge - centre) / focal_px
    seen = lens.project(np.concatenate([rays, np.ones((len(rays), 1))], axis=1))
    size = np.array([lens.width_px, lens.height_px])
    tolerance = 1e-6 * size  # of a pinhole lens with the principal point in the centre, the edges agree
    inside = np.isfinite(seen).all() and ((seen >= -tolerance) & (seen <= size + tolerance)).all()
    if not inside:
        return False
    back = lens.unproject(seen)
    return bool(np.abs((back - rays) * focal_px).max() <= _INVERSE_TOLERANCE_PX)
