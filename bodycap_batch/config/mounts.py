"""Usual names of body cameras, and the bone that each camera is mounted on."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

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
"""Spellings of each place, the preferred one first, by role of the bone without its side."""
_SIDES = {"left": "Left", "right": "Right", "l": "Left", "r": "Right"}


def _names() -> Iterator[tuple[str, tuple[str, str]]]:
    """Yield each known spelling of a mount's name with the pair (preferred name, role of the bone)."""
    for role, spellings in _CENTRAL_SPELLINGS.items():
        for spelling in spellings:
            yield spelling, (spellings[0], role)
    for part, spellings in _SIDED_SPELLINGS.items():
        for side, prefix in _SIDES.items():
            for spelling in spellings:
                found = (f"{prefix.lower()}_{spellings[0]}", prefix + part)
                yield f"{side}_{spelling}", found
                yield f"{spelling}_{side}", found


_MOUNT_BY_SPELLING = {name.replace("_", ""): found for name, found in _names()}
ROLES = tuple(dict.fromkeys(role for _, role in _MOUNT_BY_SPELLING.values()))
MOUNT_NAMES = tuple(dict.fromkeys(mount for mount, _ in _MOUNT_BY_SPELLING.values()))
"""The preferred name of each place on the body where a camera can be mounted, for messages and help texts."""

PLACES_TEXT = (
    ", ".join(spellings[0] for spellings in _CENTRAL_SPELLINGS.values())
    + "; and with left_ or right_ before it "
    + ", ".join(spellings[0] for spellings in _SIDED_SPELLINGS.values())
)
"""All places in few words, for messages."""

MOTION_PLACES = ("torso", "left_palm", "right_palm")
"""The places that a run can find from the motion of the cameras. It needs one camera at each. Evidence:
docs/decisions/places.md."""

TRUNK_ROLES = ("Hips", "Spine", "Spine1", "Neck", "Head")
"""Roles of the bones of the trunk and the head."""

_REFERENCE_ROLES = ("Spine1", "Spine", "Hips")
"""Roles of the bones of a torso camera, the preferred one first. The common clock is that of this camera."""

NOT_WORN = "none"
"""Value of ``mount:`` for a camera that nobody wears, for example on a tripod."""

_NOISE = frozenset((
    "cam", "camera", "webcam", "gopro", "go", "pro", "hero", "insta", "osmo", "action", "dji", "sony",
    "iphone", "phone", "video", "vid", "movie", "clip", "film", "take", "rec", "recording", "footage", "file",
    "mount", "mounted", "view", "pov", "worn", "side",
))  # fmt: skip
"""Words in the name of a video that say nothing about the camera's place on the body."""
_WORD = re.compile(r"[a-z]+")
_CAMEL = re.compile(r"(?<=[a-z])(?=[A-Z])")
_GLUED_CAMERA = re.compile(r"(?:cam|camera|gopro)$")

_QUALIFIER = re.compile(r"[_\- ]?(back|front|top|bottom|upper|lower|inner|outer|[0-9]+|[a-c])$")


def reference_index(roles: Sequence[str | None]) -> int:
    """Return the index of the camera whose clock is the common clock: on the torso, else the first camera.

    Args:
        roles: Role of the bone of each camera; None if it is unknown.
    """
    return next((roles.index(role) for role in _REFERENCE_ROLES if role in roles), 0)


def _key(name: str) -> str:
    """Return a name in lower case and without separators: ``leftpalm`` for ``LeftPalm`` and ``left-palm``."""
    return re.sub(r"[_\-. ]+", "", name).lower()


def mount_of(name: str) -> tuple[str, str] | None:
    """Return the pair (mount, role) for a camera's name; None if the name is not a known place on the body.

    A qualifier at the end of the name is ignored. It distinguishes cameras on the same body segment:
    ``torso_back``, ``torso_2``. So are numbers, and words that name a camera or a recording: ``Torso Cam 1``,
    ``chest_cam``.
    """
    known = _MOUNT_BY_SPELLING.get(_key(name))
    if known is not None:
        return known
    bare = _QUALIFIER.sub("", name.lower())
    if bare and bare != name.lower() and (known := mount_of(bare)) is not None:
        return known
    words = _WORD.findall(_CAMEL.sub(" ", name).lower())
    kept = "_".join(word for word in (_GLUED_CAMERA.sub("", word) for word in words) if word not in _NOISE)
    kept = kept.strip("_")
    return mount_of(kept) if kept and len(kept) < len(name) and kept != name.lower() else None


def place_of_role(role: str) -> str:
    """Return the preferred name of the place of a camera on the bone with a role; the role if it has none."""
    return next((mount for mount, known in _MOUNT_BY_SPELLING.values() if known == role), role)


def role_of_segment(segment: str) -> str | None:
    """Return the role for a value of ``segment:``, which is a role (``LeftHand``) or the name of a mount.

    Returns:
        The role; None if the value is unknown.
    """
    roles = {_key(role): role for role in ROLES}
    return roles.get(_key(segment)) or _MOUNT_BY_SPELLING.get(_key(segment), ("", None))[1]
