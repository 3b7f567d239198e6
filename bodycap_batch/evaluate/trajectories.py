"""Camera trajectories against the truth: ATE, RPE, coverage; all cameras under one alignment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.core.errors import JobError
from bodycap_batch.evaluate.association import Association, interpolate_truth, nearest_truth
from bodycap_batch.formats.tum import TimedPoses, read_tum
from bodycap_batch.model.geometry import Similarity, align_points, invert, rotation_angle_rad

Alignment = Literal["sim3", "se3", "none"]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrajectoryOptions:
    """How trajectories are compared.

    Attributes:
        align: Similarity, rigid or no alignment, one for all cameras of a capture.
        association: The truth interpolated at the frame's time, or the nearest one.
        max_gap_s: Interpolation: no truth inside a longer gap.
        max_diff_s: Nearest: largest time difference of a pair.
        rpe_delta_s: Time between the two poses of a relative error.
    """

    align: Alignment = "sim3"
    association: Association = "interpolate"
    max_gap_s: float = 0.1
    max_diff_s: float = 0.02
    rpe_delta_s: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorSummary:
    """Statistics of an error, in the unit of its name."""

    rmse: float
    mean: float
    median: float
    p95: float
    max: float

    @classmethod
    def of(cls, errors: FloatArray) -> ErrorSummary:
        """Summarise errors (N,), N ≥ 1."""
        return cls(
            rmse=float(np.sqrt(np.mean(errors**2))),
            mean=float(np.mean(errors)),
            median=float(np.median(errors)),
            p95=float(np.percentile(errors, 95)),
            max=float(np.max(errors)),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraScore:
    """One camera (or all) against the truth.

    Attributes:
        frames: Frames of the video, None where not told.
        registered: Frames with a pose.
        coverage: registered / frames.
        scored: Registered frames that have a truth.
        ate_m: Distance of camera centres after alignment, metres.
        rotation_deg: Angle between orientations after alignment.
        rpe_m: Translation error over `rpe_delta_s`, metres.
        rpe_deg: Rotation error over `rpe_delta_s`.
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
    """Scores of a capture.

    Attributes:
        options: How it was compared.
        scale: Scale of the alignment (truth = scale · estimate).
        cameras: By camera name.
        total: All cameras together.
        truth_from_estimate: The one alignment.
    """

    options: TrajectoryOptions
    scale: float
    cameras: Mapping[str, CameraScore]
    total: CameraScore
    truth_from_estimate: Similarity

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {
            "options": asdict(self.options),
            "scale": self.scale,
            "cameras": {name: asdict(score) for name, score in self.cameras.items()},
            "total": asdict(self.total),
        }


def evaluate_trajectories(
    estimates: Mapping[str, Path],
    truths: Mapping[str, Path],
    options: TrajectoryOptions | None = None,
    frames: Mapping[str, int] | None = None,
) -> TrajectoryReport:
    """Score TUM files against TUM files.

    Args:
        estimates: world_from_camera by camera, in any gauge that is common to all.
        truths: world_from_camera by camera; cameras without truth are an error.
        options: How to compare.
        frames: Frames of each video, for the coverage.

    Raises:
        JobError: A file is missing or malformed, or too few poses have a truth.
    """
    return score_trajectories(
        {name: read_tum(path) for name, path in estimates.items()},
        {name: read_tum(path) for name, path in truths.items()},
        options,
        frames,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _MatchedPoses:
    """One camera's estimates with their truths."""

    times_ns: IntArray
    estimate: FloatArray
    truth: FloatArray
    registered: int


def score_trajectories(
    estimates: Mapping[str, TimedPoses],
    truths: Mapping[str, TimedPoses],
    options: TrajectoryOptions | None = None,
    frames: Mapping[str, int] | None = None,
) -> TrajectoryReport:
    """Score poses against poses; see `evaluate_trajectories`.

    Source: S. Umeyama, PAMI 1991 (alignment); J. Sturm et al., "A benchmark for the evaluation of RGB-D
        SLAM systems", IROS 2012 (ATE and RPE).
    """
    options = options or TrajectoryOptions()
    missing = sorted(set(estimates) - set(truths))
    if missing:
        hint = f"truth is given for {', '.join(sorted(truths)) or 'none'}"
        raise JobError(f"no truth for camera {', '.join(missing)}", hint=hint)
    empty = sorted(name for name in estimates if len(truths[name].times_ns) == 0)
    if empty:
        raise JobError(
            f"the truth of camera {', '.join(empty)} holds no poses",
            hint="a TUM file: time tx ty tz qx qy qz qw",
        )
    pairs = {name: _match_poses(estimates[name], truths[name], options) for name in sorted(estimates)}
    alignment = _truth_from_estimate(pairs, options.align)
    counts = frames or {}
    errors = {name: _pose_errors(pair, alignment, options.rpe_delta_s) for name, pair in pairs.items()}
    cameras = {
        name: _score(counts.get(name), pairs[name].registered, len(pairs[name].times_ns), errors[name])
        for name in pairs
    }
    known = all(name in counts for name in pairs)
    total = _score(
        sum(counts[name] for name in pairs) if known else None,
        sum(pair.registered for pair in pairs.values()),
        sum(len(pair.times_ns) for pair in pairs.values()),
        tuple(np.concatenate(parts) for parts in zip(*errors.values(), strict=True)),
    )
    return TrajectoryReport(
        options=options,
        scale=alignment.scale,
        cameras=cameras,
        total=total,
        truth_from_estimate=alignment,
    )


def truth_at(
    truth: TimedPoses, times_ns: IntArray, options: TrajectoryOptions
) -> tuple[FloatArray, BoolArray]:
    """The truth (N,4,4) at given times and where there is one (N,)."""
    if options.association == "nearest":
        return nearest_truth(truth, times_ns, options.max_diff_s)
    return interpolate_truth(truth, times_ns, options.max_gap_s)


def _match_poses(estimate: TimedPoses, truth: TimedPoses, options: TrajectoryOptions) -> _MatchedPoses:
    poses, found = truth_at(truth, estimate.times_ns, options)
    return _MatchedPoses(
        times_ns=estimate.times_ns[found],
        estimate=estimate.world_from_cam[found],
        truth=poses[found],
        registered=len(found),
    )


def _truth_from_estimate(pairs: Mapping[str, _MatchedPoses], align: Alignment) -> Similarity:
    """truth_from_estimate over the centres of all cameras."""
    if align == "none":
        return Similarity(1.0, np.eye(3), np.zeros(3))
    estimate = np.concatenate([pair.estimate[:, :3, 3] for pair in pairs.values()])
    truth = np.concatenate([pair.truth[:, :3, 3] for pair in pairs.values()])
    try:
        return align_points(estimate, truth, with_scale=align == "sim3")
    except ValueError as error:
        raise JobError(
            f"{len(estimate)} poses have a truth at their time: cannot align ({error})",
            hint="check that both files use the same clock",
        ) from error


def _pose_errors(pair: _MatchedPoses, alignment: Similarity, delta_s: float) -> tuple[FloatArray, ...]:
    """Errors of centres, orientations, and of relative motion (m, deg)."""
    aligned = alignment.apply_to_poses(pair.estimate)
    centres = np.linalg.norm(aligned[:, :3, 3] - pair.truth[:, :3, 3], axis=1)
    difference = invert(pair.truth) @ aligned
    angles = np.rad2deg(rotation_angle_rad(difference[:, :3, :3])) if len(aligned) else np.zeros(0)
    first, second = _pairs_at_interval(pair.times_ns, delta_s)
    moved = invert(aligned[first]) @ aligned[second]
    should = invert(pair.truth[first]) @ pair.truth[second]
    relative = invert(should) @ moved
    turns = np.rad2deg(rotation_angle_rad(relative[:, :3, :3])) if len(first) else np.zeros(0)
    return centres, angles, np.linalg.norm(relative[:, :3, 3], axis=1), turns


def _pairs_at_interval(times_ns: IntArray, delta_s: float) -> tuple[IntArray, IntArray]:
    """Index pairs whose times differ by delta, to half a frame."""
    if len(times_ns) < 2:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    wanted = times_ns + round(delta_s * 1e9)
    after = np.minimum(np.searchsorted(times_ns, wanted), len(times_ns) - 1)
    before = after - 1
    nearer = np.where(wanted - times_ns[before] < np.abs(times_ns[after] - wanted), before, after)
    near = np.abs(times_ns[nearer] - wanted) <= 0.5 * np.median(np.diff(times_ns))
    first = np.flatnonzero(near & (nearer > np.arange(len(times_ns))))
    return first, nearer[first]


def _score(frames: int | None, registered: int, scored: int, errors: tuple[FloatArray, ...]) -> CameraScore:
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
