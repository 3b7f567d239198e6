"""The standard body by stature, the axes of its segments, and where cameras usually sit on it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from importlib import resources
from itertools import combinations
from typing import Any

import numpy as np
import yaml

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import JobError
from bodycap_batch.model.geometry import make_transform
from bodycap_batch.model.skeleton import Mount, SkeletonModel, rest_pose

PRESETS = ("upper_body", "full_body")
"""Both are the whole humanoid: what is solved follows the cameras, not the preset."""

MEAN_HEIGHT_M = 1.70
"""Stature taken when none is given: between the means of adult women and men in Europe (1.64 and 1.78 m;
NCD Risk Factor Collaboration, "A century of trends in adult human height", eLife 2016)."""

NOMINAL_SIGMA_RAD = float(np.radians(15.0))
NOMINAL_SIGMA_M = 0.029
"""Per axis, of a mount known by its name only: straps turn, and bodies differ; 5 cm in all. The 15° are how
lightly it is weighed against postures. Mounts are off by 15° in all, which `NOMINAL_ERROR_RAD` has per axis;
weighed with that, joints of simulated walks come out 2 mm worse (4.3 cm without a T-pose)."""

NOMINAL_ERROR_RAD = float(np.radians(15.0 / np.sqrt(3.0)))
"""What it is believed to be off by, per axis."""

STATED_SIGMA_RAD = float(np.radians(5.0))
STATED_SIGMA_M = 0.015
"""Per axis, of a mount whose pose the job states without saying how well: 15° and 4.5 cm are three sigma."""

_UP, _FORWARD, _LEFT = np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0]), np.array([1.0, 0.0, 0.0])
_NEXT_ROLE = {
    "Shoulder": "Arm",
    "Arm": "ForeArm",
    "ForeArm": "Hand",
    "UpLeg": "Leg",
    "Leg": "Foot",
}


@cache
def _load_preset_data(name: str) -> dict[str, Any]:
    text = resources.files("bodycap_batch.presets").joinpath(name).read_text(encoding="utf-8")
    return dict(yaml.safe_load(text))


def load_skeleton(preset: str, height_m: float | None = None) -> SkeletonModel:
    """Build a preset's skeleton for a person of the given stature.

    Args:
        preset: One of `PRESETS`.
        height_m: Stature; `MEAN_HEIGHT_M` when None.

    Raises:
        JobError: The preset does not exist or the stature is not a person's.
    """
    if preset not in PRESETS:
        raise JobError(
            f"no skeleton preset {preset!r}", field="skeleton", hint=f"one of {', '.join(PRESETS)}"
        )
    height = MEAN_HEIGHT_M if height_m is None else height_m
    if not 0.5 <= height <= 2.8:
        raise JobError(f"a stature of {height} m is no person's", field="height_m", hint="give it in metres")
    joints: dict[str, Any] = _load_preset_data("humanoid.yaml")["joints"]
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


def split_side(role: str) -> tuple[str, str]:
    """Split ``LeftForeArm`` into ("Left", "ForeArm"); the side is "" for trunk and head."""
    for side in ("Left", "Right"):
        if role.startswith(side):
            return side, role.removeprefix(side)
    return "", role


def rest_positions(skeleton: SkeletonModel) -> FloatArray:
    """Joint centres (J,3) of the zero pose."""
    out = np.array(skeleton.offsets_m)
    for joint in range(1, len(out)):
        out[joint] += out[skeleton.parents[joint]]
    return out


def bone_vector(skeleton: SkeletonModel, role: str) -> FloatArray | None:
    """From a role's joint to the far end of its bone at zero pose (3,), or None where it has none."""
    side, part = split_side(role)
    joint = skeleton.index_of_role(role)
    if joint is None:
        return None
    following = skeleton.index_of_role(side + _NEXT_ROLE[part]) if part in _NEXT_ROLE else None
    rest = rest_positions(skeleton)
    if following is not None:
        vector = rest[following] - rest[joint]
        return np.asarray(vector) if np.linalg.norm(vector) > 1e-6 else None
    below = [index for index in range(len(rest)) if _is_descendant(skeleton, index, joint)]
    tips = np.array([rest[i] + np.nan_to_num(skeleton.end_offsets_m[i]) - rest[joint] for i in below])
    farthest = tips[np.argmax(np.linalg.norm(tips, axis=1))]
    return np.asarray(farthest) if np.linalg.norm(farthest) > 1e-6 else None


def _is_descendant(skeleton: SkeletonModel, joint: int, ancestor: int) -> bool:
    while joint > ancestor:
        joint = int(skeleton.parents[joint])
    return joint == ancestor


def segment_axes(skeleton: SkeletonModel, role: str) -> FloatArray:
    """Anatomical axes of a segment as columns (3,3) in its joint's frame: along, forward, outward.

    They are read off the rig's T-pose, its zero pose where it names none, so that arms may rest stretched out
    or hanging. Along points to
    the bone's far end (up for trunk and head, down for feet); forward is where the standing body faces (the
    side the elbow closes to, the thumb's side of the hand); outward is away from the body for a hanging
    limb (the back of the hand), left for trunk and head. Left-hand segments make a left-handed triad,
    so that mirrored segments have mirrored axes.
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
    # A limb that rests pointing forward closes upwards instead.
    reference = _FORWARD if abs(along @ _FORWARD) < 0.9 else _UP
    forward = reference - (reference @ along) * along
    forward /= np.linalg.norm(forward)
    outward = np.cross(forward, along) if side == "Left" else np.cross(along, forward)
    return np.asarray(turn.T @ np.stack([along, forward, outward], axis=1))


def nominal_mount(camera: str, role: str, skeleton: SkeletonModel) -> Mount:
    """Where a camera on the bone of `role` usually sits.

    A trunk's or head's camera whose name holds the word "back" (``torso_back``) sits and looks backwards.

    Raises:
        JobError: The skeleton has no joint of that role.
    """
    if skeleton.index_of_role(role) is None:
        raise JobError(
            f"camera {camera!r} sits on {role}, which the skeleton {skeleton.name!r} does not have",
            field="capture.cameras",
            hint=f"it has {', '.join(name for name in skeleton.roles if name)}",
        )
    entry = _load_preset_data("mounts.yaml")[split_side(role)[1]]
    axes = segment_axes(skeleton, role)
    bone = bone_vector(skeleton, role)
    length = 0.0 if bone is None else float(np.linalg.norm(bone))
    centre = np.array(entry["centre_m"]) + np.array([entry.get("along", 0.0) * length, 0.0, 0.0])
    facing = np.array([1.0, -1.0 if _faces_back(camera, role) else 1.0, 1.0])
    centre, view = facing * centre, facing * np.array(entry["view"], float)
    view, down = axes @ view, axes @ np.array(entry["down"], float)
    view, down = view / np.linalg.norm(view), down / np.linalg.norm(down)
    rotation = np.stack([np.cross(down, view), down, view], axis=1)
    return Mount(
        camera=camera,
        role=role,
        joint_from_cam=make_transform(rotation, axes @ centre),
        sigma_rad=NOMINAL_SIGMA_RAD,
        sigma_m=NOMINAL_SIGMA_M,
        by_name=True,
    )


def _faces_back(camera: str, role: str) -> bool:
    return not split_side(role)[0] and "back" in re.split(r"[_\-. ]", camera.lower())


_ARTICULATED = ("Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot", "ToeBase", "Neck", "Head")
_REACH_MARGIN_RATIO = 0.15
_REACH_MARGIN_M = 0.05
_MIN_DISTANCE_M = 0.08
"""Two cameras on different bones cannot come nearer: each stands off its own bone."""


def camera_reach(skeleton: SkeletonModel, mounts: Sequence[Mount]) -> list[tuple[str, str, float, float]]:
    """How near and how far two cameras on one body can be, whatever the pose.

    Args:
        skeleton: The body.
        mounts: Where each camera sits.

    Returns:
        Rows (camera, camera, least, most), metres, to the centimetre. Bodies differ and straps slip: 15 % and
        5 cm are allowed for.

    Source: the reach of a chain of ball joints: all links in one line, or the longest against the others.
    """
    rest = rest_positions(skeleton)
    rows = []
    for first, second in combinations(sorted(mounts, key=lambda mount: mount.camera), 2):
        ways = [_joints_to_root(skeleton, mount) for mount in (first, second)]
        shared = set(ways[0]) & set(ways[1])
        ends = [
            rest[way[0]] + mount.joint_from_cam[:3, 3]
            for way, mount in zip(ways, (first, second), strict=True)
        ]
        limbs = [
            [rest[joint] for joint in way if joint not in shared and _is_articulated(skeleton, joint)]
            for way in ways
        ]
        chain = np.array([ends[0], *limbs[0], *limbs[1][::-1], ends[1]])
        links = np.linalg.norm(np.diff(chain, axis=0), axis=1)
        most = float(links.sum())
        least = max(0.0, 2.0 * float(links.max()) - most)
        low = (
            max(_MIN_DISTANCE_M, (1 - _REACH_MARGIN_RATIO) * least - _REACH_MARGIN_M)
            if len(chain) > 2
            else 0.5 * least
        )
        high = (1 + _REACH_MARGIN_RATIO) * most + _REACH_MARGIN_M
        rows.append((first.camera, second.camera, round(low, 2), round(high, 2)))
    return rows


def _joints_to_root(skeleton: SkeletonModel, mount: Mount) -> list[int]:
    joint = skeleton.index_of_role(mount.role)
    if joint is None:
        raise JobError(f"no joint plays {mount.role}", field="capture.cameras")
    way = [joint]
    while skeleton.parents[way[-1]] >= 0:
        way.append(int(skeleton.parents[way[-1]]))
    return way


def _is_articulated(skeleton: SkeletonModel, joint: int) -> bool:
    return split_side(skeleton.roles[joint])[1] in _ARTICULATED
