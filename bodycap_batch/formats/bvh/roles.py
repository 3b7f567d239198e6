"""Assign anatomical roles to the joints of a skeleton from the joint names and the tree.

Names have different meanings in different skeletons. For example, "LeftShoulder" is the collar bone in
HumanIK and Mixamo, but the upper arm in skeletons with a LeftCollar or a LeftElbow. Other skeletons have
names that this program does not know. Therefore a word in a name gives only candidates for the role, and the
tree decides: limbs are pairs of similar chains, the pair nearer to the root is the legs, and the two longest
successive bones of a chain are the upper and the lower part of the limb.

The parts of a limb are numbered from the trunk to the tip. These numbers are called slots.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.formats.bvh.joint_words import ARM, LEG, JointName, read_names

_PARTS = {ARM: ("Shoulder", "Arm", "ForeArm", "Hand"), LEG: ("UpLeg", "Leg", "Foot", "ToeBase")}
_CORE = {ARM: (1, 2, 3), LEG: (0, 1, 2)}
"""Slots that every limb has: three joints with two long bones between them. Collar bone and toes are missing
in some skeletons."""

ROLES = (
    *("Hips", "Spine", "Spine1", "Neck", "Head"),
    *(side + part for side in ("Left", "Right") for limb in (ARM, LEG) for part in _PARTS[limb]),
)
"""Names of all roles, as in HumanIK."""

_EXACT_SCORE, _PARTIAL_SCORE, _TREE_SCORE = 10.0, 8.0, 2.0
"""Score of a joint whose name is a word for its slot, whose name contains such a word, and whose name says
nothing. Evidence: none; only the order of the scores is important."""

_CORE_SCORE = 3.0
"""Score that is added for each core slot with a joint. Evidence: none; it is larger than `_TREE_SCORE`, so
that a chain without an upper arm, for example, is chosen only if there is no other."""

_SECOND_CHOICE_COST = 0.1
"""Score that is subtracted if a word in a joint name is interpreted with its second meaning. Derivation: it
affects only the choice between selections with otherwise equal scores."""

_LENGTH_SCORE = 3.0
"""Score of a limb bone as long as the longest path of the skeleton. Derivation: it decides where names say
nothing, and the difference between two names that fit is larger."""

_END_FACTOR = 2.0
"""Factor on the score of the bone that ends in a hand without one single child: fingers, or nothing, begin
there. Derivation: in skeletons of CMU the collar bone is 1.4 times as long as the forearm."""

_DEPTH_COST = 0.005
"""Score that is subtracted for each step of a joint from the root, so that the first of two equal names on a
limb is chosen, such as the wrist of a wrist and a hand."""

_SIMILAR_SCORE, _LEGS_BELOW_SCORE = 3.0, 2.0
"""Score of two chains of equal length, and of legs that branch off nearer to the root than the arms.
Evidence: none; they decide where names say nothing."""

_SIGNS = {"l": 1, "r": -1, "": 0}
"""Sign of the left direction for each side."""

_OTHER_SIDE = {"l": "r", "r": "l", "": ""}
"""The opposite of each side; "" for an unknown side."""

_WINDOW = 16
"""Maximum number of steps between two successive joints of a limb. Twist joints and helpers may lie between
them; no skeleton has so many."""

_MAX_PAIRS = 20
"""Number of the best pairs of chains, of arms and of legs each, that are combined. Evidence: none."""

_MIN_OFFSET_RATIO = 1e-6
"""Minimum distance between a joint and its parent, as a part of the longest path of the skeleton. A joint
with a shorter distance is treated as a helper joint without a bone. Derivation: the distance of helper joints
is zero, except for rounding errors."""

_MIN_TOE_RATIO = 0.3
"""Minimum forward part of the direction from the ankle to the toes, if left and right are found from it."""


@dataclass(frozen=True, slots=True)
class _Chain:
    """A selection of the joints of a limb: pairs (slot, joint) from the trunk to the tip, and its score."""

    score: float = 0.0
    length: float = 0.0
    joints: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True, slots=True)
class _Pair:
    """Two chains that branch off at one joint. `sides` are ``l`` and ``r`` in the order of the chains."""

    score: float
    branch: int
    chains: tuple[_Chain, _Chain]
    sides: tuple[str, str]

    def used(self) -> set[int]:
        return {joint for chain in self.chains for _, joint in chain.joints}


class _Tree:
    """The tree of the joints: what the names say, and the lengths and positions of the zero pose.

    Args:
        joints: (J,) names of the joints.
        parents: (J,) index of the parent of each joint; −1 for the root.
        offsets: (J,3) joint centres in the frames of the parents; None if they are unknown.
        ends: (J,3) far ends of the bones in the frames of their joints; None if they are unknown.
    """

    def __init__(
        self,
        joints: Sequence[str],
        parents: Sequence[int],
        offsets: FloatArray | None,
        ends: FloatArray | None,
    ) -> None:
        count = len(joints)
        self.names = read_names(joints)
        self.parents = [int(parent) for parent in parents]
        self.children: list[list[int]] = [[] for _ in range(count)]
        self.ancestors: list[list[int]] = []
        self.at = np.zeros((count, 3)) if offsets is None else np.array(offsets, dtype=np.float64)
        self.lengths: list[float] = np.linalg.norm(self.at, axis=1).tolist()
        if not any(self.lengths[1:]):
            self.lengths = [1.0] * count
        path = [0.0] * count
        for joint, parent in enumerate(self.parents):
            self.ancestors.append([] if parent < 0 else [parent, *self.ancestors[parent]])
            if parent >= 0:
                self.children[parent].append(joint)
                self.at[joint] += self.at[parent]
                path[joint] = path[parent] + self.lengths[joint]
        self.tips = self.at + (0.0 if ends is None else np.nan_to_num(np.asarray(ends, dtype=np.float64)))
        self.size = max(path) or 1.0
        self.has_bone = [length > _MIN_OFFSET_RATIO * self.size for length in self.lengths]
        self.repeats = [
            bool(name.slots) and any(self.names[above].slots == name.slots for above in self.ancestors[joint])
            for joint, name in enumerate(self.names)
        ]
        self.leftness = [_SIGNS[name.side] for name in self.names]
        for joint in range(count - 1, 0, -1):
            self.leftness[self.parents[joint]] += self.leftness[joint]

    def below(self, joint: int) -> list[int]:
        """Return a joint and its descendants."""
        return [other for other in range(joint, len(self.parents)) if self.is_below(other, joint)]

    def is_below(self, joint: int, ancestor: int) -> bool:
        """Return True if a joint is `ancestor` or one of its descendants."""
        return joint == ancestor or ancestor in self.ancestors[joint]

    def side_of(self, joint: int) -> str:
        """Return the side that most names in the subtree of a joint have; "" if there is no majority."""
        return "" if self.leftness[joint] == 0 else "l" if self.leftness[joint] > 0 else "r"


def assign_roles(
    joints: Sequence[str],
    parents: Sequence[int],
    offsets_m: FloatArray | None = None,
    end_offsets_m: FloatArray | None = None,
) -> tuple[str, ...]:
    """Assign an anatomical role to each joint.

    Args:
        joints: (J,) joint names of the skeleton.
        parents: (J,) index of the parent of each joint; −1 for the root. Parents come before their children.
        offsets_m: (J,3) joint centres in the frames of the parents. If they are given, joints with a bone are
            preferred to helper joints of zero length, and the lengths of bones decide where names say
            nothing.
        end_offsets_m: (J,3) far ends of the bones in the frames of their joints; NaN if there is none. They
            help to find left and right where names do not say it.

    Returns:
        (J,) role of each joint, with the names of HumanIK: Hips, Spine, Spine1 (the joint at which the arms
        branch off), Neck, Head, LeftShoulder (the collar bone), LeftArm and the other names in `ROLES`. A
        joint without a role has the role "". Each of the other roles occurs at most once.
    """
    tree = _Tree(joints, parents, offsets_m, end_offsets_m)
    pairs = _limb_pairs(tree)
    found: dict[str, int] = {}
    for limb, parts in _PARTS.items():
        pair = pairs.get(limb)
        if pair is None:
            named = {side: _single_limb(tree, limb, side) for side in "lr"}
        else:
            named = dict(zip(pair.sides, pair.chains, strict=True))
        for side, chain in named.items():
            for slot, joint in chain.joints:
                found[f"{'Left' if side == 'l' else 'Right'}{parts[slot]}"] = joint
    _assign_trunk(found, tree, [pair.branch for pair in pairs.values()])
    role_of = {joint: role for role, joint in found.items()}
    return tuple(role_of.get(joint, "") for joint in range(len(joints)))


def _slot_scores(name: JointName, limb: str, side: str, *, by_name: bool, repeats: bool) -> dict[int, float]:
    """Return the scores of a joint with this name in the slots of a limb that it can have.

    The arguments are those of `_best_chains`. A joint that repeats a word of a joint above it ("Arm2" below
    "Arm1") may also have the slots that follow.
    """
    if name.helper or (side and name.side not in ("", side)) or (by_name and not name.side):
        return {}
    choices, base = name.slots.get(limb, ()), _EXACT_SCORE if name.exact else _PARTIAL_SCORE
    scores = {slot: base - _SECOND_CHOICE_COST * choice for choice, slot in enumerate(choices)}
    if not by_name and (repeats or not name.is_known):
        free = range(max(choices, default=-1) + 1, 4)
        scores |= {slot: _TREE_SCORE if slot in _CORE[limb] else 0.5 for slot in free}
    return {slot: score + _CORE_SCORE * (slot in _CORE[limb]) for slot, score in scores.items()}


def _best_chains(tree: _Tree, limb: str, side: str, *, by_name: bool) -> list[_Chain]:
    """Return, for each joint, the best chain of a limb in its subtree.

    The joints of a chain are on one path of the tree, and their slots increase along the path.

    Args:
        tree: The tree.
        limb: `ARM` or `LEG`.
        side: ``l`` or ``r``: joints whose names have the other side are left out; "" for all joints.
        by_name: True to use only joints whose name contains a word for the slot.
    """
    count, core = len(tree.parents), _CORE[limb]
    fits = [
        _slot_scores(name, limb, side, by_name=by_name, repeats=repeats)
        for name, repeats in zip(tree.names, tree.repeats, strict=True)
    ]
    after: list[dict[int, _Chain]] = [{} for _ in range(count)]
    best = [_Chain()] * count
    for joint in range(count - 1, -1, -1):
        is_end = limb == ARM and not tree.names[joint].is_known and len(tree.children[joint]) != 1
        for slot, own in fits[joint].items():
            rest = after[joint].get(slot, _Chain())
            score = own + rest.score - _DEPTH_COST * len(tree.ancestors[joint])
            chain = _Chain(score, rest.length, ((slot, joint), *rest.joints))
            best[joint] = max(best[joint], chain, key=lambda each: each.score)
            longest, length, below = 0.0, 0.0, joint
            for ancestor in tree.ancestors[joint][:_WINDOW]:
                longest, length = max(longest, tree.lengths[below]), length + tree.lengths[below]
                for upper in fits[ancestor]:
                    if upper >= slot:
                        continue
                    is_bone = upper + 1 == slot and upper in core and slot in core
                    gain = _LENGTH_SCORE * longest / tree.size if is_bone else 0.0
                    gain *= _END_FACTOR if is_end and slot == core[-1] and below == joint else 1.0
                    longer = _Chain(chain.score + gain, chain.length + length, chain.joints)
                    if longer.score > after[ancestor].get(upper, _Chain()).score:
                        after[ancestor][upper] = longer
                below = ancestor
        parent = tree.parents[joint]
        if parent >= 0 and best[joint].score > best[parent].score:
            best[parent] = best[joint]
    return best


def _limb_pairs(tree: _Tree) -> dict[str, _Pair]:
    """Return the pair of arms and the pair of legs, by limb; a limb that was not found is left out."""
    candidates: dict[str, list[_Pair]] = {ARM: [], LEG: []}

    @cache
    def chains(limb: str, side: str) -> list[_Chain]:
        both = (_best_chains(tree, limb, side, by_name=by_name) for by_name in (False, True))
        return [_usable(tree, limb, whole, named) for whole, named in zip(*both, strict=True)]

    for limb, pairs in candidates.items():
        for branch, children in enumerate(tree.children):
            sides = {joint: tree.side_of(joint) for joint in children if len(children) > 1}
            some = [joint for joint, side in sides.items() if chains(limb, side)[joint].score]
            for first, second in itertools.combinations(some, 2):
                if sides[first] and sides[first] == sides[second]:
                    continue
                own = sides[first] or _OTHER_SIDE[sides[second]]
                sides_of_pair = (own, _OTHER_SIDE[own])
                one, other = chains(limb, own)[first], chains(limb, sides_of_pair[1])[second]
                if one.score and other.score:
                    pairs.append(_Pair(_pair_score(one, other), branch, (one, other), sides_of_pair))
        pairs.sort(key=lambda pair: -pair.score)
    choices: list[tuple[float, dict[str, _Pair]]] = [(0.0, {})]
    for arms, legs in itertools.product(*((*pairs[:_MAX_PAIRS], None) for pairs in candidates.values())):
        chosen = {limb: pair for limb, pair in ((ARM, arms), (LEG, legs)) if pair is not None}
        score = sum(pair.score for pair in chosen.values())
        if arms is not None and legs is not None:
            if arms.used() & legs.used():
                continue
            score += _LEGS_BELOW_SCORE * tree.is_below(arms.branch, legs.branch)
        choices.append((score, chosen))
    return _with_sides(tree, max(choices, key=lambda choice: choice[0])[1])


def _single_limb(tree: _Tree, limb: str, side: str) -> _Chain:
    """Return the limb of one side if there is no pair of such limbs. Its first name says the side."""
    whole = _best_chains(tree, limb, side, by_name=False)[0]
    named = _best_chains(tree, limb, side, by_name=True)[0]
    is_sided = bool(whole.joints) and tree.names[whole.joints[0][1]].side == side and bool(named.joints)
    return _usable(tree, limb, whole if is_sided else named, named)


def _usable(tree: _Tree, limb: str, whole: _Chain, named: _Chain) -> _Chain:
    """Return the chain to use.

    Joints without a word in their names, and second meanings of words, are used only in a complete limb.
    Collar bone and toes without such a word are used only if no name of the limb says anything.

    Args:
        tree: The tree.
        limb: `ARM` or `LEG`.
        whole: The best chain of all joints.
        named: The best chain of the joints whose names say their part.
    """
    choices = {joint: tree.names[joint].slots.get(limb, ()) for _, joint in (*whole.joints, *named.joints)}
    core = {*_CORE[limb]}
    if core <= {slot for slot, _ in whole.joints}:
        speaks = any(slot in choices[joint] for slot, joint in whole.joints)
        kept = [(s, j) for s, j in whole.joints if s in core or s in choices[j] or not speaks]
        return _Chain(whole.score, whole.length, tuple(kept))
    kept = [(slot, joint) for slot, joint in named.joints if choices[joint][0] == slot]
    return _Chain(named.score if kept else 0.0, named.length, tuple(kept))


def _pair_score(first: _Chain, second: _Chain) -> float:
    """Return the score of two chains as the two limbs of a body: equal lengths are usual."""
    if not (first.length and second.length):
        return first.score + second.score
    unlike = min(1.0, 4.0 * abs(math.log(first.length / second.length)))
    return first.score + second.score + _SIMILAR_SCORE * (1.0 - unlike)


def _with_sides(tree: _Tree, pairs: dict[str, _Pair]) -> dict[str, _Pair]:
    """Return the pairs with sides. Sides that the names do not say follow from the other pair, or the toes.

    A pair whose sides cannot be found is left out.
    """
    across = np.zeros(3)
    for pair in pairs.values():
        across += _SIGNS[pair.sides[0]] * _across(tree, pair)
    if not across.any() and LEG in pairs:
        across = _left_from_toes(tree, pairs[LEG])
    out = {}
    for limb, pair in pairs.items():
        sides, way = pair.sides, float(across @ _across(tree, pair))
        if not sides[0] and way:
            sides = ("l", "r") if way > 0.0 else ("r", "l")
        if sides[0]:
            out[limb] = replace(pair, sides=sides)
    return out


def _across(tree: _Tree, pair: _Pair) -> FloatArray:
    """Return the vector (3,) from the second to the first limb of a pair in the zero pose."""
    first, second = (tree.at[[joint for _, joint in chain.joints]].mean(axis=0) for chain in pair.chains)
    return np.asarray(first - second)


def _left_from_toes(tree: _Tree, legs: _Pair) -> FloatArray:
    """Return the direction (3,) to the left of a body whose toes point forward; zero if it is unknown."""
    up, toes = np.zeros(3), np.zeros(3)
    for chain in legs.chains:
        joint_of = dict(chain.joints)
        if not {0, 2} <= joint_of.keys():
            return np.zeros(3)
        up += tree.at[joint_of[0]] - tree.at[joint_of[2]]
        foot = tree.tips[tree.below(joint_of[2])] - tree.at[joint_of[2]]
        toes += foot[np.argmax(np.linalg.norm(foot, axis=1))]
    up /= max(float(np.linalg.norm(up)), 1e-300)
    forward = toes - (toes @ up) * up
    if np.linalg.norm(forward) <= _MIN_TOE_RATIO * np.linalg.norm(toes):
        return np.zeros(3)
    return np.asarray(np.cross(up, forward))


def _assign_trunk(found: dict[str, int], tree: _Tree, branches: Sequence[int]) -> None:
    """Add Hips, Spine, Spine1, Neck and Head to the roles of the limbs.

    Args:
        found: Index of the joint with each role. The keys are the roles. The roles of the trunk are added to
            this mapping.
        tree: The tree.
        branches: The joints at which pairs of limbs branch off.
    """
    taken = set(found.values())
    words = [name.trunk if not name.side else "" for name in tree.names]

    def claim(role: str, joint: int | None) -> None:
        if joint is not None and joint not in taken:
            found[role] = joint
            taken.add(joint)

    def first(word: str, among: Sequence[int]) -> int | None:
        return next((joint for joint in among if words[joint] == word and joint not in taken), None)

    everything = [joint for joint, name in enumerate(tree.names) if not name.helper]
    head = next((joint for joint in everything if words[joint] == "head" and tree.names[joint].exact), None)
    head = first("head", everything) if head is None else head
    hips = _hips(tree, words, branches, head)
    claim("Hips", first("hips", everything) if hips is None else hips)
    claim("Hips", first("root", everything) if "Hips" not in found else None)
    arms = [found.get(f"{side}Shoulder", found.get(f"{side}Arm")) for side in ("Left", "Right")]
    chest = None
    if arms[0] is not None and arms[1] is not None:
        chest = _common_ancestor(tree, [tree.parents[arm] for arm in arms if arm is not None])
    while chest is not None and words[chest] == "neck" and tree.parents[chest] >= 0:
        chest = tree.parents[chest]
    if chest is None or chest in taken:
        spine = [joint for joint in everything if words[joint] == "spine" and joint not in taken]
        chest = spine[-1] if spine else None
    claim("Spine1", chest)
    top = found.get("Spine1", found.get("Hips"))
    claim("Head", _head_by_tree(tree, top, taken) if head is None and branches else head)
    between = _joints_between(tree, found.get("Hips"), found.get("Spine1"))
    claim("Spine", _first_with_bone(tree, between))
    necks = _joints_between(tree, top, found.get("Head"))
    named = [joint for joint in necks if words[joint] == "neck"]
    claim("Neck", _first_with_bone(tree, named or (necks[:1] if "Spine1" in found else [])))


def _hips(tree: _Tree, words: Sequence[str], branches: Sequence[int], head: int | None) -> int | None:
    """Return the joint that carries legs and trunk; None if no pair of limbs was found.

    A joint above it whose name says that it is the hips is preferred.
    """
    if not branches:
        return None
    carrier = _common_ancestor(tree, branches if head is None else [*branches, head])
    path = [carrier, *tree.ancestors[carrier]]
    return next((joint for joint in path if words[joint] == "hips"), carrier)


def _common_ancestor(tree: _Tree, joints: Sequence[int]) -> int:
    """Return the joint farthest from the root whose subtree contains all given joints."""
    path = [joints[0], *tree.ancestors[joints[0]]]
    return next(joint for joint in path if all(tree.is_below(other, joint) for other in joints))


def _head_by_tree(tree: _Tree, top: int | None, taken: set[int]) -> int | None:
    """Return the head if no name says it: the end of the longest branch of the chest that is no limb.

    A last bone that is longer than the bone before it ends at the top of the head and not at its joint.
    """
    count = len(tree.parents)
    reach, is_free = [0.0] * count, [not name.helper for name in tree.names]
    for joint in range(count - 1, 0, -1):
        parent = tree.parents[joint]
        reach[parent] = max(reach[parent], reach[joint] + tree.lengths[joint])
        is_free[joint] &= joint not in taken
        is_free[parent] &= is_free[joint] or tree.names[joint].helper
    path: list[int] = []
    free = [] if top is None else [joint for joint in tree.children[top] if is_free[joint]]
    while free and (not path or len(free) == 1):
        path.append(max(free, key=lambda joint: reach[joint] + tree.lengths[joint]))
        free = [joint for joint in tree.children[path[-1]] if is_free[joint]]
    if len(path) > 2 and not free and tree.lengths[path[-1]] > tree.lengths[path[-2]]:
        path.pop()
    return path[-1] if path else None


def _joints_between(tree: _Tree, upper: int | None, lower: int | None) -> list[int]:
    """Return the joints between two joints of one path, from the upper joint to the lower joint.

    The two joints are not included. The list is empty if the upper joint is not an ancestor of the lower
    joint.
    """
    if upper is None or lower is None or upper not in tree.ancestors[lower]:
        return []
    path = tree.ancestors[lower]
    return path[: path.index(upper)][::-1]


def _first_with_bone(tree: _Tree, among: Sequence[int]) -> int | None:
    """Return the first joint with a bone; the first joint if none has one; None if `among` is empty."""
    return min(among, key=lambda joint: not tree.has_bone[joint], default=None)
