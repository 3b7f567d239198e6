"""How a foot rolls over the floor: about the heel, flat, and about the toes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.skeleton import SkeletonModel

_HEEL_RATIO = 1.0 / 3.0
"""Distance of the heel behind the ankle, as a share of the distance of the toe tip before the ankle. Origin:
the foot is 0.152 of the stature long (Drillis and Contini 1966), and the toe tip of the preset is 0.114 of
the stature before the ankle."""
_TOES_FLAT_DEG = 28.0
"""Angle of the foot, degrees, up to which the toes stay flat while the heel rises. Origin: the toe joints
extend by about 30 degrees in walking."""
_TOES_SOFT_DEG = 6.0
"""Width, degrees, of the change from flat toes to toes that rise with the foot. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FootShape:
    """The points of a foot that touch the floor, in the zero pose, metres.

    The origin is the ankle. −y is forward. Attributes:
        heel: (3,) lowest point of the heel.
        ball: (3,) joint of the toes.
        toes: (3,) tip of the toes, relative to the joint of the toes.
    """

    heel: FloatArray
    ball: FloatArray
    toes: FloatArray

    @property
    def height_m(self) -> float:
        """Height of the ankle above the floor when the foot is flat, metres."""
        return float(-self.heel[2])

    def soles(self, yaw_deg: FloatArray, pitch_deg: FloatArray) -> FloatArray:
        """Return heel, ball and toe tip relative to the ankle as (T,3,3) in the world, metres.

        The ball is the point below the joint of the toes that is on the floor when the foot is flat.
        """
        turn, toe_turn = foot_rotation(yaw_deg, pitch_deg), foot_rotation(yaw_deg, toe_pitch_deg(pitch_deg))
        joint = turn.apply(self.ball)
        below = np.array([0.0, 0.0, self.toes[2]])
        return np.stack(
            [turn.apply(self.heel), joint + toe_turn.apply(below), joint + toe_turn.apply(self.toes)], axis=1
        )

    def ankle_on_floor(self, flat_m: FloatArray, yaw_deg: FloatArray, pitch_deg: FloatArray) -> FloatArray:
        """Return the ankle (T,3) of a foot that has rolled from its flat position without slipping.

        Args:
            flat_m: (T,2) place of the ankle on the floor when the foot is flat, metres.
            yaw_deg: (T,) direction of the foot, degrees; 0: towards −y.
            pitch_deg: (T,) angle of the foot, degrees; positive: the heel is up, negative: the toes are up.
        """
        place = np.column_stack([flat_m, np.full(len(flat_m), self.height_m)])
        flat = Rotation.from_euler("Z", yaw_deg[:, None], degrees=True)
        turn = foot_rotation(yaw_deg, pitch_deg)
        about_heel = place + flat.apply(self.heel) - turn.apply(self.heel)
        toe_turn = foot_rotation(yaw_deg, toe_pitch_deg(pitch_deg))
        tip = place + flat.apply(self.ball + self.toes)
        about_toes = tip - toe_turn.apply(self.toes) - turn.apply(self.ball)
        return np.asarray(np.where((pitch_deg < 0.0)[:, None], about_heel, about_toes))


def shape_of(skeleton: SkeletonModel, side: str) -> FootShape:
    """Return the shape of one foot of a skeleton in the T-pose.

    Args:
        skeleton: Skeleton with HumanIK joint names.
        side: ``Left`` or ``Right``.
    """
    toe = skeleton.joints.index(f"{side}ToeBase")
    ball, toes = skeleton.offsets_m[toe], skeleton.end_offsets_m[toe]
    forward = -(ball[1] + toes[1])
    heel = np.array([0.0, _HEEL_RATIO * forward, ball[2] + toes[2]])
    return FootShape(heel=heel, ball=np.array(ball), toes=np.array(toes))


def toe_pitch_deg(pitch_deg: FloatArray) -> FloatArray:
    """Return the angle of the toes to the floor (T,) for angles of the foot (T,), degrees.

    The toes stay flat until the toe joints are extended, and rise with the foot then. They are in line with a
    foot whose toes are up.
    """
    soft = _TOES_SOFT_DEG * np.logaddexp(0.0, (pitch_deg - _TOES_FLAT_DEG) / _TOES_SOFT_DEG)
    at_zero = _TOES_SOFT_DEG * np.logaddexp(0.0, -_TOES_FLAT_DEG / _TOES_SOFT_DEG)
    return np.asarray(np.where(pitch_deg < 0.0, pitch_deg, soft - at_zero))


def foot_rotation(yaw_deg: FloatArray, pitch_deg: FloatArray) -> Rotation:
    """Return the rotations of T feet in the world from direction and angle, degrees."""
    return Rotation.from_euler("ZX", np.column_stack([yaw_deg, pitch_deg]), degrees=True)
