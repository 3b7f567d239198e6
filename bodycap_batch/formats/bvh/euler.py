"""Convert between rotations and intrinsic Euler angles in any order of the axes, continuous over time."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import FloatArray

_GIMBAL_LOCK_COSINE = 1e-7
"""Minimum cosine of the second Euler angle. A rotation with a smaller cosine is treated as gimbal lock.
Derivation: the errors of the first and the third angle are 1e-16 rad divided by the cosine. At the minimum
cosine, these errors are 1e-9 rad."""

_FULL_TURN_RAD = 2.0 * np.pi
"""Angle of a full turn, radians."""


def rotation_from_angles(axes: str, angles_rad: FloatArray) -> FloatArray:
    """Return the product of rotations about single axes. The rotation about the first axis is leftmost.

    Args:
        axes: K letters X, Y or Z. A letter may occur more than once.
        angles_rad: (T,K) angles about the axes, radians.

    Returns:
        The rotations (T,3,3). They are the identity for K = 0.
    """
    from scipy.spatial.transform import Rotation

    out = np.broadcast_to(np.eye(3), (len(angles_rad), 3, 3)).copy()
    for column, axis in enumerate(axes):
        out = out @ Rotation.from_euler(axis, angles_rad[:, [column]]).as_matrix()
    return out


def continuous_angles(orders: tuple[str, ...], rotation: FloatArray) -> FloatArray:
    """Convert rotations to the Euler angles that change as little as possible from tick to tick.

    Two triples of angles describe the same rotation: (a, b, c) and (a + π, π − b, c + π). In addition, a full
    turn may be added to any angle. At each tick, the triple nearest to the triple of the previous tick is
    returned. In gimbal lock, the rotation determines only b and a ± c. Then infinitely many triples describe
    the rotation, and the triple nearest to the triple of the previous tick is returned.

    Args:
        orders: (J,) order of three different axes for each joint, for example "ZXY". The rotation about the
            first axis is leftmost.
        rotation: (T,J,3,3) rotations.

    Returns:
        The angles (T,J,3), radians, in the order of the axes.
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
    """Return the angles (a, b, c) of rotations R = Rx(a) Ry(b) Rz(c), with b between −π/2 and π/2.

    Args:
        rotation: (...,3,3) rotations.

    Returns:
        The angles (...,3), radians, and a number (...) that marks gimbal lock: it is 0 without gimbal lock,
        and sign(b) in gimbal lock. In gimbal lock, the first of the three angles is the sum c + sign(b) · a,
        and the third is 0.
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
    """Return the angles of the same rotation that are nearest to the angles of the previous tick.

    Args:
        principal: (J,3) angles from `_principal_angles`, radians.
        locked: (J,) gimbal lock from `_principal_angles`.
        previous: (J,3) angles of the previous tick, radians.

    Returns:
        The angles (J,3), radians.
    """
    direct = _add_full_turns(principal, previous)
    other = _add_full_turns(principal * [1, -1, 1] + np.pi, previous)
    if locked.any():
        direct = np.where(locked[:, None] != 0, _split_locked_sum(direct, locked, previous), direct)
        other = np.where(locked[:, None] != 0, _split_locked_sum(other, locked, previous), other)
    step_direct = ((direct - previous) ** 2).sum(axis=1)
    step_other = ((other - previous) ** 2).sum(axis=1)
    return np.where((step_other < step_direct)[:, None], other, direct)


def _add_full_turns(angles: FloatArray, previous: FloatArray) -> FloatArray:
    """Add full turns to the angles, so that each angle differs by at most half a turn from `previous`."""
    return np.asarray(angles + _FULL_TURN_RAD * np.round((previous - angles) / _FULL_TURN_RAD))


def _split_locked_sum(angles: FloatArray, locked: FloatArray, previous: FloatArray) -> FloatArray:
    """Return the angles in gimbal lock that are nearest to the angles of the previous tick.

    In gimbal lock, the rotation determines only the sum c + sign(b) · a. The change of this sum since the
    previous tick is divided equally between a and c. `angles` may be either of the two equivalent triples,
    because adding π to a and c changes the sum only by full turns.

    Args:
        angles: (J,3) angles of this tick, radians, from `_principal_angles`, or other angles of the same
            rotations.
        locked: (J,) gimbal lock from `_principal_angles`.
        previous: (J,3) angles of the previous tick, radians.

    Returns:
        The angles (J,3), radians. They are correct only for joints in gimbal lock.
    """
    total = angles[:, 0] + locked * angles[:, 2]
    before = previous[:, 2] + locked * previous[:, 0]
    change = total - before
    half = 0.5 * (change - _FULL_TURN_RAD * np.round(change / _FULL_TURN_RAD))
    return np.stack([previous[:, 0] + locked * half, angles[:, 1], previous[:, 2] + half], axis=-1)
