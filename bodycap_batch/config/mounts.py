"""Names people give to body cameras, and the bone each one rides on."""

from __future__ import annotations

import re
from collections.abc import Iterator

_CENTRE = {
    "Spine1": ("torso", "chest", "sternum", "spine1", "upper_body"),
    "Head": ("head", "forehead", "helmet", "cap"),
    "Hips": ("hips", "hip", "pelvis", "waist", "belt"),
    "Spine": ("spine", "belly", "abdomen"),
}
_SIDED = {
    "Hand": ("palm", "hand"),
    "Arm": ("upper_arm", "upperarm", "arm"),
    "ForeArm": ("forearm", "fore_arm", "lower_arm", "wrist"),
    "UpLeg": ("thigh", "upper_leg", "upleg"),
    "Leg": ("shin", "lower_leg", "calf", "leg"),
    "Foot": ("foot", "shoe"),
    "Shoulder": ("shoulder", "clavicle"),
}
_CANONICAL = {
    "Spine1": "torso",
    "Head": "head",
    "Hips": "hips",
    "Spine": "spine",
    "Hand": "palm",
    "Arm": "upper_arm",
    "ForeArm": "forearm",
    "UpLeg": "thigh",
    "Leg": "shin",
    "Foot": "foot",
    "Shoulder": "shoulder",
}
_SIDES = {"left": "Left", "right": "Right", "l": "Left", "r": "Right"}


def _names() -> Iterator[tuple[str, tuple[str, str]]]:
    """Every known spelling with its (canonical mount, role)."""
    for role, spellings in _CENTRE.items():
        for spelling in spellings:
            yield spelling, (_CANONICAL[role], role)
    for part, spellings in _SIDED.items():
        for side, prefix in _SIDES.items():
            for spelling in spellings:
                found = (f"{prefix.lower()}_{_CANONICAL[part]}", prefix + part)
                yield f"{side}_{spelling}", found
                yield f"{spelling}_{side}", found


_TABLE = {name.replace("_", ""): found for name, found in _names()}
ROLES = tuple(dict.fromkeys(role for _, role in _TABLE.values()))
MOUNT_NAMES = tuple(dict.fromkeys(mount for mount, _ in _TABLE.values()))
"""One name for each place a camera can sit, for messages and help texts."""

_QUALIFIER = re.compile(r"[_\- ]?(back|front|top|bottom|upper|lower|inner|outer|[0-9]+|[a-c])$")


def _key(name: str) -> str:
    """Spelling without case, separators or camel case: ``LeftPalm``, ``left-palm`` -> ``leftpalm``."""
    return re.sub(r"[_\-. ]+", "", name).lower()


def mount_of(name: str) -> tuple[str, str] | None:
    """Map a camera's name to its (mount, role), or None where it names no place on the body.

    A qualifier at the end tells cameras on one segment apart: ``torso_back``, ``torso_2``.
    """
    known = _TABLE.get(_key(name))
    if known is not None:
        return known
    bare = _QUALIFIER.sub("", name.lower())
    return mount_of(bare) if bare and bare != name.lower() else None


def role_of_segment(segment: str) -> str | None:
    """Map ``segment:`` (a role such as ``LeftHand`` or any mount's name) to the role, or None."""
    roles = {_key(role): role for role in ROLES}
    return roles.get(_key(segment)) or _TABLE.get(_key(segment), ("", None))[1]
