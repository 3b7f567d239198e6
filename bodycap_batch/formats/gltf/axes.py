"""World axes against file axes, and the numbers of the format."""

from __future__ import annotations

from typing import Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray, frozen_array
from bodycap_batch.model.geometry import make_transform

FILE_FROM_WORLD: FloatArray = frozen_array(
    [[1, 0, 0], [0, 0, 1], [0, -1, 0]], name="file_from_world", shape=(3, 3)
)
"""File (Y up, facing +Z) from world (Z up, facing −Y) axes."""

FLOAT, UINT16, UINT32 = 5126, 5123, 5125
COMPONENT_DTYPES: dict[int, np.dtype[Any]] = {
    FLOAT: np.dtype("<f4"),
    UINT16: np.dtype("<u2"),
    UINT32: np.dtype("<u4"),
}
ELEMENT_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}
ELEMENT_ARRAY_BUFFER, ARRAY_BUFFER = 34963, 34962


def poses_in_file_axes(world_from_joint: FloatArray) -> FloatArray:
    """Poses (...,4,4) with both frames turned from world axes to the file's."""
    rotation = FILE_FROM_WORLD @ world_from_joint[..., :3, :3] @ FILE_FROM_WORLD.T
    return make_transform(rotation, world_from_joint[..., :3, 3] @ FILE_FROM_WORLD.T)


def rotations_in_world_axes(rotation: FloatArray) -> FloatArray:
    """Local rotations (...,3,3) from the file's axes to the world's."""
    return np.asarray(FILE_FROM_WORLD.T @ rotation @ FILE_FROM_WORLD)
