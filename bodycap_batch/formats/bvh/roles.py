"""Which joint of a rig is the elbow? Anatomical roles from joint names and the tree.

Rigs disagree on names: "LeftShoulder" is the collar bone in HumanIK and Mixamo, the upper arm in rigs that
have a LeftCollar or a LeftElbow. So a word only offers candidates, and the order along the limb decides.
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
"""Every role: HumanIK's names."""

_ARM_WORDS = {
    (0,): "clavicle collar collarbone clav",
    (0, 1): "shoulder",
    (1,): "shldr arm upperarm uparm humerus",
    (2,): "forearm lowerarm lowarm loarm elbow radius",
    (3,): "hand wrist palm",
}
_LEG_WORDS = {
    (0,): "upleg upperleg thigh femur hip",
    (1, 0): "leg",
    (1,): "lowleg lowerleg loleg calf shin shank tibia knee",
    (2,): "ankle",
    (2, 3): "foot",
    (3,): "toe toes toebase ball",
}
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
_LEG_SCORES = (10.0, 10.0, 10.0, 9.0)
"""What finding each joint of a limb is worth: collar bone and toes are the ones a rig may lack."""

_WORD_PATTERN = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")


def _slots_by_word(words: dict[tuple[int, ...], str]) -> dict[str, tuple[int, ...]]:
    return {word: slots for slots, text in words.items() for word in text.split()}


_ARM_SLOTS, _LEG_SLOTS = _slots_by_word(_ARM_WORDS), _slots_by_word(_LEG_WORDS)


def assign_roles(
    joints: Sequence[str], parents: Sequence[int], offsets_m: FloatArray | None = None
) -> tuple[str, ...]:
    """Name the anatomical role of each joint.

    Args:
        joints: (J,) names as the rig has them.
        parents: (J,) index of each parent, −1 for the root; parents before children.
        offsets_m: (J,3) joint centres in their parents, to prefer the joints that have a bone over
            helpers of zero length.

    Returns:
        (J,) HumanIK names (Hips, Spine, Spine1 = the joint that carries the arms, Neck, Head,
        LeftShoulder = collar bone, LeftArm ...), "" where a joint has none; each role at most once.
    """
    names = [_split_name(name) for name in _strip_common_prefix(joints)]
    chains = [_ancestors(joint, parents) for joint in range(len(joints))]
    found: dict[str, int] = {}
    for side, title in (("l", "Left"), ("r", "Right")):
        for table, slots, worth in ((_ARM_SLOTS, _ARM, _ARM_SCORES), (_LEG_SLOTS, _LEG, _LEG_SCORES)):
            allowed = [table.get(base, ()) if mine == side else () for mine, base in names]
            for slot, joint in _best_chain(allowed, chains, worth).items():
                found[title + slots[slot]] = joint
    has_bone = np.ones(len(joints), dtype=bool)
    if offsets_m is not None:
        has_bone = np.linalg.norm(np.asarray(offsets_m), axis=1) > 1e-9
    bases = [base if not side else "" for side, base in names]
    _assign_trunk(found, bases, chains, has_bone.tolist())
    role_of = {joint: role for role, joint in found.items()}
    return tuple(role_of.get(joint, "") for joint in range(len(joints)))


def _strip_common_prefix(joints: Sequence[str]) -> list[str]:
    """Drop a namespace ("mixamorig:") and what all names begin with ("Bip01 ", "Character1_")."""
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
    """Split a joint name into its side ("l", "r" or "") and the rest in lower case, digits dropped."""
    tokens = [token.lower() for token in _WORD_PATTERN.findall(name)]
    while tokens and tokens[-1].isdigit():
        tokens.pop()
    side = ""
    for place in (0, -1):
        if len(tokens) > 1 and tokens[place] in ("left", "right", "l", "r"):
            side = tokens.pop(place)[0]
            break
    while tokens and tokens[-1].isdigit():
        tokens.pop()
    base = "".join(tokens)
    known = base in _ARM_SLOTS or base in _LEG_SLOTS
    for prefix in ("left", "right", "l", "r"):
        rest = base.removeprefix(prefix)
        if not side and not known and rest != base and (rest in _ARM_SLOTS or rest in _LEG_SLOTS):
            return prefix[0], rest
    return side, base


def _ancestors(joint: int, parents: Sequence[int]) -> list[int]:
    """A joint's parent, its parent, and so on to the root."""
    out: list[int] = []
    while parents[joint] >= 0:
        joint = int(parents[joint])
        out.append(joint)
    return out


def _best_chain(
    allowed: Sequence[tuple[int, ...]], chains: Sequence[list[int]], worth: tuple[float, ...]
) -> dict[int, int]:
    """Pick joints down one path of the tree, slots increasing, that are worth the most together.

    A word's second choice costs a little; among equals the joint nearest the trunk wins.

    Returns:
        Joint index of each slot that was found.
    """
    best: dict[tuple[int, int], tuple[float, dict[int, int]]] = {}
    top: tuple[float, dict[int, int]] = (0.0, {})
    for joint, slots in enumerate(allowed):
        for choice, slot in enumerate(slots):
            start: tuple[float, dict[int, int]] = (0.0, {})
            for ancestor in chains[joint]:
                for before in range(slot):
                    candidate = best.get((ancestor, before), start)
                    start = candidate if candidate[0] > start[0] else start
            score = start[0] + worth[slot] - 0.1 * choice
            best[joint, slot] = (score, {**start[1], slot: joint})
            top = best[joint, slot] if score > top[0] else top
    return top[1]


def _assign_trunk(
    found: dict[str, int], bases: Sequence[str], chains: Sequence[list[int]], has_bone: Sequence[bool]
) -> None:
    """Add Hips, Spine, Spine1, Neck and Head to the limbs already found."""
    taken = set(found.values())

    def first(words: set[str], among: Sequence[int]) -> int | None:
        return next((joint for joint in among if bases[joint] in words and joint not in taken), None)

    def claim(role: str, joint: int | None) -> None:
        if joint is not None and joint not in taken:
            found[role] = joint
            taken.add(joint)

    everything = range(len(bases))
    hips = _lowest_common_ancestor([found.get("LeftUpLeg"), found.get("RightUpLeg")], chains)
    named = first(_HIPS_WORDS - {"root"}, everything)
    claim(
        "Hips", named if named is not None else hips if hips is not None else first(_HIPS_WORDS, everything)
    )
    claim("Head", first(_HEAD_WORDS, everything))
    arms = [found.get(f"{side}Shoulder", found.get(f"{side}Arm")) for side in ("Left", "Right")]
    chest = _lowest_common_ancestor(arms, chains)
    while chest is not None and bases[chest] in _NECK_WORDS and chains[chest]:
        chest = chains[chest][0]
    if chest is None or chest in taken:
        spine = [joint for joint in everything if bases[joint] in _SPINE_WORDS and joint not in taken]
        chest = spine[-1] if spine else None
    claim("Spine1", chest)
    between = _joints_between(found.get("Hips"), found.get("Spine1"), chains)
    claim("Spine", _choose_joint("spine", between, bases, has_bone))
    necks = _joints_between(found.get("Spine1", found.get("Hips")), found.get("Head"), chains)
    necks = [joint for joint in necks if bases[joint] in _NECK_WORDS] or (
        necks[:1] if "Spine1" in found else []
    )
    claim("Neck", _choose_joint("neck", necks, bases, has_bone))


def _lowest_common_ancestor(joints: Sequence[int | None], chains: Sequence[list[int]]) -> int | None:
    """The lowest joint that stands above all the given ones; None when one is missing."""
    given = [joint for joint in joints if joint is not None]
    if len(given) < len(joints):
        return None
    return next((joint for joint in chains[given[0]] if all(joint in chains[other] for other in given)), None)


def _joints_between(upper: int | None, lower: int | None, chains: Sequence[list[int]]) -> list[int]:
    """Joints strictly between two joints of one path, from the upper one down."""
    if upper is None or lower is None or upper not in chains[lower]:
        return []
    path = chains[lower]
    return path[: path.index(upper)][::-1]


def _choose_joint(
    word: str, among: Sequence[int], bases: Sequence[str], has_bone: Sequence[bool]
) -> int | None:
    """Of several joints the one named exactly so, else the first with a bone, else the first."""
    order = sorted(
        among, key=lambda joint: (not (bases[joint] == word and has_bone[joint]), not has_bone[joint])
    )
    return order[0] if order else None
