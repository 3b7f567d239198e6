"""Preset skeletons scaled to a stature, the anatomical axes of segments, and the nominal camera mounts."""

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
"""Names of the preset skeletons. Both presets contain all joints of the body. The cameras, not the preset,
determine which joints are estimated."""

MEAN_HEIGHT_M = 1.70
"""Stature, metres, that is used if no stature is given. It lies between the means of adult women and men in
Europe, 1.64 m and 1.78 m. Source: NCD Risk Factor Collaboration, "A century of trends in adult human height",
eLife 2016."""

_STATURE_RANGE_M = (0.5, 2.8)
"""Minimum and maximum stature, metres. Derivation: the range from small children to the tallest people, with
a margin. A stature in centimetres or feet is outside this range and is therefore refused."""

NOMINAL_SIGMA_RAD = float(np.radians(15.0))
"""Sigma, radians per axis, of the prior on a mount's rotation, if the job does not give the rotation.

The nominal rotation is then chosen from the camera's name. The sigma is larger than the expected error
`NOMINAL_ERROR_RAD`, so that the posture of the body has more influence on the rotation. Evidence:
docs/decisions/export.md."""

NOMINAL_SIGMA_M = 0.029
"""Sigma, metres per axis, of a mount's nominal position, if the job does not give the position. Derivation:
5 cm for the three axes together, because straps move and bodies differ."""

NOMINAL_ERROR_RAD = float(np.radians(15.0 / np.sqrt(3.0)))
"""Expected error, radians per axis, of a mount's nominal rotation, if the job does not give the rotation.
Derivation: 15° for the three axes together."""

STATED_SIGMA_RAD = float(np.radians(5.0))
"""Sigma, radians per axis, of a mount rotation, if the job gives the rotation but not its accuracy.
Derivation: 15° are three sigmas."""

STATED_SIGMA_M = 0.015
"""Sigma, metres per axis, of a mount position, if the job gives the position but not its accuracy.
Derivation: 4.5 cm are three sigmas."""

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
def _load_preset_data(name: str) -> dict[str, Any]:
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
            f"no skeleton preset {preset!r}", field="skeleton", hint=f"one of {', '.join(PRESETS)}"
        )
    height = MEAN_HEIGHT_M if height_m is None else height_m
    low, high = _STATURE_RANGE_M
    if not low <= height <= high:
        raise JobError(
            f"a stature of {height} m is not plausible", field="height_m", hint="give it in metres"
        )
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
    subtree = [index for index in range(len(rest)) if _is_descendant(skeleton, index, joint)]
    tips = np.array([rest[i] + np.nan_to_num(skeleton.end_offsets_m[i]) - rest[joint] for i in subtree])
    farthest = tips[np.argmax(np.linalg.norm(tips, axis=1))]
    return np.asarray(farthest) if np.linalg.norm(farthest) > _MIN_BONE_M else None


def _is_descendant(skeleton: SkeletonModel, joint: int, ancestor: int) -> bool:
    """Return True if `joint` is `ancestor` or one of the descendants of `ancestor`."""
    while joint > ancestor:
        joint = int(skeleton.parents[joint])
    return joint == ancestor


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


def nominal_mount(camera: str, role: str, skeleton: SkeletonModel) -> Mount:
    """Return the nominal mount of a camera on the bone with an anatomical role.

    A camera on trunk or head is mounted on the back if the camera's name contains the word "back", as in
    ``torso_back``.

    Raises:
        JobError: The skeleton has no joint with this role.
    """
    if skeleton.index_of_role(role) is None:
        raise JobError(
            f"camera {camera!r} is mounted on {role}, which the skeleton {skeleton.name!r} does not have",
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
    """Return True if a camera on trunk or head is mounted on the back, according to the camera's name."""
    return not split_side(role)[0] and "back" in re.split(r"[_\-. ]", camera.lower())


_ARTICULATED = ("Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot", "ToeBase", "Neck", "Head")
"""Parts of the body that move relative to their parent. The spine is treated as rigid."""

_REACH_MARGIN_RATIO = 0.15
"""Margin for the possible distances between two cameras, as a fraction of the distance. The smallest distance
is decreased by this fraction, and the largest distance is increased by it, because bodies differ from the
skeleton. Evidence: none."""

_REACH_MARGIN_M = 0.05
"""Margin, metres, for the possible distances between two cameras. It is subtracted from the smallest distance
and added to the largest distance, because straps slip. Evidence: none."""

_MIN_DISTANCE_M = 0.08
"""Minimum distance, metres, between two cameras on different bones. Derivation: the distance of each camera
from its bone is 4 to 5 cm (mounts.yaml)."""


def camera_reach(skeleton: SkeletonModel, mounts: Sequence[Mount]) -> list[tuple[str, str, float, float]]:
    """Return the smallest and the largest possible distance of each pair of cameras, over all postures.

    Args:
        skeleton: The skeleton.
        mounts: The mount of each camera.

    Returns:
        For each pair of cameras, a row (name of the first camera, name of the second camera, smallest
        distance, largest distance). The distances are in metres, rounded to centimetres. They include the
        margins `_REACH_MARGIN_RATIO` and `_REACH_MARGIN_M`.

    Derivation: the joints between two cameras form a chain of ball joints. The largest distance occurs if all
        links form one straight line. The smallest distance occurs if the longest link points in one direction
        and all other links point in the opposite direction.
    """
    rest = rest_positions(skeleton)
    rows = []
    for first, second in combinations(sorted(mounts, key=lambda mount: mount.camera), 2):
        paths = [_joints_to_root(skeleton, mount) for mount in (first, second)]
        shared = set(paths[0]) & set(paths[1])
        ends = [
            rest[path[0]] + mount.joint_from_cam[:3, 3]
            for path, mount in zip(paths, (first, second), strict=True)
        ]
        limbs = [
            [rest[joint] for joint in path if joint not in shared and _is_articulated(skeleton, joint)]
            for path in paths
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
    """Return the index of the joint that a camera is mounted on, followed by its ancestors up to the root."""
    joint = skeleton.index_of_role(mount.role)
    if joint is None:
        raise JobError(f"no joint has the role {mount.role}", field="capture.cameras")
    path = [joint]
    while skeleton.parents[path[-1]] >= 0:
        path.append(int(skeleton.parents[path[-1]]))
    return path


def _is_articulated(skeleton: SkeletonModel, joint: int) -> bool:
    """Return True if a joint moves relative to its parent. The spine is treated as rigid."""
    return split_side(skeleton.roles[joint])[1] in _ARTICULATED
