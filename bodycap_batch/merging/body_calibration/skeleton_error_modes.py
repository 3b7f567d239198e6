"""Error modes of a skeleton whose bone lengths were not measured but scaled from the stature.

There are two kinds of error. People of equal stature have different bone lengths. Different motion capture
systems place the joints at different points of the same body.
"""

from __future__ import annotations

from collections.abc import Sequence

from bodycap_batch.merging.body.bones import Bone
from bodycap_batch.merging.graph.error_modes import ErrorModes, no_modes
from bodycap_batch.model.skeleton_presets import split_side

PROPORTION_SIGMA = 0.04
"""Relative sigma of a bone length that was scaled from the stature.

A scale that is derived from such bone lengths has the same relative sigma.

Between people, the ratio of a segment's length to the stature has a standard deviation of 3 to 5 %.
Winter's table gives only mean ratios. Source: C. C. Gordon et al., "2012 Anthropometric Survey of U.S. Army
Personnel", Natick 2014.
"""

_JOINT_PLACEMENT_SIGMA = {
    "Spine1": (0.0, 0.01, 0.055),
    "Arm": (0.02, 0.0, 0.0),
    "ForeArm": (0.025, 0.0, 0.0),
    "Hand": (0.03, 0.0, 0.0),
}
"""By joint, sigma of the joint's position in the body, as fractions of the stature.

Motion capture systems place a joint at different points of the body. The three sigmas are for the directions
[outwards, back, up] in a T-pose.

Derived from the skeletons of three makers, see docs/decisions/body_calibration.md.
"""


def bone_length_modes(bones: Sequence[Bone], cameras: Sequence[str]) -> ErrorModes:
    """Return one error mode for each kind of bone. For example, both forearms are one kind.

    The mode makes all bones of this kind longer by the fraction `PROPORTION_SIGMA`, left and right alike.

    Args:
        bones: Bones of the graph.
        cameras: Names of the cameras. The modes do not change the mounts of these cameras.

    Returns:
        The error modes, one for each kind of bone.
    """
    parts = _part_names(bones)
    names = sorted({part for part, bone in zip(parts, bones, strict=True) if bone.parent >= 0})
    out = no_modes(bones, cameras, len(names))
    for index, bone in enumerate(bones):
        if bone.parent >= 0:
            out.offsets_m[index, :, names.index(parts[index])] = PROPORTION_SIGMA * bone.offset_m
    return out


def joint_placement_modes(bones: Sequence[Bone], cameras: Sequence[str], stature_m: float) -> ErrorModes:
    """Return the error modes of joint placement.

    Each mode moves one joint to another point of the body, because another motion capture system may define
    the joint there. The left and the right joint move symmetrically.

    If ``Spine1`` moves, its child joints keep their places. If a joint of an arm moves, all joints further
    along the arm move by the same amount.

    Args:
        bones: Bones of the graph.
        cameras: Names of the cameras. The modes do not change the mounts of these cameras.
        stature_m: Stature of the subject, metres.

    Returns:
        The error modes, one for each joint and direction.
    """
    parts = _part_names(bones)
    moves = [
        (part, axis)
        for part in sorted(set(parts) & set(_JOINT_PLACEMENT_SIGMA))
        for axis in range(3)
        if _JOINT_PLACEMENT_SIGMA[part][axis]
    ]
    out = no_modes(bones, cameras, len(moves))
    for mode, (part, axis) in enumerate(moves):
        size_m = stature_m * _JOINT_PLACEMENT_SIGMA[part][axis]
        for index, bone in enumerate(bones):
            outwards = -1.0 if axis == 0 and split_side(bone.role)[0] == "Right" else 1.0
            if parts[index] == part and bone.parent >= 0:
                out.offsets_m[index, axis, mode] += outwards * size_m
            if part == "Spine1" and bone.parent >= 0 and parts[bone.parent] == part:
                out.offsets_m[index, axis, mode] -= size_m
    return out


def _part_names(bones: Sequence[Bone]) -> list[str]:
    """Return the role of each bone without the side, for example ``Arm`` for ``LeftArm``."""
    return [split_side(bone.role)[1] for bone in bones]
