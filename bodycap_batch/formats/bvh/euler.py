"""Intrinsic Euler angles in any order, continuous over time."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import FloatArray

_GIMBAL_LOCK_COSINE = 1e-7
"""Below this the first and third angle cannot be told apart: each alone would be wrong by 1e-16 over it."""

_FULL_TURN_RAD = 2.0 * np.pi


def rotation_from_angles(axes: str, angles_rad: FloatArray) -> FloatArray:
    """Product of elementary rotations in the given order (first axis leftmost).

    Args:
        axes: K letters of X, Y, Z; repeats allowed.
        angles_rad: (T,K).

    Returns:
        (T,3,3) rotations, identity for no axes.
    """
    out = np.broadcast_to(np.eye(3), (len(angles_rad), 3, 3)).copy()
    for column, axis in enumerate(axes):
        out = out @ _elementary_rotation("XYZ".index(axis), angles_rad[:, column])
    return out


def _elementary_rotation(axis: int, angle_rad: FloatArray) -> FloatArray:
    """Rotations (T,3,3) about one axis."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    out = np.zeros((len(angle_rad), 3, 3))
    out[:, axis, axis] = 1.0
    out[:, first, first] = out[:, second, second] = cos
    out[:, second, first] = sin
    out[:, first, second] = -sin
    return out


def continuous_angles(orders: tuple[str, ...], rotation: FloatArray) -> FloatArray:
    """Euler angles that move as little as possible from one tick to the next.

    Every rotation has two triples, (a, b, c) and (a + π, π − b, c + π), each with any number of whole
    turns; the nearest to the previous tick is taken. In gimbal lock only a ± c is fixed, and the rest of
    the freedom is spent on staying close.

    Args:
        orders: J orders of three different axes each, first axis leftmost ("ZXY").
        rotation: (T,J,3,3).

    Returns:
        (T,J,3) angles in radians, in the order's order.
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
    """Angles (...,3) of R = Rx(a) Ry(b) Rz(c), and which are locked.

    In gimbal lock the first angle holds c + sign(b) · a. The second output is 0 where not locked, else
    sign(b).
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
    """The equivalent angles (J,3) nearest to the previous ones."""
    direct = _add_full_turns(principal, previous)
    other = _add_full_turns(principal * [1, -1, 1] + np.pi, previous)
    if locked.any():
        direct = np.where(locked[:, None] != 0, _split_locked_sum(direct, locked, previous), direct)
        other = np.where(locked[:, None] != 0, _split_locked_sum(other, locked, previous), other)
    step_direct = ((direct - previous) ** 2).sum(axis=1)
    step_other = ((other - previous) ** 2).sum(axis=1)
    return np.where((step_other < step_direct)[:, None], other, direct)


def _add_full_turns(angles: FloatArray, previous: FloatArray) -> FloatArray:
    """Add the whole turns that bring each angle within half a turn of the previous one."""
    return np.asarray(angles + _FULL_TURN_RAD * np.round((previous - angles) / _FULL_TURN_RAD))


def _split_locked_sum(angles: FloatArray, locked: FloatArray, previous: FloatArray) -> FloatArray:
    """In gimbal lock, split the one known sum c + sign · a so that a and c move equally little.

    `angles` is either triple of the lock: both have the same middle axis pose, and the sum is a plus
    sign times c in each (π added to both a and c leaves it the same up to whole turns).
    """
    total = angles[:, 0] + locked * angles[:, 2]
    before = previous[:, 2] + locked * previous[:, 0]
    change = total - before
    half = 0.5 * (change - _FULL_TURN_RAD * np.round(change / _FULL_TURN_RAD))
    return np.stack([previous[:, 0] + locked * half, angles[:, 1], previous[:, 2] + half], axis=-1)
