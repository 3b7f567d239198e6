"""Describe a user's skeleton in words: roles of the joints and directions of the bones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.skeleton import SkeletonModel, rest_pose

_DIRECTIONS = {
    "left": (1, 0, 0), "right": (-1, 0, 0), "up": (0, 0, 1), "down": (0, 0, -1), "forward": (0, -1, 0),
    "back": (0, 1, 0),
}  # fmt: skip
"""Unit vectors of the six directions of the body, in world axes. The keys are the names of the directions."""

_MAX_NAMED_DIRECTION_DEG = 10.0
"""If the angle between a bone and one of the six directions is smaller than this limit, the description of
the bone is only the name of this direction, without an angle. Unit: degrees. Evidence: none."""

_MIN_BONE_M = 1e-6
"""Minimum length, metres, of a bone. A shorter bone is treated as a bone without direction. Derivation: the
limit is larger than the rounding error of numbers with six decimals in a BVH file in centimetres."""

_NEXT_PART = {
    "Shoulder": "Arm",
    "Arm": "ForeArm",
    "ForeArm": "Hand",
    "UpLeg": "Leg",
    "Leg": "Foot",
    "Foot": "ToeBase",
}
"""Next part of a limb for each part. The bone of a part ends at the joint of the next part."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JointDescription:
    """A description of one joint of a skeleton, as the program interprets the joint.

    Attributes:
        name: Name of the joint in the file.
        role: Anatomical name of the joint; "" if the joint has no role.
        parent: Name of the parent; "" for the root.
        bone_m: Length of the bone, metres. The bone ends at the next joint of the limb. If there is no next
            joint, it ends at the only child, or at the End Site.
        points: Direction of the bone in the T-pose, for example ``left`` or ``down, 20° left``; "" for a bone
            without length.
        note: Note about the joint; "" if there is no note.
    """

    name: str
    role: str
    parent: str
    bone_m: float
    points: str
    note: str


def describe_joints(skeleton: SkeletonModel) -> tuple[JointDescription, ...]:
    """Return a description of each joint of a skeleton, in the order of the joints."""
    rest = rest_pose(skeleton)
    out = []
    for joint, name in enumerate(skeleton.joints):
        parent = int(skeleton.parents[joint])
        bone = _bone_vector(skeleton, rest, joint)
        length = float(np.linalg.norm(bone))
        role = skeleton.roles[joint]
        is_helper = parent >= 0 and float(np.linalg.norm(skeleton.offsets_m[joint])) < _MIN_BONE_M
        note = "not rotated by the motion" if not role else ""
        if is_helper:
            note = f"{note}, " * bool(note) + "same position as its parent"
        out.append(
            JointDescription(
                name=name,
                role=role,
                parent=skeleton.joints[parent] if parent >= 0 else "",
                bone_m=length,
                points=describe_direction(bone),
                note=note,
            )
        )
    return tuple(out)


def _bone_vector(skeleton: SkeletonModel, rest: FloatArray, joint: int) -> FloatArray:
    """Return the vector (3,) of the bone that starts at a joint, in the world, metres.

    The vector is zero for a joint with several children, if none of the children is the next joint of a limb.

    Args:
        skeleton: The skeleton.
        rest: (J,4,4) joint poses in the T-pose, in the world.
        joint: Index of the joint.
    """
    side = next((word for word in ("Left", "Right") if skeleton.roles[joint].startswith(word)), "")
    following = _NEXT_PART.get(skeleton.roles[joint].removeprefix(side)) if side else None
    end = None if following is None else skeleton.index_of_role(side + following)
    children = np.flatnonzero(skeleton.parents == joint)
    if end is None and len(children) == 1:
        end = int(children[0])
    if end is not None:
        return np.asarray(rest[end, :3, 3] - rest[joint, :3, 3])
    return np.asarray(rest[joint, :3, :3] @ np.nan_to_num(skeleton.end_offsets_m[joint]))


def describe_direction(vector: FloatArray) -> str:
    """Describe a direction in words, for example ``left`` or ``down, 20° left``.

    The first word is the nearest of the six directions. The angle is the deviation from this nearest
    direction, and the last word is the direction of the deviation.

    Args:
        vector: (3,) direction in world axes, of any length; "" for a vector without length.
    """
    length = np.linalg.norm(vector)
    if length <= _MIN_BONE_M:
        return ""
    unit = vector / length
    ranked = sorted(_DIRECTIONS, key=lambda word: -float(unit @ np.array(_DIRECTIONS[word])))
    nearest = unit @ np.array(_DIRECTIONS[ranked[0]])
    angle_deg = float(np.degrees(np.arccos(np.clip(nearest, -1.0, 1.0))))
    if angle_deg < _MAX_NAMED_DIRECTION_DEG:
        return ranked[0]
    return f"{ranked[0]}, {angle_deg:.0f}° {ranked[1]}"


def describe_arm_pose(skeleton: SkeletonModel) -> str:
    """Describe how the arms are held in the T-pose. The axes of the limbs are computed in the T-pose."""
    rest, arms = rest_pose(skeleton), []
    for side in ("Left", "Right"):
        joint = skeleton.index_of_role(f"{side}Arm")
        if joint is not None:
            arms.append((side.lower(), describe_direction(_bone_vector(skeleton, rest, joint))))
    if not arms:
        return "no joints of the arms were found"
    if all(word.split(",")[0] == side for side, word in arms):
        return "arms stretched out to the sides (T-pose)"
    if all(word.split(",")[0] == "down" for _, word in arms):
        return "arms hanging"
    return "; ".join(f"{side} arm {word or 'without length'}" for side, word in arms)
