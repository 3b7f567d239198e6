"""The continuous motion of each foot.

The foot is flat while it stands, rolls over the ball before it leaves the floor, swings smoothly to the next
place, and lands on the heel.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.fill.leg_geometry import LegGeometry, soft_length
from bodycap_batch.fill.trunk_signals import ORDINARY_SPEED_M_PER_S
from bodycap_batch.model.fill_data import Footsteps

_HEEL_RISE_RAD = np.radians(62.0)
"""Angle of the foot when it leaves the floor, at 1.3 m/s. Source: D. A. Winter, "Biomechanics and Motor
Control of Human Movement", 4th ed., fig. 3.30 (foot angle)."""
_MAX_HEEL_RISE_RAD = np.radians(70.0)
"""Maximum angle of the foot on its ball. Evidence: none."""
_HEEL_STRIKE_RAD = np.radians(20.0)
"""Angle of the raised toes when the heel touches the floor, at 1.3 m/s. Source: as `_HEEL_RISE_RAD`. Both
angles are proportional to the square root of the speed of the person. Evidence for the root: none."""
_HEEL_RISE_SHARE = 0.42
"""Share of the time on the floor during which the heel is raised, before a step. Source: as
`_HEEL_RISE_RAD`."""
_HEEL_RISE_POWER = 3.0
"""Exponent of time in the angle of the rising heel. Evidence: none."""
_HEEL_RISE_S = (0.08, 0.35)
"""Minimum and maximum time (s) of this. Evidence: none."""
_LANDING_S = 0.09
"""Time (s) from the touch of the heel until the foot is flat. Source: as `_HEEL_RISE_RAD`."""
_LANDED_SHARE = 0.3
"""Share of this time that has passed when the foot counts as standing: the heel touches the floor before the
ankle rests. Evidence: docs/decisions/filling.md."""
_OVERSHOOT = 1.15
"""Ratio of the largest angle of the foot, shortly after it leaves the floor, to the angle when it leaves the
floor. Source: as `_HEEL_RISE_RAD`."""
_CLEARANCE_M = 0.03
"""Least height (metres) of the lowest point of the foot above the floor in the middle of a swing. Derivation:
the toes of walking people pass 1 to 2 cm above the floor (Winter 1991), and a margin."""
REACH_SHARE = 0.997
"""Maximum distance between hip and ankle of a foot that lands, as a share of the length of the leg.
Derivation: the knee is bent by 5 to 10° when the heel touches the floor (Murray and others, 1964)."""
_SLACK = 0.003
"""Slack of the leg of a standing foot that is just within reach, as a share of its length: with less, the
heel rises. Derivation: the knee is bent by 9°, and by 3 to 9° when the heel rises."""
_ROLLING_M = 0.08
"""Distance (metres) of the hip ahead of the ankle from which the heel rises as far as the reach needs.
Evidence: none."""
_SWING_KNEE_RAD = np.radians(72.0)
"""Flexion of the knee in the swing, where it is largest, at 1.3 m/s: the least flexion of a swinging leg. It
is proportional to the fourth root of the speed. Evidence: docs/decisions/filling.md."""
_LEAVING_KNEE_RAD = np.radians(35.0)
"""Flexion of the knee when the foot leaves the floor, at 1.3 m/s. Source: as `_HEEL_RISE_RAD`,
fig. of the knee."""
_SWING_KNEE_AT = 0.35
"""Share of the swing at which it is largest. Source: as `_LEAVING_KNEE_RAD`."""
_LOADING_KNEE_RAD = np.radians(5.0)
"""Flexion that the knee gains when the foot takes the load. Evidence: docs/decisions/filling.md."""
_EXTENDED_AT = 0.92
"""Share of the swing at which the knee is extended for the landing. Source: as `_LEAVING_KNEE_RAD`."""
_RISING_SHARE = 0.7
"""Share of a swing during which the foot rises to a higher place or sinks to a lower one. Evidence: none."""
_MAX_DELAY_S = 0.1
"""Maximum time (s) by which a foot lands later because it would be out of reach. Evidence: none."""
_BISECTIONS = 16
"""Number of halvings of the angle of the heel. Derivation: 70° / 2^16 is 0.001°."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FootPath:
    """The motion of one foot at T ticks.

    Attributes:
        ankle_m: (T,3) ankle in the world, metres.
        heading_rad: (T,) direction of the foot about z.
        pitch_rad: (T,) angle by which the toes are lowered against the flat foot.
        toe_rad: (T,) angle by which the toes are raised against the foot.
        knee_rad: (T,) least flexion of the knee. The leg takes it even if the ankle is then not reached.
    """

    ankle_m: FloatArray
    heading_rad: FloatArray
    pitch_rad: FloatArray
    toe_rad: FloatArray
    knee_rad: FloatArray


@dataclass(frozen=True, slots=True)
class _Stance:
    """A period in which the foot stands; it may lie outside the recording, where it is extrapolated."""

    start: int
    end: int
    place: FloatArray
    heading: float


def reachable_steps(
    steps: Footsteps, legs: tuple[LegGeometry, LegGeometry], hips_m: FloatArray, fps: float
) -> Footsteps:
    """Return the periods of standing with later starts where a foot would land beyond the reach of its leg.

    Args:
        steps: Where and when the feet stand.
        legs: The legs.
        hips_m: (T,2,3) left and right hip joint in the world, metres.
        fps: Ticks per second.
    """
    starts, places = steps.start_tick.copy(), steps.ankle_in_world_m.copy()
    for index, side in enumerate(steps.side):
        leg, start, end = legs[side], int(steps.start_tick[index]), int(steps.end_tick[index])
        last = start + min(round(_MAX_DELAY_S * fps), (end - start) // 3)
        limit = REACH_SHARE * leg.length_m
        while start < last and start > 0 and np.linalg.norm(places[index] - hips_m[start, side]) > limit:
            start += 1
        starts[index] = start
        # What is still too far is nearer than it was taken to be.
        places[index, :2] = _within_reach(places[index], hips_m[start, side], limit)
    return replace(steps, start_tick=starts, ankle_in_world_m=places)


def kept_steps(steps: Footsteps, missed: BoolArray) -> Footsteps:
    """Return the periods of standing without ticks at their ends at which the foot is not on the floor.

    Args:
        steps: When the feet should stand.
        missed: (T,2) True if the left or right foot is not where it should stand.
    """
    starts, ends = steps.start_tick.copy(), steps.end_tick.copy()
    for index, side in enumerate(steps.side):
        own = np.flatnonzero(~missed[starts[index] : ends[index], side])
        first, count = (int(own[0]), int(own[-1] - own[0]) + 1) if len(own) else (0, 0)
        starts[index] += first
        ends[index] = starts[index] + count
    return replace(steps, start_tick=starts, end_tick=ends).keep(ends > starts)


def _within_reach(place: FloatArray, hip: FloatArray, limit_m: float) -> FloatArray:
    """Return the horizontal position (2,) of an ankle, moved towards the hip if the leg cannot reach it."""
    away = place[:2] - hip[:2]
    distance = float(np.hypot(*away))
    longest = float(np.sqrt(max(limit_m**2 - (hip[2] - place[2]) ** 2, 0.0)))
    return np.asarray(place[:2] if distance <= longest else hip[:2] + away * (longest / distance))


def foot_path(
    steps: Footsteps,
    side: int,
    leg: LegGeometry,
    hip_m: FloatArray | None,
    velocity: FloatArray,
    fps: float,
) -> FootPath | None:
    """Return the motion of one foot; None if it never stands.

    Args:
        steps: Where and when the feet stand.
        side: Index of the foot.
        leg: The leg.
        hip_m: (T,3) hip joint in the world, metres: the heel is raised where the leg does not reach the
            standing foot. None if the reach does not matter.
        velocity: (T,3) velocity of the hips without the sway of single steps, m/s.
        fps: Ticks per second.
    """
    ticks = len(velocity)
    stances = _with_neighbours(steps, side, velocity, fps)
    if not stances:
        return None
    path = FootPath(
        ankle_m=np.zeros((ticks, 3)),
        heading_rad=np.zeros(ticks),
        pitch_rad=np.zeros(ticks),
        toe_rad=np.zeros(ticks),
        knee_rad=np.zeros(ticks),
    )
    forces = [_strength(first, second, fps) for first, second in itertools.pairwise(stances)]
    for position, stance in enumerate(stances):
        rise = forces[position] if position < len(forces) else 0.0
        strike = forces[position - 1] if position > 0 else 0.0
        _stand(path, stance, (rise, strike), leg, hip_m, fps)
    for position, strength in enumerate(forces):
        first, second = stances[position], stances[position + 1]
        _swing(path, first, second, strength, leg, _landing_knee(path, second, leg, hip_m))
    return path


def _with_neighbours(steps: Footsteps, side: int, velocity: FloatArray, fps: float) -> list[_Stance]:
    """Return the periods of standing, with one more before and after if the recording cuts off a swing."""
    own = np.flatnonzero(steps.side == side)
    out = [
        _Stance(
            int(steps.start_tick[index]),
            int(steps.end_tick[index]),
            steps.ankle_in_world_m[index],
            float(steps.heading_rad[index]),
        )
        for index in own
    ]
    if not out:
        return out
    # A swing that is cut off takes as long as the others.
    gaps = [second.start - first.end for first, second in itertools.pairwise(out)]
    swing = max(2, int(np.median(gaps)) if gaps else round(0.4 * fps))
    ticks = len(velocity)
    first, last = out[0], out[-1]
    if first.start > 0:
        back = velocity[0] * [1.0, 1.0, 0.0] * (2.5 * swing / fps)
        end = min(first.start - swing, 0)
        out.insert(0, _Stance(end - swing, end, first.place - back, first.heading))
    if last.end < ticks:
        ahead = velocity[-1] * [1.0, 1.0, 0.0] * (2.5 * swing / fps)
        start = max(last.end + swing, ticks)
        out.append(_Stance(start, start + swing, last.place + ahead, last.heading))
    return out


def _strength(first: _Stance, second: _Stance, fps: float) -> float:
    """Return how strongly the foot rolls over ball and heel at the step between two periods of standing."""
    apart = second.place[:2] - first.place[:2]
    ahead = float(apart @ [np.sin(first.heading), -np.cos(first.heading)])
    middle = 0.5 * (second.start + second.end - first.start - first.end)
    speed = ahead / max(middle / fps, 1.0 / fps)
    return float(np.sqrt(np.clip(speed / ORDINARY_SPEED_M_PER_S, 0.02, 1.2)))


def _stand(
    path: FootPath,
    stance: _Stance,
    strength: tuple[float, float],
    leg: LegGeometry,
    hip_m: FloatArray | None,
    fps: float,
) -> None:
    """Write the motion of the foot while it stands."""
    own = np.arange(max(stance.start, 0), min(stance.end, len(path.pitch_rad)))
    rise, strike = strength
    seconds = (own - stance.start) / fps
    length = (stance.end - stance.start) / fps
    before = min(float(np.clip(_HEEL_RISE_SHARE * length, *_HEEL_RISE_S)), 0.6 * length)
    after = min(_LANDING_S, 0.3 * length)
    late = np.clip((seconds - (length - before)) / before, 0.0, 1.0)
    up = late**_HEEL_RISE_POWER
    path.knee_rad[own] = np.sqrt(rise) * _LEAVING_KNEE_RAD * late**2
    down = 1.0 - _smooth(seconds / after + _LANDED_SHARE)
    pitch = rise * _HEEL_RISE_RAD * up - strike * _HEEL_STRIKE_RAD * down
    if hip_m is not None:
        pitch = _reaching_pitch(stance, pitch, leg, hip_m[own], path.knee_rad[own])
    path.pitch_rad[own] = pitch
    path.toe_rad[own] = np.maximum(pitch, 0.0)
    path.heading_rad[own] = stance.heading
    path.ankle_m[own] = standing_ankle(leg, stance.place, stance.heading, pitch)


def _reaching_pitch(
    stance: _Stance, pitch: FloatArray, leg: LegGeometry, hip_m: FloatArray, knee_rad: FloatArray
) -> FloatArray:
    """Return the pitch (N,), increased where a foot behind the hip is reached only with a raised heel."""
    low, high = pitch.copy(), np.maximum(pitch, _MAX_HEEL_RISE_RAD)

    def distance(angle: FloatArray) -> FloatArray:
        ankle = standing_ankle(leg, stance.place, stance.heading, angle)
        return np.asarray(np.linalg.norm(ankle - hip_m, axis=1))

    forward = np.array([np.sin(stance.heading), -np.cos(stance.heading)])
    behind = _smooth((hip_m[:, :2] - stance.place[:2]) @ forward / _ROLLING_M)
    flat = distance(pitch)
    wanted = flat + behind * (soft_length(flat, leg.reach_m(knee_rad), _SLACK) - flat)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        good = distance(middle) <= wanted
        high = np.where(good, middle, high)
        low = np.where(good, low, middle)
    return np.asarray(np.where(behind > 0.0, high, pitch))


def standing_ankle(leg: LegGeometry, place: FloatArray, heading: float, pitch: FloatArray) -> FloatArray:
    """Return the ankle (N,3) of a foot that turns about its ball (lowered toes) or its heel (raised toes).

    Args:
        leg: The leg.
        place: (3,) the ankle while the foot is flat.
        heading: Direction of the foot about z.
        pitch: (N,) angle by which the toes are lowered. The toes themselves stay level.
    """
    forward = np.array([np.sin(heading), -np.cos(heading)])
    pivot = np.where(pitch >= 0.0, leg.ball_ahead_m, -leg.heel_behind_m)
    height = np.where(pitch >= 0.0, leg.ankle_over_ball_m, leg.ankle_height_m)
    ahead = pivot - pivot * np.cos(pitch) + height * np.sin(pitch)
    out = np.empty((len(pitch), 3))
    out[:, :2] = place[:2] + ahead[:, None] * forward
    out[:, 2] = place[2] - leg.ankle_height_m + leg.drop_m(pitch, np.maximum(pitch, 0.0))
    return out


def _swing(
    path: FootPath,
    first: _Stance,
    second: _Stance,
    strength: float,
    leg: LegGeometry,
    landing_rad: float,
) -> None:
    """Write the motion of the foot between two periods of standing."""
    ticks = len(path.pitch_rad)
    inside: IntArray = np.arange(max(first.end, 0), min(second.start, ticks))
    if len(inside) == 0:
        return
    count = second.start - first.end + 1
    phase = (inside - first.end + 1.0) / count
    # The last and the last but one tick of standing give the angle and its rate when the foot leaves.
    leaving = strength * _HEEL_RISE_RAD
    if 0 < first.end <= ticks:
        leaving = float(path.pitch_rad[first.end - 1])
    arriving = -strength * _HEEL_STRIKE_RAD
    if 0 <= second.start < ticks:
        arriving = float(path.pitch_rad[second.start])
    raised = min(arriving, -strength * _HEEL_STRIKE_RAD)
    rate = 0.0
    if 1 < first.end <= ticks and first.end - 2 >= first.start:
        rate = float(path.pitch_rad[first.end - 1] - path.pitch_rad[first.end - 2])
    peak = max(leaving * _OVERSHOOT, leaving + 0.3 * rate)
    pitch = _hermite(
        phase,
        np.array([0.0, 0.12, 0.8, 1.0]),
        np.array([leaving, peak, raised, arriving]),
        np.array([rate * count, 0.0, 0.0, 0.0]),
    )
    toe = np.maximum(leaving, 0.0) * (1.0 - _smooth(phase / 0.35))
    start = standing_ankle(leg, first.place, first.heading, np.array([leaving - rate, leaving]))
    end = standing_ankle(leg, second.place, second.heading, np.array([arriving]))[0]
    speed = (start[1] - start[0])[:2] * count
    travel = _quintic(phase, start[1, :2], speed, end[:2])
    # The drop is limited to what the foot has while it rolls over the ball.
    rise = second.place[2] - first.place[2]
    # The foot rises before it moves ahead to a higher place, and sinks after it has moved over a lower place.
    late = phase / _RISING_SHARE if rise > 0.0 else 1.0 - (1.0 - phase) / _RISING_SHARE
    floor = first.place[2] + _smooth(late) * rise - leg.ankle_height_m
    path.knee_rad[inside] = _swing_knee(path, first, count, strength, landing_rad, phase)
    path.pitch_rad[inside] = pitch
    path.toe_rad[inside] = toe
    # A person may spin around between two steps. From three quarters of a turn on, the foot leaves out whole
    # turns.
    turn = second.heading - first.heading
    turn -= np.sign(turn) * 2.0 * np.pi * np.floor(abs(turn) / (2.0 * np.pi) + 0.25)
    path.heading_rad[inside] = first.heading + _smooth(phase) * turn
    path.ankle_m[inside, :2] = travel
    path.ankle_m[inside, 2] = floor + leg.drop_m(pitch, toe) + _CLEARANCE_M * np.sin(np.pi * phase) ** 2


def _landing_knee(path: FootPath, stance: _Stance, leg: LegGeometry, hip_m: FloatArray | None) -> float:
    """Return the flexion of the knee before the foot takes the load; 0 if the recording has no landing."""
    if hip_m is None or not 0 <= stance.start < len(hip_m):
        return 0.0
    away = np.linalg.norm(path.ankle_m[[stance.start]] - hip_m[[stance.start]], axis=1)
    landed = leg.knee_rad(soft_length(away, leg.length_m, _SLACK))
    return float(np.maximum(landed[0] - _LOADING_KNEE_RAD, 0.0))


def _swing_knee(
    path: FootPath, first: _Stance, count: int, strength: float, landing_rad: float, phase: FloatArray
) -> FloatArray:
    """Return the least flexion (N,) of the knee at phases (N,) of a swing of `count` ticks.

    The curve continues that of the standing leg before, and ends with the flexion of the landing.
    """
    leaving, peak = np.sqrt(strength) * np.array([_LEAVING_KNEE_RAD, _SWING_KNEE_RAD])
    rate = 0.0
    if 1 < first.end <= len(path.knee_rad) and first.end - 2 >= first.start:
        before, leaving = path.knee_rad[first.end - 2 : first.end]
        rate = float(leaving - before) * count
    return _hermite(
        phase,
        np.array([0.0, _SWING_KNEE_AT, _EXTENDED_AT, 1.0]),
        np.array([leaving, peak, landing_rad, landing_rad]),
        np.array([rate, 0.0, 0.0, 0.0]),
    )


def _quintic(phase: FloatArray, start: FloatArray, speed: FloatArray, end: FloatArray) -> FloatArray:
    """Return positions (N,2) on a path from a start with a speed to an end at rest.

    The accelerations at both ends are zero.

    Args:
        phase: (N,) 0 at the start, 1 at the end.
        start: (2,) position at the start.
        speed: (2,) derivative of the position with respect to the phase, at the start.
        end: (2,) position at the end.
    """
    x = phase[:, None]
    along = x - 6.0 * x**3 + 8.0 * x**4 - 3.0 * x**5
    return np.asarray(start + _smooth(x) * (end - start) + along * speed)


def _hermite(x: FloatArray, knots: FloatArray, values: FloatArray, slopes: FloatArray) -> FloatArray:
    from scipy.interpolate import CubicHermiteSpline

    return np.asarray(CubicHermiteSpline(knots, values, slopes)(x))


def _smooth(x: FloatArray) -> FloatArray:
    """Return a smooth step from 0 to 1. Its first and second derivatives are zero at both ends."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x**3 * (10.0 - 15.0 * x + 6.0 * x * x))
