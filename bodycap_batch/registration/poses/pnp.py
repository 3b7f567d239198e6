"""Estimate the poses of frames and their covariances from observed map points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert, make_transform
from bodycap_batch.model.scene import FrameStatus
from bodycap_batch.registration.poses.batched_pnp import (
    MIN_COUNTED_WEIGHT,
    Observations,
    PoseQuality,
    evaluate_poses,
    refine_poses,
)

_MIN_INLIER_WEIGHT_RATIO = 0.3
"""Minimum inlier weight ratio of an accepted pose: the weight of the inliers divided by the weight of all
observations. Evidence: none."""
_MIN_NOISE_PX = 0.3
"""Pixels: smallest assumed noise of an observation. It replaces a smaller noise estimate from the residuals.
Evidence: none."""
_UNCONSTRAINED_VARIANCE = 1e12
"""Variance assumed for a pose that the observations do not determine. It exceeds every limit."""
_WEIGHT_RATIO_FLOOR = 1e-3
"""Minimum divisor of the noise. The noise is divided by the inlier weight ratio. A smaller ratio is replaced
by this minimum, to prevent a division by zero."""
_MAX_TRIALS = 2000
"""Maximum number of RANSAC iterations. Evidence: none."""
TRUSTED_WEIGHT_RATIO = 0.6
"""Minimum inlier weight ratio of a refined pose for which RANSAC is skipped. With a smaller ratio, RANSAC is
tried too. For poses with a larger ratio, RANSAC never found a better pose."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AcceptanceCriteria:
    """The conditions that a pose must meet.

    Attributes:
        max_error_px: Maximum reprojection error of an inlier, pixels.
        min_inliers: Minimum number of inliers.
        max_sigma_depth: Maximum sigma of the camera centre, as a fraction of the median depth.
        min_noise_px: Smallest assumed noise of an observation, pixels.
        seed: Seed of RANSAC.
    """

    max_error_px: float
    min_inliers: int
    max_sigma_depth: float
    min_noise_px: float = _MIN_NOISE_PX
    seed: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class FramePose:
    """The estimated pose of one frame, or the reason why the frame has no pose.

    Attributes:
        status: Status of the frame. A frame with the status `REGISTERED` or `KEYFRAME` has a pose. Any other
            status is the reason why the frame has no pose.
        gauge_from_cam: (4,4) pose; None if the frame has no pose.
        covariance: (6,6) covariance as in `Trajectory`, if the map had no error; None if the frame has no
            pose.
        scatter: Sigma of the centre (root of the summed variances) from the independent noise of the
            observations alone, in the unit of the gauge. Neighbouring frames have the rest of the error in
            common. NaN if the frame has no pose.
        inliers: Number of inliers.
        inlier_weight_ratio: Ratio of the inliers' weight to the weight of all observations.
        error_px: Mean reprojection error of the inliers, pixels.
    """

    status: FrameStatus
    gauge_from_cam: FloatArray | None = None
    covariance: FloatArray | None = None
    scatter: float = float("nan")
    inliers: int = 0
    inlier_weight_ratio: float = 0.0
    error_px: float = float("nan")


def solve_poses(
    lens: Camera,
    observations: Observations,
    px: FloatArray,
    start: FloatArray,
    criteria: AcceptanceCriteria,
    threads: int = 1,
) -> list[FramePose]:
    """Estimate the poses of all frames of a camera from the observed map points.

    Each initial pose is refined. A frame without an initial pose, or with a low inlier weight ratio, is
    solved again from a RANSAC pose. The result with the higher inlier weight ratio is kept.

    Args:
        lens: The camera model.
        observations: (M) observations, ordered by frame.
        px: (M,2) observed pixels of these observations.
        start: (F,4,4) initial poses cam_from_gauge; NaN for a frame without an initial pose.
        criteria: The conditions that a pose must meet.
        threads: Number of threads that solve chunks of frames. The result does not depend on it.

    Returns:
        The pose of each frame, or the reason why the frame has no pose.
    """
    has_start = np.asarray(np.isfinite(start).all(axis=(1, 2)))
    initial = np.where(has_start[:, None, None], start, np.eye(4))
    poses = refine_poses(observations, initial, criteria.max_error_px, threads)
    count = np.diff(observations.bounds)
    solved = accept_poses(observations, poses, criteria, threads)
    for frame in np.flatnonzero(count >= criteria.min_inliers).tolist():
        if has_start[frame] and solved[frame].inlier_weight_ratio >= TRUSTED_WEIGHT_RATIO:
            continue
        own = observations.select_frame(frame)
        chosen = own.weight >= MIN_COUNTED_WEIGHT
        if chosen.sum() < criteria.min_inliers:
            chosen[:] = True
        start_pose = ransac_pose(lens, own.points[chosen], px[observations.rows(frame)][chosen], criteria)
        if start_pose is not None:
            refined = refine_poses(own, start_pose[None], criteria.max_error_px)
            solved[frame] = max(
                solved[frame],
                *accept_poses(own, refined, criteria),
                key=lambda pose: pose.inlier_weight_ratio,
            )
    return solved


def ransac_pose(
    camera: Camera, points: FloatArray, px: FloatArray, criteria: AcceptanceCriteria
) -> FloatArray | None:
    """Return the pose cam_from_gauge (4,4) of a calibrated camera; None if RANSAC fails.

    Args:
        camera: The camera model.
        points: (N,3) map points in the gauge.
        px: (N,2) observed pixels of the points.
        criteria: The inlier limit and the seed.

    Source: Lebeda, Matas, Chum, "Fixing the locally optimized RANSAC", BMVC 2012, as in COLMAP.
    """
    import pycolmap

    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = criteria.max_error_px
    options.ransac.random_seed = criteria.seed
    options.ransac.max_num_trials = _MAX_TRIALS
    found = pycolmap.estimate_absolute_pose(px, points, camera.to_pycolmap(), options)
    if found is None:
        return None
    matrix = np.asarray(found["cam_from_world"].matrix())
    return make_transform(matrix[:, :3], matrix[:, 3])


def accept_poses(
    observations: Observations,
    cam_from_gauge: FloatArray,
    criteria: AcceptanceCriteria,
    threads: int = 1,
) -> list[FramePose]:
    """Count the inliers of poses, estimate their covariances, and accept or reject each pose.

    Args:
        observations: Observations of F frames.
        cam_from_gauge: (F,4,4) poses of the frames.
        criteria: The conditions that a pose must meet.
        threads: Number of threads. The result does not depend on it.

    Returns:
        The accepted pose of each frame, or the reason why the pose was rejected.
    """
    quality = evaluate_poses(observations, cam_from_gauge, criteria.max_error_px, threads)
    covariance, independent = _covariances(quality, criteria.min_noise_px)
    sigma = np.sqrt(np.linalg.eigvalsh(covariance[:, 3:, 3:])[:, -1])
    constrained = sigma < criteria.max_sigma_depth * quality.depth
    gauge_from_cam = invert(cam_from_gauge)
    out = []
    for frame, count in enumerate(np.diff(observations.bounds).tolist()):
        inliers = int(quality.inliers[frame])
        if count < criteria.min_inliers:
            out.append(FramePose(status=FrameStatus.FEW_TRACKS))
        elif inliers < criteria.min_inliers or quality.inlier_weight_ratio[frame] < _MIN_INLIER_WEIGHT_RATIO:
            evidence = float(quality.inlier_weight_ratio[frame])
            out.append(
                FramePose(status=FrameStatus.FEW_INLIERS, inliers=inliers, inlier_weight_ratio=evidence)
            )
        else:
            is_constrained = bool(constrained[frame])
            out.append(
                FramePose(
                    status=FrameStatus.REGISTERED if is_constrained else FrameStatus.UNCONSTRAINED,
                    gauge_from_cam=gauge_from_cam[frame] if is_constrained else None,
                    covariance=covariance[frame] if is_constrained else None,
                    scatter=float(np.sqrt(np.trace(independent[frame, 3:, 3:]))),
                    inliers=inliers,
                    inlier_weight_ratio=float(quality.inlier_weight_ratio[frame]),
                    error_px=float(quality.error_px[frame]),
                )
            )
    return out


def _covariances(quality: PoseQuality, min_noise_px: float) -> tuple[FloatArray, FloatArray]:
    """Return covariances (F,6,6) from the information and the noise of the inliers, for an exact map.

    If the information matrix is singular, the variances are huge. Observations that disagree with a pose make
    this pose less certain. The sigmas therefore grow as the inlier weight ratio falls. Evidence:
    docs/decisions/registration.md.

    A left perturbation of cam_from_gauge is a right perturbation of gauge_from_cam with the opposite sign.
    Both perturbations therefore have the same covariance.

    Returns:
        The covariances from the reduced chi-squared of the inliers, multiplied by the ratio by which common
        errors of neighbouring points increase the variance; and the covariances from the median noise, as
        if the errors of all observations were independent.
    """
    noise_px = np.maximum(1.4826 * np.nan_to_num(quality.noise_px), min_noise_px)
    solvable = np.linalg.matrix_rank(quality.information) == 6
    information = np.where(solvable[:, None, None], quality.information, np.eye(6) / _UNCONSTRAINED_VARIANCE)
    ratio = np.maximum(quality.inlier_weight_ratio, _WEIGHT_RATIO_FLOOR)
    inverse = np.linalg.inv(information) / ratio[:, None, None] ** 2
    common_px2 = np.fmax(np.nan_to_num(quality.variance_px2), quality.common_px2)
    variance_px2 = np.maximum(common_px2, noise_px**2)
    return inverse * variance_px2[:, None, None], inverse * noise_px[:, None, None] ** 2
