"""Compare a motion with the true motion. Joints are matched by anatomical role."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.errors import JobError
from bodycap_batch.evaluate.trajectories import ErrorSummary, interpolate_truth
from bodycap_batch.formats.bvh import read_bvh
from bodycap_batch.formats.joint_positions import read_joint_positions
from bodycap_batch.formats.tum import TimedPoses
from bodycap_batch.model.geometry import Similarity, align_points, nearest_rotation, rotation_angle_rad
from bodycap_batch.model.skeleton import Motion

ROOT = "Hips"
"""Role of the joint whose position is subtracted for the root-relative error."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionOptions:
    """Options for the comparison of motions.

    Attributes:
        align: Kind of the alignment: one rigid alignment ("se3") for all joints and frames, or no alignment
            ("none").
        offset_s: Time (seconds) that is added to the times of the estimate before the truth is interpolated.
        roles: Roles of the joints to compare, in addition to `ROOT`; if empty, all common roles.
    """

    align: Literal["se3", "none"] = "se3"
    offset_s: float = 0.0
    roles: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionReport:
    """The result of comparing a motion with the true motion: errors of the joints over all frames.

    Attributes:
        frames: Number of compared frames.
        joints: Roles of the compared joints.
        mpjpe_m: Distance (metres) between estimated and true joint centres after alignment. Its mean is the
            mean per-joint position error (MPJPE).
        root_relative_m: Distance (metres) between estimated and true joint centres after alignment, with the
            position of the root subtracted from both motions.
        procrustes_m: Distance (metres) between estimated and true joint centres after a separate similarity
            alignment of each frame.
        angle_deg: Angle (degrees) between estimated and true joint orientations after alignment; None if the
            truth has no orientations.
        angle_offset_free_deg: Angle (degrees) between estimated and true joint orientations, after a constant
            rotation offset of each joint is removed; None if the truth has no orientations.
        per_joint_m: Mean root-relative distance (metres) of each joint except the root, by role.
        per_joint_deg: Mean of `angle_offset_free_deg` for each joint, by role; empty if the truth has no
            orientations.
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
        """Return the errors as plain JSON values."""
        return asdict(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class _JointPoses:
    """The poses of J joints at T times.

    Attributes:
        times_ns: (T,) times, nanoseconds.
        roles: (J,) anatomical roles of the joints.
        positions: (T,J,3) joint centres in the world, metres.
        rotations: (T,J,3,3) joint orientations in the world; identity matrices if unknown.
        oriented: Whether the orientations are known.
    """

    times_ns: IntArray
    roles: tuple[str, ...]
    positions: FloatArray
    rotations: FloatArray
    oriented: bool


def evaluate_motion(estimate: Path, truth: Path, options: MotionOptions | None = None) -> MotionReport:
    """Compare the motion in a BVH file with the true motion.

    Both motions must start at the same instant. Joints are matched by anatomical role, and the truth is
    interpolated at the times of the estimate.

    Args:
        estimate: BVH file of the estimated motion.
        truth: File of the true motion: a BVH file, or a file ``joints.npz``, which holds only positions.
        options: Options of the comparison.

    Raises:
        JobError: A file is missing or malformed, or the motions have no common joints or times.
    """
    true_joints = _read_truth(Path(truth))
    joints = _read_joints(estimate, "give the motion.bvh of a results folder")
    return _compare_joints(joints, true_joints, options or MotionOptions())


def score_motion(estimate: Motion, truth: Motion, options: MotionOptions | None = None) -> MotionReport:
    """Compare an estimated motion with the true motion. Both motions must have the same clock.

    Joints are matched as in `evaluate_motion`.
    """
    return _compare_joints(
        _joints_from_motion(estimate), _joints_from_motion(truth), options or MotionOptions()
    )


def _read_truth(path: Path) -> _JointPoses:
    """Read the true joint poses from a BVH or a .npz file."""
    if path.suffix.lower() != ".npz":
        return _read_joints(path, "give a BVH file that contains a motion")
    truth = read_joint_positions(path)
    shape = (*truth.x_in_world_m.shape, 3)
    return _JointPoses(
        times_ns=truth.times_ns,
        roles=truth.roles,
        positions=truth.x_in_world_m,
        rotations=np.broadcast_to(np.eye(3), shape),
        oriented=False,
    )


def _read_joints(path: Path, hint: str) -> _JointPoses:
    """Read the joint poses of a BVH file; without frames, an error has a hint."""
    _, motion = read_bvh(path)
    if motion is None:
        raise JobError("the BVH file contains no frames", path=path, hint=hint)
    return _joints_from_motion(motion)


def _joints_from_motion(motion: Motion) -> _JointPoses:
    """Return the poses of all joints of a motion that have an anatomical role."""
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
    """Compare the joints that have the same role in both motions, and return their errors."""
    selected = {*options.roles, ROOT} if options.roles else set(truth.roles)
    roles = tuple(role for role in estimate.roles if role in truth.roles and role in selected)
    if ROOT not in roles or len(roles) < 3:
        message = (
            f"the two motions have {len(roles)} joints in common ({', '.join(roles)}), but {ROOT} "
            "and two more common joints are needed"
        )
        raise JobError(
            message,
            hint="use joint names that the program knows, for example the names of HumanIK, Mixamo, Biped "
            "or CMU",
        )
    positions, true_positions, rotations, true_rotations = _match_joints(estimate, truth, roles, options)
    if len(positions) == 0:
        raise JobError(
            "the two motions have no time in common", hint="check offset_s and the times of the frames"
        )
    alignment = Similarity(1.0, np.eye(3), np.zeros(3))
    if options.align == "se3":
        alignment = align_points(positions.reshape(-1, 3), true_positions.reshape(-1, 3), with_scale=False)
    aligned = alignment.apply(positions)
    root = roles.index(ROOT)
    relative = np.linalg.norm(
        (aligned - aligned[:, root : root + 1]) - (true_positions - true_positions[:, root : root + 1]),
        axis=-1,
    )
    angles = offset_free = None
    if truth.oriented:
        aligned_rotations = alignment.rotation @ rotations
        difference = np.swapaxes(aligned_rotations, -1, -2) @ true_rotations
        angles = np.rad2deg(rotation_angle_rad(difference))
        offset_free = _angles_without_offset(aligned_rotations, true_rotations)
    others = [index for index in range(len(roles)) if index != root]
    return MotionReport(
        frames=len(positions),
        joints=roles,
        mpjpe_m=_summary(np.linalg.norm(aligned - true_positions, axis=-1)),
        root_relative_m=_summary(relative[:, others]),
        procrustes_m=_summary(_procrustes_distances(positions, true_positions)),
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
    """Return the estimated and the true poses of J joints, at the T times of the estimate with truth.

    Returns:
        (T,J,3) estimated positions; (T,J,3) true positions; (T,J,3,3) estimated rotations; (T,J,3,3) true
        rotations.
    """
    times = estimate.times_ns + round(options.offset_s * 1e9)
    estimate_joints = [estimate.roles.index(role) for role in roles]
    positions = np.empty((len(times), len(roles), 3))
    rotations = np.empty((len(times), len(roles), 3, 3))
    found = np.ones(len(times), dtype=bool)
    for index, role in enumerate(roles):
        joint = truth.roles.index(role)
        poses = np.tile(np.eye(4), (len(truth.times_ns), 1, 1))
        poses[:, :3, 3] = truth.positions[:, joint]
        poses[:, :3, :3] = truth.rotations[:, joint]
        timed = TimedPoses(times_ns=truth.times_ns, world_from_cam=poses)
        at_times, found = interpolate_truth(timed, times)
        positions[:, index], rotations[:, index] = at_times[:, :3, 3], at_times[:, :3, :3]
    return (
        estimate.positions[found][:, estimate_joints],
        positions[found],
        estimate.rotations[found][:, estimate_joints],
        rotations[found],
    )


def _angles_without_offset(rotation: FloatArray, true_rotation: FloatArray) -> FloatArray:
    """Return the angles (T,J), degrees, between rotations after a constant offset of each joint is removed.

    The rotation from the estimate to the truth is computed at each time. The chordal mean of these rotations
    over time is the joint's offset.

    Args:
        rotation: (T,J,3,3) estimated rotations.
        true_rotation: (T,J,3,3) true rotations.
    """
    offset = np.swapaxes(rotation, -1, -2) @ true_rotation
    mean = nearest_rotation(offset.sum(axis=0))
    return np.asarray(np.rad2deg(rotation_angle_rad(np.swapaxes(offset, -1, -2) @ mean)))


def _procrustes_distances(positions: FloatArray, true_positions: FloatArray) -> FloatArray:
    """Return the distances (T,J) between estimated and true positions (T,J,3) after alignment.

    The estimated positions of each frame have a separate similarity alignment with the true positions.
    """
    out = np.empty(positions.shape[:2])
    for frame, (source, target) in enumerate(zip(positions, true_positions, strict=True)):
        out[frame] = np.linalg.norm(align_points(source, target).apply(source) - target, axis=-1)
    return out


def _summary(errors: FloatArray) -> ErrorSummary:
    """Return the statistics of all errors in an array of any shape."""
    return ErrorSummary.of(errors.reshape(-1))
