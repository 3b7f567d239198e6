"""A motion against the true one: joint positions and bone orientations, matched by anatomical role."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.errors import JobError
from bodycap_batch.evaluate.association import interpolate_truth
from bodycap_batch.evaluate.trajectories import ErrorSummary
from bodycap_batch.formats.bvh import read_bvh
from bodycap_batch.formats.tum import TimedPoses
from bodycap_batch.model.geometry import Similarity, align_points, rotation_angle_rad
from bodycap_batch.model.skeleton import Motion

_ROLE_BY_TRUTH_NAME = {
    "root": "Hips",
    "torso": "Spine1",
    "head": "Head",
    **{
        f"{side}_{joint}": side.title() + role
        for side in ("left", "right")
        for joint, role in {
            "palm": "Hand",
            "elbow": "ForeArm",
            "shoulder": "Arm",
            "hip": "UpLeg",
            "knee": "Leg",
            "ankle": "Foot",
        }.items()
    },
}
"""Joint names of a capture's ``gt/joints.npz``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionOptions:
    """How motions are compared.

    Attributes:
        align: One rigid alignment over all joints and frames, or none.
        root: Role whose position is subtracted for the root-relative error.
        offset_s: Added to the estimate's times before the truth is looked up.
        max_gap_s: No truth inside a longer gap.
        roles: Compare these joints only (with the root); all that both have when empty.
    """

    align: Literal["se3", "none"] = "se3"
    root: str = "Hips"
    offset_s: float = 0.0
    max_gap_s: float = 0.1
    roles: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionReport:
    """Errors of joints, over all frames.

    Attributes:
        frames: Frames compared.
        joints: Roles compared.
        mpjpe_m: Distance of joint centres after alignment.
        root_relative_m: The same with the root's position taken from each.
        procrustes_m: After a similarity of its own for every frame (shape alone).
        angle_deg: Angle between bone orientations after alignment; None where the truth has none.
        angle_offset_free_deg: The same with each joint's constant offset taken out.
        per_joint_m: Mean root-relative error by role.
        per_joint_deg: Mean angle by role, constant offset taken out.
    """

    frames: int
    joints: tuple[str, ...]
    mpjpe_m: ErrorSummary
    root_relative_m: ErrorSummary
    procrustes_m: ErrorSummary
    angle_deg: ErrorSummary | None
    angle_offset_free_deg: ErrorSummary | None
    per_joint_m: Mapping[str, float]
    per_joint_deg: Mapping[str, float]

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return asdict(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class _JointPoses:
    """Timed joint positions (T,J,3) and orientations (T,J,3,3), the latter identity if not `oriented`."""

    times_ns: IntArray
    roles: tuple[str, ...]
    positions: FloatArray
    rotations: FloatArray
    oriented: bool


def evaluate_motion(estimate: Path, truth: Path, options: MotionOptions | None = None) -> MotionReport:
    """Compare a BVH with another, or with a capture's ``joints.npz`` (positions only).

    Both start at the same instant; joints are matched by anatomical role, the truth is interpolated at
    the estimate's times.

    Raises:
        JobError: A file is missing or malformed, or the two share no joints or no time.
    """
    found = _read_truth(Path(truth))
    _, motion = read_bvh(estimate)
    if motion is None:
        raise JobError("no frames in the file", path=estimate, hint="give the motion.bvh of a result")
    return _compare_joints(_joints_from_motion(motion), found, options or MotionOptions())


def score_motion(estimate: Motion, truth: Motion, options: MotionOptions | None = None) -> MotionReport:
    """Compare two motions on one clock; see `evaluate_motion`."""
    return _compare_joints(
        _joints_from_motion(estimate), _joints_from_motion(truth), options or MotionOptions()
    )


def _read_truth(path: Path) -> _JointPoses:
    if path.suffix.lower() != ".npz":
        _, motion = read_bvh(path)
        if motion is None:
            raise JobError("no frames in the file", path=path, hint="give a BVH file with its motion")
        return _joints_from_motion(motion)
    try:
        with np.load(path, allow_pickle=False) as content:
            names, seconds, world = (np.asarray(content[key]) for key in ("names", "t", "world"))
    except (OSError, KeyError, ValueError) as error:
        raise JobError(f"not a joints file: {error}", path=path, hint="needs names, t, world") from error
    kept = [index for index, name in enumerate(names.tolist()) if name in _ROLE_BY_TRUTH_NAME]
    return _JointPoses(
        times_ns=np.round(seconds * 1e9).astype(np.int64),
        roles=tuple(_ROLE_BY_TRUTH_NAME[str(names[index])] for index in kept),
        positions=world[:, kept].astype(np.float64),
        rotations=np.broadcast_to(np.eye(3), (len(seconds), len(kept), 3, 3)),
        oriented=False,
    )


def _joints_from_motion(motion: Motion) -> _JointPoses:
    roles = motion.skeleton.roles
    kept = [index for index, role in enumerate(roles) if role]
    poses = motion.world_from_joint()[:, kept]
    return _JointPoses(
        times_ns=motion.times_ns(),
        roles=tuple(roles[index] for index in kept),
        positions=poses[..., :3, 3],
        rotations=poses[..., :3, :3],
        oriented=True,
    )


def _compare_joints(estimate: _JointPoses, truth: _JointPoses, options: MotionOptions) -> MotionReport:
    wanted = {*options.roles, options.root} if options.roles else set(truth.roles)
    roles = tuple(role for role in estimate.roles if role in truth.roles and role in wanted)
    if options.root not in roles or len(roles) < 3:
        message = f"the two share {len(roles)} joints ({', '.join(roles)}); needs {options.root} and two more"
        raise JobError(message, hint="joints are matched by name: HumanIK, Mixamo, Biped, CMU ... names")
    mine, theirs, rotations, true_rotations = _match_joints(estimate, truth, roles, options)
    if len(mine) == 0:
        raise JobError("the two motions share no time", hint="check offset_s and the frame times")
    alignment = Similarity(1.0, np.eye(3), np.zeros(3))
    if options.align == "se3":
        alignment = align_points(mine.reshape(-1, 3), theirs.reshape(-1, 3), with_scale=False)
    aligned = alignment.apply(mine)
    root = roles.index(options.root)
    relative = np.linalg.norm(
        (aligned - aligned[:, root : root + 1]) - (theirs - theirs[:, root : root + 1]), axis=-1
    )
    angles = offset_free = None
    if truth.oriented:
        turned = alignment.rotation @ rotations
        angles = np.rad2deg(rotation_angle_rad(np.swapaxes(turned, -1, -2) @ true_rotations))
        offset_free = _angles_without_offset(turned, true_rotations)
    others = [index for index in range(len(roles)) if index != root]
    return MotionReport(
        frames=len(mine),
        joints=roles,
        mpjpe_m=_summary(np.linalg.norm(aligned - theirs, axis=-1)),
        root_relative_m=_summary(relative[:, others]),
        procrustes_m=_summary(_procrustes_distances(mine, theirs)),
        angle_deg=None if angles is None else _summary(angles),
        angle_offset_free_deg=None if offset_free is None else _summary(offset_free),
        per_joint_m={roles[index]: float(relative[:, index].mean()) for index in others},
        per_joint_deg={}
        if offset_free is None
        else {role: float(offset_free[:, index].mean()) for index, role in enumerate(roles)},
    )


def _match_joints(
    estimate: _JointPoses, truth: _JointPoses, roles: tuple[str, ...], options: MotionOptions
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Positions of both and rotations of both, where both have a time."""
    times = estimate.times_ns + round(options.offset_s * 1e9)
    mine = [estimate.roles.index(role) for role in roles]
    positions = np.empty((len(times), len(roles), 3))
    rotations = np.empty((len(times), len(roles), 3, 3))
    found = np.ones(len(times), dtype=bool)
    for index, role in enumerate(roles):
        joint = truth.roles.index(role)
        poses = np.tile(np.eye(4), (len(truth.times_ns), 1, 1))
        poses[:, :3, 3] = truth.positions[:, joint]
        poses[:, :3, :3] = truth.rotations[:, joint]
        timed = TimedPoses(times_ns=truth.times_ns, world_from_cam=poses)
        at_times, found = interpolate_truth(timed, times, options.max_gap_s)
        positions[:, index], rotations[:, index] = at_times[:, :3, 3], at_times[:, :3, :3]
    return (
        estimate.positions[found][:, mine],
        positions[found],
        estimate.rotations[found][:, mine],
        rotations[found],
    )


def _angles_without_offset(rotation: FloatArray, true_rotation: FloatArray) -> FloatArray:
    """Angles (T,J) left after the one right-hand offset per joint that explains most (chordal mean)."""
    offset = np.swapaxes(rotation, -1, -2) @ true_rotation
    u, _, vt = np.linalg.svd(offset.sum(axis=0))
    u[..., -1] *= np.linalg.det(u @ vt)[..., None]
    return np.asarray(np.rad2deg(rotation_angle_rad(np.swapaxes(offset, -1, -2) @ (u @ vt))))


def _procrustes_distances(mine: FloatArray, theirs: FloatArray) -> FloatArray:
    """Distances (T,J) after a similarity for each frame."""
    out = np.empty(mine.shape[:2])
    for frame, (source, target) in enumerate(zip(mine, theirs, strict=True)):
        out[frame] = np.linalg.norm(align_points(source, target).apply(source) - target, axis=-1)
    return out


def _summary(errors: FloatArray) -> ErrorSummary:
    return ErrorSummary.of(errors.reshape(-1))
