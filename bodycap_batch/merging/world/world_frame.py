"""The rigid transform from the solved frame of reference (metres, arbitrary axes) to the world."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import Similarity, so3_exp

MIN_MOVING_SPEED_M_PER_S = 0.4
"""Minimum horizontal speed (m/s) at which the body is treated as moving. Evidence: none."""


def rotation_to_z_up(up: FloatArray) -> FloatArray:
    """Return the smallest rotation (3,3) that takes `up` (3,) to +z."""
    axis = np.cross(up, [0.0, 0.0, 1.0])
    norm = float(np.linalg.norm(axis))
    if norm < 1e-9:
        return np.eye(3) if up[2] > 0.0 else np.diag([1.0, -1.0, -1.0])
    return so3_exp(axis / norm * np.arctan2(norm, up[2]))


def initial_heading(forward: FloatArray, centre_m: FloatArray, fps: float) -> float:
    """Return the body's mean heading over its first moving second, in radians from +x towards +y.

    The first moving second starts when the body first moves horizontally. If the body never moves, this
    second starts at tick 0.

    Args:
        forward: (T,3) forward directions of the body, z up.
        centre_m: (T,3) positions of the body, metres.
        fps: Number of ticks per second.
    """
    window, stride = max(round(fps), 1), max(round(0.25 * fps), 1)
    start = 0
    if len(centre_m) > stride:
        travelled = np.linalg.norm(centre_m[stride:, :2] - centre_m[:-stride, :2], axis=1)
        moving = np.flatnonzero(travelled > MIN_MOVING_SPEED_M_PER_S * stride / fps)
        start = int(moving[0]) if len(moving) else 0
    mean = forward[start : start + window, :2].sum(axis=0)
    return float(np.arctan2(mean[1], mean[0]))


def world_from_solved_frame(
    rotation: FloatArray, hips_m: FloatArray, floor_m: float, heading_rad: float
) -> Similarity:
    """Return the rigid transform from the solved frame of reference to the world.

    Args:
        rotation: (3,3) rotation that takes the up direction of the solved frame of reference to +z.
        hips_m: (3,) position of the hips at tick 0, after `rotation`. In the world, this position is above
            the origin.
        floor_m: Height of the floor in metres, after `rotation`. In the world, the floor is at z = 0.
        heading_rad: Heading of the body in its first moving second, after `rotation`. In the world, the body
            faces −y in this second.
    """
    yaw = Rotation.from_euler("z", -0.5 * np.pi - heading_rad).as_matrix()
    origin = np.array([hips_m[0], hips_m[1], floor_m])
    return Similarity(1.0, yaw @ rotation, -(yaw @ origin))
