"""Preset skeletons scaled to a stature, and the anatomical axes of segments."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib import resources
from typing import Any

import numpy as np
import yaml

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import JobError
from bodycap_batch.model.skeleton import SkeletonModel, rest_pose

PRESETS = ("auto", "full_body", "upper_body")
"""Names of the preset skeletons. All of them contain all joints of the body. The cameras, not the preset,
determine which joints are estimated. ``upper_body`` is the former name of ``auto``."""

MEAN_HEIGHT_M = 1.70
"""Stature, metres, that is used if no stature is given. It lies between the means of adult women and men in
Europe, 1.64 m and 1.78 m. Source: NCD Risk Factor Collaboration, "A century of trends in adult human height",
eLife 2016."""

_STATURE_RANGE_M = (0.5, 2.8)
"""Minimum and maximum stature, metres. Derivation: the range from small children to the tallest people, with
a margin. A stature in centimetres or feet is outside this range and is therefore refused."""

LEG_PARTS = ("Leg", "Foot")
_MEASURED_PARTS = ("ForeArm", "Hand", *LEG_PARTS)
"""Parts of limbs whose distance from the part above is the length of a long bone. These bones give the
stature of a body."""

ANKLE_OVER_LEG = 0.039 / 0.491
"""Ratio of the ankle's height above the sole to the length of the leg. Source: R. Drillis, R. Contini, "Body
segment parameters", 1966."""

_UP, _FORWARD, _LEFT = np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0]), np.array([1.0, 0.0, 0.0])
"""Unit vectors of a standing body in the axes of the skeleton: z up, −y forward."""
_NEXT_ROLE = {
    "Shoulder": "Arm",
    "Arm": "ForeArm",
    "ForeArm": "Hand",
    "UpLeg": "Leg",
    "Leg": "Foot",
}
"""By part of a limb, the next part of the limb. The bone of a part ends at the joint of the next part. Hands
and feet have no entry; their bones end at the farthest point of the hand or foot."""

_MIN_BONE_M = 1e-6
"""Minimum length, metres, of a bone. A shorter bone is treated as a bone without direction. Derivation: the
limit is far below the length of any real bone and above rounding errors."""


@cache
def load_preset_data(name: str) -> dict[str, Any]:
    """Return the content of a data file of ``bodycap_batch/presets``."""
    text = resources.files("bodycap_batch.presets").joinpath(name).read_text(encoding="utf-8")
    return dict(yaml.safe_load(text))


def load_skeleton(preset: str, height_m: float | None = None) -> SkeletonModel:
    """Return the skeleton of a person of the given stature.

    Args:
        preset: Name of the preset, one of `PRESETS`.
        height_m: Stature, metres; None for `MEAN_HEIGHT_M`.

    Raises:
        JobError: The preset does not exist, or no person has this stature.
    """
    if preset not in PRESETS:
        raise JobError(
            f"there is no skeleton preset {preset!r}",
            field="skeleton",
            hint=f"use one of {', '.join(PRESETS)}",
        )
    height = MEAN_HEIGHT_M if height_m is None else height_m
    if not is_plausible_stature(height):
        raise JobError(
            f"a body height of {height} m is not plausible",
            field="height_m",
            hint="give the height in metres",
        )
    joints: dict[str, Any] = load_preset_data("humanoid.yaml")["joints"]
    names = tuple(joints)
    at = {name: height * np.array(entry["at"], dtype=np.float64) for name, entry in joints.items()}
    origin = {
        name: at[entry["parent"]] if "parent" in entry else np.zeros(3) for name, entry in joints.items()
    }
    ends = [
        height * np.array(entry["end"]) - at[name] if "end" in entry else np.full(3, np.nan)
        for name, entry in joints.items()
    ]
    return SkeletonModel(
        name=preset,
        joints=names,
        parents=np.array(
            [names.index(entry["parent"]) if "parent" in entry else -1 for entry in joints.values()]
        ),
        offsets_m=np.array([at[name] - origin[name] for name in names]),
        end_offsets_m=np.array(ends),
        roles=names,
        bvh_channels=((),) * len(names),
    )


def stature_from_limbs(skeleton: SkeletonModel, parts: Sequence[str] = _MEASURED_PARTS) -> float | None:
    """Return the stature, metres, of a usual person with the limbs of a skeleton.

    It is the median over the long bones of the limbs. Real people have proportions that differ by some
    percent; a larger difference shows that the unit of length is not the metre.

    Args:
        skeleton: The skeleton.
        parts: Parts at the lower end of the long bones.

    Returns:
        The stature; None if the skeleton has no long bone of a limb with a role.
    """
    usual, ratios = load_skeleton("full_body", MEAN_HEIGHT_M), []
    for side in ("Left", "Right"):
        for upper, lower in _NEXT_ROLE.items():
            own, other = (_distance_m(body, side + upper, side + lower) for body in (skeleton, usual))
            if lower in parts and own is not None and other:
                ratios.append(own / other)
    return float(np.median(ratios)) * MEAN_HEIGHT_M if ratios else None


def _distance_m(skeleton: SkeletonModel, first: str, second: str) -> float | None:
    """Return the distance, metres, between two joints in the zero pose; None if the skeleton lacks a role."""
    joints = [joint for role in (first, second) if (joint := skeleton.index_of_role(role)) is not None]
    if len(joints) < 2:
        return None
    return float(np.linalg.norm(np.subtract(*rest_positions(skeleton)[joints])))


def is_plausible_stature(height_m: float) -> bool:
    """Return True if there are people with this stature, metres."""
    low, high = _STATURE_RANGE_M
    return low <= height_m <= high


def split_side(role: str) -> tuple[str, str]:
    """Split a role such as ``LeftForeArm`` into side and part. For trunk and head, the side is ""."""
    for side in ("Left", "Right"):
        if role.startswith(side):
            return side, role.removeprefix(side)
    return "", role


def rest_positions(skeleton: SkeletonModel) -> FloatArray:
    """Return the joint centres (J,3) in the world in the zero pose, metres."""
    out = np.array(skeleton.offsets_m)
    for joint in range(1, len(out)):
        out[joint] += out[skeleton.parents[joint]]
    return out


def bone_vector(skeleton: SkeletonModel, role: str) -> FloatArray | None:
    """Return the vector of a bone in the zero pose.

    The bone starts at the joint with the given role and ends at the next joint of the limb. A bone without a
    next joint, such as the hand, ends at the point of its descendants that is farthest from the joint.

    Returns:
        The vector (3,) in world axes, metres. None if no joint has the role, or if the bone has no length.
    """
    side, part = split_side(role)
    joint = skeleton.index_of_role(role)
    if joint is None:
        return None
    following = skeleton.index_of_role(side + _NEXT_ROLE[part]) if part in _NEXT_ROLE else None
    rest = rest_positions(skeleton)
    if following is not None:
        vector = rest[following] - rest[joint]
        return np.asarray(vector) if np.linalg.norm(vector) > _MIN_BONE_M else None
    subtree = skeleton.subtree(joint)
    tips = np.array([rest[i] + np.nan_to_num(skeleton.end_offsets_m[i]) - rest[joint] for i in subtree])
    farthest = tips[np.argmax(np.linalg.norm(tips, axis=1))]
    return np.asarray(farthest) if np.linalg.norm(farthest) > _MIN_BONE_M else None


def segment_axes(skeleton: SkeletonModel, role: str) -> FloatArray:
    """Return the anatomical axes (3,3) of a segment as columns in the frame of its joint.

    The columns are:

    - along: the direction to the far end of the bone; for trunk and head the direction up, for the feet down;
    - forward: the direction that the standing body faces; for the forearm the direction in which the elbow
      bends, for the hand the direction of the thumb;
    - outward: the direction away from the body for a hanging limb; for trunk and head the direction to the
      left, for the hand the direction of the back of the hand.

    The axes are computed in the T-pose, so they do not depend on how the arms are held in the zero pose. The
    axes of left limbs are left-handed, so the axes of left and right segments are mirrored.
    """
    side, part = split_side(role)
    joint = skeleton.index_of_role(role)
    turn = np.eye(3) if joint is None else rest_pose(skeleton)[joint, :3, :3]
    if not side:
        return np.asarray(turn.T @ np.stack([_UP, _FORWARD, _LEFT], axis=1))
    vector = None if part in ("Foot", "ToeBase") else bone_vector(skeleton, role)
    if vector is None and part == "Hand":
        vector = bone_vector(skeleton, side + "ForeArm")
    along = -_UP if vector is None else turn @ vector / np.linalg.norm(vector)
    # For a limb that points forward, the forward axis is undefined. The direction up replaces it.
    reference = _FORWARD if abs(along @ _FORWARD) < 0.9 else _UP
    forward = reference - (reference @ along) * along
    forward /= np.linalg.norm(forward)
    outward = np.cross(forward, along) if side == "Left" else np.cross(along, forward)
    return np.asarray(turn.T @ np.stack([along, forward, outward], axis=1))
