"""The pelvis and the lower spine: between the measured trunk and the feet."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.fill.contacts import STAND, Contacts
from bodycap_batch.fill.trunk_signals import ORDINARY_SPEED_M_PER_S, STEP_HZ, TrunkSignals, low_pass
from bodycap_batch.model.fill_data import Footsteps
from bodycap_batch.model.geometry import interpolate_rotation, so3_exp

_YAW_RAD = np.radians(3.0)
"""Amplitude of the pelvis's yaw with each stride, at 1.3 m/s. Source: M. P. Murray, A. B. Drought, R. C.
Kory, "Walking patterns of normal men", Journal of Bone and Joint Surgery 46-A, 1964: ± 3 to 5°. The smaller
value, because the turn that reaches the feet is added."""
_LIST_RAD = np.radians(3.5)
"""Amplitude of the pelvis's list with each stride, at 1.3 m/s. Source: as `_YAW_RAD`. Both amplitudes are
proportional to the speed."""
_FOLLOWING_RAD = (float(np.radians(20.0)), float(np.radians(70.0)))
"""Angles of the trunk against the vertical from which the pelvis starts to follow it, and follows it most.
Evidence: none."""
_BOWING_SHARE = 0.5
"""Share of the angle of a bowed trunk that the pelvis has. Derivation: in a deep bow, hips and spine take
about half of the angle each."""
_LYING_HEIGHT = (0.5, 0.8)
"""Heights of the trunk's joint over the floor, as shares of the length of the leg, below which a person with
a level trunk lies, and above which the person bows. Derivation: on a bed the trunk is at 0.6 to 0.7, in a
deep bow at 1."""
_RECLINED_RAD = (float(np.radians(60.0)), float(np.radians(80.0)))
"""Angles of the trunk against the vertical from which a person may lie, and is taken to lie. Evidence:
none."""
_MAX_TURN_RAD = np.radians(6.0)
"""Maximum angle by which the pelvis is turned about each axis so that a leg reaches its foot. Evidence:
none."""
_AXIS_WEIGHTS = np.array([1.0, 1.0, 0.3])
"""Weights of tilt, list and yaw in this turn. The yaw is small, because the stride determines it. Evidence:
none."""
_DAMPING_M2 = 0.02**2
"""Damping (m²) of this turn: a turn that moves a hip by less than 2 cm per radian is avoided. Evidence:
none."""
_DIFFERENCE_RAD = 1e-3
"""Angle (radians) of the numeric derivative of the hip joints. Derivation: it moves them by 0.1 mm."""
_CORRECTIONS = 3
"""Number of linear corrections. Evidence: none."""
_FADE_HZ = 1.5
"""Cutoff frequency (Hz) of the start and the end of these rotations. Evidence: none."""


def stride_phase_rad(steps: Footsteps, ticks: int) -> FloatArray:
    """Return the phase (T,) of the stride: 0 when the left foot touches the floor, π when the right one does.

    The phase is interpolated between steps, and constant before the first and after the last step.
    """
    events = [
        (int(start), int(side)) for start, side in zip(steps.start_tick, steps.side, strict=True) if start > 0
    ]
    if not events:
        return np.zeros(ticks)
    at: list[int] = []
    phase: list[float] = []
    last = -np.inf
    for start, side in sorted(events):
        if at and start <= at[-1]:
            continue
        wanted = np.pi * side
        while wanted <= last:
            wanted += 2.0 * np.pi
        at.append(start)
        phase.append(wanted)
        last = wanted
    return np.asarray(np.interp(np.arange(ticks), at, phase))


def reclined_share(trunk: FloatArray, floor_m: float, leg_m: float) -> FloatArray:
    """Return 0 for a standing or sitting person, 1 for a lying one, and a smooth change between (T,).

    Args:
        trunk: (T,4,4) poses of the trunk's joint in the world, metres.
        floor_m: Height of the floor, metres.
        leg_m: Length of a leg, metres.
    """
    low = 1.0 - _smooth_step((trunk[:, 2, 3] - floor_m) / leg_m, _LYING_HEIGHT)
    return np.asarray(low * _smooth_step(_tilt_rad(trunk), _RECLINED_RAD))


def following_pelvis(pelvis: FloatArray, trunk: FloatArray, reclined: FloatArray) -> FloatArray:
    """Return the orientation (T,3,3) of a pelvis that follows a trunk which is bent far or lies.

    Args:
        pelvis: (T,3,3) orientation of the pelvis below an upright trunk.
        trunk: (T,3,3) orientation of the trunk in the world.
        reclined: (T,) 1 for a lying person.
    """
    most = _BOWING_SHARE + (1.0 - _BOWING_SHARE) * reclined
    return interpolate_rotation(pelvis, trunk, _smooth_step(_tilt_rad(trunk), _FOLLOWING_RAD) * most)


def _tilt_rad(rotation: FloatArray) -> FloatArray:
    return np.asarray(np.arccos(np.clip(rotation[:, 2, 2], -1.0, 1.0)))


def _smooth_step(values: FloatArray, limits: tuple[float, float]) -> FloatArray:
    x = np.clip((values - limits[0]) / (limits[1] - limits[0]), 0.0, 1.0)
    return np.asarray(x * x * (3.0 - 2.0 * x))


def pelvis_rotation(
    signals: TrunkSignals, contacts: Contacts, steps: Footsteps, has_gait: bool
) -> FloatArray:
    """Return the orientation (T,3,3) of the pelvis in the world below an upright trunk.

    Args:
        signals: The signals of the trunk.
        contacts: Which feet stand.
        steps: Where the feet stand.
        has_gait: Whether the legs are filled.
    """
    ticks = len(signals.heading_rad)
    zero = np.zeros(ticks)
    yaw, tilt = signals.heading_rad, zero
    if has_gait:
        phase = stride_phase_rad(steps, ticks)
        walking = low_pass((contacts.state != STAND).astype(np.float64), _FADE_HZ, signals.fps)
        strength = np.clip(walking, 0.0, 1.0) * np.clip(
            signals.speed_m_per_s() / ORDINARY_SPEED_M_PER_S, 0.0, 1.3
        )
        yaw = yaw - _YAW_RAD * strength * np.cos(phase)
        tilt = -_LIST_RAD * strength * np.sin(phase)
    turn = so3_exp(np.column_stack([zero, zero, yaw]))
    return np.asarray(turn @ so3_exp(np.column_stack([zero, tilt, zero])))


def reaching_pelvis(
    pelvis: FloatArray,
    hips_of: Callable[[FloatArray], FloatArray],
    ankles_m: FloatArray,
    limits_m: FloatArray,
    fps: float,
) -> FloatArray:
    """Return the pelvis (T,3,3), tilted and turned a little so that the legs reach the feet.

    Where a foot is beyond the reach of its leg, the pelvis is turned by the smallest angles that bring the
    hip nearer to it. The angles are limited and smooth over time.

    Args:
        pelvis: (T,3,3) orientation of the pelvis in the world.
        hips_of: Returns the left and right hip joint (T,2,3) in the world, metres, for an orientation of the
            pelvis.
        ankles_m: (T,2,3) left and right ankle in the world, metres.
        limits_m: (2,) maximum distance between hip and ankle of each leg, metres.
        fps: Ticks per second.
    """
    turn = np.zeros((len(pelvis), 3))
    for _ in range(_CORRECTIONS):
        hips = hips_of(pelvis @ so3_exp(turn))
        away = hips - ankles_m
        distance = np.linalg.norm(away, axis=2)
        excess = np.maximum(distance - limits_m, 0.0)
        slopes = np.empty((len(pelvis), 2, 3))
        for axis in range(3):
            step = turn.copy()
            step[:, axis] += _DIFFERENCE_RAD
            moved = (hips_of(pelvis @ so3_exp(step)) - hips) / _DIFFERENCE_RAD
            slopes[:, :, axis] = (moved * away).sum(axis=2) / distance
        slopes *= (excess > 0.0)[:, :, None]
        slopes *= _AXIS_WEIGHTS
        damped = slopes @ np.swapaxes(slopes, 1, 2) + _DAMPING_M2 * np.eye(2)
        solved = np.linalg.solve(damped, excess[:, :, None])[:, :, 0]
        turn = turn - _AXIS_WEIGHTS * np.einsum("tij,ti->tj", slopes, solved)
        turn = _MAX_TURN_RAD * np.tanh(turn / _MAX_TURN_RAD)
    return np.asarray(pelvis @ so3_exp(low_pass(turn, STEP_HZ, fps)))
