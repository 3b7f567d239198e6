"""Soft rules of an activity. Walking: palms below the shoulders, on their own side; reach is in the bones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from bodycap_batch.arrays import FloatArray
from bodycap_batch.body import Activity
from bodycap_batch.merging.bones import Bone
from bodycap_batch.merging.graph import bone_key
from bodycap_batch.skeleton import SkeletonModel
from bodycap_batch.skeleton_presets import rest_positions

_SIGMA_M = 0.05
_ANCHOR_M = 1.0
"""Distance of the points from which height and side are judged: far enough that spheres are nearly planes."""
_CROSSING_M = 0.1
"""How far a walking palm may cross the body's middle before it is pulled back."""


@dataclass(frozen=True, slots=True)
class Rule:
    """A bone's joint keeps a distance within bounds from a point of another bone.

    Attributes:
        name: For the report.
        base: Index of the bone that carries the point.
        bone: Index of the bone whose joint is bounded.
        anchor_m: (3,) the point, in the base's frame.
        low_m: Smallest distance.
        high_m: Largest distance.
    """

    name: str
    base: int
    bone: int
    anchor_m: FloatArray
    low_m: float
    high_m: float

    def add(self, graph: Any, tick: int) -> None:
        """Add the soft factor of one tick: no force inside the bounds, a spring outside."""
        middle, half = 0.5 * (self.low_m + self.high_m), 0.5 * (self.high_m - self.low_m)
        dead_zone = gtsam.noiseModel.mEstimator.L2WithDeadZone.Create(half / _SIGMA_M)
        noise = gtsam.noiseModel.Robust.Create(dead_zone, gtsam.noiseModel.Isotropic.Sigma(1, _SIGMA_M))
        anchor = gtsam.Pose3(gtsam.Rot3(), self.anchor_m)
        keys = bone_key(tick, self.base), bone_key(tick, self.bone)
        graph.add(gtsam.RangeFactorWithTransformPose3(*keys, middle, noise, anchor))

    def active(self, world_from_bone: FloatArray) -> float:
        """Share of ticks in which solved poses (T,B,4,4) press against the bounds."""
        base = world_from_bone[:, self.base]
        anchor = np.einsum("tij,j->ti", base[:, :3, :3], self.anchor_m) + base[:, :3, 3]
        distance = np.linalg.norm(world_from_bone[:, self.bone, :3, 3] - anchor, axis=1)
        return float(((distance < self.low_m) | (distance > self.high_m)).mean())


def activity_rules(skeleton: SkeletonModel, bones: Sequence[Bone], activity: Activity) -> tuple[Rule, ...]:
    """The rules that apply to the bones of the graph; ``generic`` has none beyond the bones' lengths."""
    index = {bone.role: position for position, bone in enumerate(bones)}
    chest = index.get("Spine1")
    if activity != "walk" or chest is None:
        return ()
    rest = rest_positions(skeleton)
    rules = []
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        hand, arm = index.get(side + "Hand"), skeleton.index_of_role(side + "Arm")
        if hand is None or arm is None:
            continue
        shoulder = rest[arm] - rest[bones[chest].joint]
        above = shoulder + np.array([0.0, 0.0, _ANCHOR_M])
        beside = shoulder + np.array([sign * _ANCHOR_M, 0.0, 0.0])
        across = _ANCHOR_M + abs(float(shoulder[0])) + _CROSSING_M
        rules.append(Rule(f"{side} palm below the shoulder", chest, hand, above, _ANCHOR_M, 3.0 * _ANCHOR_M))
        rules.append(Rule(f"{side} palm on its side", chest, hand, beside, 0.0, across))
    return tuple(rules)
