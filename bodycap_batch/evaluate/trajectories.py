"""Compare camera trajectories with ground truth: absolute and relative errors (ATE, RPE) and coverage.

One alignment is estimated for all cameras together. The position of a camera relative to another one is
compared without an estimation of the scale.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.core.errors import JobError
from bodycap_batch.formats.tum import TimedPoses
from bodycap_batch.model.geometry import (
    Similarity,
    align_points,
    invert,
    nearest_rotation,
    poses_at,
    rotation_angle_rad,
)

_SNAP_NS = 1_000_000
"""Maximum time difference (nanoseconds) at which a true pose is used without interpolation.

Derivation: timestamps in some files have only four decimals."""
_MAX_GAP_NS = 100_000_000
"""Maximum time (nanoseconds) between two true poses for an interpolation. Origin: three frames of a usual
video."""


def interpolate_truth(truth: TimedPoses, times_ns: IntArray) -> tuple[FloatArray, BoolArray]:
    """Interpolate true poses at given times: rotations by slerp, positions linearly.

    Args:
        truth: True poses in time order.
        times_ns: (N,) times at which the truth is interpolated, nanoseconds.

    Returns:
        (N,4,4) true poses, identity matrices at times without truth; (N,) mask, True at times with truth.
    """
    return poses_at(truth.times_ns, truth.world_from_cam, times_ns, max_gap_ns=_MAX_GAP_NS, snap_ns=_SNAP_NS)


Alignment = Literal["sim3", "se3", "none"]
"""Kind of the alignment: similarity, rigid, or none. All cameras have one common alignment."""
_RPE_DELTA_S = 1.0
"""Time (seconds) between the two poses of a relative pose error, which is then an error per second."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorSummary:
    """Statistics of one kind of error.

    The unit is not stored here. It is the end of the name of the report's field, for example ``ate_m``.
    """

    rmse: float
    mean: float
    median: float
    p95: float
    max: float

    @classmethod
    def of(cls, errors: FloatArray) -> ErrorSummary:
        """Return the statistics of N errors (N,); N must be at least 1."""
        return cls(
            rmse=float(np.sqrt(np.mean(errors**2))),
            mean=float(np.mean(errors)),
            median=float(np.median(errors)),
            p95=float(np.percentile(errors, 95)),
            max=float(np.max(errors)),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraScore:
    """Errors of one camera's trajectory, or of all trajectories together.

    An error is None if there are no poses to compare.

    Attributes:
        frames: Number of frames of the video; None if unknown.
        registered: Number of frames with an estimated pose; 0 for a camera with rotations alone.
        coverage: Fraction of the video's frames with an estimated pose; None if `frames` is unknown.
        scored: Number of frames with an estimated pose and a true pose.
        ate_m: Absolute trajectory error: distance (metres) between estimated and true camera centre after
            alignment.
        rotation_deg: Angle (degrees) between estimated and true orientation after alignment. Rotations alone,
            without positions, have an alignment of their own.
        rpe_m: Translation part (metres) of the relative pose error over a second.
        rpe_deg: Rotation part (degrees) of the relative pose error over a second.
    """

    frames: int | None
    registered: int
    coverage: float | None
    scored: int
    ate_m: ErrorSummary | None
    rotation_deg: ErrorSummary | None
    rpe_m: ErrorSummary | None
    rpe_deg: ErrorSummary | None


@dataclass(frozen=True, slots=True, kw_only=True)
class TrajectoryReport:
    """The result of comparing the trajectories of a capture with the true trajectories.

    Attributes:
        align: Kind of the alignment.
        scale: Scale of the alignment (truth = scale · estimate).
        cameras: Errors of each camera, by camera name.
        total: Errors of all cameras together.
        truth_from_estimate: The alignment that maps estimated positions to true positions.
    """

    align: Alignment
    scale: float
    cameras: Mapping[str, CameraScore]
    total: CameraScore
    truth_from_estimate: Similarity

    def to_dict(self) -> dict[str, Any]:
        """Return the errors as plain JSON values."""
        return {
            "options": {"align": self.align},
            "scale": self.scale,
            "cameras": {name: asdict(score) for name, score in self.cameras.items()},
            "total": asdict(self.total),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class _MatchedPoses:
    """The N estimated poses of one camera that have a true pose.

    Attributes:
        times_ns: (N,) times of the poses, nanoseconds.
        estimate: (N,4,4) estimated poses.
        truth: (N,4,4) true poses.
        registered: Number of all estimated poses, including estimated poses without a true pose.
        rotation_only: True if the estimates are rotations without positions: all positions are the same.
    """

    times_ns: IntArray
    estimate: FloatArray
    truth: FloatArray
    registered: int
    rotation_only: bool


def score_trajectories(
    estimates: Mapping[str, TimedPoses],
    truths: Mapping[str, TimedPoses],
    align: Alignment = "sim3",
    frames: Mapping[str, int] | None = None,
) -> TrajectoryReport:
    """Compare estimated poses with true poses.

    Args:
        estimates: Estimated poses world_from_camera in one gauge for all cameras, by camera name.
        truths: True poses world_from_camera, by camera name. Every camera in `estimates` needs some.
        align: Kind of the alignment.
        frames: Number of frames of each camera's video, by camera name, for the coverage.

    Raises:
        JobError: A camera has no true path, or too few poses have a true pose.

    Source: S. Umeyama, PAMI 1991 (alignment); J. Sturm et al., "A benchmark for the evaluation of RGB-D
        SLAM systems", IROS 2012 (ATE and RPE).
    """
    missing = sorted(set(estimates) - set(truths))
    if missing:
        hint = (
            "add a .tum file with the true path of each camera; the cameras with a true path are: "
            f"{', '.join(sorted(truths)) or 'none'}"
        )
        raise JobError(f"there is no true path for camera {', '.join(missing)}", hint=hint)
    empty = sorted(name for name in estimates if len(truths[name].times_ns) == 0)
    if empty:
        raise JobError(
            f"the true path of camera {', '.join(empty)} has no poses",
            hint="write one pose on each line: time tx ty tz qx qy qz qw",
        )
    pairs = {name: _match_poses(estimates[name], truths[name]) for name in sorted(estimates)}
    alignment = _truth_from_estimate(pairs, align)
    counts = frames or {}
    errors = {name: _pose_errors(pair, alignment) for name, pair in pairs.items()}
    cameras = {
        name: _score(counts.get(name), pairs[name].registered, len(pairs[name].times_ns), errors[name])
        for name in pairs
    }
    has_all_counts = all(name in counts for name in pairs)
    total = _score(
        sum(counts[name] for name in pairs) if has_all_counts else None,
        sum(pair.registered for pair in pairs.values()),
        sum(len(pair.times_ns) for pair in pairs.values()),
        tuple(np.concatenate(parts) for parts in zip(*errors.values(), strict=True)),
    )
    return TrajectoryReport(
        align=align,
        scale=alignment.scale,
        cameras=cameras,
        total=total,
        truth_from_estimate=alignment,
    )


def _match_poses(estimate: TimedPoses, truth: TimedPoses) -> _MatchedPoses:
    """Associate the estimated poses of one camera with true poses."""
    poses, found = interpolate_truth(truth, estimate.times_ns)
    centres = estimate.world_from_cam[:, :3, 3]
    rotation_only = len(centres) > 1 and bool((centres == centres[0]).all())
    return _MatchedPoses(
        times_ns=estimate.times_ns[found],
        estimate=estimate.world_from_cam[found],
        truth=poses[found],
        registered=0 if rotation_only else len(found),
        rotation_only=rotation_only,
    )


def _truth_from_estimate(pairs: Mapping[str, _MatchedPoses], align: Alignment) -> Similarity:
    """Return the alignment truth_from_estimate that fits the camera centres of all cameras best."""
    placed = [pair for pair in pairs.values() if not pair.rotation_only]
    if align == "none" or not placed:
        return Similarity(1.0, np.eye(3), np.zeros(3))
    estimate = np.concatenate([pair.estimate[:, :3, 3] for pair in placed])
    truth = np.concatenate([pair.truth[:, :3, 3] for pair in placed])
    try:
        return align_points(estimate, truth, with_scale=align == "sim3")
    except ValueError as error:
        raise JobError(
            f"the paths cannot be aligned, because only {len(estimate)} poses have a true pose at the same "
            f"time ({error})",
            hint="check that both files use the same clock",
        ) from error


def _pose_errors(pair: _MatchedPoses, alignment: Similarity) -> tuple[FloatArray, ...]:
    """Return the errors of one camera's poses.

    Returns:
        (N,) errors of the camera centres, metres; (N,) errors of the orientations, degrees; (M,) relative
        errors of the translation, metres; (M,) relative errors of the rotation, degrees. The errors of
        positions that are not known are empty.
    """
    if pair.rotation_only:
        sums = np.sum(pair.truth[:, :3, :3] @ np.swapaxes(pair.estimate[:, :3, :3], 1, 2), axis=0)
        alignment = Similarity(1.0, nearest_rotation(sums), np.zeros(3))
    aligned = alignment.apply_to_poses(pair.estimate)
    centres = np.linalg.norm(aligned[:, :3, 3] - pair.truth[:, :3, 3], axis=1)
    difference = invert(pair.truth) @ aligned
    angles = np.rad2deg(rotation_angle_rad(difference[:, :3, :3])) if len(aligned) else np.zeros(0)
    first, second = _pairs_at_interval(pair.times_ns)
    estimated = invert(aligned[first]) @ aligned[second]
    expected = invert(pair.truth[first]) @ pair.truth[second]
    relative = invert(expected) @ estimated
    relative_angles = np.rad2deg(rotation_angle_rad(relative[:, :3, :3])) if len(first) else np.zeros(0)
    relative_m = np.linalg.norm(relative[:, :3, 3], axis=1)
    if pair.rotation_only:
        centres, relative_m = np.zeros(0), np.zeros(0)
    return centres, angles, relative_m, relative_angles


def _pairs_at_interval(times_ns: IntArray) -> tuple[IntArray, IntArray]:
    """Find the pairs of poses with a time difference of `_RPE_DELTA_S`, within half a frame interval.

    Returns:
        (M,) index of the first pose of each pair; (M,) index of the second pose of each pair.
    """
    if len(times_ns) < 2:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    target_ns = times_ns + round(_RPE_DELTA_S * 1e9)
    after = np.minimum(np.searchsorted(times_ns, target_ns), len(times_ns) - 1)
    before = after - 1
    nearest = np.where(target_ns - times_ns[before] < np.abs(times_ns[after] - target_ns), before, after)
    is_near = np.abs(times_ns[nearest] - target_ns) <= 0.5 * np.median(np.diff(times_ns))
    first = np.flatnonzero(is_near & (nearest > np.arange(len(times_ns))))
    return first, nearest[first]


def _score(frames: int | None, registered: int, scored: int, errors: tuple[FloatArray, ...]) -> CameraScore:
    """Return the score of one camera, or of all cameras together.

    Args:
        frames: Number of frames of the video; None if unknown.
        registered: Number of frames with an estimated pose.
        scored: Number of frames with an estimated pose and a true pose.
        errors: The errors in the form that `_pose_errors` returns.
    """
    ate, rotation, rpe_m, rpe_deg = (ErrorSummary.of(part) if len(part) else None for part in errors)
    return CameraScore(
        frames=frames,
        registered=registered,
        coverage=registered / frames if frames else None,
        scored=scored,
        ate_m=ate,
        rotation_deg=rotation,
        rpe_m=rpe_m,
        rpe_deg=rpe_deg,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class RelativeCameraError:
    """The result of comparing the vector from the reference camera to another camera with the true vector.

    Attributes:
        frames: Number of frames in which both cameras have an estimated pose and a true pose.
        vector_m: Error (metres) of the vector between the camera centres in the world, after one rigid
            alignment of both trajectories with the truth.
        in_reference_m: Error (metres) of the vector between the camera centres in the coordinates of the
            reference camera, without alignment.
    """

    frames: int
    vector_m: ErrorSummary
    in_reference_m: ErrorSummary

    def to_dict(self) -> dict[str, Any]:
        """Return the errors as plain JSON values."""
        return asdict(self)


def relative_camera_error(
    estimates: Mapping[str, TimedPoses],
    truths: Mapping[str, TimedPoses],
    camera: str,
    reference: str,
) -> RelativeCameraError:
    """Compare the vector between two cameras with the true vector, without an estimation of the scale.

    Args:
        estimates: Estimated poses world_from_camera (metres) at common times, by camera name.
        truths: True poses world_from_camera (metres) at common times, by camera name.
        camera: Name of the camera on the limb.
        reference: Name of the camera on the trunk.

    Raises:
        JobError: A camera is missing, or fewer than three frames have an estimated pose and a true pose of
            both cameras.
    """
    for name in (camera, reference):
        if name not in estimates or name not in truths:
            raise JobError(
                f"camera {name!r} has no estimated path or no true path",
                hint="give a camera that both folders contain",
            )
    times = estimates[camera].times_ns
    columns = [
        (estimates[camera].world_from_cam, np.ones(len(times), dtype=bool)),
        interpolate_truth(estimates[reference], times),
        interpolate_truth(truths[camera], times),
        interpolate_truth(truths[reference], times),
    ]
    found = np.logical_and.reduce([mask for _, mask in columns])
    if found.sum() < 3:
        hint = "check that all files use the same clock"
        raise JobError(f"only {found.sum()} frames have estimated and true poses of both cameras", hint=hint)
    limb, trunk, true_limb, true_trunk = (poses[found] for poses, _ in columns)
    centres = np.concatenate([limb[:, :3, 3], trunk[:, :3, 3]])
    alignment = align_points(
        centres, np.concatenate([true_limb[:, :3, 3], true_trunk[:, :3, 3]]), with_scale=False
    )
    vector = (limb[:, :3, 3] - trunk[:, :3, 3]) @ alignment.rotation.T
    true_vector = true_limb[:, :3, 3] - true_trunk[:, :3, 3]
    in_reference = (invert(trunk) @ limb)[:, :3, 3] - (invert(true_trunk) @ true_limb)[:, :3, 3]
    return RelativeCameraError(
        frames=int(found.sum()),
        vector_m=ErrorSummary.of(np.linalg.norm(vector - true_vector, axis=1)),
        in_reference_m=ErrorSummary.of(np.linalg.norm(in_reference, axis=1)),
    )
