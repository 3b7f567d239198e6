"""A walk whose feet stand still on the floor.

The motion of one instant is found in this order. The plan gives the place of the body and the footprints. A
foot in stance rolls over its footprint without slipping. The height of the root is the height at which the
knee of the standing leg has the angle of its curve. A foot in the air follows the curves of hip and knee of
its leg, with a smooth correction so that it leaves its old footprint and meets its new footprint. Then the
angles of both legs follow from the places of root and feet.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.spatial.transform import Rotation

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.skeleton import SkeletonModel
from bodycap_batch.synthetic.foot_roll import FootShape, foot_rotation, shape_of, toe_pitch_deg
from bodycap_batch.synthetic.gait import WalkStyle, local_rotations
from bodycap_batch.synthetic.gait_curves import (
    REFERENCE_M_S,
    hip_flexion_deg,
    knee_flexion_deg,
    pelvis_list_deg,
    stance_share,
    steps_per_s,
)
from bodycap_batch.synthetic.gait_plan import MARGIN_S, Plan, draw_walker, smooth_step
from bodycap_batch.synthetic.pressing import ArmAngles, rotation_about

_SIDES = ("Left", "Right")
_GRID_HZ = 100.0
"""Sampling rate (Hz) of the splines of the root and of the angles of the trunk and the arms."""
_FLAT_AT = 0.09
"""Share of the gait cycle from heel strike to the flat foot. Origin: the foot is flat at about 10 %."""
_HEEL_RISE_AT = 0.33
"""Share of the gait cycle from heel strike to the rise of the heel. Origin: 31 to 40 % (Perry and
Burnfield)."""
_RISE_POWER = 2.4
"""Power of the angle of the foot over time while the heel rises. Origin: the knee then follows its curve
until toe off."""
_ROLLING_DEG = 20.0
"""Angle of the foot at toe off, degrees, above which the foot rolls over the toes as in walking. With less,
the heel rises only while both feet stand."""
_RISE_POWERS = (1.3, 3.5)
"""Smallest and largest power of the angle of the foot over time. Origin: with less, the heel would rise with
a jerk; with more, the foot would be flat until shortly before toe off."""
_STANDING_KNEE_DEG = 5.0
"""Flexion of the knees of a standing person, degrees. Evidence: none."""
_STRAIGHTEST_KNEE_DEG = 3.0
"""Smallest flexion of a knee, degrees. Origin: a leg that is nearly straight needs fast changes of its angles
for small changes of its length."""
_SHIFT_SIGMA_S = 0.11
"""Standard deviation (seconds) of the smoothing of the weight between the feet. Evidence: none."""
_RISE_SIGMA = 0.034
"""Standard deviation of the smoothing of the height of the root, as a share of the gait cycle. Origin: the
height then has one maximum and one minimum a step, as in recorded walks."""
_STEPPING_KNEE_DEG = 9.0
"""Additional flexion of the knees in steps on the spot, aside and back, degrees. Evidence: none."""
_SOFT_REACH_M = 0.0008
"""Width (metres) of the smooth limit of the root's height by the length of the legs. Evidence: none."""
_SPREAD = 4
"""Standard deviation (samples of `_GRID_HZ`) of the smoothing of these limits. Evidence: none."""
_SWAY_SHARE = 0.62
"""Share of the distance between the body's path and the standing foot by which the pelvis moves to this foot.
Origin: the pelvis then moves 3 to 10 cm from side to side. Compare M. S. Orendurff et al., "The effect of
walking speed on center of mass displacement", J. Rehabil. Res. Dev. 41, 2004."""
_CLEARANCE_M = 0.012
"""Smallest height (metres) of the sole in the middle of the swing. Origin: the toes of walking people pass
about 1 to 2 cm above the floor (Winter 1991)."""
_SOFT_CLEARANCE_M = 0.004
"""Width (metres) of the smooth limit of the sole's height. Evidence: none."""
_LANDING_SHARE = 0.65
"""Speed of the foot shortly before heel strike, as a share of the speed of the body. Evidence: none."""
_LIFT_DEG = {"hip": 12.0, "knee": 27.0}
"""Flexion (degrees) of the leg in the middle of a short step, in addition to the curves. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Foot:
    """One foot: its shape and its N stances. The first one starts before the plan, the last ends after it.

    Attributes:
        side: ``Left`` or ``Right``.
        number: 0 for the left foot, 1 for the right foot.
        shape: Its shape.
        strike_s: (N,) times at which the foot touches the floor, seconds.
        off_s: (N,) times at which the foot leaves the floor, seconds.
        place_m: (N,2) places of the ankle above the floor, metres.
        yaw_deg: (N,) directions of the foot, degrees; 0: towards −y. They do not jump by 360 degrees.
        strike_deg: (N,) angles of the foot at the first contact, degrees; negative: the toes are up.
        off_deg: (N,) angles of the foot at the last contact, degrees; positive: the heel is up.
        cycle_s: (N,) durations of the gait cycle that ends with the swing before the stance, seconds.
        speed_m_s: (N,) speeds in this cycle, metres per second.
        stride: (N,) ways of the foot in the swing before the stance, forward, as shares of the usual stride.
        rise_power: (N,) power of the angle of the foot over time while the heel rises.
    """

    side: str
    number: int
    shape: FootShape
    strike_s: FloatArray
    off_s: FloatArray
    place_m: FloatArray
    yaw_deg: FloatArray
    strike_deg: FloatArray
    off_deg: FloatArray
    cycle_s: FloatArray
    speed_m_s: FloatArray
    stride: FloatArray
    rise_power: FloatArray

    def stance_at(self, t_s: FloatArray) -> tuple[IntArray, IntArray, BoolArray]:
        """Return the numbers of the latest stance (T,) and of the next one (T,), and if the foot stands (T,).

        The last stance has no next one, and is returned twice.
        """
        index = np.searchsorted(self.strike_s, t_s, side="right") - 1
        return index, self.after(index), t_s <= self.off_s[index]

    def after(self, index: IntArray) -> IntArray:
        """Return the numbers (T,) of the stances after other ones."""
        return np.minimum(index + 1, len(self.strike_s) - 1)

    def swung(self, index: IntArray, stands: BoolArray, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the part (T,) of the swing after a stance that is over, and the length (T,) of the swing.

        While the foot stands, they are 0 and 1.
        """
        start = self.off_s[index]
        length = np.where(stands, 1.0, self.strike_s[self.after(index)] - start)
        return np.where(stands, 0.0, t_s - np.where(stands, 0.0, start)) / length, length


class StanceWalk:
    """A walk with stance: the pose of the body at any time.

    Args:
        skeleton: Skeleton of the body in the T-pose, with HumanIK joint names.
        length_s: Latest common time of the capture, seconds. The walk also covers `MARGIN_S` seconds before
        time
            0 and after this time.
        style: What else the person does, as for `Walk`.
        rng: Source of randomness for plan and person.
    """

    def __init__(
        self, skeleton: SkeletonModel, length_s: float, style: WalkStyle, rng: np.random.Generator
    ) -> None:
        self.skeleton = skeleton
        for_person, for_plan, for_arms = rng.spawn(3)
        bones = {name: skeleton.offsets_m[index] for index, name in enumerate(skeleton.joints)}
        self._thigh_m = float(-bones["LeftLeg"][2])
        self._shank_m = float(-bones["LeftFoot"][2])
        self._hips_m = np.array([bones["LeftUpLeg"], bones["RightUpLeg"]])
        height_m = float((self._thigh_m + self._shank_m) / 0.491)
        self.walker = draw_walker(height_m, for_person)
        self.plan = Plan(
            length_s,
            style.t_pose_s + (1.0 if style.t_pose_s else 0.0),
            self.walker,
            style.on_the_spot,
            for_plan,
        )
        self._style = style
        pace = steps_per_s(np.array(self.walker.speed_m_s), height_m) * self.walker.step_gain
        self._rise_sigma_s = _RISE_SIGMA * 2.0 / float(pace)
        self._feet = tuple(self._planned_foot(number, side) for number, side in enumerate(_SIDES))
        self._build_splines(for_arms)
        self._corrections = tuple(self._find_corrections(foot) for foot in self._feet)

    def _planned_foot(self, number: int, side: str) -> Foot:
        """Return a foot with the footprints of the plan."""
        prints = self.plan.footprints(number)
        power = np.full(len(prints["strike_s"]), _RISE_POWER)
        return Foot(side=side, number=number, shape=shape_of(self.skeleton, side), rise_power=power, **prints)

    def pose(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return root positions (T,3) in the world (m) and local rotations (T,J,3,3) at common times (T,)."""
        t_s = np.asarray(t_s, dtype=np.float64)
        root, turns = self._root(t_s), self._turns(t_s)
        pelvis = rotation_about("ZYX", turns[:, :3])
        out = {"Hips": pelvis}
        for foot in self._feet:
            self._leg(foot, t_s, root, pelvis, out)
        self._trunk(turns, pelvis, out)
        for number, side in enumerate(_SIDES):
            self._arm(side, t_s, self._swings(t_s)[:, 2 * number : 2 * number + 2], out)
        return root, local_rotations(self.skeleton, out, len(t_s))

    def contacts(self, start_s: float, end_s: float) -> dict[str, FloatArray]:
        """Return the stances (N,2) of each foot, by side: heel strike and toe off, seconds.

        Only the stances that overlap the given time are returned. The first stance of the plan starts at
        −inf, and the last one ends at inf.
        """
        out = {}
        for foot in self._feet:
            stances = np.column_stack([foot.strike_s, foot.off_s])
            out[foot.side] = stances[(stances[:, 1] > start_s) & (stances[:, 0] < end_s)]
        return out

    # The plan at one instant.

    @staticmethod
    def _stance_pitch(foot: Foot, index: IntArray, t_s: FloatArray) -> FloatArray:
        """Return the angle (T,) of a foot in the stances `index` (T,), degrees."""
        after = (t_s - foot.strike_s[index]) / (_FLAT_AT * foot.cycle_s[index])
        later = foot.after(index)
        share = stance_share(foot.speed_m_s[later])
        early = np.where(foot.off_deg[index] > _ROLLING_DEG, share - _HEEL_RISE_AT, share - 0.5)
        rise_s = np.minimum(early * foot.cycle_s[later], 0.6 * (foot.off_s[index] - foot.strike_s[index]))
        with np.errstate(invalid="ignore"):
            risen = np.clip(1.0 - (foot.off_s[index] - t_s) / rise_s, 0.0, None)
        risen = np.where(np.isfinite(foot.off_s[index]), risen, 0.0)
        return np.asarray(
            foot.strike_deg[index] * (1.0 - smooth_step(after))
            + foot.off_deg[index] * risen ** foot.rise_power[index]
        )

    def _stance_ankle(self, foot: Foot, index: IntArray, t_s: FloatArray) -> FloatArray:
        """Return the ankle (T,3) of a foot in the stances `index` (T,), metres."""
        pitch = self._stance_pitch(foot, index, t_s)
        return foot.shape.ankle_on_floor(foot.place_m[index], foot.yaw_deg[index], pitch)

    def _foot_angles(self, foot: Foot, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return direction (T,) and angle (T,) of a foot, degrees."""
        index, later, stands = foot.stance_at(t_s)
        part, length = foot.swung(index, stands, t_s)
        start = foot.off_s[index]
        yaw = foot.yaw_deg[index] + smooth_step(part) * (foot.yaw_deg[later] - foot.yaw_deg[index])
        step = 1e-3
        edge = np.where(np.isfinite(start), start, 0.0)
        rate = (self._stance_pitch(foot, index, edge) - self._stance_pitch(foot, index, edge - step)) / step
        fall = smooth_step(part**0.8)
        coasting = rate * length * part * (1.0 - part) ** 5
        swing = foot.off_deg[index] * (1.0 - fall) + foot.strike_deg[later] * fall + coasting
        return yaw, np.asarray(np.where(stands, self._stance_pitch(foot, index, t_s), swing))

    def _cycle(self, foot: Foot, t_s: FloatArray) -> FloatArray:
        """Return the position (T,) in a leg's gait cycle, 0 to 1. It waits in the middle of long stances."""
        index, later, stands = foot.stance_at(t_s)
        share = stance_share(foot.speed_m_s[later])
        since = (t_s - foot.strike_s[index]) / foot.cycle_s[index]
        left = np.where(np.isfinite(foot.off_s[index]), foot.off_s[index] - t_s, 1e3) / foot.cycle_s[later]
        middle = 0.5 * share
        first, second = np.minimum(since, middle), np.maximum(share - left, middle)
        held = np.where(since < middle, first, second)
        part, _ = foot.swung(index, stands, t_s)
        return np.asarray(np.where(stands, held, share + part * (1.0 - share)))

    def _knee_curve(self, foot: Foot, t_s: FloatArray) -> FloatArray:
        """Return the flexion (T,) of the knee that the curves give, degrees."""
        index, later, stands = foot.stance_at(t_s)
        cycle = self._cycle(foot, t_s)
        newer = np.where(stands, smooth_step((cycle - 0.2) / 0.25), 1.0)
        stride = foot.stride[index] + newer * (foot.stride[later] - foot.stride[index])
        pace = foot.speed_m_s[index] + newer * (foot.speed_m_s[later] - foot.speed_m_s[index])
        size = np.clip(np.abs(stride) * 1.1, 0.0, 1.0)
        waits = foot.off_s[index] - foot.strike_s[index] - 0.8 * foot.cycle_s[index]
        apart = np.minimum(t_s - foot.strike_s[index], foot.off_s[index] - t_s) - 0.3 * foot.cycle_s[later]
        calm = np.where(stands & (waits > 0), smooth_step(apart / 0.4 + 0.5), 0.0)
        curve = knee_flexion_deg(cycle, np.maximum(pace, 0.6))
        weight = size * (1.0 - calm)
        still = _STANDING_KNEE_DEG + _STEPPING_KNEE_DEG * (1.0 - size) * (1.0 - calm) * (size > 0)
        return np.asarray(still * (1.0 - weight) + curve * weight)

    # The root.

    def _build_splines(self, rng: np.random.Generator) -> None:
        """Sample root, pelvis, trunk and arms, and build their splines."""
        t_s = np.arange(-MARGIN_S, self.plan.end_s, 1.0 / _GRID_HZ)
        body = self.plan.body(t_s)
        phase, size, speed = self._rhythm(t_s)
        ratio = size * np.clip(speed / REFERENCE_M_S, 0.4, 1.3)
        opposite = phase + 0.5
        listing = ratio * pelvis_list_deg(phase)  # Left side up.
        rotation = 4.2 * ratio * np.cos(2 * np.pi * (phase - 0.04))  # Left side to the front.
        tilt = 1.0 * ratio * np.cos(4 * np.pi * (phase - 0.02))
        # In the zero pose the left side is on +x and the face towards −y: the left side moves to the front by
        # a negative rotation about z, and up by a negative rotation about y.
        lean = self.walker.lean_deg * (0.4 + 0.6 * size) + 1.2 * ratio * np.cos(4 * np.pi * (phase - 0.1))
        thorax = -(3.6 * ratio * np.cos(2 * np.pi * (phase - 0.06)))
        drift = _slow_drift(t_s, rng, 3)
        turns = np.column_stack(
            [
                body[:, 2] - rotation,
                -listing,
                tilt,
                lean + 0.7 * drift[:, 0],
                rotation - thorax + 1.0 * drift[:, 1],
                0.75 * listing,
                body[:, 2] + 4.0 * drift[:, 2],
            ]
        )
        self._turns = CubicSpline(t_s, turns)
        swing = self.walker.arm_gain * size * np.clip(4.0 + 11.0 * speed / REFERENCE_M_S, 4.0, 22.0)
        arms = []
        for cycle in (opposite, phase):  # Each arm swings with the opposite leg.
            forth = np.cos(2 * np.pi * (cycle - 0.03))
            arms += [swing * (forth - 0.15), 14.0 + 0.45 * swing * (forth + 0.6)]
        self._swings = CubicSpline(t_s, np.column_stack(arms))
        weights = self._weights(t_s)
        sway = self._sway(t_s, body, weights)
        root = np.column_stack([body[:, :2] + sway, np.zeros(len(t_s))])
        pelvis = rotation_about("ZYX", turns[:, :3])
        root[:, 2] = self._height(t_s, root, pelvis)[0]
        for _ in range(2):
            self._root = CubicSpline(t_s, root)
            self._feet = tuple(self._with_rise(foot) for foot in self._feet)
            root[:, 2] = self._height(t_s, root, pelvis)[0]
        root[:, 2] = self._height(t_s, root, pelvis)[1]
        self._root = CubicSpline(t_s, root)

    def _height(self, t_s: FloatArray, root: FloatArray, pelvis: Rotation) -> tuple[FloatArray, FloatArray]:
        """Return the height (T,) of the root in metres at which the standing knees follow their curves.

        The leg in front counts from shortly before its heel strike. The second height (T,) is limited to what
        both legs can reach.
        """
        heights: list[FloatArray] = []
        loads: list[FloatArray] = []
        limits: list[FloatArray] = []
        for foot in self._feet:
            index, later, stands = foot.stance_at(t_s)
            both_s = self._both_s(foot, later)
            index = np.where(~stands & (t_s > foot.strike_s[later] - both_s), later, index)
            ankle = self._stance_ankle(foot, index, np.clip(t_s, foot.strike_s[index], foot.off_s[index]))
            hip = root * [1.0, 1.0, 0.0] + pelvis.apply(self._hips_m[foot.number])
            across2 = ((ankle - hip)[:, :2] ** 2).sum(axis=1)
            knee = np.maximum(self._knee_curve(foot, t_s), _STRAIGHTEST_KNEE_DEG)
            for degrees, out in ((knee, heights), (np.full_like(knee, _STRAIGHTEST_KNEE_DEG), limits)):
                reach2 = np.clip(self._reach_m(degrees) ** 2 - across2, 0.09, None)
                out.append(ankle[:, 2] + np.sqrt(reach2) - hip[:, 2])
            on = smooth_step((t_s - foot.strike_s[index]) / both_s + 0.8)
            off = smooth_step((foot.off_s[index] - t_s) / both_s - 0.8)
            loads.append(on * off + 1e-6)
            late = np.maximum(0.0, np.maximum(foot.strike_s[index] - t_s, t_s - foot.off_s[index]))
            late = np.maximum(0.0, late - 1.5 / _GRID_HZ)
            limits[-1] = limits[-1] + 40.0 * late**2 + 1.0 * late
        weights = np.array(loads) / np.sum(loads, axis=0)
        wanted = gaussian_filter1d((weights * np.array(heights)).sum(axis=0), self._rise_sigma_s * _GRID_HZ)
        limit = np.minimum(*limits)
        reached = limit - _SOFT_REACH_M * np.logaddexp(0.0, (limit - wanted) / _SOFT_REACH_M)
        # Spread each lowering over the time around it, so that it starts and ends smoothly.
        around = 2 * _SPREAD
        excess = maximum_filter1d(wanted - reached, 2 * around + 1)
        return wanted, np.asarray(wanted - gaussian_filter1d(excess, _SPREAD, radius=around))

    def _with_rise(self, foot: Foot) -> Foot:
        """Return a foot whose heel rises so that its knee has the angle of the curve when both feet stand.

        The time at which the other foot strikes counts.
        """
        index = np.flatnonzero(foot.off_deg > _ROLLING_DEG)
        if not len(index):
            return foot
        later = foot.after(index)
        share = stance_share(foot.speed_m_s[later])
        rise_s = np.minimum(
            (share - _HEEL_RISE_AT) * foot.cycle_s[later], 0.6 * (foot.off_s[index] - foot.strike_s[index])
        )
        both_s = self._both_s(foot, later)
        at = foot.off_s[index] - both_s
        hip = self._hip_at(foot, at)
        wanted = self._reach_m(np.maximum(self._knee_curve(foot, at), _STRAIGHTEST_KNEE_DEG))
        tried = np.linspace(0.0, 1.0, 60)
        misfit = []
        for part in tried:
            pitch = part * foot.off_deg[index]
            ankle = foot.shape.ankle_on_floor(foot.place_m[index], foot.yaw_deg[index], pitch)
            misfit.append(np.abs(np.linalg.norm(ankle - hip, axis=1) - wanted))
        best = np.maximum(tried[np.argmin(misfit, axis=0)], 1e-3)
        power = np.log(best) / np.log(1.0 - both_s / rise_s)
        powers = foot.rise_power.copy()
        powers[index] = np.clip(power, *_RISE_POWERS)
        return replace(foot, rise_power=powers)

    @staticmethod
    def _both_s(foot: Foot, index: IntArray) -> FloatArray:
        """Return the time (T,) in seconds for which both feet stand around the swings to `index` (T,)."""
        share = stance_share(foot.speed_m_s[index]) - 0.5
        return np.asarray(np.maximum(share, 0.05) * foot.cycle_s[index])

    def _reach_m(self, knee_deg: FloatArray) -> FloatArray:
        """Return the distance (T,) in metres from hip to ankle at a flexion (T,) of the knee, degrees."""
        a, b = self._thigh_m, self._shank_m
        return np.asarray(np.sqrt(a * a + b * b + 2 * a * b * np.cos(np.radians(knee_deg))))

    def _weights(self, t_s: FloatArray) -> FloatArray:
        """Return how much of the body each foot carries (T,2). The sum is 1."""
        loads = []
        for foot in self._feet:
            index, later, stands = foot.stance_at(t_s)
            both = np.maximum(2 * stance_share(foot.speed_m_s[later]) - 1.0, 0.1) * 0.5
            on = smooth_step((t_s - foot.strike_s[index]) / (both * foot.cycle_s[index]))
            off = smooth_step((foot.off_s[index] - t_s) / (both * foot.cycle_s[later]))
            loads.append(np.where(stands, np.minimum(on, off), 0.0) + 1e-6)
        both_loads = np.column_stack(loads)
        return np.asarray(both_loads / both_loads.sum(axis=1, keepdims=True))

    def _sway(self, t_s: FloatArray, body: FloatArray, weights: FloatArray) -> FloatArray:
        """Return by how much the pelvis moves from the path towards the standing foot (T,2), metres."""
        centre = np.zeros((len(t_s), 2))
        for foot in self._feet:
            index, _, _ = foot.stance_at(t_s)
            centre = centre + weights[:, foot.number, None] * foot.place_m[index]
        angle = np.radians(body[:, 2])
        left = np.column_stack([np.cos(angle), np.sin(angle)])
        aside = ((centre - body[:, :2]) * left).sum(axis=1)
        aside = gaussian_filter1d(aside, _SHIFT_SIGMA_S * _GRID_HZ)
        return np.asarray(_SWAY_SHARE * aside[:, None] * left)

    def _rhythm(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the position in the left leg's gait cycle, the size of the motion, and the speed, each (T,).

        The size is 0 while the person stands.
        """
        phase, size, speed = np.zeros_like(t_s), np.zeros_like(t_s), np.zeros_like(t_s)
        for bout in self.plan.bouts:
            inside = (t_s >= bout.start_s) & (t_s <= bout.end_s)
            strikes = np.concatenate([[bout.start_s], bout.strikes_s])
            first = (0.0 if bout.first == 0 else 0.5) - 0.5
            phase[inside] = CubicSpline(strikes, first + 0.5 * np.arange(len(strikes)))(t_s[inside])
            up = smooth_step((t_s[inside] - bout.start_s) / 0.8)
            down = smooth_step((bout.end_s - t_s[inside]) / 0.8)
            size[inside] = {"walk": 1.0, "back": 0.5}.get(bout.kind, 0.3) * up * down
            speed[inside] = bout.speed_m_s if bout.kind == "walk" else 0.6
        return phase, size, speed

    # The legs.

    def _curve_ankle(self, foot: Foot, index: IntArray, t_s: FloatArray) -> FloatArray:
        """Return the ankle (T,3) of the curves in the swings after the stances `index` (T,), metres."""
        later = index + 1
        start, end = foot.off_s[index], foot.strike_s[later]
        part = (t_s - start) / (end - start)
        share = stance_share(foot.speed_m_s[later])
        cycle = share + part * (1.0 - share)
        size = np.clip(np.abs(foot.stride[later]), 0.0, 1.3)
        small = np.clip(1.0 - size, 0.0, 1.0)
        middle = np.sin(np.pi * np.clip(part, 0.0, 1.0)) ** 2
        curve = knee_flexion_deg(cycle, np.maximum(foot.speed_m_s[later], 0.6))
        knee = np.minimum(size, 1.0) * curve + small * (_STANDING_KNEE_DEG + _LIFT_DEG["knee"] * middle)
        hip = size * hip_flexion_deg(cycle) * np.sign(foot.stride[later]) + small * _LIFT_DEG["hip"] * middle
        yaw = foot.yaw_deg[index] + smooth_step(part) * (foot.yaw_deg[later] - foot.yaw_deg[index])
        thigh, shank = np.radians(hip), np.radians(hip - knee)
        leg = np.column_stack(
            [
                np.zeros_like(t_s),
                -self._thigh_m * np.sin(thigh) - self._shank_m * np.sin(shank),
                -self._thigh_m * np.cos(thigh) - self._shank_m * np.cos(shank),
            ]
        )
        return np.asarray(self._hip_at(foot, t_s) + rotation_about("Z", yaw).apply(leg))

    def _hip_at(self, foot: Foot, t_s: FloatArray) -> FloatArray:
        """Return the hip (T,3) of a leg, metres."""
        pelvis = rotation_about("ZYX", self._turns(t_s)[:, :3])
        return np.asarray(self._root(t_s) + pelvis.apply(self._hips_m[foot.number]))

    def _find_corrections(self, foot: Foot) -> FloatArray:
        """Return the corrections (N−1,4,3) of the swings of a foot: place and speed, at start and end."""
        count = len(foot.strike_s) - 1
        index = np.arange(count)
        step = 1e-3
        out = np.zeros((count, 4, 3))
        for place, (times, stance) in enumerate(((foot.off_s[:-1], index), (foot.strike_s[1:], index + 1))):
            side = -step if place == 0 else step
            here = self._stance_ankle(foot, stance, times) - self._curve_ankle(foot, index, times)
            there = self._stance_ankle(foot, stance, times + side) - self._curve_ankle(
                foot, index, times + side
            )
            out[:, 2 * place], out[:, 2 * place + 1] = here, (there - here) / side
        out[:, 3, :2] += _LANDING_SHARE * self._root(foot.strike_s[1:], 1)[:, :2]
        return out

    def _ankle(self, foot: Foot, t_s: FloatArray, yaw_deg: FloatArray, pitch_deg: FloatArray) -> FloatArray:
        """Return the ankle (T,3) of a foot, metres."""
        index, _, stands = foot.stance_at(t_s)
        out = self._stance_ankle(foot, index, t_s)
        flying = ~stands
        if not flying.any():
            return out
        at, number = t_s[flying], index[flying]
        start, end = foot.off_s[number], foot.strike_s[number + 1]
        length = end - start
        x = (at - start) / length
        weights = np.column_stack(
            [
                (1 + 2 * x) * (1 - x) ** 2,
                x * (1 - x) ** 2 * length,
                x * x * (3 - 2 * x),
                x * x * (x - 1) * length,
            ]
        )
        fix = (weights[:, :, None] * self._corrections[foot.number][number]).sum(axis=1)
        ankle = self._curve_ankle(foot, number, at) + fix
        soles = foot.shape.soles(yaw_deg[flying], pitch_deg[flying])[:, :, 2].min(axis=1)
        least = _CLEARANCE_M * np.sin(np.pi * x) ** 2
        soft = _SOFT_CLEARANCE_M * np.sin(np.pi * x) ** 2 + 1e-9
        ankle[:, 2] = least - soles + soft * np.logaddexp(0.0, (ankle[:, 2] + soles - least) / soft)
        hips = self._hip_at(foot, at)
        way = ankle - hips
        distance = np.linalg.norm(way, axis=1)
        longest = float(self._reach_m(np.array(_STRAIGHTEST_KNEE_DEG)))
        kept = longest - soft * np.logaddexp(0.0, (longest - distance) / soft)
        out[flying] = hips + way * (kept / distance)[:, None]
        return out

    def _leg(
        self, foot: Foot, t_s: FloatArray, root: FloatArray, pelvis: Rotation, out: dict[str, Rotation]
    ) -> None:
        """Add the rotations of hip, knee, ankle and toes of one leg, so that the foot has its place."""
        yaw, pitch = self._foot_angles(foot, t_s)
        hip = root + pelvis.apply(self._hips_m[foot.number])
        way = self._ankle(foot, t_s, yaw, pitch) - hip
        a, b = self._thigh_m, self._shank_m
        distance = np.clip(np.linalg.norm(way, axis=1), abs(a - b) + 1e-6, a + b - 1e-9)
        knee = np.arccos(np.clip((distance**2 - a * a - b * b) / (2 * a * b), -1, 1))
        front = -pelvis.as_matrix()[:, :, 1] - foot_rotation(yaw, 0 * yaw).as_matrix()[:, :, 1]
        down = way / np.linalg.norm(way, axis=1, keepdims=True)
        side = np.cross(front, down)
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        in_world = np.stack([side, down, np.cross(side, down)], axis=-1)
        bent = np.column_stack([np.zeros_like(knee), b * np.sin(knee), -a - b * np.cos(knee)])
        bent /= np.linalg.norm(bent, axis=1, keepdims=True)
        across = np.tile([1.0, 0.0, 0.0], (len(knee), 1))
        in_thigh = np.stack([across, bent, np.cross(across, bent)], axis=-1)
        thigh = Rotation.from_matrix(in_world @ np.swapaxes(in_thigh, -1, -2))
        bend = Rotation.from_euler("X", knee[:, None])
        flat = foot_rotation(yaw, pitch)
        out[f"{foot.side}UpLeg"] = pelvis.inv() * thigh
        out[f"{foot.side}Leg"] = bend
        out[f"{foot.side}Foot"] = (thigh * bend).inv() * flat
        out[f"{foot.side}ToeBase"] = rotation_about("X", toe_pitch_deg(pitch) - pitch)

    # Trunk, head and arms.

    def _trunk(self, turns: FloatArray, pelvis: Rotation, out: dict[str, Rotation]) -> None:
        """Add the rotations of trunk, neck and head. The head stays level and looks along the path."""
        bend, turn = (self._style.posture.get(part, 0.0) for part in ("Bend", "Turn"))
        chest = pelvis
        for share, name in ((0.45, "Spine"), (0.55, "Spine1")):
            angles = np.column_stack(
                [share * (turns[:, 4] + turn), share * turns[:, 5], share * (turns[:, 3] + bend)]
            )
            out[name] = rotation_about("ZYX", angles)
            chest = chest * out[name]
        level = rotation_about("ZX", np.column_stack([turns[:, 6], np.full(len(turns), 3.0)]))
        half = Rotation.from_rotvec(0.5 * (chest.inv() * level).as_rotvec())
        out["Neck"] = out["Head"] = half

    def _arm(self, side: str, t_s: FloatArray, swing: FloatArray, out: dict[str, Rotation]) -> None:
        """Add the rotations of clavicle, shoulder, elbow and wrist of one arm."""
        outward, held = 1.0 if side == "Left" else -1.0, self._style.held(side)
        ahead = self._style.arms_ahead
        angles = ArmAngles(
            flexion=-3.0 + held["Arm"] + 25.0 * ahead + (1.0 - 0.6 * ahead) * swing[:, 0],
            abduction=np.full_like(t_s, 9.0 + held["Out"]),
            elbow=8.0 + held["Elbow"] + 60.0 * ahead + swing[:, 1],
            pronation=np.full_like(t_s, 8.0 + held["Twist"]),
            spin=np.full_like(t_s, held["Spin"]),
            wrist=0.1 * swing[:, 0],
            radial=np.zeros_like(t_s),
        )
        end_s = self._style.t_pose_s
        free = smooth_step(t_s - end_s) if end_s else np.ones_like(t_s)
        angles, lift = self._style.pressed(side, angles, np.zeros_like(t_s), t_s)
        turns = outward * np.column_stack([np.full_like(t_s, held["Ahead"]), lift + held["Lift"]])
        out.update({f"{side}Shoulder": rotation_about("ZY", -turns), **angles.rotations(side, free)})


def _slow_drift(t_s: FloatArray, rng: np.random.Generator, count: int) -> FloatArray:
    """Return slow random oscillations (T,count) with a root mean square of 1."""
    rates, phases = rng.uniform(0.07, 0.35, (4, count)), rng.uniform(0, 2 * np.pi, (4, count))
    waves = np.sin(2 * np.pi * rates * t_s[:, None, None] + phases)
    return np.asarray(waves.sum(axis=1) / np.sqrt(2.0))
