"""Compute the light on a room's surfaces once, and multiply the textures by this light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.synthetic.raycast import RayScene
from bodycap_batch.synthetic.textures import shade_image
from bodycap_batch.synthetic.triangles import Surface

_CELL_M = 0.08
"""Distance (metres) between the points of a surface at which the light is computed."""
_AMBIENT = 0.60
"""Irradiance (light on a surface) without lamps, as a multiplier of the texture's brightness."""
_LAMP_SAMPLES = 6
"""Number of random points on each lamp. A shadow ray is cast from every surface point to each of these
points."""
_LAMP_SIZE_M = 0.35
"""Size (metres) of a lamp along x and y."""
_LIFT_M = 0.004
"""Distance (metres) between a surface and the start of its shadow rays. Without this distance, the surface
would shade itself."""
_LAMP_STRENGTH = 10.0
"""Irradiance of all lamps together at a distance of 0, as a multiplier of the texture's brightness. The
irradiance decreases with 1 / (1 + d²), where d is the distance in metres."""
_MIN_EMISSION = 0.05
"""Minimum emission of a lamp in any direction, as a fraction of the emission straight down."""
_RAY_LENGTH = 0.98
"""Length of a shadow ray, as a fraction of the distance to the lamp. The ray ends before the lamp, because
the lamp's housing must not block the ray."""


def light_surfaces(surfaces: Sequence[Surface], lamps: FloatArray, rng: np.random.Generator) -> list[Surface]:
    """Return the surfaces with their textures multiplied by the irradiance.

    The irradiance is ambient light plus the light of lamps with soft shadows.

    Args:
        surfaces: All surfaces of the room.
        lamps: (L,3) centres (m) of the ceiling lamps in the world. The lamps shine down.
        rng: Source of randomness for the points of the lamps.
    """
    corners = np.concatenate([surface.corners() for surface in surfaces])
    quads = np.arange(len(surfaces), dtype=np.uint32)[:, None] * 4
    triangles = np.concatenate([quads + np.array([0, 1, 2]), quads + np.array([0, 2, 3])]).astype(np.uint32)
    scene = RayScene(corners, triangles)
    grids = [_light_grid(surface) for surface in surfaces]
    points = np.concatenate([grid.reshape(-1, 3) for grid in grids])
    normals = np.concatenate(
        [
            np.tile(surface.normal, (grid[..., 0].size, 1))
            for surface, grid in zip(surfaces, grids, strict=True)
        ]
    )
    light = np.full(len(points), _AMBIENT)
    brightness = 1.0 / (len(lamps) * _LAMP_SAMPLES)
    for lamp in lamps:
        for _ in range(_LAMP_SAMPLES):
            source = lamp + np.append(rng.uniform(-0.5, 0.5, 2) * _LAMP_SIZE_M, 0.0)
            ray = source - points
            distance = np.linalg.norm(ray, axis=1)
            cosine = np.clip((ray * normals).sum(axis=1) / distance, 0, None)
            emitted = np.clip(ray[:, 2] / distance, _MIN_EMISSION, None)
            lit = cosine > 0
            rays = np.concatenate([points + normals * _LIFT_M, ray], axis=1)[lit].astype(np.float32)
            hidden = scene.is_occluded(rays, _RAY_LENGTH)
            strength = _LAMP_STRENGTH * cosine[lit] * emitted[lit] / (1.0 + distance[lit] ** 2)
            light[lit] += brightness * np.where(hidden, 0.0, strength)
    out, start = [], 0
    for surface, grid in zip(surfaces, grids, strict=True):
        stop = start + grid[..., 0].size
        out.append(_with_light(surface, light[start:stop].reshape(grid.shape[:2])))
        start = stop
    return out


def _light_grid(surface: Surface) -> FloatArray:
    """Return the world positions (R,C,3) of a grid of points on a surface, metres."""
    columns, rows = (max(2, int(side / _CELL_M) + 1) for side in surface.size_m)
    v, u = np.meshgrid(np.linspace(0.02, 0.98, rows), np.linspace(0.02, 0.98, columns), indexing="ij")
    return np.asarray(surface.corner + u[..., None] * surface.across + v[..., None] * surface.down)


def _with_light(surface: Surface, light: FloatArray) -> Surface:
    """Return a surface with its texture multiplied by the light (R,C).

    The surface of a lamp stays unchanged.
    """
    if surface.shines:
        return surface
    height, width = surface.image.shape[:2]
    smooth = cv2.GaussianBlur(light.astype(np.float32), (3, 3), 0.8)
    gain = cv2.resize(smooth, (width, height), interpolation=cv2.INTER_LINEAR)
    return replace(surface, image=shade_image(surface.image, gain))
