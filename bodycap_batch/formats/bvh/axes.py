"""Convert between world axes, metres, and the axes and units of a BVH file.

A point (x, y, z) in the world is (x, z, −y) · units per metre in the file.
"""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.formats.y_up import WORLD_FROM_Y_UP, Y_UP_FROM_WORLD

UNITS_PER_METRE: dict[str, float] = {"cm": 100.0, "m": 1.0}
"""By name of the unit, the number of file units per metre."""


def world_from_file_points(x_in_file: FloatArray, units: str) -> FloatArray:
    """Convert points (...,3) from file axes and units to world axes and metres."""
    return np.asarray(x_in_file @ Y_UP_FROM_WORLD / UNITS_PER_METRE[units])


def file_from_world_points(x_in_world: FloatArray, units: str) -> FloatArray:
    """Convert points (...,3) from world axes and metres to file axes and units."""
    return np.asarray(x_in_world @ WORLD_FROM_Y_UP * UNITS_PER_METRE[units])
