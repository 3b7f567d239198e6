"""How far a body may differ from the one that its stature promises: between people, and between rigs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.body.bones import Bone
from bodycap_batch.merging.graph.error_modes import ErrorModes
from bodycap_batch.model.skeleton_presets import split_side

PROPORTION_SIGMA = 0.04
"""Spread of a limb's share of the stature between people, so also of a scale that rests on it (standard
deviations of segment lengths over stature are 3 to 5 %: Winter's table gives means only; C. C. Gordon et al.,
"2012 Anthropometric Survey of U.S. Army Personnel", Natick 2014)."""

_JOINT_PLACEMENT_SIGMA = {
    "Spine1": (0.0, 0.01, 0.055),
    "Arm": (0.02, 0.0, 0.0),
    "ForeArm": (0.025, 0.0, 0.0),
    "Hand": (0.03, 0.0, 0.0),
}
"""How far other rigs' centres lie from ours, [outwards, back, up] in a T-pose, as shares of the stature.

In rigs of three makers (two bodies of the CMU Graphics Lab Motion Capture Database, Xsens MVN, the University
of Wisconsin's) the joint that carries the shoulders lies 3, 5, 4.5 and 22 % of the stature below them (ours
11.8) and up to 2.6 % behind them (1.5); half the distance of the shoulders is 12.9, 10.4, 10.0 and 9.3 %
(12.9), the upper arm 16.5, 14.8, 17.7 and 16.6 % (18.6), the forearm 9.5, 11.4, 14.4 and 13.8 % (14.6). Taken
is the root mean square distance from ours, were every rig between the extremes as likely as any other;
backwards a round 1 %."""


def bone_length_modes(bones: Sequence[Bone], cameras: Sequence[str]) -> ErrorModes:
    """The ways in which bones may be longer than a height has them, each by its share, both sides alike.

    Args:
        bones: The graph's bones.
        cameras: Names of the cameras, whose mounts stay.
    """
    parts = _part_names(bones)
    names = sorted({part for part, bone in zip(parts, bones, strict=True) if bone.parent >= 0})
    offsets_m = np.zeros((len(bones), 3, len(names)))
    for index, bone in enumerate(bones):
        if bone.parent >= 0:
            offsets_m[index, :, names.index(parts[index])] = PROPORTION_SIGMA * bone.offset_m
    return _modes_from_offsets(offsets_m, cameras)


def joint_placement_modes(bones: Sequence[Bone], cameras: Sequence[str], stature_m: float) -> ErrorModes:
    """The ways in which other rigs place the joints of a body of that stature, both sides alike.

    A joint that lies elsewhere leaves those that follow it where they are, but for the arms': each of their
    bones grows by itself.

    Args:
        bones: The graph's bones.
        cameras: Names of the cameras, whose mounts stay.
        stature_m: Of the body.
    """
    parts = _part_names(bones)
    ways = [
        (part, axis)
        for part in sorted(set(parts) & set(_JOINT_PLACEMENT_SIGMA))
        for axis in range(3)
        if _JOINT_PLACEMENT_SIGMA[part][axis]
    ]
    offsets_m = np.zeros((len(bones), 3, len(ways)))
    for way, (part, axis) in enumerate(ways):
        size = stature_m * _JOINT_PLACEMENT_SIGMA[part][axis]
        for index, bone in enumerate(bones):
            outwards = -1.0 if axis == 0 and split_side(bone.role)[0] == "Right" else 1.0
            if parts[index] == part and bone.parent >= 0:
                offsets_m[index, axis, way] += outwards * size
            if part == "Spine1" and bone.parent >= 0 and parts[bone.parent] == part:
                offsets_m[index, axis, way] -= size
    return _modes_from_offsets(offsets_m, cameras)


def _part_names(bones: Sequence[Bone]) -> list[str]:
    return [split_side(bone.role)[1] for bone in bones]


def _modes_from_offsets(offsets_m: FloatArray, cameras: Sequence[str]) -> ErrorModes:
    """Directions (B,3,M) in which nothing but the bones differs."""
    count = offsets_m.shape[2]
    return ErrorModes(
        mounts={camera: np.zeros((6, count)) for camera in cameras},
        log_scale=np.zeros(count),
        rest=np.zeros_like(offsets_m),
        offsets_m=offsets_m,
    )
