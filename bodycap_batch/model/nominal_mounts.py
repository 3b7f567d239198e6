"""The mount of a camera that follows from its name, and the reach between two cameras."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from bodycap_batch.core.errors import JobError
from bodycap_batch.model.geometry import make_transform
from bodycap_batch.model.skeleton import Mount, SkeletonModel
from bodycap_batch.model.skeleton_presets import (
    bone_vector,
    load_preset_data,
    rest_positions,
    segment_axes,
    split_side,
)

NOMINAL_SIGMA_RAD = float(np.radians(15.0))
"""Sigma, radians per axis, of the prior on a mount's rotation, if the job does not give the rotation.

The nominal rotation is then chosen from the camera's name. The sigma is larger than the expected error
`NOMINAL_ERROR_RAD`, so that the posture of the body has more influence on the rotation. Evidence:
docs/decisions/export.md."""
STATED_SIGMA_RAD = float(np.radians(5.0))
"""Sigma, radians per axis, of a mount rotation, if the job gives the rotation but not its accuracy.
Derivation: 15° are three sigmas."""
STATED_SIGMA_M = 0.015
"""Sigma, metres per axis, of a mount position, if the job gives the position but not its accuracy.
Derivation: 4.5 cm are three sigmas."""
_ARTICULATED = ("Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot", "ToeBase", "Neck", "Head")
"""Parts of the body that move relative to their parent. The spine is treated as rigid."""
_LIMBS = (("Arm", "ForeArm", "Hand"), ("UpLeg", "Leg", "Foot", "ToeBase"))
"""Parts of the limbs that a camera needs, from the trunk to the tip: all parts up to its own."""
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
NOMINAL_SIGMA_M = 0.029
"""Sigma, metres per axis, of a mount's nominal position, if the job does not give the position. Derivation:
5 cm for the three axes together, because straps move and bodies differ."""
NOMINAL_ERROR_RAD = float(np.radians(15.0 / np.sqrt(3.0)))
"""Expected error, radians per axis, of a mount's nominal rotation, if the job does not give the rotation.
Derivation: 15° for the three axes together."""


def nominal_mount(camera: str, role: str, skeleton: SkeletonModel) -> Mount:
    """Return the nominal mount of a camera on the bone with an anatomical role.

    A camera on trunk or head is mounted on the back if the camera's name contains the word "back", as in
    ``torso_back``.

    Raises:
        JobError: The skeleton has no joint with this role, or a joint above it on the limb is missing.
    """
    require_limb(camera, role, skeleton)
    entry = load_preset_data("mounts.yaml")[split_side(role)[1]]
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


def require_limb(camera: str, role: str, skeleton: SkeletonModel, path: Path | None = None) -> None:
    """Check that a skeleton has the joint on which a camera is mounted, and those above it on the limb.

    Raises:
        JobError: A joint is missing. The error says which, and what to write.
    """
    side, part = split_side(role)
    limb = next((parts[: parts.index(part) + 1] for parts in _LIMBS if part in parts), (part,))
    missing = [side + each for each in limb if skeleton.index_of_role(side + each) is None]
    if missing:
        free = [name for name, own in zip(skeleton.joints, skeleton.roles, strict=True) if not own]
        pairs = ", ".join(f"JOINT: {each}" for each in missing)
        raise JobError(
            f"camera {camera} is mounted on {role}, but no joint of the skeleton {skeleton.name!r} has the "
            f"role {', '.join(missing)}",
            path=path,
            field="skeleton",
            hint=f"write skeleton_map: {{{pairs}}} in the job, with the names of the joints; `bodycap "
            f"skeleton` shows all joints; joints without a role: {', '.join(free[:30]) or 'none'}",
        )


def _faces_back(camera: str, role: str) -> bool:
    """Return True if a camera on trunk or head is mounted on the back, according to the camera's name."""
    return not split_side(role)[0] and "back" in re.split(r"[_\-. ]", camera.lower())


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
        paths = [skeleton.path_to_root(skeleton.roles.index(mount.role)) for mount in (first, second)]
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


def _is_articulated(skeleton: SkeletonModel, joint: int) -> bool:
    """Return True if a joint moves relative to its parent. The spine is treated as rigid."""
    return split_side(skeleton.roles[joint])[1] in _ARTICULATED
