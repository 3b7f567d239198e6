"""Intrinsic Euler angles in any order of the axes, continuous over time."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import FloatArray

_GIMBAL_LOCK_COSINE = 1e-7
"""Cosine of the second angle below which the rotation counts as gimbal lock. Derivation: the first and third
angle have errors of 1e-16 divided by this cosine; at 1e-7 that is 1e-9 rad."""

_FULL_TURN_RAD = 2.0 * np.pi
"""Radians. One full turn."""


def rotation_from_angles(axes: str, angles_rad: FloatArray) -> FloatArray:
    """Multiply elementary rotations in the given order, the first axis leftmost.

    Args:
        axes: K letters of X, Y, Z, which may repeat.
        angles_rad: (T,K) angle about each axis.

    Returns:
        (T,3,3) rotations; the identity for K = 0.
    """
    out = np.broadcast_to(np.eye(3), (len(angles_rad), 3, 3)).copy()
    for column, axis in enumerate(axes):
        out = out @ _elementary_rotation("XYZ".index(axis), angles_rad[:, column])
    return out


def _elementary_rotation(axis: int, angle_rad: FloatArray) -> FloatArray:
    """Return the rotations (T,3,3) about one axis (0 = X) by angles (T,)."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    out = np.zeros((len(angle_rad), 3, 3))
    out[:, axis, axis] = 1.0
    out[:, first, first] = out[:, second, second] = cos
    out[:, second, first] = sin
    out[:, first, second] = -sin
    return out


def continuous_angles(orders: tuple[str, ...], rotation: FloatArray) -> FloatArray:
    """Convert rotations to the Euler angles that change as little as possible from tick to tick.

    Every rotation has two triples of angles, (a, b, c) and (a + π, π − b, c + π), to which full turns may be
    added. The triple nearest to that of the previous tick is returned. In gimbal lock only a ± c is
    determined; of all solutions, the nearest to the previous tick is returned.

    Args:
        orders: (J,) order of three different axes for each joint, the first axis leftmost ("ZXY").
        rotation: (T,J,3,3) rotations.

    Returns:
        (T,J,3) angles in radians, in the order of the axes.
    """
    axes = np.array([["XYZ".index(letter) for letter in order] for order in orders], dtype=np.int64)
    parity = np.where((axes[:, 1] - axes[:, 0]) % 3 == 1, 1.0, -1.0)
    joints = np.arange(len(orders))[:, None, None]
    permuted = rotation[:, joints, axes[:, :, None], axes[:, None, :]]
    principal, locked = _principal_angles(permuted)
    out = np.zeros_like(principal)
    previous = np.zeros(principal.shape[1:])
    for tick in range(len(out)):
        previous = _nearest_equivalent(principal[tick], locked[tick], previous)
        out[tick] = previous
    return out * parity[:, None]


def _principal_angles(rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the angles (a, b, c) of rotations R = Rx(a) Ry(b) Rz(c), and which rotations are in gimbal lock.

    Args:
        rotation: (...,3,3) rotations.

    Returns:
        (...,3) angles in radians; in gimbal lock, the first is c + sign(b) · a and the third is 0. And the
        lock (...): sign(b) in gimbal lock, else 0.
    """
    cos_b = np.hypot(rotation[..., 0, 0], rotation[..., 0, 1])
    b = np.arctan2(rotation[..., 0, 2], cos_b)
    a = np.arctan2(-rotation[..., 1, 2], rotation[..., 2, 2])
    c = np.arctan2(-rotation[..., 0, 1], rotation[..., 0, 0])
    locked = cos_b < _GIMBAL_LOCK_COSINE
    a = np.where(locked, np.arctan2(rotation[..., 1, 0], rotation[..., 1, 1]), a)
    sign = np.where(locked, np.sign(b), 0.0)
    return np.stack([a, b, np.where(locked, 0.0, c)], axis=-1), sign


def _nearest_equivalent(principal: FloatArray, locked: FloatArray, previous: FloatArray) -> FloatArray:
    """Return the equivalent angles (J,3) that are nearest to those of the previous tick (J,3)."""
    direct = _add_full_turns(principal, previous)
    other = _add_full_turns(principal * [1, -1, 1] + np.pi, previous)
    if locked.any():
        direct = np.where(locked[:, None] != 0, _split_locked_sum(direct, locked, previous), direct)
        other = np.where(locked[:, None] != 0, _split_locked_sum(other, locked, previous), other)
    step_direct = ((direct - previous) ** 2).sum(axis=1)
    step_other = ((other - previous) ** 2).sum(axis=1)
    return np.where((step_other < step_direct)[:, None], other, direct)


def _add_full_turns(angles: FloatArray, previous: FloatArray) -> FloatArray:
    """Add full turns such that each angle is within half a turn of the previous one."""
    return np.asarray(angles + _FULL_TURN_RAD * np.round((previous - angles) / _FULL_TURN_RAD))


def _split_locked_sum(angles: FloatArray, locked: FloatArray, previous: FloatArray) -> FloatArray:
    """Return the angles (J,3) in gimbal lock for which a and c change by the same, smallest amount.

    In gimbal lock only the sum c + sign · a is determined. `angles` may be either of the two equivalent
    triples: adding π to a and c changes the sum by full turns only.
    """
    total = angles[:, 0] + locked * angles[:, 2]
    before = previous[:, 2] + locked * previous[:, 0]
    change = total - before
    half = 0.5 * (change - _FULL_TURN_RAD * np.round(change / _FULL_TURN_RAD))
    return np.stack([previous[:, 0] + locked * half, angles[:, 1], previous[:, 2] + half], axis=-1)
