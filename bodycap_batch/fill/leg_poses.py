"""Two-bone inverse kinematics of the legs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.fill.foot_paths import FootPath
from bodycap_batch.fill.leg_geometry import LegGeometry, soft_length
from bodycap_batch.model.geometry import so3_exp

_SLACK = 0.0006
"""Slack of a leg that is just long enough, as a share of its length. Derivation: the knee is bent by 4°."""
_MIN_SHARE = 0.25
"""Minimum distance between hip and ankle, as a share of the length of the leg. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LegPose:
    """The orientations of one leg in the world at T ticks.

    Attributes:
        thigh: (T,3,3) world_from_joint rotation of the hip joint.
        shin: (T,3,3) of the knee.
        foot: (T,3,3) of the ankle.
        toe: (T,3,3) of the toes.
    """

    thigh: FloatArray
    shin: FloatArray
    foot: FloatArray
    toe: FloatArray


def pose_leg(leg: LegGeometry, hip_m: FloatArray, path: FootPath, pelvis: FloatArray) -> LegPose:
    """Return the pose of a leg whose foot follows a path.

    Args:
        leg: The leg.
        hip_m: (T,3) hip joint in the world, metres.
        path: The motion of the foot.
        pelvis: (T,3,3) orientation of the pelvis in the world.
    """
    foot = _foot_rotation(path.heading_rad, path.pitch_rad + leg.flat_pitch_rad)
    toe = _foot_rotation(path.heading_rad, path.pitch_rad + leg.flat_pitch_rad - path.toe_rad)
    to_ankle = path.ankle_m - hip_m
    distance = np.linalg.norm(to_ankle, axis=1)
    thigh_m, shin_m = float(np.linalg.norm(leg.thigh_m)), float(np.linalg.norm(leg.shin_m))
    reached = np.maximum(soft_length(distance, leg.reach_m(path.knee_rad), _SLACK), _MIN_SHARE * leg.length_m)
    along = to_ankle / np.maximum(distance, 1e-9)[:, None]
    # The knee points where pelvis and foot point in the mean. Their mean has no direction if the person has
    # turned by 180° over a standing foot, so the pelvis counts less the more it has turned.
    toes = np.column_stack([np.sin(path.heading_rad), -np.cos(path.heading_rad), np.zeros(len(distance))])
    share = 0.5 - 0.5 * (toes * pelvis[:, :, 1]).sum(axis=1, keepdims=True)
    ahead = toes - share * pelvis[:, :, 1]
    ahead = ahead - (ahead * along).sum(axis=1, keepdims=True) * along
    # A leg that points forward leaves no forward direction: the knee of a sitting person points up.
    ahead = ahead + 1e-3 * (np.array([0.0, 0.0, 1.0]) - along[:, 2:] * along)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    cosine = (thigh_m**2 + reached**2 - shin_m**2) / (2.0 * thigh_m * reached)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    upper = np.cos(angle)[:, None] * along + np.sin(angle)[:, None] * ahead
    lower = (reached[:, None] * along - thigh_m * upper) / shin_m
    axis = np.cross(ahead, along)
    return LegPose(
        thigh=_aim(leg.thigh_m, upper, axis), shin=_aim(leg.shin_m, lower, axis), foot=foot, toe=toe
    )


def _aim(zero_m: FloatArray, direction: FloatArray, axis: FloatArray) -> FloatArray:
    """Return rotations (T,3,3) that turn a bone of the zero pose to a direction, with the hinge on an axis.

    Args:
        zero_m: (3,) the bone in the zero pose. Its hinge lies along +x there.
        direction: (T,3) unit vectors of the bone.
        axis: (T,3) unit vectors of the hinge, perpendicular to the directions.
    """
    return np.asarray(_frame(direction, axis) @ _frame(zero_m[None], np.array([[1.0, 0.0, 0.0]]))[0].T)


def _frame(along: FloatArray, axis: FloatArray) -> FloatArray:
    first = along / np.linalg.norm(along, axis=-1, keepdims=True)
    second = axis - (axis * first).sum(axis=-1, keepdims=True) * first
    second /= np.linalg.norm(second, axis=-1, keepdims=True)
    return np.stack([first, second, np.cross(first, second)], axis=-1)


def _foot_rotation(heading_rad: FloatArray, pitch_rad: FloatArray) -> FloatArray:
    """Return rotations (T,3,3) about z by a heading, after lowering the toes by a pitch.

    In the zero pose the foot points to −y: a rotation about +x by a positive angle lowers the toes.
    """
    zero = np.zeros_like(heading_rad)
    turn = so3_exp(np.column_stack([zero, zero, heading_rad]))
    lower = so3_exp(np.column_stack([pitch_rad, zero, zero]))
    return np.asarray(turn @ lower)
