"""Convert between world axes (Z up, facing −Y) and the axes of files with Y up, which face +Z."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import FloatArray, frozen_array
from bodycap_batch.model.animated_camera import AnimatedCamera
from bodycap_batch.model.geometry import make_transform

Y_UP_FROM_WORLD: FloatArray = frozen_array(
    [[1, 0, 0], [0, 0, 1], [0, -1, 0]], name="y_up_from_world", shape=(3, 3)
)
"""Rotation from world axes to file axes: a point (x, y, z) in the world is (x, z, −y) in the file."""
WORLD_FROM_Y_UP: FloatArray = Y_UP_FROM_WORLD.T
"""Rotation from file axes to world axes."""


def in_other_axes(target_from_source: FloatArray, rotation: FloatArray) -> FloatArray:
    """Convert rotations (...,3,3) between two frames from source axes (3,3) to target axes, on both sides."""
    return np.asarray(target_from_source @ rotation @ target_from_source.T)


def camera_poses_with_y_up(camera: AnimatedCamera) -> FloatArray:
    """Return the poses (T,4,4) of the axes of a camera in computer graphics, in a scene with Y up."""
    return make_transform(Y_UP_FROM_WORLD, np.zeros(3)) @ camera.scene_from_gl()


def poses_from_y_up(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Return the world poses (N,4,4) of rotations (N,3,3) and translations (N,3) in a scene with Y up."""
    return make_transform(WORLD_FROM_Y_UP @ rotation, translation @ Y_UP_FROM_WORLD)
