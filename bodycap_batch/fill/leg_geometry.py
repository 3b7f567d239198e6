"""The lengths and the zero pose of the legs of a skeleton."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.fill_data import SIDES
from bodycap_batch.model.skeleton import SkeletonModel
from bodycap_batch.model.skeleton_presets import ANKLE_OVER_LEG, rest_positions

_FLAT_TOLERANCE_M = 0.02
"""Maximum difference (metres) between the drop from ankle to toe in the zero pose and the height of the ankle
for which the foot of the zero pose counts as flat on the floor. Evidence: none."""

_TOE_HEIGHT_M = 0.005
"""Height (metres) of the end of the toes above the floor while a foot stands, for a foot that is not flat in
the zero pose. Derivation: the middle of the permitted range of −0.5 to +1 cm, rounded up."""

_FOOT_OVER_LEG = 0.152 / 0.491
"""Ratio of the length of the foot to the length of the leg, for a skeleton without toes. Source: R. Drillis,
R. Contini, "Body segment parameters", 1966."""


_HEEL_OVER_LEG = 0.05
"""Distance from the ankle back to the heel, as a ratio to the length of the leg. Derivation: 4 cm for a leg
of 0.8 m, a quarter of the length of the foot behind the ankle less the soft heel."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LegGeometry:
    """One leg of a skeleton. Vectors are in the axes of the zero pose: z up, −y forward, metres.

    Attributes:
        chain: Indices of the joints below the root down to the hip, the hip last.
        hip: Index of the hip joint.
        knee: Index of the knee.
        ankle: Index of the ankle.
        below: Indices of all joints below the ankle.
        toe: Index of the joint of the toes; None if the foot has no such joint.
        thigh_m: (3,) from hip to knee.
        shin_m: (3,) from knee to ankle.
        ball_m: (3,) from the ankle to the joint of the toes, or to the end of a foot without toes.
        toe_m: (3,) from the joint of the toes to the end of the toes.
        flat_pitch_rad: Angle by which the toes of the foot are lowered against the zero pose while the foot
            stands flat.
        ankle_height_m: Height of the ankle above the floor while the foot stands flat.
    """

    chain: tuple[int, ...]
    hip: int
    knee: int
    ankle: int
    below: tuple[int, ...]
    toe: int | None
    thigh_m: FloatArray
    shin_m: FloatArray
    ball_m: FloatArray
    toe_m: FloatArray
    flat_pitch_rad: float
    ankle_height_m: float

    @property
    def length_m(self) -> float:
        """Length of the straight leg from hip to ankle, metres."""
        return float(np.linalg.norm(self.thigh_m) + np.linalg.norm(self.shin_m))

    @property
    def ball_ahead_m(self) -> float:
        """Distance from the ankle forward to the ball of the flat foot, metres."""
        forward = float(np.hypot(self.ball_m[0], self.ball_m[1]))
        cos, sin = np.cos(self.flat_pitch_rad), np.sin(self.flat_pitch_rad)
        return float(forward * cos + self.ball_m[2] * sin)

    @property
    def ankle_over_ball_m(self) -> float:
        """Height of the ankle above the ball of the flat foot, metres."""
        forward = float(np.hypot(self.ball_m[0], self.ball_m[1]))
        cos, sin = np.cos(self.flat_pitch_rad), np.sin(self.flat_pitch_rad)
        return float(forward * sin - self.ball_m[2] * cos)

    @property
    def heel_behind_m(self) -> float:
        """Distance from the ankle back to the heel, metres."""
        return _HEEL_OVER_LEG * self.length_m

    @property
    def heel_m(self) -> FloatArray:
        """Vector (3,) from the ankle to the bottom of the heel, in the axes of the zero pose, metres."""
        cos, sin = np.cos(self.flat_pitch_rad), np.sin(self.flat_pitch_rad)
        back, down = self.heel_behind_m, -self.ankle_height_m
        return np.array([0.0, cos * back + sin * down, cos * down - sin * back])

    def reach_m(self, knee_rad: FloatArray) -> FloatArray:
        """Return the distance (N,) between hip and ankle at a flexion (N,) of the knee, metres."""
        thigh, shin = float(np.linalg.norm(self.thigh_m)), float(np.linalg.norm(self.shin_m))
        return np.asarray(np.sqrt(thigh**2 + shin**2 + 2.0 * thigh * shin * np.cos(knee_rad)))

    def knee_rad(self, distance: FloatArray) -> FloatArray:
        """Return the flexion (N,) of the knee at a distance (N,) between hip and ankle, metres."""
        thigh, shin = float(np.linalg.norm(self.thigh_m)), float(np.linalg.norm(self.shin_m))
        return np.asarray(
            np.arccos(np.clip((distance**2 - thigh**2 - shin**2) / (2.0 * thigh * shin), -1.0, 1.0))
        )

    def drop_m(self, pitch_rad: FloatArray, toe_rad: FloatArray) -> FloatArray:
        """Return how far the lowest point of the foot is below the ankle (N,), metres.

        Args:
            pitch_rad: (N,) angle by which the toes are lowered against the flat foot.
            toe_rad: (N,) angle by which the toes are raised against the foot.
        """
        whole = pitch_rad + self.flat_pitch_rad
        toes = whole - toe_rad
        ball_ahead = float(np.hypot(self.ball_m[0], self.ball_m[1]))
        toe_ahead = float(np.hypot(self.toe_m[0], self.toe_m[1]))
        ball = ball_ahead * np.sin(whole) - self.ball_m[2] * np.cos(whole)
        tip = ball + toe_ahead * np.sin(toes) - self.toe_m[2] * np.cos(toes)
        heel = self.ankle_height_m * np.cos(pitch_rad) - self.heel_behind_m * np.sin(pitch_rad)
        return np.asarray(np.maximum.reduce([ball, tip, heel]))


def soft_length(distance: FloatArray, length_m: FloatArray | float, slack: float) -> FloatArray:
    """Return the distance (T,) between hip and ankle that a leg takes for a wanted distance (T,).

    It equals the wanted distance for a bent leg, and approaches the length of the leg smoothly.

    Args:
        distance: (T,) wanted distance, in metres.
        length_m: Length of the leg that is as straight as possible; a number or (T,).
        slack: What a leg that is just long enough lacks to be straight, as a share of its length.
    """
    free = 1.0 - distance / length_m
    return np.asarray(length_m * (1.0 - 0.5 * (free + np.hypot(free, 2.0 * slack))))


def leg_geometry(skeleton: SkeletonModel) -> tuple[LegGeometry, LegGeometry] | None:
    """Return the left and the right leg of a skeleton; None if one of them has no hip, knee or ankle."""
    legs = [_one_leg(skeleton, side) for side in SIDES]
    return (legs[0], legs[1]) if legs[0] is not None and legs[1] is not None else None


def _one_leg(skeleton: SkeletonModel, side: str) -> LegGeometry | None:
    joints = [skeleton.index_of_role(side + part) for part in ("UpLeg", "Leg", "Foot")]
    if None in joints:
        return None
    hip, knee, ankle = (joint for joint in joints if joint is not None)
    if knee not in skeleton.subtree(hip) or ankle not in skeleton.subtree(knee):
        return None
    rest = rest_positions(skeleton)
    thigh, shin = rest[knee] - rest[hip], rest[ankle] - rest[knee]
    length = float(np.linalg.norm(thigh) + np.linalg.norm(shin))
    toe = skeleton.index_of_role(side + "ToeBase")
    below = tuple(skeleton.subtree(ankle)[1:])
    ends = [rest[j] + np.nan_to_num(skeleton.end_offsets_m[j]) - rest[ankle] for j in (ankle, *below)]
    tip = max(ends, key=lambda end: float(np.hypot(end[0], end[1])))
    if np.hypot(tip[0], tip[1]) < 0.25 * _FOOT_OVER_LEG * length:
        # A foot that ends at the ankle cannot touch the floor with its toes.
        tip = np.zeros(3)
    ball = tip if toe is None else rest[toe] - rest[ankle]
    ankle_height = ANKLE_OVER_LEG * length
    pitch = 0.0
    drop = float(-tip[2])
    if abs(drop - ankle_height) <= _FLAT_TOLERANCE_M:
        ankle_height = drop
    elif np.any(tip):
        reach = float(np.linalg.norm(tip))
        wanted = np.arcsin(np.clip((ankle_height - _TOE_HEIGHT_M) / reach, 0.0, 0.8))
        pitch = float(wanted - np.arcsin(np.clip(drop / reach, -1.0, 1.0)))
        ankle_height = float(reach * np.sin(wanted)) + _TOE_HEIGHT_M
    return LegGeometry(
        chain=tuple(reversed(skeleton.path_to_root(hip)[:-1])),
        hip=hip,
        knee=knee,
        ankle=ankle,
        below=below,
        toe=toe,
        thigh_m=thigh,
        shin_m=shin,
        ball_m=ball,
        toe_m=tip - ball,
        flat_pitch_rad=pitch,
        ankle_height_m=ankle_height,
    )
