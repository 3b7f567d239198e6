"""The continuous motion of each foot: flat while it stands, over the ball before it leaves the floor, and a
smooth swing to the next place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.fill.leg_geometry import LegGeometry
from bodycap_batch.model.fill_data import Footsteps

_HEEL_RISE_RAD = np.radians(50.0)
"""Angle of the foot when it leaves the floor, at 1.3 m/s. Source: D. A. Winter, "Biomechanics and Motor Control
of Human Movement", 4th ed., fig. 3.30 (foot angle)."""
_HEEL_STRIKE_RAD = np.radians(20.0)
"""Angle of the raised toes when the heel touches the floor, at 1.3 m/s. Source: as `_HEEL_RISE_RAD`."""
_FULL_SPEED = 1.3
"""Speed (m/s) for which these angles hold. They are proportional to the mean speed of the swing's foot."""
_HEEL_RISE_SHARE = 0.42
"""Share of the time on the floor during which the heel is raised, before a step. Source: as `_HEEL_RISE_RAD`."""
_HEEL_RISE_S = (0.08, 0.35)
"""Minimum and maximum time (s) of this. Evidence: none."""
_LANDING_S = 0.09
"""Time (s) from the touch of the heel until the foot is flat. Source: as `_HEEL_RISE_RAD`."""
_HEEL_OVER_BALL = 0.35
"""Distance from the ankle back to the heel, as a ratio to the distance forward to the ball. Source:
R. Drillis, R. Contini, "Body segment parameters", 1966."""
_CLEARANCE_M = 0.05
"""Height (metres) by which the middle of a swing is raised above the line from its start to its end.
Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FootPath:
    """The motion of one foot at T ticks.

    Attributes:
        ankle_m: (T,3) ankle in the world, metres.
        heading_rad: (T,) direction of the foot about z.
        pitch_rad: (T,) angle by which the toes are lowered against the flat foot.
        toe_rad: (T,) angle by which the toes are raised against the foot.
    """

    ankle_m: FloatArray
    heading_rad: FloatArray
    pitch_rad: FloatArray
    toe_rad: FloatArray


def foot_path(
    steps: Footsteps, side: int, leg: LegGeometry, ticks: int, fps: float
) -> FootPath | None:
    """Return the motion of one foot; None if it never stands."""
    order = np.flatnonzero(steps.side == side)
    if len(order) == 0:
        return None
    times = np.arange(ticks) / fps
    ankle, pitch = np.zeros((ticks, 3)), np.zeros(ticks)
    heading, toe = np.zeros(ticks), np.zeros(ticks)
    ball = float(-leg.ball_m[1]) if np.any(leg.ball_m) else 0.0
    for position, index in enumerate(order):
        start, end = int(steps.start_tick[index]), int(steps.end_tick[index])
        place, facing = steps.ankle_in_world_m[index], float(steps.heading_rad[index])
        has_next, has_last = position + 1 < len(order), position > 0
        # The strengths of the roll over ball and heel depend on the lengths of the steps.
        rise = _strength(steps, order, position, fps) if has_next else 0.0
        strike = _strength(steps, order, position - 1, fps) if has_last else 0.0
        own = slice(start, end)
        local = times[own] - start / fps
        length = (end - start) / fps
        before = 0.0 if not has_next else float(np.clip(_HEEL_RISE_SHARE * length, *_HEEL_RISE_S))
        after = _LANDING_S if has_last else 0.0
        before, after = min(before, 0.6 * length), min(after, 0.3 * length)
        up = _smooth((local - (length - before)) / before) if before > 0 else np.zeros(len(local))
        down = 1.0 - _smooth(local / after) if after > 0 else np.zeros(len(local))
        pitch[own] = rise * _HEEL_RISE_RAD * up - strike * _HEEL_STRIKE_RAD * down
        toe[own] = rise * _HEEL_RISE_RAD * up
        heading[own] = facing
        ankle[own] = _pivoted(place, facing, pitch[own], ball, leg.ankle_height_m)
        if not has_last:
            ankle[:start], heading[:start] = place, facing
        if not has_next:
            ankle[end:], heading[end:] = place, facing
            continue
        following = int(order[position + 1])
        begin = int(steps.start_tick[following])
        _swing(
            slice(end, begin),
            (place, facing, rise),
            (steps.ankle_in_world_m[following], float(steps.heading_rad[following])),
            _Foot(ball, leg.ankle_height_m),
            (ankle, heading, pitch, toe),
        )
    return FootPath(ankle_m=ankle, heading_rad=heading, pitch_rad=pitch, toe_rad=toe)


@dataclass(frozen=True, slots=True)
class _Foot:
    ball_m: float
    ankle_height_m: float


def _strength(steps: Footsteps, order: FloatArray, position: int, fps: float) -> float:
    """Return how strongly the foot rolls over ball and heel at the step after one period of standing."""
    first, second = int(order[position]), int(order[position + 1])
    apart = steps.ankle_in_world_m[second, :2] - steps.ankle_in_world_m[first, :2]
    facing = float(steps.heading_rad[first])
    ahead = float(apart @ [np.sin(facing), -np.cos(facing)])
    middle_first = 0.5 * (steps.start_tick[first] + steps.end_tick[first])
    middle_second = 0.5 * (steps.start_tick[second] + steps.end_tick[second])
    speed = ahead / max((middle_second - middle_first) / fps, 1.0 / fps)
    return float(np.clip(speed / _FULL_SPEED, 0.15, 1.1)) if ahead > 0.0 else 0.15


def _pivoted(
    place: FloatArray, heading: float, pitch: FloatArray, ball_m: float, height_m: float
) -> FloatArray:
    """Return the ankle (N,3) of a foot that turns about its ball (lowered toes) or its heel (raised toes)."""
    forward = np.array([np.sin(heading), -np.cos(heading)])
    heel_m = _HEEL_OVER_BALL * ball_m
    pivot = np.where(pitch >= 0.0, ball_m, -heel_m)
    # The ankle relative to the pivot: `pivot` behind it and `height_m` above it.
    cos, sin = np.cos(pitch), np.sin(pitch)
    ahead = pivot - pivot * cos + height_m * sin
    above = height_m * cos + pivot * sin
    out = np.empty((len(pitch), 3))
    out[:, :2] = place[:2] + ahead[:, None] * forward
    out[:, 2] = place[2] - height_m + above
    return out


def _swing(
    ticks: slice,
    start: tuple[FloatArray, float, float],
    end: tuple[FloatArray, float],
    foot: _Foot,
    out: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
) -> None:
    """Write the motion of a foot between two periods of standing."""
    ankle, heading, pitch, toe = out
    count = ticks.stop - ticks.start
    if count <= 0:
        return
    place, facing, strength = start
    goal, goal_facing = end
    phase = (np.arange(count) + 1.0) / (count + 1.0)
    first = strength * _HEEL_RISE_RAD
    last = -strength * _HEEL_STRIKE_RAD
    lift_off = _pivoted(place, facing, np.array([first]), foot.ball_m, foot.ankle_height_m)[0]
    landing = _pivoted(goal, goal_facing, np.array([last]), foot.ball_m, foot.ankle_height_m)[0]
    travel = _smooth(phase)
    ankle[ticks] = lift_off + travel[:, None] * (landing - lift_off)
    ankle[ticks, 2] += _CLEARANCE_M * np.sin(np.pi * phase) ** 2
    turn = (goal_facing - facing + np.pi) % (2.0 * np.pi) - np.pi
    heading[ticks] = facing + travel * turn
    pitch[ticks] = first + _smooth(np.clip(phase / 0.75, 0.0, 1.0)) * (last - first)
    toe[ticks] = first * (1.0 - _smooth(np.clip(phase / 0.3, 0.0, 1.0)))


def _smooth(x: FloatArray) -> FloatArray:
    """Return a smooth step from 0 to 1. Its first and second derivatives are zero at both ends."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x**3 * (10.0 - 15.0 * x + 6.0 * x * x))
