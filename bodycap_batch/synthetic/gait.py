"""A walking person, procedurally: a path with turns, gait phases, joint angles, reaching.

Nothing here is drawn from the priors of the skeleton stage (no random walk on velocities): joint angles are
periodic functions of a gait phase plus a few slow sinusoids, the path is a spline through chosen places.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.skeleton import SkeletonModel, forward_kinematics
from bodycap_batch.synthetic.pressing import ArmAngles, Press

_LAP_S = 13.0
# One lap: seconds, x, y (m, room's middle = 0), direction of the face (degrees from +x, counter-clockwise).
# It begins with steps to the right, facing a wall: the sideways movement from which a map starts well.
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
_TURN_S, _TURN_DEG, _SWAY_M = 5.0, 75.0, 0.02
"""On the spot: there and back again in so long, so far to either side, swaying by so much."""
_ARM_PARTS = ("Lift", "Ahead", "Arm", "Out", "Spin", "Elbow", "Twist")
_LATTICE_HZ = 50.0
_MARGIN_S = 4.0


@dataclass(frozen=True, slots=True)
class _Wobble:
    """A slow, band-limited change of an angle: a few sinusoids between 0.1 and 0.6 Hz."""

    amplitude: FloatArray
    rate_hz: FloatArray
    phase: FloatArray

    def __call__(self, t_s: FloatArray) -> FloatArray:
        waves = np.sin(2 * np.pi * self.rate_hz * t_s[:, None] + self.phase)
        return np.asarray((self.amplitude * waves).sum(axis=1))


def _wobble(degrees: float, rng: np.random.Generator) -> _Wobble:
    share = rng.uniform(0.3, 1.0, 4)
    return _Wobble(
        degrees * share / np.linalg.norm(share) * np.sqrt(2.0),
        rng.uniform(0.1, 0.6, 4),
        rng.uniform(0, 2 * np.pi, 4),
    )


@dataclass(frozen=True, slots=True)
class _Reach:
    """One arm reaching out: when, how long each ramp takes, and the extra angles (degrees)."""

    side: str
    start_s: float
    ramp_s: float
    hold_s: float
    flexion: float
    abduction: float
    elbow: float
    pronation: float

    def weight(self, t_s: FloatArray) -> FloatArray:
        """0 … 1, twice differentiable."""
        up = np.clip((t_s - self.start_s) / self.ramp_s, 0, 1)
        down = np.clip((t_s - self.start_s - self.ramp_s - self.hold_s) / self.ramp_s, 0, 1)
        return np.asarray(_smooth(up) - _smooth(down))


def _smooth(x: FloatArray) -> FloatArray:
    """Step from 0 to 1 with vanishing first and second derivative at both ends."""
    return np.asarray(x**3 * (10 - 15 * x + 6 * x * x))


def _bump(phase: FloatArray, centre_deg: float, width: float) -> FloatArray:
    """A smooth periodic bump of height 1."""
    return np.asarray(np.exp((np.cos(phase - np.radians(centre_deg)) - 1.0) / width**2))


def _about(axis: str, degrees: FloatArray) -> Rotation:
    return Rotation.from_euler(axis, degrees.reshape(-1, len(axis)), degrees=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class Habits:
    """What the walker does beside walking.

    Attributes:
        t_pose_s: The walker first stands with arms stretched out until then, at most.
        arms_ahead: 1 holds both forearms up before the chest, 0 lets them hang.
        presses: Hands laid against the chest.
        on_the_spot: Turns to both sides where it stands instead of walking.
        bearing: Degrees by which joints are held other than everyone's, where not 0: ``Bend`` and ``Turn``
            of the trunk, and with ``Left`` or ``Right`` before it ``Lift`` and ``Ahead`` of the shoulder,
            ``Arm`` (flexion), ``Out`` (abduction), ``Spin`` of the upper arm, ``Elbow`` and ``Twist``
            (pronation). Arms in a T-pose are stretched out all the same.
    """

    t_pose_s: float = 0.0
    arms_ahead: float = 0.0
    presses: tuple[Press, ...] = ()
    on_the_spot: bool = False
    bearing: Mapping[str, float] = field(default_factory=dict)


class Walk:
    """The built-in walker: poses of every joint at any time.

    Args:
        skeleton: A body with HumanIK names.
        length_s: Time to be covered, from a few seconds before 0.
        habits: What it does beside walking.
        rng: Source of the individual's gait.
    """

    def __init__(
        self, skeleton: SkeletonModel, length_s: float, habits: Habits, rng: np.random.Generator
    ) -> None:
        self.skeleton = skeleton
        self._t_pose_s = habits.t_pose_s
        self._arms_ahead = habits.arms_ahead
        self._presses = habits.presses
        self._bearing = habits.bearing
        # Streams of their own: a longer capture is the same walk, continued.
        for_path, for_reaches, rng = rng.spawn(3)
        self._way = (_draw_turns if habits.on_the_spot else _draw_path)(length_s, for_path)
        self._stride_gain = float(rng.uniform(0.92, 1.08))
        self._wobbles = {
            name: _wobble(degrees, rng)
            for name, degrees in (
                ("LeftArm", 3.0), ("RightArm", 3.0), ("LeftOut", 3.0), ("RightOut", 3.0), ("LeftElbow", 4.0),
                ("RightElbow", 4.0), ("LeftTwist", 5.0), ("RightTwist", 5.0), ("LeftWrist", 4.0),
                ("RightWrist", 4.0), ("LeftRadial", 3.0), ("RightRadial", 3.0), ("Bend", 1.5), ("Lean", 1.0),
                ("Turn", 3.0), ("Look", 9.0), ("Nod", 4.0),
            )
        }  # fmt: skip
        self._reaches = _draw_reaches(length_s, habits.t_pose_s, for_reaches)
        lattice = np.arange(-_MARGIN_S, length_s + _MARGIN_S, 1.0 / _LATTICE_HZ)
        speed = np.linalg.norm(self._path(lattice, 1)[:, :2], axis=1)
        cycles = np.cumsum(0.32 * np.tanh(speed / 0.1) + 0.45 * speed) / _LATTICE_HZ
        self._phase = CubicSpline(lattice, 2 * np.pi * (cycles + rng.uniform()))
        self._height = CubicSpline(lattice, self._standing_height(lattice))

    def pose(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Root positions (T,3) in the world (m) and local rotations (T,J,3,3) at times (T,)."""
        path = self._path(t_s)
        root = np.column_stack([path[:, :2], self._height(t_s)])
        return root, self._rotations(t_s)

    def _path(self, t_s: FloatArray, derivative: int = 0) -> FloatArray:
        """x, y (m) and heading (degrees), or their rates, (T,3); a T-pose comes first."""
        if self._t_pose_s == 0.0:
            return np.asarray(self._way(t_s, derivative))
        x = np.clip(t_s - self._t_pose_s, 0, None)
        rate = _smooth(np.minimum(x, 1.0))
        walked = np.where(x < 1, x**4 * (2.5 - 3 * x + x * x), x - 0.5)
        return np.asarray(self._way(walked, 1) * rate[:, None] if derivative else self._way(walked))

    def _standing_height(self, t_s: FloatArray) -> FloatArray:
        """Height of the root at which the lower foot touches the floor (soft minimum over the soles)."""
        poses = forward_kinematics(self.skeleton, np.zeros((len(t_s), 3)), self._rotations(t_s))
        soles = []
        for joint, name in enumerate(self.skeleton.joints):
            if name.endswith(("Foot", "ToeBase")):
                end = self.skeleton.end_offsets_m[joint]
                sole = np.nan_to_num(end) if np.isfinite(end).all() else np.array([0.0, 0.0, -self._ankle_m])
                soles.append((poses[:, joint, :3, :3] @ sole + poses[:, joint, :3, 3])[:, 2])
        softness_m = 0.01
        lowest = -softness_m * np.log(np.exp(-np.array(soles) / softness_m).sum(axis=0))
        return np.asarray(-lowest)

    @property
    def _ankle_m(self) -> float:
        toe = self.skeleton.joints.index("LeftToeBase")
        return float(-self.skeleton.offsets_m[toe, 2] - self.skeleton.end_offsets_m[toe, 2])

    def _rotations(self, t_s: FloatArray) -> FloatArray:
        """(T,J,3,3) parent_from_joint."""
        heading = self._path(t_s)[:, 2]
        velocity = self._path(t_s, 1)
        phase, wave = self._phase(t_s), self._wobbles
        angle = np.radians(heading)
        ahead = np.cos(angle) * velocity[:, 0] + np.sin(angle) * velocity[:, 1]
        aside = -np.sin(angle) * velocity[:, 0] + np.cos(angle) * velocity[:, 1]
        stride = self._stride_gain * np.tanh(ahead / 0.8)
        sidestep = self._stride_gain * np.tanh(aside / 0.6)
        alive = 1.0 - self._t_pose(t_s)
        out = {"Hips": _about("Z", heading + 90.0 + alive * 3.0 * stride * np.cos(phase))
               * _about("XY", np.column_stack([alive * 1.5 * np.cos(2 * phase) * np.abs(stride),
                                               alive * 2.0 * np.sin(phase) * np.abs(stride)]))}  # fmt: skip
        twist = alive * (wave["Turn"](t_s) - 3.0 * stride * np.cos(phase))
        bend, turn = (self._bearing.get(part, 0.0) for part in ("Bend", "Turn"))
        for share, name in ((0.45, "Spine"), (0.55, "Spine1")):
            angles = [
                share * twist + share * turn,
                share * alive * (2.0 + wave["Bend"](t_s)) + share * bend,
                share * alive * wave["Lean"](t_s),
            ]
            out[name] = _about("ZXY", np.column_stack(angles))
        look = [0.6 * alive * wave["Look"](t_s), 0.6 * alive * (wave["Nod"](t_s) + 3.0)]
        out["Neck"] = out["Head"] = _about("ZX", np.column_stack(look))
        for side, leg_phase in (("Left", phase + np.pi), ("Right", phase)):
            self._leg(side, leg_phase, (stride * alive, sidestep * alive), out)
            self._arm(side, t_s, (stride * np.cos(leg_phase + np.pi), alive), out)
        identity = Rotation.identity(len(t_s))
        return np.stack([out.get(name, identity).as_matrix() for name in self.skeleton.joints], axis=1)

    def _t_pose(self, t_s: FloatArray) -> FloatArray:
        """1 while the arms are stretched out, 0 from a second later."""
        return np.asarray(1.0 - _smooth(np.clip(t_s - self._t_pose_s, 0, 1))) if self._t_pose_s else 0.0 * t_s

    @staticmethod
    def _leg(
        side: str, phase: FloatArray, strides: tuple[FloatArray, FloatArray], out: dict[str, Rotation]
    ) -> None:
        """Hip, knee and ankle over the gait cycle (phase 0: that heel strikes).

        Source: the shape of sagittal joint angles in level walking, Winter, "Biomechanics and Motor
            Control of Human Movement", 2009.
        """
        stride, sidestep = strides
        effort = np.minimum(1.0, np.hypot(stride, sidestep))
        outward = 1.0 if side == "Left" else -1.0
        hip = stride * 20.0 * np.cos(phase) + 5.0 * effort
        knee = 3.0 + effort * (10.0 * _bump(phase, 45.0, 0.6) + 42.0 * _bump(phase, 255.0, 0.75))
        ankle = effort * (6.0 * _bump(phase, 150.0, 0.7) - 12.0 * _bump(phase, 225.0, 0.4))
        abduction = 2.0 + sidestep * outward * 9.0 * np.cos(phase)
        # Abduction swings the left leg towards +X: a negative turn about +Y.
        out[f"{side}UpLeg"] = _about("X", -hip) * _about("Y", -outward * abduction)
        out[f"{side}Leg"] = _about("X", knee)
        out[f"{side}Foot"] = _about("X", hip - knee - ankle)

    def _arm(
        self, side: str, t_s: FloatArray, swing: tuple[FloatArray, FloatArray], out: dict[str, Rotation]
    ) -> None:
        """Clavicle, shoulder, elbow and wrist: swing against the leg, slow habits, reaching."""
        forth, alive = swing
        wave, outward = self._wobbles, 1.0 if side == "Left" else -1.0
        held = {part: self._bearing.get(side + part, 0.0) for part in _ARM_PARTS}
        flexion = 4.0 + held["Arm"] + 11.0 * forth + wave[f"{side}Arm"](t_s)
        abduction = 10.0 + held["Out"] + wave[f"{side}Out"](t_s)
        elbow = 24.0 + held["Elbow"] + 7.0 * forth + wave[f"{side}Elbow"](t_s)
        pronation = 8.0 + held["Twist"] + wave[f"{side}Twist"](t_s)
        flexion, elbow = flexion + 25.0 * self._arms_ahead, elbow + 60.0 * self._arms_ahead
        lift = np.zeros_like(t_s)
        for reach in self._reaches:
            if reach.side == side:
                weight = reach.weight(t_s)
                flexion, abduction = flexion + weight * reach.flexion, abduction + weight * reach.abduction
                elbow, pronation = elbow + weight * reach.elbow, pronation + weight * reach.pronation
                lift = lift + weight * 5.0
        angles = ArmAngles(
            flexion=flexion,
            abduction=abduction,
            elbow=elbow,
            pronation=pronation,
            spin=np.full_like(t_s, held["Spin"]),
            wrist=wave[f"{side}Wrist"](t_s),
            radial=wave[f"{side}Radial"](t_s),
        )
        for press in self._presses:
            if press.side == side:
                angles, lift = press.blended(angles, t_s), lift * (1.0 - press.weight(t_s))
        shoulder = _about("Y", -outward * (alive * lift + held["Lift"]))
        if held["Ahead"]:
            shoulder = _about("Z", np.full_like(t_s, -outward * held["Ahead"])) * shoulder
        out[f"{side}Shoulder"] = shoulder
        out.update(angles.rotations(side, alive))


def _draw_path(length_s: float, rng: np.random.Generator) -> CubicSpline:
    """x, y (m) and heading (degrees) over time: laps through slightly different places."""
    rows = []
    for lap in range(-1, int(np.ceil(length_s / _LAP_S)) + 2):
        places = _LAP + np.array([lap * _LAP_S, 0.0, 0.0, lap * 360.0])
        places[:, 1:3] += rng.normal(0.0, 0.08, (len(places), 2))
        places[:, 3] += rng.normal(0.0, 5.0, len(places))
        rows.append(places)
    knots = np.concatenate(rows)
    return CubicSpline(knots[:, 0], knots[:, 1:])


def _draw_turns(length_s: float, rng: np.random.Generator) -> CubicSpline:
    """x, y (m) and heading (degrees) over time of somebody who stands and turns to both sides."""
    times = np.arange(-2.0 * _MARGIN_S, length_s + 2.0 * _MARGIN_S, 0.1)
    phase = rng.uniform(0, 2 * np.pi, 3)
    x, y = (_SWAY_M * np.sin(rate * times + phase[axis]) for axis, rate in enumerate((1.1, 0.9)))
    heading = 90.0 + _TURN_DEG * np.sin(2 * np.pi * times / _TURN_S + phase[2])
    return CubicSpline(times, np.column_stack([x, y, heading]))


def _draw_reaches(length_s: float, t_pose_s: float, rng: np.random.Generator) -> tuple[_Reach, ...]:
    """Arms reach in turn, forward or to the side, every two to four seconds."""
    out = []
    side = "Left" if rng.uniform() < 0.5 else "Right"
    start = 0.8 + (t_pose_s + 1.0 if t_pose_s > 0 else 0.0)
    while start < length_s:
        to_side = rng.uniform() < 0.4
        out.append(
            _Reach(
                side=side,
                start_s=start,
                ramp_s=float(rng.uniform(1.0, 1.3)),
                hold_s=float(rng.uniform(0.3, 0.8)),
                flexion=float(rng.uniform(8, 18) if to_side else rng.uniform(28, 42)),
                abduction=float(rng.uniform(30, 42) if to_side else rng.uniform(4, 12)),
                elbow=float(rng.uniform(-14, -6)),
                pronation=float(rng.uniform(10, 25)),
            )
        )
        start += float(rng.uniform(1.8, 3.2))
        side = "Right" if side == "Left" else "Left"
    return tuple(out)
