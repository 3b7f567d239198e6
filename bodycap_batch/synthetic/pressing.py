"""A hand that is held against the chest, so that the camera on the hand sees only the wearer.

This module finds the joint angles of the arm.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.skeleton import Mount, SkeletonModel
from bodycap_batch.model.skeleton_presets import segment_axes
from bodycap_batch.synthetic.gait_plan import smooth_step

RAMP_S = 0.5
"""Duration of the movement of a hand from its walking position to the chest. The movement back takes the same
time. Unit: seconds."""
_CHEST_RADIUS_M = 0.125
"""Distance (metres) of the chest's surface from the bone of the trunk."""
_CHEST_HEIGHT_RATIO = 0.45
"""Position of the touched point along the bone from Spine1 to the neck, as a fraction of the bone's length.
"""
_OFF_CHEST_M = 0.045
"""Distance (metres) of the lens from the chest's surface. The distance is larger than the renderer's minimum
distance, and so small that the chest fills the image."""
_LOW_DEG = np.array([-10.0, -40.0, 0.0, -80.0, -80.0, -80.0, -40.0])
"""Minimum of each angle of `ArmAngles`, degrees. Evidence: none."""
_HIGH_DEG = np.array([110.0, 100.0, 150.0, 90.0, 80.0, 80.0, 40.0])
"""Maximum of each angle of `ArmAngles`, degrees. Evidence: none."""
_COMFORT = 0.002
"""Residual per degree of difference between a joint angle and the middle of its range. It makes the search
prefer comfortable postures. For comparison: a camera position error of 1 cm, or a viewing direction error of
6 degrees, has a residual of 1."""


_CARRYING_DEG = np.array([53.0, 4.0, 74.0, 10.0, 20.0, 0.0, 0.0])
"""The angles of `ArmAngles` of a hand that holds a thing in front of the chest, degrees."""
_SWING_DEG, _SWING_HZ = 9.0, 0.45
"""Amplitude (degrees) and frequency (Hz) of the movement of a carried thing. Evidence: none."""


@dataclass(frozen=True, slots=True)
class ArmAngles:
    """Angles of one arm over time.

    Attributes:
        flexion: (T,) flexion of the shoulder, degrees.
        abduction: (T,) abduction of the shoulder, degrees.
        elbow: (T,) flexion of the elbow, degrees.
        pronation: (T,) pronation of the forearm, degrees.
        spin: (T,) axial rotation of the upper arm, degrees.
        wrist: (T,) rotation of the hand about its y axis, degrees.
        radial: (T,) sideways rotation of the hand towards the thumb or the little finger, degrees.
    """

    flexion: FloatArray
    abduction: FloatArray
    elbow: FloatArray
    pronation: FloatArray
    spin: FloatArray
    wrist: FloatArray
    radial: FloatArray

    def rotations(self, side: str, walk_weight: FloatArray) -> dict[str, Rotation]:
        """Return the local rotations of upper arm, forearm and hand by joint name.

        Args:
            side: ``Left`` or ``Right``.
            walk_weight: (T,) weight of the angles: 1 while walking; 0 in a T-pose, with the arm stretched out
                to the side.
        """
        outward = 1.0 if side == "Left" else -1.0
        hang = walk_weight * (90.0 - self.abduction)
        arm = rotation_about("X", -walk_weight * self.flexion) * rotation_about("Y", outward * hang)
        if np.any(self.spin):
            arm = arm * rotation_about("X", walk_weight * self.spin)
        # Pronation rotates the forearm about its bone, so that the thumb moves from the front to the body.
        # It is a positive rotation about X on both sides. The left bone points along +X, the right along -X.
        forearm = rotation_about("Z", -outward * walk_weight * self.elbow) * rotation_about(
            "X", walk_weight * self.pronation
        )
        hand = rotation_about(
            "YZ", np.column_stack([walk_weight * self.wrist, -outward * walk_weight * self.radial])
        )
        return {f"{side}Arm": arm, f"{side}ForeArm": forearm, f"{side}Hand": hand}


def rotation_about(axis: str, degrees: FloatArray) -> Rotation:
    """Return rotations by Euler angles (T,len(axis)) in degrees about the intrinsic axes `axis`."""
    return Rotation.from_euler(axis, degrees.reshape(-1, len(axis)), degrees=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class Press:
    """A period in which one hand is held against the chest, so that its camera sees only the wearer.

    Attributes:
        side: ``Left`` or ``Right``.
        start_s: Common time (seconds) at which the camera on the hand arrives at the chest.
        end_s: Common time (seconds) at which the camera leaves the chest.
        degrees: (7,) the angles of `ArmAngles`, in that order, from `start_s` to `end_s`, degrees.
        swing_deg: Amplitude of a slow oscillation of shoulder and elbow about these angles, degrees.
    """

    side: str
    start_s: float
    end_s: float
    degrees: FloatArray
    swing_deg: float = 0.0

    def weight(self, t_s: FloatArray) -> FloatArray:
        """Return the weight (T,) of the press at common times (T,).

        The weight is 1 from `start_s` to `end_s`, and changes smoothly before and after.
        """
        up = smooth_step((t_s - self.start_s) / RAMP_S + 1.0)
        return np.asarray(up - smooth_step((t_s - self.end_s) / RAMP_S))

    def blended(self, angles: ArmAngles, t_s: FloatArray) -> ArmAngles:
        """Return a weighted mean of given arm angles and the angles of the press at common times (T,)."""
        weight = self.weight(t_s)
        names = ArmAngles.__slots__
        values = {
            name: getattr(angles, name) * (1.0 - weight) + weight * target
            for name, target in zip(names, self.degrees, strict=True)
        }
        if self.swing_deg:
            swing = self.swing_deg * weight
            values["flexion"] = values["flexion"] + swing * np.sin(2 * np.pi * _SWING_HZ * t_s)
            values["elbow"] = values["elbow"] + swing * np.cos(2 * np.pi * 0.6 * _SWING_HZ * t_s)
        return ArmAngles(**values)


def carrying(side: str, start_s: float, end_s: float) -> Press:
    """Return a movement in which a hand holds a thing in front of the chest.

    Args:
        side: ``Left`` or ``Right``.
        start_s: Common time (seconds) at which the thing arrives there.
        end_s: Common time (seconds) at which the hand goes down.
    """
    return Press(side=side, start_s=start_s, end_s=end_s, degrees=_CARRYING_DEG, swing_deg=_SWING_DEG)


def find_press(mount: Mount, skeleton: SkeletonModel, start_s: float, end_s: float) -> Press:
    """Find joint angles at which the camera on a hand looks straight at the chest from a short distance.

    Args:
        mount: True mount of the camera on the hand.
        skeleton: Skeleton with the true proportions.
        start_s: Common time (seconds) at which the camera arrives at the chest.
        end_s: Common time (seconds) at which the camera leaves the chest.
    """
    side = mount.role.removesuffix("Hand")
    bone = skeleton.offsets_m[skeleton.joints.index("Neck")]
    forward = segment_axes(skeleton, "Spine1")[:, 1]
    target = _CHEST_HEIGHT_RATIO * bone + forward * (_CHEST_RADIUS_M + _OFF_CHEST_M)
    middle = 0.5 * (_LOW_DEG + _HIGH_DEG)

    def misfit(degrees: FloatArray) -> FloatArray:
        pose = _chest_from_cam(degrees, side, mount, skeleton)
        return np.concatenate(
            [
                (pose[:3, 3] - target) / 0.01,
                (pose[:3, 2] + forward) / 0.1,
                _COMFORT * (degrees - middle),
            ]
        )

    rng = np.random.default_rng(0)
    starts = [middle, *rng.uniform(_LOW_DEG, _HIGH_DEG, (7, len(middle)))]
    tries: list[Any] = [least_squares(misfit, start, bounds=(_LOW_DEG, _HIGH_DEG)) for start in starts]
    best = min(tries, key=lambda found: float(found.cost))
    return Press(side=side, start_s=start_s, end_s=end_s, degrees=np.asarray(best.x))


def _chest_from_cam(degrees: FloatArray, side: str, mount: Mount, skeleton: SkeletonModel) -> FloatArray:
    """Return the pose (4,4) of the camera in the frame of the chest joint (Spine1)."""
    turns = ArmAngles(*degrees.reshape(7, 1)).rotations(side, np.ones(1))
    joint = skeleton.index_of_role(mount.role)
    chest = skeleton.index_of_role("Spine1")
    pose = np.asarray(mount.joint_from_cam)
    while joint is not None and joint != chest and joint >= 0:
        parent_from_joint = np.eye(4)
        turn = turns.get(skeleton.joints[joint])
        if turn is not None:
            parent_from_joint[:3, :3] = turn.as_matrix()[0]
        parent_from_joint[:3, 3] = skeleton.offsets_m[joint]
        pose = parent_from_joint @ pose
        joint = int(skeleton.parents[joint])
    return np.asarray(pose)
