"""A hand laid against the chest: joint angles at which its camera sees only the wearer."""

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
"""Time that a hand takes from walking to the chest, and back, seconds."""
_CHEST_RADIUS_M = 0.125
"""Distance of the chest's surface from the bone, metres."""
_CHEST_HEIGHT_RATIO = 0.45
"""Height of the touched point, relative to the bone from Spine1 to the neck."""
_OFF_CHEST_M = 0.045
"""Distance of the lens from the cloth, metres: above the renderer's nearest distance, and near enough that
the chest fills the image."""
_LOW_DEG = np.array([-10.0, -40.0, 0.0, -80.0, -80.0, -80.0, -40.0])
"""Lower limits of the angles of `ArmAngles`, degrees. Evidence: none."""
_HIGH_DEG = np.array([110.0, 100.0, 150.0, 90.0, 80.0, 80.0, 40.0])
"""Upper limits of the angles of `ArmAngles`, degrees. Evidence: none."""
_COMFORT = 0.002
"""Cost of a degree away from the middle of a joint's range, relative to that of 1 cm or 6 degrees of
misfit."""


@dataclass(frozen=True, slots=True)
class ArmAngles:
    """Angles of one arm over time, each (T,) in degrees."""

    flexion: FloatArray
    abduction: FloatArray
    elbow: FloatArray
    pronation: FloatArray
    spin: FloatArray
    wrist: FloatArray
    radial: FloatArray

    def rotations(self, side: str, walk_weight: FloatArray) -> dict[str, Rotation]:
        """Return the rotations of upper arm, forearm and hand by joint name.

        Args:
            side: ``Left`` or ``Right``.
            walk_weight: (T,) 1 while walking; at 0 the arm is stretched out to the side.
        """
        outward = 1.0 if side == "Left" else -1.0
        hang = walk_weight * (90.0 - self.abduction)
        arm = _rotation_about("X", -walk_weight * self.flexion) * _rotation_about("Y", outward * hang)
        if np.any(self.spin):
            arm = arm * _rotation_about("X", walk_weight * self.spin)
        # Pronation turns the thumb from the front towards the body: about the bone, positive on the left.
        forearm = _rotation_about("Z", -outward * walk_weight * self.elbow) * _rotation_about(
            "X", walk_weight * self.pronation
        )
        hand = _rotation_about(
            "YZ", np.column_stack([walk_weight * self.wrist, -outward * walk_weight * self.radial])
        )
        return {f"{side}Arm": arm, f"{side}ForeArm": forearm, f"{side}Hand": hand}


def _rotation_about(axis: str, degrees: FloatArray) -> Rotation:
    """Return rotations by Euler angles (T,len(axis)) about intrinsic axes, degrees."""
    return Rotation.from_euler(axis, degrees.reshape(-1, len(axis)), degrees=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class Press:
    """One hand at the chest.

    Attributes:
        side: ``Left`` or ``Right``.
        start_s: Time at which its camera is at the chest, seconds.
        end_s: Time at which it leaves, seconds.
        degrees: (7,) angles of `ArmAngles` in between.
    """

    side: str
    start_s: float
    end_s: float
    degrees: FloatArray

    def weight(self, t_s: FloatArray) -> FloatArray:
        """Return the weight (T,) of the press at times (T,): 1 from start to end, twice differentiable."""
        up = np.clip((t_s - self.start_s) / RAMP_S + 1.0, 0, 1)
        down = np.clip((t_s - self.end_s) / RAMP_S, 0, 1)
        smooth = [x**3 * (10 - 15 * x + 6 * x * x) for x in (up, down)]
        return np.asarray(smooth[0] - smooth[1])

    def blended(self, angles: ArmAngles, t_s: FloatArray) -> ArmAngles:
        """Return the angles of the walk, blended with those of the press."""
        weight = self.weight(t_s)
        names = ArmAngles.__slots__
        values = {
            name: getattr(angles, name) * (1.0 - weight) + weight * target
            for name, target in zip(names, self.degrees, strict=True)
        }
        return ArmAngles(**values)


def find_press(mount: Mount, skeleton: SkeletonModel, start_s: float, end_s: float) -> Press:
    """Find joint angles at which the camera on a hand looks straight into the chest.

    Args:
        mount: True mount of the camera on the hand.
        skeleton: The true body.
        start_s: Time at which the camera is at the chest, seconds.
        end_s: Time at which it leaves, seconds.
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
    """Return the pose (4,4) of the camera in the frame of the joint of the chest."""
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
