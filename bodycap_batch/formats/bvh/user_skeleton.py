"""A user's own rig: which joint plays which role, with overrides, and the frame that holds its T-pose."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import JobError
from bodycap_batch.formats.bvh.reader import read_bvh
from bodycap_batch.formats.bvh.roles import ROLES
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.skeleton import Motion, SkeletonModel, rest_pose

NO_ROLE = "none"


@dataclass(frozen=True, slots=True, kw_only=True)
class RigOptions:
    """What the user says about a rig.

    Attributes:
        roles: Role by joint name (``none`` for a joint that plays none), over what its name says.
        tpose_frame: The frame, counted from 0, that holds the T-pose, where the zero pose is another one.
    """

    roles: Mapping[str, str] = field(default_factory=dict)
    tpose_frame: int | None = None


def read_rig(path: Path | str, options: RigOptions | None = None) -> tuple[SkeletonModel, Motion | None]:
    """Read a BVH file as a rig to solve onto: hierarchy, OFFSETs, channel order and zero pose as they are.

    Args:
        path: The file.
        options: What the user says about it.

    Returns:
        The rig, and the file's motion or None without frames.

    Raises:
        JobError: The file cannot be read, a joint or role does not exist, or the frame does not.
    """
    path, options = Path(path), options or RigOptions()
    skeleton, motion = read_bvh(path)
    if options.roles:
        skeleton = replace(skeleton, roles=_override_roles(path, skeleton, options.roles))
    if options.tpose_frame is not None:
        skeleton = replace(
            skeleton, tpose_rotation=_tpose_rotations(path, skeleton, motion, options.tpose_frame)
        )
    return skeleton, None if motion is None else replace(motion, skeleton=skeleton)


def _override_roles(path: Path, skeleton: SkeletonModel, wanted: Mapping[str, str]) -> tuple[str, ...]:
    """The roles with the user's in their place; one the user gives is taken from the joint that had it."""
    roles = list(skeleton.roles)
    for name, role in wanted.items():
        if name not in skeleton.joints:
            hint = _suggest_name(name, skeleton.joints)
            raise JobError(f"it has no joint {name!r}", path=path, field="skeleton_map", hint=hint)
        if role not in (*ROLES, NO_ROLE):
            hint = _suggest_name(role, (*ROLES, NO_ROLE))
            raise JobError(f"there is no role {role!r}", path=path, field="skeleton_map", hint=hint)
    given = [role for role in wanted.values() if role != NO_ROLE]
    twice = next((role for role in given if given.count(role) > 1), None)
    if twice is not None:
        hint = "each role is played by one joint"
        raise JobError(f"{twice} is given to two joints", path=path, field="skeleton_map", hint=hint)
    for index, name in enumerate(skeleton.joints):
        if name in wanted:
            roles[index] = "" if wanted[name] == NO_ROLE else wanted[name]
        elif roles[index] in given:
            roles[index] = ""
    return tuple(roles)


def _suggest_name(word: str, known: tuple[str, ...]) -> str:
    near = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    return f"did you mean {near[0]!r}?" if near else f"one of {', '.join(known[:40])}"


def _tpose_rotations(path: Path, skeleton: SkeletonModel, motion: Motion | None, frame: int) -> FloatArray:
    """Local rotations (J,3,3) of a frame, turned about the vertical until the body faces the front (−Y)."""
    count = 0 if motion is None else len(motion.root_in_world_m)
    if motion is None or not 0 <= frame < count:
        hint = f"frames count from 0; it has {count}"
        raise JobError(f"it has no frame {frame}", path=path, field="tpose_frame", hint=hint)
    local: FloatArray = motion.local_rotation[frame].copy()
    pose = rest_pose(replace(skeleton, tpose_rotation=local))
    for part in ("Arm", "UpLeg", "Shoulder"):
        left, right = (skeleton.index_of_role(side + part) for side in ("Left", "Right"))
        if left is not None and right is not None:
            across = pose[left, :2, 3] - pose[right, :2, 3]
            if np.linalg.norm(across) > 0.02:
                turn = so3_exp([0.0, 0.0, -np.arctan2(across[1], across[0])])
                local[0] = turn @ local[0]
                break
    return local
