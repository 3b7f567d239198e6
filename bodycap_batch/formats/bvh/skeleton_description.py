"""A rig's mapping in words: roles, bones, where limbs point, what is missing."""

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
_MIN_BONE_M = 1e-6
_NEXT_PART = {
    "Shoulder": "Arm",
    "Arm": "ForeArm",
    "ForeArm": "Hand",
    "UpLeg": "Leg",
    "Leg": "Foot",
    "Foot": "ToeBase",
}
_OPTIONAL_PARTS = ("Shoulder", "ToeBase")


@dataclass(frozen=True, slots=True, kw_only=True)
class JointDescription:
    """One joint as it is understood.

    Attributes:
        name: As the rig has it.
        role: Anatomical name, "" without one.
        parent: The parent's name, "" for the root.
        bone_m: Length of the bone from the joint to the next of its limb, else to its only child or its end.
        points: Where that bone points in the T-pose: ``left``, ``down, 20° left`` …, "" without length.
        note: What is special about it.
    """

    name: str
    role: str
    parent: str
    bone_m: float
    points: str
    note: str


def describe_joints(skeleton: SkeletonModel) -> tuple[JointDescription, ...]:
    """Every joint of a rig, in its order."""
    rest = rest_pose(skeleton)
    out = []
    for joint, name in enumerate(skeleton.joints):
        parent = int(skeleton.parents[joint])
        bone = _bone_vector(skeleton, rest, joint)
        length = float(np.linalg.norm(bone))
        role = skeleton.roles[joint]
        helper = parent >= 0 and float(np.linalg.norm(skeleton.offsets_m[joint])) < _MIN_BONE_M
        note = "stays at zero" if not role else ""
        if helper:
            note = f"{note}, " * bool(note) + "sits on its parent"
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
    """The bone (3,) that starts at a joint, in the world; zero where the rig branches."""
    side = next((word for word in ("Left", "Right") if skeleton.roles[joint].startswith(word)), "")
    following = _NEXT_PART.get(skeleton.roles[joint].removeprefix(side)) if side else None
    after = None if following is None else skeleton.index_of_role(side + following)
    children = np.flatnonzero(skeleton.parents == joint)
    if after is None and len(children) == 1:
        after = int(children[0])
    if after is not None:
        return np.asarray(rest[after, :3, 3] - rest[joint, :3, 3])
    return np.asarray(rest[joint, :3, :3] @ np.nan_to_num(skeleton.end_offsets_m[joint]))


def describe_direction(vector: FloatArray) -> str:
    """A direction in the body's words: the nearest of six, and how far it leans to the next."""
    unit = vector / np.linalg.norm(vector)
    ranked = sorted(_DIRECTIONS, key=lambda word: -float(unit @ np.array(_DIRECTIONS[word])))
    nearest = unit @ np.array(_DIRECTIONS[ranked[0]])
    lean = float(np.degrees(np.arccos(np.clip(nearest, -1.0, 1.0))))
    return ranked[0] if lean < 10.0 else f"{ranked[0]}, {lean:.0f}° {ranked[1]}"


def describe_arm_pose(skeleton: SkeletonModel) -> str:
    """How the rig stands in the pose its limb axes are read from."""
    rest, arms = rest_pose(skeleton), []
    for side in ("Left", "Right"):
        joint = skeleton.index_of_role(f"{side}Arm")
        if joint is not None:
            arms.append((side.lower(), _describe_direction_or_empty(_bone_vector(skeleton, rest, joint))))
    if not arms:
        return "no arms recognised"
    if all(word.split(",")[0] == side for side, word in arms):
        return "arms stretched out to the sides (T-pose)"
    if all(word.split(",")[0] == "down" for _, word in arms):
        return "arms hanging"
    return "; ".join(f"{side} arm {word or 'without length'}" for side, word in arms)


def _describe_direction_or_empty(vector: FloatArray) -> str:
    """The same, "" for a vector of no length."""
    return describe_direction(vector) if np.linalg.norm(vector) > _MIN_BONE_M else ""


def missing_roles(skeleton: SkeletonModel) -> tuple[str, ...]:
    """Roles that no joint plays."""
    return tuple(role for role in ROLES if role not in skeleton.roles)


def skeleton_warnings(skeleton: SkeletonModel) -> Iterator[str]:
    """What will hurt: missing joints, and a pose that is none of a standing body."""
    missing = [role for role in missing_roles(skeleton) if not role.endswith(_OPTIONAL_PARTS)]
    if missing:
        yield f"no joint plays {', '.join(missing)}: name one with --map JOINT=ROLE; no camera can ride there"
    rest = rest_pose(skeleton)
    head, hips, foot = (skeleton.index_of_role(role) for role in ("Head", "Hips", "LeftFoot"))
    if head is not None and hips is not None and not rest[head, 2, 3] > rest[hips, 2, 3] + 0.2:
        yield "the head is not above the hips in this pose: name a frame that stands with --tpose-frame N"
    elif foot is not None and hips is not None and not rest[foot, 2, 3] < rest[hips, 2, 3] - 0.2:
        yield "the feet are not below the hips in this pose: name a frame that stands with --tpose-frame N"
    left, right = (skeleton.index_of_role(f"{side}UpLeg") for side in ("Left", "Right"))
    if left is not None and right is not None and not rest[left, 0, 3] > rest[right, 0, 3]:
        yield "its left is not on +X (facing +Z in the file): name a frame that stands with --tpose-frame N"
