"""Read the skeleton of a user from a BVH file, and decide what it means.

This module decides the roles of the joints, the pose in which the body stands upright, its axes, and whether
the unit of length is right. Everything that it found is in the notes and warnings of the skeleton, so that
all commands say the same. The user can give roles of joints, and a frame of the file that contains the
T-pose.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import JobError
from bodycap_batch.formats.bvh.reader import read_bvh
from bodycap_batch.formats.bvh.roles import ROLES
from bodycap_batch.model.body_axes import (
    BodyAxes,
    body_axes,
    t_pose_deviation_deg,
    toes_point_back,
    upright_rotation,
)
from bodycap_batch.model.skeleton import Motion, SkeletonModel, forward_kinematics, rest_pose
from bodycap_batch.model.skeleton_presets import LEG_PARTS, MEAN_HEIGHT_M, stature_from_limbs

NO_ROLE = "none"
"""Word that a user writes in the job instead of a role to say that a joint has no role."""

_OPTIONAL_PARTS = ("Shoulder", "ToeBase")
"""Parts of limbs that many skeletons do not have. There is no warning if these parts are missing."""

_STATURE_RANGE_M = (0.85, 2.6)
"""Minimum and maximum stature, metres, of a skeleton without a stated height. Derivation: children of two
years, who can wear a camera, and the tallest people. An adult in inches that are read as centimetres has
0.59 to 0.83 m."""

_MAX_HEIGHT_RATIO = 1.15
"""Maximum ratio of the stature of a skeleton and the stated height of the subject, or of the inverse. People
of one height differ by a few percent in the lengths of their bones."""

_UNITS_CM = {
    "millimetres": 0.1, "centimetres": 1.0, "inches": 2.54, "the unit of CMU recordings": 5.644,
    "decimetres": 10.0, "feet": 30.48, "metres": 100.0,
}  # fmt: skip
"""Length of common units, centimetres, by name."""

_MAX_T_POSE_DEG = 25.0
"""Maximum deviation (degrees) of a frame from the T-pose that replaces a zero pose that is no pose. Evidence:
none; see `t_pose_deviation_deg`. The frames of a walk are above 60°."""

_FRAMES_AT_ONCE = 1000
"""Number of frames whose poses are computed together. It limits the memory."""

_AXIS_NAMES = ("+X", "−Z", "+Y", "−X", "+Z", "−Y")
"""Axes of the file along the world axes +X, +Y, +Z, −X, −Y and −Z."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RigOptions:
    """The information about a skeleton that the user gives in the job.

    Attributes:
        roles: By joint name, the role of the joint, or ``none`` for a joint without a role. These roles have
            priority over the roles that are derived from the joint names.
        tpose_frame: Number of the frame that contains the T-pose, counted from 0. None if the zero pose, or
            the frame that is nearest to a T-pose, is used.
        height_m: Stature of the subject, metres; None if it is not given.
    """

    roles: Mapping[str, str] = field(default_factory=dict)
    tpose_frame: int | None = None
    height_m: float | None = None


def read_rig(path: Path | str, options: RigOptions | None = None) -> tuple[SkeletonModel, Motion | None]:
    """Read a BVH file as the skeleton of a job.

    The hierarchy, the OFFSETs, the channel order and the zero pose of the file are kept. The T-pose of the
    skeleton stands upright and faces −Y, whatever the axes of the file are.

    Args:
        path: Path of the file.
        options: The information that the user gives about the skeleton; None if there is none.

    Returns:
        The skeleton with notes and warnings, and the motion in the file. The motion is None if the file has
        no frames.

    Raises:
        JobError: The file cannot be read; a joint, a role or the frame does not exist; neither the zero pose
            nor a frame is the pose of a body; or no person has the size of the body, or the stated height
            contradicts it.
    """
    skeleton, motion, problem = inspect_rig(path, options)
    if problem is not None:
        raise problem
    return skeleton, motion


def inspect_rig(
    path: Path | str, options: RigOptions | None = None
) -> tuple[SkeletonModel, Motion | None, JobError | None]:
    """Read a BVH file as the skeleton of a job, to show it.

    See `read_rig`. A body without a pose, or with a wrong size, is returned together with its error, as it
    is in the file.

    Raises:
        JobError: The file cannot be read, or a joint, a role or the frame does not exist.
    """
    path, options = Path(path), options or RigOptions()
    skeleton, motion = read_bvh(path)
    if options.roles:
        skeleton = replace(skeleton, roles=_override_roles(path, skeleton, options.roles))
        motion = None if motion is None else replace(motion, skeleton=skeleton)
    problem: JobError | None = None
    try:
        skeleton = _with_upright_pose(path, skeleton, motion, options.tpose_frame)
        _check_size(path, skeleton, options.height_m)
    except JobError as error:
        problem = error
    missing = [role for role in missing_roles(skeleton) if not role.endswith(_OPTIONAL_PARTS)]
    warnings = list(skeleton.warnings)
    if missing:
        warnings.append(
            f"no joint has the role {', '.join(missing)}, so no camera can be mounted on this part of the "
            "body: give the role to a joint with skeleton_map (in `bodycap skeleton`: --map JOINT=ROLE)"
        )
    if problem is None and toes_point_back(skeleton, rest_pose(skeleton)[:, :3, 3]):
        warnings.append(
            "the toes point back: left and right are exchanged in the names, or the file is mirrored; give "
            "the roles with skeleton_map, or export the file again with right-handed axes"
        )
    skeleton = replace(skeleton, warnings=tuple(warnings))
    return skeleton, None if motion is None else replace(motion, skeleton=skeleton), problem


def missing_roles(skeleton: SkeletonModel) -> tuple[str, ...]:
    """Return the roles that no joint of the skeleton has."""
    return tuple(role for role in ROLES if role not in skeleton.roles)


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


def _with_upright_pose(
    path: Path, skeleton: SkeletonModel, motion: Motion | None, frame: int | None
) -> SkeletonModel:
    """Return the skeleton with a T-pose that stands upright and faces −Y.

    The pose is the given frame, else the zero pose, else the frame that is nearest to a T-pose.

    Raises:
        JobError: The frame does not exist, or no pose is the pose of a body.
    """
    zero = np.tile(np.eye(3), (len(skeleton.joints), 1, 1))
    local, notes = zero if frame is None else _rotations_of_frame(path, motion, frame), skeleton.notes
    axes = body_axes(skeleton, _centres(skeleton, local[None]))
    if axes is None:
        return skeleton if frame is None else replace(skeleton, tpose_rotation=local)
    if not axes.is_body[0]:
        if frame is not None:
            raise _no_pose_error(
                path, f"frame {frame} is no pose of a standing body", *_nearest_t_pose(motion)
            )
        found, deviation_deg = _nearest_t_pose(motion)
        if motion is None or found is None or deviation_deg > _MAX_T_POSE_DEG:
            what = "the zero pose is no pose of a body (bones lie on one line or run back)"
            raise _no_pose_error(path, what, found, deviation_deg)
        local = np.array(motion.local_rotation[found])
        is_used = f"frame {found} is nearest to a T-pose (within {deviation_deg:.0f}°) and is used instead"
        notes = (*notes, f"the zero pose is no pose of a body; {is_used}")
        axes = body_axes(skeleton, _centres(skeleton, local[None])) or axes
    turn = upright_rotation(axes)
    if not np.array_equal(turn, np.eye(3)):
        notes = (*notes, *_axes_notes(axes, turn, is_zero=local is zero))
    elif local is zero:
        return replace(skeleton, notes=notes)
    local = np.concatenate([(turn @ local[0])[None], local[1:]])
    return replace(skeleton, tpose_rotation=local, notes=notes)


def _rotations_of_frame(path: Path, motion: Motion | None, frame: int) -> FloatArray:
    count = 0 if motion is None else len(motion.root_in_world_m)
    if motion is None or not 0 <= frame < count:
        hint = f"choose a frame from 0 to {count - 1}: the file has {count} frames, and the first frame is 0"
        raise JobError(f"the file has no frame {frame}", path=path, field="tpose_frame", hint=hint)
    return np.array(motion.local_rotation[frame])


def _centres(skeleton: SkeletonModel, local_rotation: FloatArray) -> FloatArray:
    """Return the joint centres (T,J,3) of poses with the root at the origin, metres."""
    root = np.zeros((len(local_rotation), 3))
    return forward_kinematics(skeleton, root, local_rotation)[..., :3, 3]


def _nearest_t_pose(motion: Motion | None) -> tuple[int | None, float]:
    """Return the frame that is nearest to a T-pose, and its deviation in degrees.

    The frame is None if no frame is the pose of a body.
    """
    if motion is None:
        return None, math.inf
    deviations = np.concatenate(
        [
            t_pose_deviation_deg(motion.skeleton, _centres(motion.skeleton, part))
            for start in range(0, len(motion.local_rotation), _FRAMES_AT_ONCE)
            for part in [motion.local_rotation[start : start + _FRAMES_AT_ONCE]]
        ]
    )
    best = int(np.argmin(deviations))
    return (best, float(deviations[best])) if np.isfinite(deviations[best]) else (None, math.inf)


def _no_pose_error(path: Path, what: str, frame: int | None, deviation_deg: float) -> JobError:
    hint = (
        "export the file again with the person in a T-pose in the first frame, and name it: tpose_frame: 0"
        if frame is None
        else f"write tpose_frame: {frame} if the person stands straight there (it is {deviation_deg:.0f}° "
        "from a T-pose), or export a frame in which the person stands in a T-pose and name it"
    )
    return JobError(
        f"{what}, so it does not say where up and forward are", path=path, field="tpose_frame", hint=hint
    )


def _axes_notes(axes: BodyAxes, turn: FloatArray, *, is_zero: bool) -> list[str]:
    """Return a note if the pose is turned by more than a few degrees."""
    if np.trace(turn) > 1.0 + 2.0 * math.cos(math.radians(5.0)):
        return []
    up, forward = (_axis_name(each) for each in (axes.up[0], np.cross(axes.left[0], axes.up[0])))
    pose = "the rest pose" if is_zero else "the T-pose"
    return [f"in {pose} of the file, up is {up} and the body faces {forward}; it is turned upright to solve"]


def _axis_name(vector: FloatArray) -> str:
    """Return the name of the axis of the file that is nearest to a world vector (3,)."""
    along = np.concatenate([vector, -vector])
    best = int(np.argmax(along))
    off = math.degrees(math.acos(min(1.0, float(along[best]))))
    return _AXIS_NAMES[best] + (f" ({off:.0f}° off)" if off > 3.0 else "")


def _check_size(path: Path, skeleton: SkeletonModel, height_m: float | None) -> None:
    """Check that the body has the size of a person. A wrong unit of length makes all results wrong.

    Raises:
        JobError: Neither the extent of the body nor its limbs have the size of a person, or both contradict
            the stated height.
    """
    limbs = stature_from_limbs(skeleton, LEG_PARTS) or stature_from_limbs(skeleton)
    statures = [value for value in (_extent_m(skeleton), limbs) if value is not None]
    if not statures or any(_fits(each, height_m) for each in statures):
        return
    but = "no person has this height" if height_m is None else f"the stated height is {height_m:.3g} m"
    raise JobError(
        f"the skeleton is {statures[0]:.2f} m tall, but {but}",
        path=path,
        field="skeleton",
        hint=_unit_hint(path, statures, height_m),
    )


def _fits(stature_m: float, height_m: float | None) -> bool:
    """Return True if a stature is that of a person, or fits the stated height."""
    low, high = _STATURE_RANGE_M
    if height_m is not None:
        low, high = height_m / _MAX_HEIGHT_RATIO, height_m * _MAX_HEIGHT_RATIO
    return low <= stature_m <= high


def _extent_m(skeleton: SkeletonModel) -> float | None:
    """Return the height, metres, from the soles to the top of the head in the T-pose; None without them."""
    head = skeleton.index_of_role("Head")
    feet = [joint for joint, role in enumerate(skeleton.roles) if role.endswith(("Foot", "ToeBase"))]
    if head is None or not feet:
        return None
    rest = rest_pose(skeleton)
    tips = rest[:, 2, 3] + (rest[:, 2, :3] * np.nan_to_num(skeleton.end_offsets_m)).sum(axis=1)
    return float(max([tips[head], *tips[skeleton.parents == head]]) - min(tips[feet]))


def _unit_hint(path: Path, statures_m: Sequence[float], height_m: float | None) -> str:
    """Return what to write if the statures of a skeleton contradict a person, with the unit that fits."""
    if not min(statures_m) > 0.0:
        return "bones have no length: export the file with OFFSETs"
    lengths = [np.abs(read_bvh(path, units=unit)[0].offsets_m).sum() for unit in ("m", "auto")]
    target, factor = height_m or MEAN_HEIGHT_M, float(lengths[0] / lengths[1])

    def off(length_cm: float) -> float:
        """Return how far the nearest stature is from the target in a unit of this length, as a logarithm."""
        return min(abs(math.log(each * factor * length_cm / 100.0 / target)) for each in statures_m)

    name, length_cm = min(_UNITS_CM.items(), key=lambda unit: off(unit[1]))
    tall = [each * factor * length_cm / 100.0 for each in statures_m]
    if any(_fits(each, height_m) for each in tall):
        return (
            f"its lengths fit {name}, in which it is {tall[0]:.2f} m tall: multiply all lengths by "
            f"{length_cm:g}, so that they are centimetres"
        )
    correct = "" if height_m is None else "correct the height, or "
    return f"no common unit of length fits: {correct}multiply all lengths by {target / statures_m[0]:.3g}"
