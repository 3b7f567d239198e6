"""Soft limits of distances: elbows and knees, the reach of arms, and the position of a walker's palms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.body.bones import HINGE_ARM_M, Bone, anatomical_axes, hinges
from bodycap_batch.merging.graph.factors import bone_key
from bodycap_batch.model.merge_data import Activity
from bodycap_batch.model.skeleton import SkeletonModel
from bodycap_batch.model.skeleton_presets import rest_positions, split_side

_REACH_SIGMA_M = 0.05
"""Sigma (metres) of the violation of a limit on the reach or on the position of a palm. Evidence: none."""
_HINGE_SIGMA_M = 0.02
"""Sigma (metres) of the violation of a limit that keeps an elbow or a knee from bending backward. Evidence:
none."""
_SHOULDER_MOTION_M = 0.05
"""Distance (metres) that the centre of a shoulder moves relative to the trunk when the clavicle rotates by 15
to 20°."""
_ANCHOR_DISTANCE_M = 1.0
"""Distance (metres) from a shoulder to two points: one above the shoulder, one to its side. A walker's palm
stays below the shoulder and on its side of the body. Both rules are limits on the distance of the palm from
one of these points. At this distance, a sphere about a point is nearly a plane."""
_MAX_CROSSING_M = 0.1
"""Maximum distance (metres) of a walker's palm beyond the middle of the body. Evidence: none."""


@dataclass(frozen=True, slots=True)
class DistanceLimit:
    """Bounds on the distance of a bone's joint from a point on another bone.

    Attributes:
        name: Name of the limit in the report.
        base: Index of the base bone, which holds the point.
        bone: Index of the bone with the joint.
        anchor_m: (3,) position of the point in the base bone's frame.
        low_m: Minimum distance, metres.
        high_m: Maximum distance, metres.
        sigma_m: Sigma of the distance outside the bounds, metres.
    """

    name: str
    base: int
    bone: int
    anchor_m: FloatArray
    low_m: float
    high_m: float
    sigma_m: float = _REACH_SIGMA_M

    def add(self, graph: Any, tick: int) -> None:
        """Add the factor of one tick. Its cost is zero inside the bounds and quadratic outside."""
        middle, half = 0.5 * (self.low_m + self.high_m), 0.5 * (self.high_m - self.low_m)
        dead_zone = gtsam.noiseModel.mEstimator.L2WithDeadZone.Create(half / self.sigma_m)
        noise = gtsam.noiseModel.Robust.Create(dead_zone, gtsam.noiseModel.Isotropic.Sigma(1, self.sigma_m))
        anchor = gtsam.Pose3(gtsam.Rot3(), self.anchor_m)
        keys = bone_key(tick, self.base), bone_key(tick, self.bone)
        graph.add(gtsam.RangeFactorWithTransformPose3(*keys, middle, noise, anchor))

    def violation_m(self, world_from_bone: FloatArray) -> FloatArray:
        """Return how far (T,), metres, solved poses (T,B,4,4) violate the bounds; 0 inside the bounds."""
        base = world_from_bone[:, self.base]
        anchor = np.einsum("tij,j->ti", base[:, :3, :3], self.anchor_m) + base[:, :3, 3]
        distance = np.linalg.norm(world_from_bone[:, self.bone, :3, 3] - anchor, axis=1)
        return np.asarray(np.maximum(np.maximum(self.low_m - distance, distance - self.high_m), 0.0))


def soft_limits(
    skeleton: SkeletonModel, bones: Sequence[Bone], activity: Activity
) -> tuple[DistanceLimit, ...]:
    """Return all limits that apply to the bones of the graph."""
    return (
        *hinge_limits(skeleton, bones),
        *arm_reach_limits(skeleton, bones),
        *activity_limits(skeleton, bones, activity),
    )


def hinge_limits(skeleton: SkeletonModel, bones: Sequence[Bone]) -> tuple[DistanceLimit, ...]:
    """Return limits that keep elbows and knees from bending backward.

    The far end of the lower bone must be near enough to a point on the side to which the joint bends. The
    hinge keeps this far end in the plane of bending.
    """
    limits = []
    for hinge in hinges(skeleton, tuple(bones)):
        side, part = split_side(bones[hinge.upper].role)
        forward = anatomical_axes(skeleton, bones[hinge.upper].role)[:, 1] * (1.0 if part == "Arm" else -1.0)
        joint = hinge.anchors_m.mean(axis=0)
        name = f"{side} {'elbow' if part == 'Arm' else 'knee'} not overstretched"
        # The end of a straight limb has this distance from the point; the end of a bent limb is nearer.
        anchor = joint + HINGE_ARM_M * forward
        limits.append(
            DistanceLimit(name, hinge.upper, hinge.following, anchor, 0.0, hinge.range_m, _HINGE_SIGMA_M)
        )
    return tuple(limits)


def arm_reach_limits(skeleton: SkeletonModel, bones: Sequence[Bone]) -> tuple[DistanceLimit, ...]:
    """Return limits that keep each palm within an arm's length of its shoulder.

    The position of the shoulder follows from the pose of the chest.
    """
    index = {bone.role: position for position, bone in enumerate(bones)}
    chest = index.get("Spine1")
    rest, limits = rest_positions(skeleton), []
    for side in ("Left", "Right"):
        hand, arm = index.get(side + "Hand"), index.get(side + "Arm")
        if chest is None or hand is None or arm is None:
            continue
        shoulder = rest[bones[arm].joint] - rest[bones[chest].joint]
        links = [bones[index[side + part]].offset_m for part in ("ForeArm", "Hand")]
        reach = float(sum(np.linalg.norm(link) for link in links)) + _SHOULDER_MOTION_M
        limits.append(DistanceLimit(f"{side} palm within reach", chest, hand, shoulder, 0.0, reach))
    return tuple(limits)


def activity_limits(
    skeleton: SkeletonModel, bones: Sequence[Bone], activity: Activity
) -> tuple[DistanceLimit, ...]:
    """Return the additional limits of an activity; ``generic`` has none."""
    index = {bone.role: position for position, bone in enumerate(bones)}
    chest = index.get("Spine1")
    if activity != "walk" or chest is None:
        return ()
    rest = rest_positions(skeleton)
    limits = []
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        hand, arm = index.get(side + "Hand"), skeleton.index_of_role(side + "Arm")
        if hand is None or arm is None:
            continue
        shoulder = rest[arm] - rest[bones[chest].joint]
        above = shoulder + np.array([0.0, 0.0, _ANCHOR_DISTANCE_M])
        beside = shoulder + np.array([sign * _ANCHOR_DISTANCE_M, 0.0, 0.0])
        across = _ANCHOR_DISTANCE_M + abs(float(shoulder[0])) + _MAX_CROSSING_M
        limits.append(
            DistanceLimit(
                f"{side} palm below the shoulder",
                chest,
                hand,
                above,
                _ANCHOR_DISTANCE_M,
                3.0 * _ANCHOR_DISTANCE_M,
            )
        )
        limits.append(DistanceLimit(f"{side} palm on its side", chest, hand, beside, 0.0, across))
    return tuple(limits)
