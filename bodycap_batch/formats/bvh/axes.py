"""Convert between world axes, metres, and the axes and units of a BVH file.

A point (x, y, z) in the world is (x, z, −y) · units per metre in the file.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from bodycap_batch.core.arrays import FloatArray, frozen_array

Units = Literal["cm", "m"]

UNITS_PER_METRE: dict[str, float] = {"cm": 100.0, "m": 1.0}
"""By name of the unit, the number of file units per metre."""

WORLD_FROM_FILE: FloatArray = frozen_array(
    [[1, 0, 0], [0, 0, -1], [0, 1, 0]], name="world_from_file", shape=(3, 3)
)
"""Rotation from file axes (Y up, facing +Z) to world axes (Z up, facing −Y)."""


def world_from_file_points(x_in_file: FloatArray, units: str) -> FloatArray:
    """Convert points (...,3) from file axes and units to world axes and metres."""
    return np.asarray(x_in_file @ WORLD_FROM_FILE.T / UNITS_PER_METRE[units])


def file_from_world_points(x_in_world: FloatArray, units: str) -> FloatArray:
    """Convert points (...,3) from world axes and metres to file axes and units."""
    return np.asarray(x_in_world @ WORLD_FROM_FILE * UNITS_PER_METRE[units])


def world_from_file_rotations(rotation: FloatArray) -> FloatArray:
    """Convert local rotations (...,3,3) from file axes to world axes."""
    return np.asarray(WORLD_FROM_FILE @ rotation @ WORLD_FROM_FILE.T)


def file_from_world_rotations(rotation: FloatArray) -> FloatArray:
    """Convert local rotations (...,3,3) from world axes to file axes."""
    return np.asarray(WORLD_FROM_FILE.T @ rotation @ WORLD_FROM_FILE)
