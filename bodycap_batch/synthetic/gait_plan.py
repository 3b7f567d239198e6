"""Plan where a person walks, turns and steps, and where and when each foot stands."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.synthetic.gait_curves import stance_share, steps_per_s

MARGIN_S = 4.0
"""Additional time (seconds) that the plan covers before time 0 and after the capture."""
_PATH_HZ = 100.0
"""Sampling rate (Hz) of the path of the body."""
_ARC_STEP_M = 0.01
"""Distance (metres) between the points of a planned walk."""
_HALF_ROOM_M = (3.6, 3.0)
"""Largest distance (metres) of a planned walk from the middle of the room, along x and y. Evidence: none."""
_TRIES = 40
"""Number of walks that are drawn until one stays within `_HALF_ROOM_M`. Otherwise the best one is taken."""
_RAMP_S = 1.3
"""Time (seconds) from standing to full speed, and from full speed to standing. Origin: about two steps."""
_BEND_SLOWING_M = 0.2
"""Relative loss of speed for each unit of curvature (1/m) of a bend, metres. Evidence: none."""
_MID_STANCE = {"walk": 0.23, "back": 0.34}
"""Time from heel strike until the body passes the ankle, as a share of the gait cycle. Origin: with it, the
angle of the hip in walking has the published mean of `hip_flexion_deg` at heel strike and at toe off."""
_AHEAD, _BEHIND = 0.21, 0.39
"""Way of the body from heel strike to above the ankle, and from there to toe off, as shares of a stride."""
_STRIDE_M_PER_M = 1.42 / 1.75
"""Length of a stride at `REFERENCE_M_S` for each metre of stature. Origin: `steps_per_s`."""
_PAIR_S = 1.2
"""Time (seconds) of two steps aside or on the spot. Evidence: none."""
_PAIR_DEG, _PAIR_M = 40.0, 0.27
"""Largest turn (degrees) and mean way (metres) of two steps on the spot or aside. Evidence: none."""
_BACK_STEP_M, _BACK_STEP_S = 0.32, 0.66
"""Length (metres) and time (seconds) of a step back. Evidence: none."""
_STRIKE_DEG = {"walk": -17.0, "back": 14.0, "aside": 8.0, "turn": 8.0}
"""Angle of the foot at its first contact, degrees; negative: the heel touches first. The angle for walking
belongs to a stride at `REFERENCE_M_S`. Evidence for the other kinds: none."""
_OFF_DEG = {"walk": 55.0, "back": -3.0, "aside": 16.0, "turn": 16.0}
"""Angle of the foot at its last contact, degrees; positive: the toes touch last. As `_STRIKE_DEG`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Walker:
    """How one person walks.

    Attributes:
        speed_m_s: Preferred speed, metres per second.
        height_m: Stature, metres.
        step_gain: Factor of the number of steps per second; 1: as the mean of all people.
        width_m: Distance of the feet across the walking direction, metres.
        asymmetry: Relative difference of the times of left and right steps.
        toe_out_deg: Angle by which the toes point outwards, degrees.
        lean_deg: Lean of the trunk to the front, degrees.
        arm_gain: Factor of the swing of the arms.
    """

    speed_m_s: float
    height_m: float
    step_gain: float
    width_m: float
    asymmetry: float
    toe_out_deg: float
    lean_deg: float
    arm_gain: float


def draw_walker(height_m: float, rng: np.random.Generator) -> Walker:
    """Draw how a person of a given stature walks.

    The speed is uniform from 0.6 to 1.7 m/s. The standard deviations between people are 4 % of the cadence,
    2 cm of the step width, 1.5 % of the asymmetry and 2 degrees of the lean. Evidence for these deviations:
    none.
    """
    return Walker(
        speed_m_s=float(rng.uniform(0.6, 1.7)),
        height_m=height_m,
        step_gain=float(1.0 + 0.04 * np.clip(rng.normal(), -2, 2)),
        width_m=float(0.10 + 0.02 * np.clip(rng.normal(), -2, 2)),
        asymmetry=float(0.015 * np.clip(rng.normal(), -2, 2)),
        toe_out_deg=float(6.0 + 2.5 * np.clip(rng.normal(), -2, 2)),
        lean_deg=float(3.0 + 2.0 * np.clip(rng.normal(), -2, 2)),
        arm_gain=float(rng.uniform(0.75, 1.25)),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Bout:
    """A time of stepping between two times of standing.

    Attributes:
        kind: ``walk``, ``back``, ``aside`` or ``turn``.
        start_s: Start, seconds.
        end_s: End, seconds.
        first: 0 if the left foot steps first, 1 if the right foot does.
        strikes_s: (N,) times at which a foot touches the floor, seconds. The feet alternate.
        speed_m_s: Speed, metres per second, without start and stop.
    """

    kind: str
    start_s: float
    end_s: float
    first: int
    strikes_s: FloatArray
    speed_m_s: float


class Plan:
    """The path of a body over the floor, its bouts of stepping, and its footprints.

    Args:
        length_s: Latest time of the capture, seconds.
        still_s: Time (seconds) for which the person stands at the start of the capture.
        walker: How the person walks.
        on_the_spot: True: the person only stands and turns.
        rng: Source of randomness. A longer plan starts with the steps of a shorter plan.
    """

    def __init__(
        self, length_s: float, still_s: float, walker: Walker, on_the_spot: bool, rng: np.random.Generator
    ) -> None:
        self.walker, self.bouts = walker, list[Bout]()
        self._prints: tuple[dict[str, list[Any]], ...] = (defaultdict(list), defaultdict(list))
        self._rng, for_places = rng.spawn(2)
        self._rows = [np.array([-3.0 * MARGIN_S, 0.0, 0.0, float(self._rng.uniform(-180, 180))])]
        self._stand_until(still_s + float(self._rng.uniform(0.3, 0.8)))
        self._plant_first()
        turns = 0
        while self._now < length_s + 2.0 * MARGIN_S:
            if on_the_spot:
                self._turn((1.0 if turns % 2 else -1.0) * float(self._rng.uniform(70.0, 130.0)))
            else:
                self._walk_somewhere()
                self._stand_until(self._now + float(self._rng.uniform(0.5, 1.3)))
                choice = float(self._rng.uniform())
                if choice < 0.35:
                    self._aside()
                elif choice < 0.65:
                    self._back()
            turns += 1
            self._stand_until(self._now + float(self._rng.uniform(0.4, 1.0)))
        rows = np.array(self._rows)
        self._path = CubicSpline(rows[:, 0], rows[:, 1:])
        self._place_feet(for_places)
        for number in (0, 1):
            self._add_print(number, off_s=float("inf"), off_deg=0.0)

    def footprints(self, number: int) -> dict[str, FloatArray]:
        """Return the footprints of the left foot (0) or of the right foot (1), as the fields of `Foot`."""
        return {name: np.array(values) for name, values in self._prints[number].items()}

    def _add_print(self, number: int, **values: Any) -> None:
        """Add values of the next footprint of a foot, by field of `Foot`."""
        for name, value in values.items():
            self._prints[number][name].append(value)

    @property
    def end_s(self) -> float:
        """Last time that the plan covers, seconds."""
        return self._now

    @property
    def _now(self) -> float:
        return float(self._rows[-1][0])

    def body(self, t_s: FloatArray) -> FloatArray:
        """Return x, y (metres) and direction (degrees; 0: towards −y) of the body at times (T,), as (T,3)."""
        return np.asarray(self._path(t_s))

    def _stand_until(self, end_s: float) -> None:
        """Add a time of standing to the path."""
        times = np.arange(self._now, end_s, 1.0 / _PATH_HZ)[1:]
        self._rows.extend(np.array([time, *self._rows[-1][1:]]) for time in times)

    def _move(
        self,
        kind: str,
        way: Callable[[FloatArray], FloatArray],
        effort_s: float,
        first: int,
        speed_m_s: float,
    ) -> None:
        """Add a bout to path and bouts.

        Args:
            kind: Kind of the bout.
            way: Function from effort (T,) in seconds to x, y and direction (T,3).
            effort_s: Duration of the bout at full speed, seconds. Start and stop take `_RAMP_S` more.
            first: Foot that steps first.
            speed_m_s: Speed that gives the number of steps in a walk, metres per second.
        """
        start, ramp = self._now, min(_RAMP_S, effort_s)
        length = effort_s + ramp
        count = int(np.ceil(length * _PATH_HZ))
        times = np.linspace(0.0, length, count + 1)
        effort = _ramped(times, length, ramp)
        rows = np.column_stack([start + times, way(effort)])
        self._rows.extend(rows[1:])
        if kind == "walk":
            moved = np.linalg.norm(np.diff(rows[:, 1:3], axis=0), axis=1) * count / length
            speed = np.maximum(moved, 0.5 * speed_m_s)
            rate = steps_per_s(speed, self.walker.height_m) * self.walker.step_gain
            phase = np.concatenate([[0.0], np.cumsum(rate) * length / count])
            number = max(3, round(float(phase[-1])))
        else:
            pace = _BACK_STEP_S if kind == "back" else 0.5 * _PAIR_S
            number = max(2, round(length / pace))
            number += 0 if kind == "back" else number % 2
            phase = times
        wanted = np.arange(1, number + 1) * phase[-1] / number
        strikes = np.interp(wanted, phase, times)
        step = np.diff(strikes, prepend=0.0)
        sign = 1.0 - 2.0 * ((np.arange(number) + first) % 2)
        strikes[:-1] += (step * (0.5 * self.walker.asymmetry * sign + 0.008 * self._rng.normal(size=number)))[
            :-1
        ]
        self.bouts.append(
            Bout(
                kind=kind, start_s=start, end_s=self._now, first=first, strikes_s=start + strikes,
                speed_m_s=speed_m_s,
            )
        )  # fmt: skip

    def _walk_somewhere(self) -> None:
        """Draw a walk that stays in the room, turn towards its start, and walk."""
        rng, here = self._rng, self._rows[-1]
        best: tuple[float, float, FloatArray] | None = None
        for _ in range(_TRIES):
            turn = float(rng.uniform(-160, 160)) if rng.uniform() < 0.7 else 0.0
            lengths = rng.uniform((2.4, 1.2), (5.0, 3.6))
            bend = np.radians(rng.uniform(50, 190)) * (1.0 if rng.uniform() < 0.5 else -1.0)
            points = _bent_way(
                here[1:3], here[3] + turn, (lengths[0], lengths[1]), bend, rng.uniform(0.9, 1.6)
            )
            excess = float((np.abs(points[:, :2]) / _HALF_ROOM_M).max())
            if best is None or excess < best[0]:
                best = excess, turn, points
            if excess <= 1.0:
                break
        assert best is not None  # There is at least one try.
        if best[1]:
            self._turn(best[1])
            self._stand_until(self._now + float(rng.uniform(0.2, 0.6)))
        points = best[2]
        speed = self.walker.speed_m_s * float(rng.uniform(0.94, 1.06))
        pace = speed * (1.0 - _BEND_SLOWING_M * np.abs(points[:, 3]))
        effort = np.concatenate([[0.0], np.cumsum(_ARC_STEP_M / pace[1:])])
        way = CubicSpline(effort, points[:, :3])
        self._move(
            "walk", lambda passed: np.asarray(way(passed)), float(effort[-1]), int(rng.integers(2)), speed
        )

    def _turn(self, degrees: float) -> None:
        """Turn on the spot by an angle; positive: to the left."""
        pairs = int(np.ceil(abs(degrees) / _PAIR_DEG))
        self._step("turn", [0.0, 0.0, degrees], _pairs_s(pairs), 0 if degrees > 0 else 1)

    def _aside(self) -> None:
        """Step to one side, towards the middle of the room."""
        here = self._rows[-1][1:]
        left = _forward(here[2] + 90.0)
        first = 0 if float(left @ here[:2]) < 0 else 1
        pairs = int(self._rng.integers(2, 4))
        way = (1.0 if first == 0 else -1.0) * pairs * _PAIR_M * float(self._rng.uniform(0.85, 1.15)) * left
        self._step("aside", [*way, 0.0], _pairs_s(pairs), first)

    def _back(self) -> None:
        """Step back."""
        steps = int(self._rng.integers(3, 6))
        way = -_forward(self._rows[-1][3]) * steps * _BACK_STEP_M
        self._step("back", [*way, 0.0], steps * _BACK_STEP_S, int(self._rng.integers(2)))

    def _step(self, kind: str, change: list[float], effort_s: float, first: int) -> None:
        """Add a bout in which x, y and direction change steadily by given values."""
        here = self._rows[-1][1:].copy()
        self._move(kind, lambda passed: here + np.outer(passed / effort_s, change), effort_s, first, 0.0)

    def _plant_first(self) -> None:
        """Put both feet beside the body at the start."""
        here = self._rows[-1][1:]
        for number in (0, 1):
            self._add_print(
                number,
                strike_s=-float("inf"),
                place_m=here[:2] + self._aside_of(number, here[2]),
                yaw_deg=here[2] + self._toe_out(number),
                strike_deg=0.0,
                cycle_s=1.1,
                speed_m_s=0.0,
                stride=0.0,
            )

    def _aside_of(self, number: int, yaw_deg: float) -> FloatArray:
        """Return the way (2,) in metres from the body to a foot."""
        return (0.5 if number == 0 else -0.5) * self.walker.width_m * _forward(yaw_deg + 90.0)

    def _toe_out(self, number: int) -> float:
        return (1.0 if number == 0 else -1.0) * self.walker.toe_out_deg

    def _place_feet(self, rng: np.random.Generator) -> None:
        """Add the footprints of all bouts."""
        usual = _STRIDE_M_PER_M * self.walker.height_m
        for bout in self.bouts:
            count = len(bout.strikes_s)
            steps = np.diff(bout.strikes_s, prepend=bout.start_s)
            for index, (strike, step) in enumerate(zip(bout.strikes_s, steps, strict=True)):
                number = (bout.first + index) % 2
                before = self._prints[number]["place_m"][-1]
                cycle = (
                    float(steps[max(index, 1) - 1 : index + 2].mean()) * 2.0
                    if bout.kind == "walk"
                    else 2 * step
                )
                share = float(stance_share(np.array(bout.speed_m_s)))
                if bout.kind in _MID_STANCE:
                    later_s = _MID_STANCE[bout.kind] * min(cycle, 2.0 * float(np.median(steps)))
                    seen = min(strike + later_s, bout.end_s)
                    last = index >= count - 2
                    body = self.body(np.array([bout.end_s if index == count - 1 else seen]))[0]
                else:
                    done = (index // 2 + 1) / (count // 2)
                    ends = self.body(np.array([bout.start_s, bout.end_s]))
                    body, last = ends[0] + done * (ends[1] - ends[0]), index >= count - 2
                place = body[:2] + self._aside_of(number, body[2])
                if not last and bout.kind == "walk":
                    place = place + 0.008 * rng.normal(size=2)
                yaw = float(body[2]) + self._toe_out(number)
                stride = float((place - before) @ _forward(yaw)) / usual
                off = float(strike - (1.0 - share) * cycle)
                if index and bout.kind == "walk":
                    # The last steps take longer. The foot behind leaves the floor when it usually does.
                    both_s = (share - 0.5) * 2.0 * float(np.median(steps))
                    off = min(off, float(bout.strikes_s[index - 1]) + 1.15 * both_s)
                ahead, behind = 1.0, 1.0
                if bout.kind == "walk":
                    at = self.body(np.array([strike, off]))
                    ahead = float((place - at[0, :2]) @ _forward(at[0, 2])) / (_AHEAD * usual)
                    behind = float((at[1, :2] - before) @ _forward(at[1, 2])) / (_BEHIND * usual)
                self._add_print(
                    number,
                    off_s=off,
                    off_deg=_OFF_DEG[bout.kind] * float(np.clip(behind, 0.2, 1.15)) ** 0.7,
                    strike_s=float(strike),
                    place_m=place,
                    yaw_deg=yaw,
                    strike_deg=_STRIKE_DEG[bout.kind] * float(np.clip(ahead, 0.0, 1.15)),
                    cycle_s=cycle,
                    speed_m_s=bout.speed_m_s,
                    stride=stride,
                )


def smooth_step(x: FloatArray) -> FloatArray:
    """Return a smooth step from 0 to 1, with first and second derivatives of 0 at both ends and outside."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x**3 * (10 - 15 * x + 6 * x * x))


def _pairs_s(pairs: int) -> float:
    """Return the time at full speed, seconds, of pairs of steps on the spot or aside."""
    return max(pairs * _PAIR_S - _RAMP_S, 0.5 * pairs * _PAIR_S)


def _ramped(times_s: FloatArray, length_s: float, ramp_s: float) -> FloatArray:
    """Return the effort (T,) at times (T,). It starts and ends smoothly, and its rate is 1 between."""

    def start(t_s: FloatArray) -> FloatArray:
        x = np.clip(t_s / ramp_s, 0.0, None)
        return np.asarray(ramp_s * np.where(x < 1, x**4 * (2.5 - 3 * x + x * x), x - 0.5))

    return start(times_s) - start(times_s - (length_s - ramp_s))


def _forward(yaw_deg: float) -> FloatArray:
    """Return the direction (2,) over the floor of a body with this direction in degrees; 0: towards −y."""
    angle = np.radians(yaw_deg)
    return np.array([np.sin(angle), -np.cos(angle)])


def _bent_way(
    start_m: FloatArray, yaw_deg: float, lengths_m: tuple[float, float], bend_rad: float, radius_m: float
) -> FloatArray:
    """Return a straight way, a bend and a straight way: x, y, direction (degrees), curvature (1/m).

    The curvature changes smoothly, so that the bend is a little longer than its radius says.
    """
    arc = abs(bend_rad) * radius_m
    total = lengths_m[0] + arc + lengths_m[1]
    along = np.arange(0.0, total, _ARC_STEP_M)
    ease = min(0.5, 0.5 * arc)
    inside = smooth_step((along - lengths_m[0] + ease) / (2 * ease)) - smooth_step(
        (along - lengths_m[0] - arc + ease) / (2 * ease)
    )
    curvature = inside * bend_rad / (inside.sum() * _ARC_STEP_M)
    yaw = np.radians(yaw_deg) + np.concatenate([[0.0], np.cumsum(curvature[:-1]) * _ARC_STEP_M])
    steps = _ARC_STEP_M * np.column_stack([np.sin(yaw), -np.cos(yaw)])
    points = start_m + np.concatenate([np.zeros((1, 2)), np.cumsum(steps[:-1], axis=0)])
    return np.column_stack([points, np.degrees(yaw), curvature])
