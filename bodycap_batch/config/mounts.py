"""Usual names of body cameras, and the bone that carries each of them."""

from __future__ import annotations

import re
from collections.abc import Iterator

_CENTRAL_SPELLINGS = {
    "Spine1": ("torso", "chest", "sternum", "spine1", "upper_body"),
    "Head": ("head", "forehead", "helmet", "cap"),
    "Hips": ("hips", "hip", "pelvis", "waist", "belt"),
    "Spine": ("spine", "belly", "abdomen"),
}
_SIDED_SPELLINGS = {
    "Hand": ("palm", "hand"),
    "Arm": ("upper_arm", "upperarm", "arm"),
    "ForeArm": ("forearm", "fore_arm", "lower_arm", "wrist"),
    "UpLeg": ("thigh", "upper_leg", "upleg"),
    "Leg": ("shin", "lower_leg", "calf", "leg"),
    "Foot": ("foot", "shoe"),
    "Shoulder": ("shoulder", "clavicle"),
}
_MOUNT_NAME = {
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
    """Yield every known spelling with its (mount, role)."""
    for role, spellings in _CENTRAL_SPELLINGS.items():
        for spelling in spellings:
            yield spelling, (_MOUNT_NAME[role], role)
    for part, spellings in _SIDED_SPELLINGS.items():
        for side, prefix in _SIDES.items():
            for spelling in spellings:
                found = (f"{prefix.lower()}_{_MOUNT_NAME[part]}", prefix + part)
                yield f"{side}_{spelling}", found
                yield f"{spelling}_{side}", found


_MOUNT_BY_SPELLING = {name.replace("_", ""): found for name, found in _names()}
ROLES = tuple(dict.fromkeys(role for _, role in _MOUNT_BY_SPELLING.values()))
MOUNT_NAMES = tuple(dict.fromkeys(mount for mount, _ in _MOUNT_BY_SPELLING.values()))
"""One name for each place that a camera can be mounted on, for messages and help texts."""

_QUALIFIER = re.compile(r"[_\- ]?(back|front|top|bottom|upper|lower|inner|outer|[0-9]+|[a-c])$")


def _key(name: str) -> str:
    """Return a name without case and separators: ``LeftPalm`` and ``left-palm`` give ``leftpalm``."""
    return re.sub(r"[_\-. ]+", "", name).lower()


def mount_of(name: str) -> tuple[str, str] | None:
    """Return the (mount, role) that a camera's name means; None if it names no place on the body.

    A qualifier at the end distinguishes cameras on one segment: ``torso_back``, ``torso_2``.
    """
    known = _MOUNT_BY_SPELLING.get(_key(name))
    if known is not None:
        return known
    bare = _QUALIFIER.sub("", name.lower())
    return mount_of(bare) if bare and bare != name.lower() else None


def role_of_segment(segment: str) -> str | None:
    """Return the role that ``segment:`` means: a role (``LeftHand``) or a mount's name; None if unknown."""
    roles = {_key(role): role for role in ROLES}
    return roles.get(_key(segment)) or _MOUNT_BY_SPELLING.get(_key(segment), ("", None))[1]
