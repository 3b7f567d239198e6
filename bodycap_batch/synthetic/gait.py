"""A procedural walk: a path with bends, a gait phase, joint angles, and arms that reach out.

The velocities of this motion are not a random walk. So the motion differs from the motion model that the
merging stage assumes. Joint angles are periodic functions of a gait phase plus a few slow sinusoids. The path
is a spline through given positions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.skeleton import SkeletonModel, forward_kinematics
from bodycap_batch.synthetic.foot_roll import shape_of
from bodycap_batch.synthetic.gait_plan import MARGIN_S, smooth_step
from bodycap_batch.synthetic.pressing import ArmAngles, Press, rotation_about

_LAP_S = 13.0
"""Duration (seconds) of one lap of the path."""
_LAP = np.array(
    [
        [0.0, -1.60, -1.00, 90.0],
        [1.1, -1.05, -0.95, 92.0],
        [2.2, -0.45, -0.80, 72.0],
        [3.4, 0.40, -0.65, 40.0],
        [4.6, 1.30, -0.15, 45.0],
        [5.8, 1.75, 0.60, 88.0],
        [7.0, 1.30, 1.30, 150.0],
        [8.2, 0.35, 1.40, 192.0],
        [9.4, -0.60, 1.05, 218.0],
        [10.6, -1.40, 0.45, 262.0],
        [11.8, -1.75, -0.40, 345.0],
    ]
)
"""Positions on one lap. Columns: time (seconds); x and y (metres from the room's middle); direction of the
face (degrees from +x, counter-clockwise). The lap starts with steps to the right while the person faces a
wall, because a map is easy to initialise from sideways movement."""
_TURN_WAVES, _STILL_WAVES = (
    ((0.02, 1.1, 1.0), (0.02, 0.9, 1.0), (75.0, 2 * np.pi, 5.0)),
    ((0.003, 1.3, 1.0), (0.003, 0.9, 1.0), (0.4, 0.7, 1.0)),
)
"""Motion of a person who rotates on the spot, and of one who stands still, along x, y (m) and about the
vertical (degrees): amplitude, an angle (radians), and the time (s) in which the wave passes this angle."""
_STILL_NOD_DEG = 22.0
"""Nod (degrees) of a person who looks at a table. Neck and head each turn by 0.6 of it."""
_STILL_PARTS, _STILL_SHARE, _STILL_ARMS_AHEAD = ("Bend", "Lean", "Turn", "Look", "Nod"), 0.12, 0.7
"""Movements that are small in a person who stands still, the share that is left of them, and how far the arms
are ahead. Evidence: none."""
_ARM_PARTS = ("Lift", "Ahead", "Arm", "Out", "Spin", "Elbow", "Twist")
"""Names of the angles of an arm's posture, which `WalkStyle.posture` explains."""
_WAVING_PARTS = ("Arm", "Out", "Elbow", "Twist", "Wrist", "Radial")
"""Names of the angles of an arm that oscillate slowly."""
_SAMPLE_HZ = 50.0
"""Sampling rate (Hz) of the two splines that describe the gait phase and the height of the root."""


def _draw_oscillation(degrees: float, rng: np.random.Generator) -> Callable[[FloatArray], FloatArray]:
    """Draw a slow oscillation of an angle, which gives the angle (T,) in degrees at times (T,) in seconds.

    It is the sum of four sinusoids between 0.1 and 0.6 Hz. Its root mean square is about `degrees`.
    """
    weight = rng.uniform(0.3, 1.0, 4)
    amplitude = degrees * weight / np.linalg.norm(weight) * np.sqrt(2.0)
    rate_hz, phase = rng.uniform(0.1, 0.6, 4), rng.uniform(0, 2 * np.pi, 4)
    return lambda t_s: np.asarray(
        (amplitude * np.sin(2 * np.pi * rate_hz * t_s[:, None] + phase)).sum(axis=1)
    )


@dataclass(frozen=True, slots=True)
class _ArmReach:
    """A movement in which one arm reaches out and returns.

    Attributes:
        side: ``Left`` or ``Right``.
        start_s: Common time at which the movement starts, seconds.
        ramp_s: Duration of reaching out, and of returning, seconds.
        hold_s: Time for which the arm stays stretched out, seconds.
        degrees: Additional angles, degrees, by field of `ArmAngles`.
    """

    side: str
    start_s: float
    ramp_s: float
    hold_s: float
    degrees: Mapping[str, float]

    def weight(self, t_s: FloatArray) -> FloatArray:
        """Return the weight (T,) of the additional angles at common times (T,). It is smooth, 0 to 1."""
        since_s = t_s - self.start_s
        up = smooth_step(since_s / self.ramp_s)
        return np.asarray(up - smooth_step((since_s - self.ramp_s - self.hold_s) / self.ramp_s))


def _periodic_bump(phase: FloatArray, centre_deg: float, width: float) -> FloatArray:
    """Return a smooth periodic function (T,) of the phase (radians) with a peak of height 1 at a centre."""
    return np.asarray(np.exp((np.cos(phase - np.radians(centre_deg)) - 1.0) / width**2))


@dataclass(frozen=True, slots=True, kw_only=True)
class WalkStyle:
    """How a person walks, and what else the person does.

    Attributes:
        t_pose_s: Duration of the T-pose at the start, seconds.
        arms_ahead: How far both forearms are held up in front of the chest. 0: the arms hang; 1: the forearms
            are in front of the chest.
        presses: Times and angles at which a hand is held against the chest.
        on_the_spot: True: the person does not walk, but rotates to both sides on the spot.
        still: True: the person stands still and faces +y. Trunk and head hardly move, the arms are ahead.
        posture: Offset (degrees) of each joint angle from the mean of all people, by name. The offset of a
            missing name is 0. Names of the trunk: ``Bend`` (forward) and ``Turn`` (about the vertical). Names
            of an arm, with the prefix ``Left`` or ``Right``: ``Lift`` (shoulder girdle up), ``Ahead``
            (shoulder girdle forward), ``Arm`` (flexion of the shoulder), ``Out`` (abduction of the shoulder),
            ``Spin`` (axial rotation of the upper arm), ``Elbow`` (flexion) and ``Twist`` (pronation). In a
            T-pose, only the angles of the trunk and of the shoulder girdle are applied.
    """

    t_pose_s: float = 0.0
    arms_ahead: float = 0.0
    presses: tuple[Press, ...] = ()
    on_the_spot: bool = False
    still: bool = False
    posture: Mapping[str, float] = field(default_factory=dict)

    def held(self, side: str) -> dict[str, float]:
        """Return the angles of the posture of one arm (``Left`` or ``Right``), degrees, by name."""
        return {part: self.posture.get(side + part, 0.0) for part in _ARM_PARTS}

    def pressed(
        self, side: str, angles: ArmAngles, lift_deg: FloatArray, t_s: FloatArray
    ) -> tuple[ArmAngles, FloatArray]:
        """Return angles and rise (T,) of the shoulder girdle of one arm with the presses, at times (T,)."""
        for press in self.presses:
            if press.side == side:
                angles, lift_deg = press.blended(angles, t_s), lift_deg * (1.0 - press.weight(t_s))
        return angles, lift_deg


class Walk:
    """The built-in walk: the pose of the body at any time.

    Args:
        skeleton: Skeleton of the body, with HumanIK joint names.
        length_s: Latest common time of the capture, seconds. The walk also covers `MARGIN_S` seconds before
            time 0 and after this time.
        style: How the person walks.
        rng: Source of randomness for path and gait.
    """

    def __init__(
        self, skeleton: SkeletonModel, length_s: float, style: WalkStyle, rng: np.random.Generator
    ) -> None:
        self.skeleton = skeleton
        self._t_pose_s = style.t_pose_s
        self._arms_ahead = max(style.arms_ahead, _STILL_ARMS_AHEAD if style.still else 0.0)
        self._nod_deg = _STILL_NOD_DEG if style.still else 3.0
        self._style = style
        # Use separate random streams, so that a longer capture starts with the walk of a shorter capture.
        for_path, for_reaches, rng = rng.spawn(3)
        if style.still or style.on_the_spot:
            waves = _STILL_WAVES if style.still else _TURN_WAVES
            self._route = _draw_standing(length_s, waves, for_path)
        else:
            self._route = _draw_path(length_s, for_path)
        self._stride_gain = float(rng.uniform(0.92, 1.08))
        self._oscillations = {
            name: _draw_oscillation(
                degrees * (_STILL_SHARE if style.still and name in _STILL_PARTS else 1.0), rng
            )
            for name, degrees in (
                ("LeftArm", 3.0), ("RightArm", 3.0), ("LeftOut", 3.0), ("RightOut", 3.0), ("LeftElbow", 4.0),
                ("RightElbow", 4.0), ("LeftTwist", 5.0), ("RightTwist", 5.0), ("LeftWrist", 4.0),
                ("RightWrist", 4.0), ("LeftRadial", 3.0), ("RightRadial", 3.0), ("Bend", 1.5), ("Lean", 1.0),
                ("Turn", 3.0), ("Look", 9.0), ("Nod", 4.0),
            )
        }  # fmt: skip
        self._reaches = _draw_reaches(length_s, style.t_pose_s, for_reaches)
        sample_s = np.arange(-MARGIN_S, length_s + MARGIN_S, 1.0 / _SAMPLE_HZ)
        speed = np.linalg.norm(self._path(sample_s, 1)[:, :2], axis=1)
        cycles = np.cumsum(0.32 * np.tanh(speed / 0.1) + 0.45 * speed) / _SAMPLE_HZ
        self._phase = CubicSpline(sample_s, 2 * np.pi * (cycles + rng.uniform()))
        self._height = CubicSpline(sample_s, self._standing_height(sample_s))

    def pose(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return root positions (T,3) in the world (m) and local rotations (T,J,3,3) at common times (T,)."""
        path = self._path(t_s)
        root = np.column_stack([path[:, :2], self._height(t_s)])
        return root, self._rotations(t_s)

    def _path(self, t_s: FloatArray, derivative: int = 0) -> FloatArray:
        """Return x, y (m) and heading (degrees), or their derivatives with respect to time, as (T,3).

        During a T-pose the person stands at the start of the path.
        """
        if self._t_pose_s == 0.0:
            return np.asarray(self._route(t_s, derivative))
        x = np.clip(t_s - self._t_pose_s, 0, None)
        rate = smooth_step(x)
        walked = np.where(x < 1, x**4 * (2.5 - 3 * x + x * x), x - 0.5)
        return np.asarray(self._route(walked, 1) * rate[:, None] if derivative else self._route(walked))

    def _standing_height(self, t_s: FloatArray) -> FloatArray:
        """Return the height (T,) of the root in metres at which the lower foot touches the floor."""
        poses = forward_kinematics(self.skeleton, np.zeros((len(t_s), 3)), self._rotations(t_s))
        soles, flat = [], np.array([0.0, 0.0, -shape_of(self.skeleton, "Left").height_m])
        for joint, name in enumerate(self.skeleton.joints):
            if name.endswith(("Foot", "ToeBase")):
                end = self.skeleton.end_offsets_m[joint]
                sole = end if np.isfinite(end).all() else flat
                soles.append((poses[:, joint, :3, :3] @ sole + poses[:, joint, :3, 3])[:, 2])
        softness_m = 0.01  # smoothness of the minimum over the soles
        lowest = -softness_m * np.log(np.exp(-np.array(soles) / softness_m).sum(axis=0))
        return np.asarray(-lowest)

    def _rotations(self, t_s: FloatArray) -> FloatArray:
        """Return the rotations parent_from_joint (T,J,3,3) at common times (T,) in seconds."""
        heading = self._path(t_s)[:, 2]
        velocity = self._path(t_s, 1)
        phase, wave = self._phase(t_s), self._oscillations
        angle = np.radians(heading)
        ahead = np.cos(angle) * velocity[:, 0] + np.sin(angle) * velocity[:, 1]
        aside = -np.sin(angle) * velocity[:, 0] + np.cos(angle) * velocity[:, 1]
        stride = self._stride_gain * np.tanh(ahead / 0.8)
        sidestep = self._stride_gain * np.tanh(aside / 0.6)
        walk_weight = 1.0 - self._t_pose(t_s)
        effort = np.abs(stride)
        pelvis_yaw = heading + 90.0 + walk_weight * 3.0 * stride * np.cos(phase)
        pelvis_tilt = [
            walk_weight * 1.5 * np.cos(2 * phase) * effort,
            walk_weight * 2.0 * np.sin(phase) * effort,
        ]
        out = {"Hips": rotation_about("Z", pelvis_yaw) * rotation_about("XY", np.column_stack(pelvis_tilt))}
        twist = walk_weight * (wave["Turn"](t_s) - 3.0 * stride * np.cos(phase))
        bend, turn = (self._style.posture.get(part, 0.0) for part in ("Bend", "Turn"))
        for share, name in ((0.45, "Spine"), (0.55, "Spine1")):
            angles = [
                share * twist + share * turn,
                share * walk_weight * (2.0 + wave["Bend"](t_s)) + share * bend,
                share * walk_weight * wave["Lean"](t_s),
            ]
            out[name] = rotation_about("ZXY", np.column_stack(angles))
        look = [0.6 * walk_weight * wave["Look"](t_s), 0.6 * walk_weight * (wave["Nod"](t_s) + self._nod_deg)]
        out["Neck"] = out["Head"] = rotation_about("ZX", np.column_stack(look))
        for side, leg_phase in (("Left", phase + np.pi), ("Right", phase)):
            self._leg(side, leg_phase, (stride * walk_weight, sidestep * walk_weight), out)
            self._arm(side, t_s, (stride * np.cos(leg_phase + np.pi), walk_weight), out)
        return local_rotations(self.skeleton, out, len(t_s))

    def _t_pose(self, t_s: FloatArray) -> FloatArray:
        """Return the weight (T,) of the T-pose.

        The weight is 1 during the T-pose, and decreases to 0 within 1 s after the T-pose.
        """
        return 1.0 - smooth_step(t_s - self._t_pose_s) if self._t_pose_s else 0.0 * t_s

    @staticmethod
    def _leg(
        side: str, phase: FloatArray, strides: tuple[FloatArray, FloatArray], out: dict[str, Rotation]
    ) -> None:
        """Add the rotations of hip, knee and ankle of one leg over the gait cycle.

        At phase 0 the heel of this leg touches the ground.

        Source: the shape of sagittal joint angles during walking on horizontal ground, Winter, "Biomechanics
            and Motor Control of Human Movement", 2009.
        """
        stride, sidestep = strides
        effort = np.minimum(1.0, np.hypot(stride, sidestep))
        outward = 1.0 if side == "Left" else -1.0
        hip = stride * 20.0 * np.cos(phase) + 5.0 * effort
        knee = 3.0 + effort * (
            10.0 * _periodic_bump(phase, 45.0, 0.6) + 42.0 * _periodic_bump(phase, 255.0, 0.75)
        )
        ankle = effort * (6.0 * _periodic_bump(phase, 150.0, 0.7) - 12.0 * _periodic_bump(phase, 225.0, 0.4))
        abduction = 2.0 + sidestep * outward * 9.0 * np.cos(phase)
        # Abduction swings the left leg towards +X: a negative rotation about +Y.
        out[f"{side}UpLeg"] = rotation_about("X", -hip) * rotation_about("Y", -outward * abduction)
        out[f"{side}Leg"] = rotation_about("X", knee)
        out[f"{side}Foot"] = rotation_about("X", hip - knee - ankle)

    def _arm(
        self, side: str, t_s: FloatArray, swing: tuple[FloatArray, FloatArray], out: dict[str, Rotation]
    ) -> None:
        """Add the rotations of clavicle, shoulder, elbow and wrist of one arm.

        The arm swings opposite to the leg. Slow oscillations, reaching and presses are added.
        """
        forth, walk_weight = swing
        held, ahead = self._style.held(side), self._arms_ahead
        wave = {part: self._oscillations[side + part](t_s) for part in _WAVING_PARTS}
        degrees: dict[str, FloatArray] = {
            "flexion": 4.0 + held["Arm"] + 11.0 * forth + wave["Arm"] + 25.0 * ahead,
            "abduction": 10.0 + held["Out"] + wave["Out"],
            "elbow": 24.0 + held["Elbow"] + 7.0 * forth + wave["Elbow"] + 60.0 * ahead,
            "pronation": 8.0 + held["Twist"] + wave["Twist"],
            "spin": np.full_like(t_s, held["Spin"]),
            "wrist": wave["Wrist"],
            "radial": wave["Radial"],
        }
        lift = np.zeros_like(t_s)
        for reach in self._reaches:
            if reach.side == side:
                weight = reach.weight(t_s)
                for name, extra in reach.degrees.items():
                    degrees[name] = degrees[name] + weight * extra
                lift = lift + weight * 5.0
        angles, lift = self._style.pressed(side, ArmAngles(**degrees), lift, t_s)
        outward = 1.0 if side == "Left" else -1.0
        shoulder = rotation_about("Y", -outward * (walk_weight * lift + held["Lift"]))
        if held["Ahead"]:
            shoulder = rotation_about("Z", np.full_like(t_s, -outward * held["Ahead"])) * shoulder
        out.update({f"{side}Shoulder": shoulder, **angles.rotations(side, walk_weight)})


def local_rotations(skeleton: SkeletonModel, turns: Mapping[str, Rotation], count: int) -> FloatArray:
    """Return the rotations parent_from_joint (T,J,3,3) at `count` times; without one, the identity."""
    identity = Rotation.identity(count)
    return np.stack([turns.get(name, identity).as_matrix() for name in skeleton.joints], axis=1)


def _draw_path(length_s: float, rng: np.random.Generator) -> CubicSpline:
    """Return x, y (m) and heading (degrees) over time. Each lap has slightly different positions."""
    rows = []
    for lap in range(-1, int(np.ceil(length_s / _LAP_S)) + 2):
        places = _LAP + np.array([lap * _LAP_S, 0.0, 0.0, lap * 360.0])
        places[:, 1:3] += rng.normal(0.0, 0.08, (len(places), 2))
        places[:, 3] += rng.normal(0.0, 5.0, len(places))
        rows.append(places)
    knots = np.concatenate(rows)
    return CubicSpline(knots[:, 0], knots[:, 1:])


def _draw_standing(
    length_s: float, waves: tuple[tuple[float, float, float], ...], rng: np.random.Generator
) -> CubicSpline:
    """Return x, y (m) and heading (degrees) over time for a person who stays in one place and faces +y."""
    times = np.arange(-2.0 * MARGIN_S, length_s + 2.0 * MARGIN_S, 0.1)
    x, y, heading = (
        size * np.sin(rate * times / period_s + phase)
        for (size, rate, period_s), phase in zip(waves, rng.uniform(0, 2 * np.pi, 3), strict=True)
    )
    return CubicSpline(times, np.column_stack([x, y, 90.0 + heading]))


def _draw_reaches(length_s: float, t_pose_s: float, rng: np.random.Generator) -> tuple[_ArmReach, ...]:
    """Draw the movements in which an arm reaches out forward or to the side.

    The left and the right arm alternate. A movement starts every 1.8 to 3.2 seconds.
    """
    out = []
    side = "Left" if rng.uniform() < 0.5 else "Right"
    start = 0.8 + (t_pose_s + 1.0 if t_pose_s > 0 else 0.0)
    while start < length_s:
        to_side = rng.uniform() < 0.4
        out.append(
            _ArmReach(
                side=side,
                start_s=start,
                ramp_s=float(rng.uniform(1.0, 1.3)),
                hold_s=float(rng.uniform(0.3, 0.8)),
                degrees={
                    "flexion": float(rng.uniform(*((8, 18) if to_side else (28, 42)))),
                    "abduction": float(rng.uniform(*((30, 42) if to_side else (4, 12)))),
                    "elbow": float(rng.uniform(-14, -6)),
                    "pronation": float(rng.uniform(10, 25)),
                },
            )
        )
        start += float(rng.uniform(1.8, 3.2))
        side = "Right" if side == "Left" else "Left"
    return tuple(out)
