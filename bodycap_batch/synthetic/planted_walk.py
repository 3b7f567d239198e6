"""A walk whose feet stand still on the floor: the root follows from joint angles and the standing foot.

The joint angles are the curves of level walking over the gait cycle. The lowest points of the feet do not
move: their height gives the height of the root, and their velocity gives the velocity of the root. So the
trunk rises, falls and sways as the angles make it. The walk starts, stops and turns.

Source of the angles: D. A. Winter, "Biomechanics and Motor Control of Human Movement", 4th ed., appendix A;
M. P. Murray, A. B. Drought, R. C. Kory, "Walking patterns of normal men", Journal of Bone and Joint Surgery
46-A, 1964 (pelvis, arms).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.skeleton import SkeletonModel, forward_kinematics

_HIP = (
    (0, 26),
    (10, 24),
    (20, 16),
    (30, 6),
    (40, -3),
    (50, -10),
    (57, -9),
    (64, 2),
    (74, 18),
    (86, 28),
    (94, 29),
)
"""Flexion of the hip (degrees) at shares of the gait cycle (per cent), which starts when the heel touches."""
_KNEE = (
    (0, 4),
    (8, 14),
    (15, 19),
    (25, 15),
    (40, 6),
    (50, 12),
    (60, 36),
    (66, 52),
    (72, 60),
    (80, 49),
    (90, 18),
)
"""Flexion of the knee (degrees) at shares of the gait cycle (per cent)."""
_ANKLE = ((0, 0), (7, -5), (20, 4), (45, 10), (53, 3), (62, -18), (72, -7), (82, 1), (92, 1))
"""Flexion of the ankle, toes up (degrees), at shares of the gait cycle (per cent)."""
_PELVIS_YAW_DEG, _PELVIS_LIST_DEG, _TRUNK_YAW_DEG, _ARM_DEG, _ELBOW_DEG = 4.0, 3.0, 7.0, 18.0, 20.0
"""Amplitudes (degrees) of the pelvis's yaw and list, of the trunk's yaw against the pelvis and of the upper
arms, and the mean flexion of the elbows."""
_ADDUCTION_DEG = 2.0
"""Amplitude (degrees) by which the standing leg leans inward. Derivation: the hips sway by ± 2 cm."""
_SAMPLE_HZ = 200.0
"""Samples per second of the walk. Derivation: the foot moves by 2 cm between two samples at most."""
_SOFTNESS_M = 0.004
"""Height (metres) over which the support changes from one point of the feet to another. Evidence: none."""
_MARGIN_S = 4.0
"""Additional time (s) that the motion covers before and after the capture."""
_HEEL = 0.05
"""Distance from the ankle back to the heel, as a ratio to the height of the hips."""
_LATE_CONTACT = 0.08
"""Share of the gait cycle by which the feet touch the floor later than in the curves. Derivation: the lowest
point changes from one foot to the other at 0.12 to 0.16, the middle of the time on both feet is at 0.06."""
_STRIDE_S = (1.0, 1.25)
"""Range of the duration (s) of a stride. Source: as in the text above."""
_STRENGTH = (0.88, 1.08)
"""Range of the ratio of the angles to the curves. Smaller ratios give shorter steps."""
_START_S = 0.8
"""Time (s) in which the walk starts or stops. Evidence: none."""
_TURN_DEG = (40.0, 110.0)
"""Range of the change (degrees) of the heading in each turn, always to one side, so that the walk stays in a
room. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlantedStyle:
    """How a person walks.

    Attributes:
        stride_s: Duration of a stride, seconds.
        strength: Ratio of the joint angles to the curves.
        pauses: (start, end) of the times at which the person stands, seconds.
        turns: (start, end, degrees) of the turns to the left.
    """

    stride_s: float = 1.1
    strength: float = 1.0
    pauses: tuple[tuple[float, float], ...] = ()
    turns: tuple[tuple[float, float, float], ...] = ()


def draw_style(length_s: float, rng: np.random.Generator) -> PlantedStyle:
    """Draw at random how a person walks for a time: pace, a pause every 8 to 12 s, turns to one side."""
    pauses, turns, at = [], [], float(rng.uniform(0.5, 1.5))
    pauses.append((-_MARGIN_S, at))
    side = 1.0 if rng.uniform() < 0.5 else -1.0
    while at < length_s:
        stop = at + float(rng.uniform(8.0, 12.0))
        turn = at + float(rng.uniform(0.5, 1.5))
        while turn < stop - _START_S:
            end = turn + float(rng.uniform(1.5, 2.5))
            turns.append((turn, end, side * float(rng.uniform(*_TURN_DEG))))
            turn = end + float(rng.uniform(0.3, 1.5))
        at = stop + float(rng.uniform(1.5, 2.5))
        pauses.append((stop, at))
    return PlantedStyle(
        stride_s=float(rng.uniform(*_STRIDE_S)),
        strength=float(rng.uniform(*_STRENGTH)),
        pauses=tuple(pauses),
        turns=tuple(turns),
    )


class PlantedWalk:
    """The walk: the pose of the body at any time.

    Args:
        skeleton: Skeleton of the body, with HumanIK joint names, in the T-pose.
        length_s: Latest common time of the capture, seconds.
        style: How the person walks.
    """

    def __init__(self, skeleton: SkeletonModel, length_s: float, style: PlantedStyle) -> None:
        self.skeleton = skeleton
        times = np.arange(-_MARGIN_S, length_s + _MARGIN_S, 1.0 / _SAMPLE_HZ)
        weight = _pause_weight(times, style.pauses)
        cycles = np.concatenate([[0.0], np.cumsum(weight[:-1])]) / _SAMPLE_HZ / style.stride_s
        heading = np.zeros(len(times))
        for start, end, degrees in style.turns:
            heading += degrees * _smooth_step((times - start) / (end - start))
        local = _joint_rotations(skeleton, cycles, style.strength * weight, heading)
        root = _planted_root(skeleton, local)
        inside = (times >= 0.0) & (times <= length_s)
        middle = 0.5 * (root[inside, :2].min(axis=0) + root[inside, :2].max(axis=0))
        root[:, :2] -= middle
        self._times, self._root = times, CubicSpline(times, root)
        self._cycles = CubicSpline(times, cycles)
        self._weight = CubicSpline(times, style.strength * weight)
        self._heading = CubicSpline(times, heading)

    def pose(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return root positions (T,3) in the world (m) and local rotations (T,J,3,3) at common times (T,)."""
        t_s = np.clip(t_s, self._times[0], self._times[-1])
        local = _joint_rotations(self.skeleton, self._cycles(t_s), self._weight(t_s), self._heading(t_s))
        return np.asarray(self._root(t_s)), local


def _pause_weight(times: FloatArray, pauses: tuple[tuple[float, float], ...]) -> FloatArray:
    """Return (T,) 1 while the person walks, 0 while the person stands, with smooth changes."""
    out = np.ones(len(times))
    for start, end in pauses:
        out *= 1.0 - _smooth_step((times - start) / _START_S) * (1.0 - _smooth_step((times - end) / _START_S))
    return out


def _joint_rotations(
    skeleton: SkeletonModel, cycles: FloatArray, strength: FloatArray, heading_deg: FloatArray
) -> FloatArray:
    """Return the rotations parent_from_joint (T,J,3,3).

    Args:
        skeleton: The skeleton.
        cycles: (T,) number of strides so far; the right heel touches the floor at whole numbers.
        strength: (T,) ratio of the joint angles to the curves.
        heading_deg: (T,) heading of the walk, degrees.
    """
    phase = 2.0 * np.pi * (cycles - _LATE_CONTACT)
    yaw = heading_deg + strength * _PELVIS_YAW_DEG * np.cos(phase)
    tilt = strength * _PELVIS_LIST_DEG * np.sin(phase)
    out = {"Hips": _turn("ZY", np.column_stack([yaw, tilt]))}
    back = -strength * _TRUNK_YAW_DEG * np.cos(phase)
    for name in ("Spine", "Spine1"):
        angles = np.column_stack([0.5 * back, -0.5 * tilt, np.full_like(back, 1.5)])
        out[name] = _turn("ZYX", angles)
    for side, shift, outward in (("Right", 0.0, -1.0), ("Left", 0.5, 1.0)):
        share = np.mod(cycles + shift, 1.0)
        hip, knee, ankle = (strength * _periodic(curve)(share) for curve in (_HIP, _KNEE, _ANKLE))
        # The adduction is relative to the pelvis, whose list turns the leg outward.
        swayed = _ADDUCTION_DEG + _PELVIS_LIST_DEG
        adduction = strength * swayed * np.sin(phase + 2.0 * np.pi * shift)
        rotation = np.column_stack([-hip, outward * adduction])
        out[f"{side}UpLeg"] = _turn("XY", rotation)
        out[f"{side}Leg"] = _turn("X", knee)
        out[f"{side}Foot"] = _turn("X", -ankle)
        lowered = -hip + knee - ankle
        out[f"{side}ToeBase"] = _turn("X", -np.maximum(lowered, 0.0))
        swing = strength * _ARM_DEG * np.cos(phase + 2.0 * np.pi * shift)
        hanging = Rotation.from_euler("Y", outward * 80.0, degrees=True)
        out[f"{side}Arm"] = _turn("X", swing) * hanging
        bend = -outward * (_ELBOW_DEG - 0.4 * swing)
        out[f"{side}ForeArm"] = _turn("Z", bend)
    identity = Rotation.identity(len(cycles))
    return np.stack([out.get(name, identity).as_matrix() for name in skeleton.joints], axis=1)


def _planted_root(skeleton: SkeletonModel, local: FloatArray) -> FloatArray:
    """Return the path (T,3) of the root for which the lowest points of the feet stand still on the floor."""
    poses = forward_kinematics(skeleton, np.zeros((len(local), 3)), local)
    hips_m = float(skeleton.offsets_m[0, 2])
    points = []
    for side in ("Left", "Right"):
        foot, toe = (skeleton.joints.index(side + part) for part in ("Foot", "ToeBase"))
        drop = float(skeleton.offsets_m[toe, 2] + np.nan_to_num(skeleton.end_offsets_m[toe, 2]))
        heel = np.array([0.0, _HEEL * hips_m, drop])
        ball = skeleton.offsets_m[toe] * [1.0, 1.0, 0.0] + [0.0, 0.0, drop]
        points += [poses[:, foot, :3, 3] + poses[:, foot, :3, :3] @ point for point in (heel, ball)]
    at = np.stack(points, axis=1)
    lowest = at[:, :, 2].min(axis=1, keepdims=True)
    weight = np.exp(-(at[:, :, 2] - lowest) / _SOFTNESS_M)
    weight /= weight.sum(axis=1, keepdims=True)
    velocity = -(np.gradient(at[:, :, :2], axis=0) * weight[:, :, None]).sum(axis=1)
    path = np.cumsum(velocity, axis=0)
    height = -(at[:, :, 2] * weight).sum(axis=1)
    return np.column_stack([path, height])


def _turn(axes: str, degrees: FloatArray | float) -> Rotation:
    """Return rotations by Euler angles (T,len(axes)) in degrees about the intrinsic axes `axes`."""
    return Rotation.from_euler(axes, np.reshape(degrees, (-1, len(axes))), degrees=True)


def _periodic(curve: tuple[tuple[float, float], ...]) -> CubicSpline:
    """Return a curve of values at shares of the cycle (per cent) as a function of the share 0 to 1."""
    knots = np.array([*curve, (100.0, curve[0][1])], dtype=np.float64)
    return CubicSpline(knots[:, 0] / 100.0, knots[:, 1], bc_type="periodic")


def _smooth_step(x: FloatArray) -> FloatArray:
    """Return a smooth step from 0 to 1. Its first and second derivatives are zero at both ends."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x**3 * (10.0 - 15.0 * x + 6.0 * x * x))
