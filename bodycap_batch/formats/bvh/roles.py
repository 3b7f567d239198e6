"""Assign anatomical roles to the joints of a skeleton from the joint names and the tree.

Names have different meanings in different skeletons. For example, "LeftShoulder" is the collar bone in
HumanIK and Mixamo, but the upper arm in skeletons with a LeftCollar or a LeftElbow. Therefore a word in a
name gives only candidates for the role. The order of the joints along the limb determines the role.

The parts of a limb are numbered. These numbers are called slots: indices of `_ARM` or `_LEG`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from bodycap_batch.core.arrays import FloatArray

_ARM = ("Shoulder", "Arm", "ForeArm", "Hand")
_LEG = ("UpLeg", "Leg", "Foot", "ToeBase")

ROLES = (
    *("Hips", "Spine", "Spine1", "Neck", "Head"),
    *(side + part for side in ("Left", "Right") for part in (*_ARM, *_LEG)),
)
"""Names of all roles, as in HumanIK."""

_ARM_WORDS = {
    (0,): "clavicle collar collarbone clav",
    (0, 1): "shoulder",
    (1,): "shldr arm upperarm uparm humerus",
    (2,): "forearm lowerarm lowarm loarm elbow radius",
    (3,): "hand wrist palm",
}
"""Words that occur in the names of arm joints. The value of an entry is a string of words, separated by
spaces. Its key lists the slots (indices of `_ARM`) that these words may mean, the most likely slot first."""

_LEG_WORDS = {
    (0,): "upleg upperleg thigh femur hip",
    (1, 0): "leg",
    (1,): "lowleg lowerleg loleg calf shin shank tibia knee",
    (2,): "ankle",
    (2, 3): "foot",
    (3,): "toe toes toebase ball",
}
"""Words that occur in the names of leg joints, separated by spaces. The key of each entry lists the slots
(indices of `_LEG`) that these words may mean, with the most likely slot first."""

_HIPS_WORDS = {"hips", "hip", "pelvis", "waist", "root"}
_SPINE_WORDS = {
    "spine",
    "chest",
    "upperchest",
    "lowerback",
    "upperback",
    "abdomen",
    "torso",
    "thorax",
    "back",
}
_NECK_WORDS = {"neck", "lowerneck", "upperneck"}
_HEAD_WORDS = {"head", "skull"}

_ARM_SCORES = (9.0, 10.0, 10.0, 10.0)
"""Score that is added for each slot (part) of the arm if a joint is found for it. The score of the collar
bone is lower, because some skeletons have no collar bone. Evidence: none; only the order of the scores is
important."""

_LEG_SCORES = (10.0, 10.0, 10.0, 9.0)
"""Score that is added for each slot (part) of the leg if a joint is found for it. The score of the toes is
lower, because some skeletons have no toes. Evidence: none; only the order of the scores is important."""

_SECOND_CHOICE_COST = 0.1
"""Score that is subtracted if a word in a joint name is interpreted with its second meaning. For the third
meaning, it is subtracted twice. Derivation: it is smaller than the difference between two slot scores.
Therefore it affects only the choice between selections with otherwise equal scores."""

_MIN_OFFSET_M = 1e-9
"""Minimum distance, metres, between a joint and its parent. A joint with a shorter distance is treated as a
helper joint without a bone. Derivation: the distance of helper joints is zero, except for rounding
errors."""

_WORD_PATTERN = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")


def _slots_by_word(words: dict[tuple[int, ...], str]) -> dict[str, tuple[int, ...]]:
    """Return a mapping from each word to the slots that the word may mean."""
    return {word: slots for slots, text in words.items() for word in text.split()}


_ARM_SLOTS, _LEG_SLOTS = _slots_by_word(_ARM_WORDS), _slots_by_word(_LEG_WORDS)


def assign_roles(
    joints: Sequence[str], parents: Sequence[int], offsets_m: FloatArray | None = None
) -> tuple[str, ...]:
    """Assign an anatomical role to each joint.

    Args:
        joints: (J,) joint names of the skeleton.
        parents: (J,) index of the parent of each joint; −1 for the root. Parents come before their children.
        offsets_m: (J,3) joint centres in the frames of the parents, metres. If they are given, joints with a
            bone are preferred to helper joints of zero length.

    Returns:
        (J,) role of each joint, with the names of HumanIK: Hips, Spine, Spine1 (the joint at which the arms
        branch off), Neck, Head, LeftShoulder (the collar bone), LeftArm and the other names in `ROLES`. A
        joint without a role has the role "". Each of the other roles occurs at most once.
    """
    names = [_split_name(name) for name in _strip_common_prefix(joints)]
    ancestors = [_ancestors(joint, parents) for joint in range(len(joints))]
    found: dict[str, int] = {}
    for side, side_name in (("l", "Left"), ("r", "Right")):
        for table, parts, scores in ((_ARM_SLOTS, _ARM, _ARM_SCORES), (_LEG_SLOTS, _LEG, _LEG_SCORES)):
            candidates = [table.get(base, ()) if own == side else () for own, base in names]
            for slot, joint in _best_chain(candidates, ancestors, scores).items():
                found[side_name + parts[slot]] = joint
    has_bone = np.ones(len(joints), dtype=bool)
    if offsets_m is not None:
        has_bone = np.linalg.norm(np.asarray(offsets_m), axis=1) > _MIN_OFFSET_M
    bases = [base if not side else "" for side, base in names]
    _assign_trunk(found, bases, ancestors, has_bone.tolist())
    role_of = {joint: role for role, joint in found.items()}
    return tuple(role_of.get(joint, "") for joint in range(len(joints)))


def _strip_common_prefix(joints: Sequence[str]) -> list[str]:
    """Remove the namespace ("mixamorig:") and the common prefix ("Bip01 ", "Character1_") from all names."""
    names = [name.rsplit(":", 1)[-1].rsplit("|", 1)[-1] for name in joints]
    if len(names) < 3:
        return names
    length = next((i for i, letters in enumerate(zip(*names, strict=False)) if len(set(letters)) > 1), None)
    common = min(names, key=len)[:length]
    whole = re.match(r".*[\s_.\-]", common)
    if common in names and re.search(r"\d$", common):
        return [name[len(common) :] for name in names]
    return [name[whole.end() :] for name in names] if whole else names


def _split_name(name: str) -> tuple[str, str]:
    """Split a joint name into the side ("l", "r" or "") and the rest.

    The rest is in lower case and without final digits.
    """
    tokens = [token.lower() for token in _WORD_PATTERN.findall(name)]
    while tokens and tokens[-1].isdigit():
        tokens.pop()
    side = ""
    for position in (0, -1):
        if len(tokens) > 1 and tokens[position] in ("left", "right", "l", "r"):
            side = tokens.pop(position)[0]
            break
    while tokens and tokens[-1].isdigit():
        tokens.pop()
    base = "".join(tokens)
    is_limb = base in _ARM_SLOTS or base in _LEG_SLOTS
    for prefix in ("left", "right", "l", "r"):
        rest = base.removeprefix(prefix)
        if not side and not is_limb and rest != base and (rest in _ARM_SLOTS or rest in _LEG_SLOTS):
            return prefix[0], rest
    return side, base


def _ancestors(joint: int, parents: Sequence[int]) -> list[int]:
    """Return the ancestors of a joint, from its parent to the root."""
    out: list[int] = []
    while parents[joint] >= 0:
        joint = int(parents[joint])
        out.append(joint)
    return out


def _best_chain(
    candidates: Sequence[tuple[int, ...]], ancestors: Sequence[list[int]], scores: tuple[float, ...]
) -> dict[int, int]:
    """Select the joints of a limb: at most one joint for each slot, with the largest sum of scores.

    The selected joints are on one path of the tree, and their slots increase along the path. If several
    selections have the same sum, the joints nearest to the trunk are selected.

    Args:
        candidates: (J,) slots that each joint may have, the most likely slot first.
        ancestors: (J,) ancestors of each joint, from its parent to the root.
        scores: Score of each slot.

    Returns:
        The index of the selected joint for each slot. The keys are the slots.
    """
    best: dict[tuple[int, int], tuple[float, dict[int, int]]] = {}
    top: tuple[float, dict[int, int]] = (0.0, {})
    for joint, slots in enumerate(candidates):
        for choice, slot in enumerate(slots):
            start: tuple[float, dict[int, int]] = (0.0, {})
            for ancestor in ancestors[joint]:
                for earlier_slot in range(slot):
                    candidate = best.get((ancestor, earlier_slot), start)
                    start = candidate if candidate[0] > start[0] else start
            score = start[0] + scores[slot] - _SECOND_CHOICE_COST * choice
            best[joint, slot] = (score, {**start[1], slot: joint})
            top = best[joint, slot] if score > top[0] else top
    return top[1]


def _assign_trunk(
    found: dict[str, int], bases: Sequence[str], ancestors: Sequence[list[int]], has_bone: Sequence[bool]
) -> None:
    """Add Hips, Spine, Spine1, Neck and Head to the roles of the limbs.

    Args:
        found: Index of the joint with each role. The keys are the roles. The roles of the trunk are added to
            this mapping.
        bases: (J,) name of each joint in lower case; "" for joints with a side.
        ancestors: (J,) ancestors of each joint, from its parent to the root.
        has_bone: (J,) False for helper joints of zero length.
    """
    taken = set(found.values())

    def first(words: set[str], among: Sequence[int]) -> int | None:
        return next((joint for joint in among if bases[joint] in words and joint not in taken), None)

    def claim(role: str, joint: int | None) -> None:
        if joint is not None and joint not in taken:
            found[role] = joint
            taken.add(joint)

    everything = range(len(bases))
    hips = _lowest_common_ancestor([found.get("LeftUpLeg"), found.get("RightUpLeg")], ancestors)
    named = first(_HIPS_WORDS - {"root"}, everything)
    claim(
        "Hips", named if named is not None else hips if hips is not None else first(_HIPS_WORDS, everything)
    )
    claim("Head", first(_HEAD_WORDS, everything))
    arms = [found.get(f"{side}Shoulder", found.get(f"{side}Arm")) for side in ("Left", "Right")]
    chest = _lowest_common_ancestor(arms, ancestors)
    while chest is not None and bases[chest] in _NECK_WORDS and ancestors[chest]:
        chest = ancestors[chest][0]
    if chest is None or chest in taken:
        spine = [joint for joint in everything if bases[joint] in _SPINE_WORDS and joint not in taken]
        chest = spine[-1] if spine else None
    claim("Spine1", chest)
    between = _joints_between(found.get("Hips"), found.get("Spine1"), ancestors)
    claim("Spine", _choose_joint("spine", between, bases, has_bone))
    necks = _joints_between(found.get("Spine1", found.get("Hips")), found.get("Head"), ancestors)
    necks = [joint for joint in necks if bases[joint] in _NECK_WORDS] or (
        necks[:1] if "Spine1" in found else []
    )
    claim("Neck", _choose_joint("neck", necks, bases, has_bone))


def _lowest_common_ancestor(joints: Sequence[int | None], ancestors: Sequence[list[int]]) -> int | None:
    """Return the joint farthest from the root that is an ancestor of all given joints.

    Returns None if one of the given joints is None, or if the given joints have no common ancestor.
    """
    present = [joint for joint in joints if joint is not None]
    if len(present) < len(joints):
        return None
    common = (joint for joint in ancestors[present[0]] if all(joint in ancestors[other] for other in present))
    return next(common, None)


def _joints_between(upper: int | None, lower: int | None, ancestors: Sequence[list[int]]) -> list[int]:
    """Return the joints between two joints of one path, from the upper joint to the lower joint.

    The two joints are not included. The list is empty if the upper joint is not an ancestor of the lower
    joint.
    """
    if upper is None or lower is None or upper not in ancestors[lower]:
        return []
    path = ancestors[lower]
    return path[: path.index(upper)][::-1]


def _choose_joint(
    word: str, among: Sequence[int], bases: Sequence[str], has_bone: Sequence[bool]
) -> int | None:
    """Choose the joint in `among` that fits the name `word` best.

    The order of preference is: a joint with the name `word` and a bone, the first joint with a bone, the
    first joint.

    Returns:
        The index of the joint; None if `among` is empty.
    """
    order = sorted(
        among, key=lambda joint: (not (bases[joint] == word and has_bone[joint]), not has_bone[joint])
    )
    return order[0] if order else None
