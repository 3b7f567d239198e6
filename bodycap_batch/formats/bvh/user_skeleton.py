"""Read the skeleton of a user from a BVH file.

The user can give roles of joints, and a frame of the file that contains the T-pose.
"""

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
from bodycap_batch.model.skeleton_presets import is_plausible_stature, stature_from_limbs

NO_ROLE = "none"
"""Word that a user writes in the job instead of a role to say that a joint has no role."""

_MIN_WIDTH_M = 0.02
"""Minimum horizontal distance, metres, between a left and a right joint. The direction that the body faces is
computed only from joints with a larger distance. Derivation: the limit is far above rounding errors and far
below the width of shoulders or hips."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RigOptions:
    """The information about a skeleton that the user gives in the job.

    Attributes:
        roles: By joint name, the role of the joint, or ``none`` for a joint without a role. These roles have
            priority over the roles that are derived from the joint names.
        tpose_frame: Number of the frame that contains the T-pose, counted from 0. None if the zero pose is
            the T-pose.
    """

    roles: Mapping[str, str] = field(default_factory=dict)
    tpose_frame: int | None = None


def read_rig(path: Path | str, options: RigOptions | None = None) -> tuple[SkeletonModel, Motion | None]:
    """Read a BVH file as the skeleton of a job.

    The hierarchy, the OFFSETs, the channel order and the zero pose of the file are kept.

    Args:
        path: Path of the file.
        options: The information that the user gives about the skeleton; None if there is none.

    Returns:
        The skeleton, and the motion in the file. The motion is None if the file has no frames.

    Raises:
        JobError: The file cannot be read, or a joint, a role or the frame does not exist, or no person has
            the size of the body in metres or centimetres.
    """
    path, options = Path(path), options or RigOptions()
    skeleton, motion = read_bvh(path)
    if options.roles:
        skeleton = replace(skeleton, roles=_override_roles(path, skeleton, options.roles))
    _check_size(path, skeleton)
    if options.tpose_frame is not None:
        skeleton = replace(
            skeleton, tpose_rotation=_tpose_rotations(path, skeleton, motion, options.tpose_frame)
        )
    return skeleton, None if motion is None else replace(motion, skeleton=skeleton)


def _check_size(path: Path, skeleton: SkeletonModel) -> None:
    """Check that the body has the size of a person. A wrong unit of length makes all results too large."""
    stature_m = stature_from_limbs(skeleton)
    if stature_m is not None and not is_plausible_stature(stature_m):
        raise JobError(
            f"a person with the arms and legs of this skeleton is {stature_m:.3g} m tall",
            path=path,
            field="skeleton",
            hint="the file must be in metres or centimetres: multiply all lengths by the unit of the file in "
            "centimetres, for example 2.54 for inches or 5.644 for CMU recordings",
        )


def _override_roles(path: Path, skeleton: SkeletonModel, user_roles: Mapping[str, str]) -> tuple[str, ...]:
    """Return the roles of all joints, with the roles given by the user.

    A role that the user gives to one joint is removed from any other joint.
    """
    roles = list(skeleton.roles)
    for name, role in user_roles.items():
        if name not in skeleton.joints:
            hint = _suggest_name(name, skeleton.joints)
            raise JobError(f"the skeleton has no joint {name!r}", path=path, field="skeleton_map", hint=hint)
        if role not in (*ROLES, NO_ROLE):
            hint = _suggest_name(role, (*ROLES, NO_ROLE))
            raise JobError(f"there is no role {role!r}", path=path, field="skeleton_map", hint=hint)
    assigned = [role for role in user_roles.values() if role != NO_ROLE]
    repeated = next((role for role in assigned if assigned.count(role) > 1), None)
    if repeated is not None:
        hint = "give each role to only one joint"
        raise JobError(
            f"the role {repeated} is given to two joints", path=path, field="skeleton_map", hint=hint
        )
    for index, name in enumerate(skeleton.joints):
        if name in user_roles:
            roles[index] = "" if user_roles[name] == NO_ROLE else user_roles[name]
        elif roles[index] in assigned:
            roles[index] = ""
    return tuple(roles)


def _suggest_name(word: str, names: tuple[str, ...]) -> str:
    """Return a hint with the most similar name. If no name is similar, the hint lists the first names."""
    similar = difflib.get_close_matches(word, names, n=1, cutoff=0.5)
    return f"did you mean {similar[0]!r}?" if similar else f"use one of {', '.join(names[:40])}"


def _tpose_rotations(path: Path, skeleton: SkeletonModel, motion: Motion | None, frame: int) -> FloatArray:
    """Return the local rotations (J,3,3) of a frame. The whole body is rotated so that it faces −Y."""
    count = 0 if motion is None else len(motion.root_in_world_m)
    if motion is None or not 0 <= frame < count:
        hint = f"choose a frame from 0 to {count - 1}: the file has {count} frames, and the first frame is 0"
        raise JobError(f"the file has no frame {frame}", path=path, field="tpose_frame", hint=hint)
    local: FloatArray = motion.local_rotation[frame].copy()
    pose = rest_pose(replace(skeleton, tpose_rotation=local))
    for part in ("Arm", "UpLeg", "Shoulder"):
        left, right = (skeleton.index_of_role(side + part) for side in ("Left", "Right"))
        if left is not None and right is not None:
            across = pose[left, :2, 3] - pose[right, :2, 3]
            if np.linalg.norm(across) > _MIN_WIDTH_M:
                turn = so3_exp([0.0, 0.0, -np.arctan2(across[1], across[0])])
                local[0] = turn @ local[0]
                break
    return local
