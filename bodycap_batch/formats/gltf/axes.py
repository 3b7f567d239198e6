"""Convert between world axes and file axes, and define the constants of the glTF format."""

from __future__ import annotations

from typing import Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray, frozen_array
from bodycap_batch.model.geometry import make_transform

FILE_FROM_WORLD: FloatArray = frozen_array(
    [[1, 0, 0], [0, 0, 1], [0, -1, 0]], name="file_from_world", shape=(3, 3)
)
"""Rotation from world axes (Z up, facing −Y) to file axes (Y up, facing +Z)."""

FLOAT, UINT16, UINT32 = 5126, 5123, 5125
"""Numbers of the component types of an accessor. Source: glTF 2.0 specification, 3.6.2."""

COMPONENT_DTYPES: dict[int, np.dtype[Any]] = {
    FLOAT: np.dtype("<f4"),
    UINT16: np.dtype("<u2"),
    UINT32: np.dtype("<u4"),
}
ELEMENT_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}
"""Number of components of each accessor type. Source: glTF 2.0 specification, 3.6.2."""

ELEMENT_ARRAY_BUFFER, ARRAY_BUFFER = 34963, 34962
"""Numbers that state what a buffer view contains: vertex indices, or vertex attributes. Source: glTF 2.0
specification, 5.11."""


def poses_in_file_axes(world_from_joint: FloatArray) -> FloatArray:
    """Convert poses (...,4,4) from world axes to file axes. The axes of the joint are converted too."""
    rotation = FILE_FROM_WORLD @ world_from_joint[..., :3, :3] @ FILE_FROM_WORLD.T
    return make_transform(rotation, world_from_joint[..., :3, 3] @ FILE_FROM_WORLD.T)


def rotations_in_world_axes(rotation: FloatArray) -> FloatArray:
    """Convert local rotations (...,3,3) from file axes to world axes."""
    return np.asarray(FILE_FROM_WORLD.T @ rotation @ FILE_FROM_WORLD)
