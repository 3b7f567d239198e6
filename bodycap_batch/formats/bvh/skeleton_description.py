"""Describe a user's skeleton in words: roles of the joints, directions of the bones, missing joints."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.formats.bvh.roles import ROLES
from bodycap_batch.model.skeleton import SkeletonModel, rest_pose

_DIRECTIONS = {
    "left": (1, 0, 0), "right": (-1, 0, 0), "up": (0, 0, 1), "down": (0, 0, -1), "forward": (0, -1, 0),
    "back": (0, 1, 0),
}  # fmt: skip
"""Unit vectors of the six directions of the body, in world axes. The keys are the names of the directions."""

_MAX_NAMED_DIRECTION_DEG = 10.0
"""If the angle between a bone and one of the six directions is smaller than this limit, the description of
the bone is only the name of this direction, without an angle. Unit: degrees. Evidence: none."""

_MIN_HEIGHT_DIFFERENCE_M = 0.2
"""Minimum height, metres, of the head above the hips, and of the hips above the feet, in a standing pose.
Derivation: both heights are larger even for a child with a stature of 1 m."""

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

_OPTIONAL_PARTS = ("Shoulder", "ToeBase")
"""Parts of limbs that many skeletons do not have. There is no warning if these parts are missing."""


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
                points=describe_direction(bone) if length > _MIN_BONE_M else "",
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
        vector: (3,) direction in world axes, of any length except zero.
    """
    unit = vector / np.linalg.norm(vector)
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
            arms.append((side.lower(), _describe_direction_or_empty(_bone_vector(skeleton, rest, joint))))
    if not arms:
        return "no joints of the arms were found"
    if all(word.split(",")[0] == side for side, word in arms):
        return "arms stretched out to the sides (T-pose)"
    if all(word.split(",")[0] == "down" for _, word in arms):
        return "arms hanging"
    return "; ".join(f"{side} arm {word or 'without length'}" for side, word in arms)


def _describe_direction_or_empty(vector: FloatArray) -> str:
    """Describe the direction of a vector in words; return "" for a vector without length."""
    return describe_direction(vector) if np.linalg.norm(vector) > _MIN_BONE_M else ""


def missing_roles(skeleton: SkeletonModel) -> tuple[str, ...]:
    """Return the roles that no joint of the skeleton has."""
    return tuple(role for role in ROLES if role not in skeleton.roles)


def skeleton_warnings(skeleton: SkeletonModel) -> Iterator[str]:
    """Yield warnings: for missing joints, and for a T-pose that is not the pose of a standing body."""
    missing = [role for role in missing_roles(skeleton) if not role.endswith(_OPTIONAL_PARTS)]
    if missing:
        yield (
            f"no joint has the role {', '.join(missing)}, so no camera can be mounted on this part of the "
            "body: give the role to a joint with --map JOINT=ROLE"
        )
    rest = rest_pose(skeleton)
    head, hips, foot = (skeleton.index_of_role(role) for role in ("Head", "Hips", "LeftFoot"))
    height, margin = rest[:, 2, 3], _MIN_HEIGHT_DIFFERENCE_M
    if head is not None and hips is not None and not height[head] > height[hips] + margin:
        yield (
            "in the T-pose, the head is not above the hips: use --tpose-frame N to choose a frame in "
            "which the person stands"
        )
    elif foot is not None and hips is not None and not height[foot] < height[hips] - margin:
        yield (
            "in the T-pose, the feet are not below the hips: use --tpose-frame N to choose a frame in "
            "which the person stands"
        )
    left, right = (skeleton.index_of_role(f"{side}UpLeg") for side in ("Left", "Right"))
    if left is not None and right is not None and not rest[left, 0, 3] > rest[right, 0, 3]:
        yield (
            "in the T-pose, the left leg is not on the left side of the person: use --tpose-frame N to "
            "choose a frame in which the person stands"
        )
