"""Read what the name of a joint says: the side of the body, the part of the body, or a helper."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from bodycap_batch.model.skeleton_presets import load_preset_data

ARM, LEG = "arm", "leg"
"""Names of the limbs in ``presets/joint_words.yaml``, which explains the words."""

_WORDS = load_preset_data("joint_words.yaml")
_SIDES = {word: side for side, text in _WORDS["sides"].items() for word in text.split()}
_HELPERS = {*_WORDS["helpers"].split()}
_HELPER_SIGNS = _WORDS["helper_signs"].split()
_EMPTY_WORDS = {*_WORDS["empty"].split()}

_COMMON_SHARE = 0.6
"""Minimum share of the joints whose names contain a word, if the word is a prefix of the whole skeleton
(``mixamorig``, ``CC_Base``). Derivation: words for one side are in less than half of the names."""

_TOKEN = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+|[^\W\d_A-Za-z]+")


@dataclass(frozen=True, slots=True, kw_only=True)
class JointName:
    """What the name of a joint says.

    Attributes:
        side: ``l``, ``r`` or ``""``.
        slots: Slots that the joint may have, by limb (`ARM`, `LEG`), the most likely slot first.
        trunk: Part of trunk or head, for example ``neck``; ``""`` for other names.
        exact: True if the name contains no further words.
        helper: True if the joint is no part of the chain of a limb.
    """

    side: str = ""
    slots: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    trunk: str = ""
    exact: bool = False
    helper: bool = False

    @property
    def is_known(self) -> bool:
        """True if the name says which part of the body the joint is."""
        return bool(self.slots or self.trunk or self.helper)


_UNSIDED = {word: JointName(trunk=part) for part, text in _WORDS["trunk"].items() for word in text.split()}
"""What a word of trunk and head means, by word."""

_SIDED = {
    word: JointName(
        slots={limb: (slot, *[other for each, other in _WORDS["second"].items() if each == word])}
    )
    for limb in (ARM, LEG)
    for slot, text in enumerate(_WORDS[limb])
    for word in text.split()
}
"""What a word of a limb means, by word."""


def read_names(joints: Sequence[str]) -> list[JointName]:
    """Return what the name of each joint says.

    Namespaces ("mixamorig:") and words that most names contain ("Bip01 ", "CC_Base_", "_JNT") are ignored.
    """
    tokens = [_split(name) for name in joints]
    counts = Counter(token for each in tokens for token in set(each))
    meaningful = {*_SIDES, *_HELPERS, *_SIDED, *_UNSIDED}
    common = {token for token, count in counts.items() if count > _COMMON_SHARE * len(joints) > 3}
    return [_read(each, common - meaningful) for each in tokens]


def _split(name: str) -> list[str]:
    """Split a name into words in lower case. A Japanese sign for a side is a word of its own."""
    plain = unicodedata.normalize("NFKC", re.split(r"[:|]", name)[-1])
    plain = re.sub(r"([左右])", r"_\1_", plain)
    return [token.lower() for token in _TOKEN.findall(plain)]


def _read(tokens: Sequence[str], common: set[str]) -> JointName:
    letters = [token for token in tokens if not token.isdigit()]
    words = [token for token in letters if token not in common]
    stated = next((word for word in words if word in _SIDES and len(letters) > 1), "")
    side = _SIDES.get(stated, "")
    if side:
        words.remove(stated)
    helper = any(word in _HELPERS for word in words)
    useful = [word for word in words if word not in _EMPTY_WORDS] or words
    for length in range(len(words), 0, -1):
        for start in range(len(words) - length, -1, -1):
            used = words[start : start + length]
            # "ArmUpper" means the same as "UpperArm".
            for order in (used, used[::-1]) if length == 2 else (used,):
                own, found = _look_up("".join(order), side)
                if found is not None:
                    return replace(found, side=own, exact={*used} >= {*useful}, helper=helper)
    signs = any(sign in word for word in words for sign in _HELPER_SIGNS)
    return JointName(side=side, helper=helper or signs)


def _look_up(text: str, side: str) -> tuple[str, JointName | None]:
    """Return the side and the meaning of a word, which may begin or end with its side ("larm", "armleft")."""
    if side:
        return side, _SIDED.get(text) or _UNSIDED.get(text)
    if text in _UNSIDED:
        return side, _UNSIDED[text]
    for word in ("left", "right", "l", "r"):
        for rest in (text.removeprefix(word), text.removesuffix(word) if len(word) > 1 else text):
            if rest != text and rest in _SIDED:
                return word[0], _SIDED[rest]
    return side, _SIDED.get(text)
