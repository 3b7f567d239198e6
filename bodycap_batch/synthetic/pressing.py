"""A hand laid against the chest: the joint angles at which its camera sees nothing but the wearer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.skeleton import Mount, SkeletonModel
from bodycap_batch.model.skeleton_presets import segment_axes

RAMP_S = 0.5
"""From walking to the chest and back: an unhurried hand."""
_CHEST_RADIUS_M = 0.125
_CHEST_SHARE = 0.45
_OFF_CHEST_M = 0.045
"""Lens to cloth: farther than the renderer's nearest distance, near enough to fill a usual lens."""
_LOW_DEG = np.array([-10.0, -40.0, 0.0, -80.0, -80.0, -80.0, -40.0])
_HIGH_DEG = np.array([110.0, 100.0, 150.0, 90.0, 80.0, 80.0, 40.0])
_COMFORT = 0.002
"""Of 1 cm or 6 degrees, a degree away from the middle of a joint's range."""


@dataclass(frozen=True, slots=True)
class ArmAngles:
    """Angles of one arm (degrees), each (T,): what `Walk` turns into rotations."""

    flexion: FloatArray
    abduction: FloatArray
    elbow: FloatArray
    pronation: FloatArray
    spin: FloatArray
    wrist: FloatArray
    radial: FloatArray

    def rotations(self, side: str, alive: FloatArray) -> dict[str, Rotation]:
        """Rotations of upper arm, forearm and hand; at `alive` = 0 they are stretched out to the side."""
        outward = 1.0 if side == "Left" else -1.0
        hang = alive * (90.0 - self.abduction)
        arm = _about("X", -alive * self.flexion) * _about("Y", outward * hang)
        if np.any(self.spin):
            arm = arm * _about("X", alive * self.spin)
        # The hand's thumb side turns from ahead towards the body: about the bone, left positive.
        forearm = _about("Z", -outward * alive * self.elbow) * _about("X", alive * self.pronation)
        hand = _about("YZ", np.column_stack([alive * self.wrist, -outward * alive * self.radial]))
        return {f"{side}Arm": arm, f"{side}ForeArm": forearm, f"{side}Hand": hand}


def _about(axis: str, degrees: FloatArray) -> Rotation:
    return Rotation.from_euler(axis, degrees.reshape(-1, len(axis)), degrees=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class Press:
    """One hand at the chest.

    Attributes:
        side: ``Left`` or ``Right``.
        start_s: When its camera is at the chest.
        end_s: When it leaves.
        degrees: (7,) the angles of `ArmAngles` meanwhile.
    """

    side: str
    start_s: float
    end_s: float
    degrees: FloatArray

    def weight(self, t_s: FloatArray) -> FloatArray:
        """0 … 1 at times (T,), twice differentiable, 1 from start to end."""
        up = np.clip((t_s - self.start_s) / RAMP_S + 1.0, 0, 1)
        down = np.clip((t_s - self.end_s) / RAMP_S, 0, 1)
        smooth = [x**3 * (10 - 15 * x + 6 * x * x) for x in (up, down)]
        return np.asarray(smooth[0] - smooth[1])

    def blended(self, angles: ArmAngles, t_s: FloatArray) -> ArmAngles:
        """The walker's angles, drawn to the chest for the while."""
        weight = self.weight(t_s)
        names = ArmAngles.__slots__
        values = {
            name: getattr(angles, name) * (1.0 - weight) + weight * target
            for name, target in zip(names, self.degrees, strict=True)
        }
        return ArmAngles(**values)


def press_of(mount: Mount, skeleton: SkeletonModel, start_s: float, end_s: float) -> Press:
    """Find how a hand reaches the chest so that its camera looks straight into it.

    Args:
        mount: Where the camera truly sits on the hand.
        skeleton: The true body.
        start_s: When the camera is at the chest.
        end_s: When it leaves.
    """
    side = mount.role.removesuffix("Hand")
    bone = skeleton.offsets_m[skeleton.joints.index("Neck")]
    forward = segment_axes(skeleton, "Spine1")[:, 1]
    target = _CHEST_SHARE * bone + forward * (_CHEST_RADIUS_M + _OFF_CHEST_M)
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
    """(4,4) pose of the camera in the frame of the joint that carries the chest."""
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
