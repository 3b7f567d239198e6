"""Frames' poses from tracked map points, with the covariance that the data support."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
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
_MIN_NOISE_PX = 0.3
MAP_COVARIANCE_SCALE = 5.0
"""Variance of a pose over what its residuals tell: the map's points around a frame are displaced together.

Measured as the normalised error without it (median over what a chi-squared has): walk12 5.1, room12 4.1,
walk131 5.2 (room131, where blocks of the map are loose, 16). The poses that a frame's two keyframes lead to
differ by 0.8 of their own variances, so nothing in a frame alone can tell."""
_UNCONSTRAINED_VARIANCE = 1e12
_WEIGHT_RATIO_FLOOR = 1e-3
_MAX_TRIALS = 2000
TRUSTED_WEIGHT_RATIO = 0.6
"""Share of the weight with the inliers above which a start led to the right pose: sampling never found a
better one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AcceptanceCriteria:
    """What makes a pose acceptable.

    Attributes:
        max_error_px: RANSAC's inlier threshold.
        min_inliers: Fewest inliers.
        max_sigma_depth: Largest centre sigma as a share of the median depth.
        min_noise_px: Least noise of a view that residuals are believed to tell.
        seed: RANSAC's seed.
    """

    max_error_px: float
    min_inliers: int
    max_sigma_depth: float
    min_noise_px: float = _MIN_NOISE_PX
    seed: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class FramePose:
    """Outcome of one frame.

    Attributes:
        status: REGISTERED or the reason why not.
        gauge_from_cam: (4,4), None unless registered.
        covariance: (6,6) as `Trajectory` has it.
        inliers: Number of inliers.
        evidence: Their share of the weight of all views.
        error_px: Mean reprojection error of the inliers.
    """

    status: FrameStatus
    gauge_from_cam: FloatArray | None = None
    covariance: FloatArray | None = None
    inliers: int = 0
    inlier_weight_ratio: float = 0.0
    error_px: float = float("nan")


def solve_poses(
    lenses: Sequence[Camera],
    observations: Observations,
    px: FloatArray,
    start: FloatArray,
    criteria: AcceptanceCriteria,
    threads: int = 1,
) -> list[FramePose]:
    """Poses of all frames of a camera, or of a rig, from the map points seen in them.

    Args:
        lenses: The camera's lens, or those of the rig's cameras.
        views: Points and where they are seen (M rows), by frame.
        px: (M,2) the same as pixels.
        start: (F,4,4) cam_from_gauge to start from; NaN where there is none.
        limits: What makes a pose acceptable.

    Where a start leads to few inliers, or there is none, the frame is sampled from scratch.
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
        start_pose = _ransac(lenses, own, chosen, px[observations.rows(frame)], criteria)
        if start_pose is not None:
            refined = refine_poses(own, start_pose[None], criteria.max_error_px)
            solved[frame] = max(
                solved[frame],
                *accept_poses(own, refined, criteria),
                key=lambda pose: pose.inlier_weight_ratio,
            )
    return solved


def _ransac(
    lenses: Sequence[Camera],
    observations: Observations,
    chosen: BoolArray,
    px: FloatArray,
    criteria: AcceptanceCriteria,
) -> FloatArray | None:
    """Pose (4,4) of one frame from some of its views; of its rig where several cameras see them."""
    points, px = observations.points[chosen], px[chosen]
    if observations.member is None or observations.cam_from_rig is None:
        return ransac_pose(lenses[0], points, px, criteria)
    member = observations.member[chosen]
    if len(np.unique(member)) > 1:
        return _ransac_rig_pose(lenses, observations.cam_from_rig, member, points, px, criteria)
    pose = ransac_pose(lenses[member[0]], points, px, criteria)
    return None if pose is None else np.asarray(invert(observations.cam_from_rig[member[0]]) @ pose)


def _ransac_rig_pose(
    lenses: Sequence[Camera],
    cam_from_rig: FloatArray,
    member: IntArray,
    points: FloatArray,
    px: FloatArray,
    criteria: AcceptanceCriteria,
) -> FloatArray | None:
    """Pose rig_from_gauge (4,4) from map points (N,3) that its cameras `member` (N,) see at pixels (N,2).

    Source: Hee Lee et al., "Minimal solutions for pose estimation of a multi-camera system", ISRR 2013, as
        in COLMAP.
    """
    import pycolmap

    options = pycolmap.RANSACOptions()
    options.max_error = criteria.max_error_px
    options.random_seed = criteria.seed
    options.max_num_trials = _MAX_TRIALS
    rig_poses = [pycolmap.Rigid3d(pose[:3]) for pose in cam_from_rig]
    cameras = [lens.to_pycolmap() for lens in lenses]
    found = pycolmap.estimate_generalized_absolute_pose(
        px, points, member.tolist(), rig_poses, cameras, options
    )
    if found is None:
        return None
    matrix = np.asarray(found["rig_from_world"].matrix())
    return make_transform(matrix[:, :3], matrix[:, 3])


def ransac_pose(
    camera: Camera, points: FloatArray, px: FloatArray, criteria: AcceptanceCriteria
) -> FloatArray | None:
    """Pose cam_from_gauge (4,4) of a calibrated camera from map points (N,3) seen at pixels (N,2).

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
    """Count the inliers of poses (F,4,4), estimate their covariance, and accept or refuse them."""
    quality = evaluate_poses(observations, cam_from_gauge, criteria.max_error_px, threads)
    covariance = _covariance(quality, criteria.min_noise_px)
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
                    inliers=inliers,
                    inlier_weight_ratio=float(quality.inlier_weight_ratio[frame]),
                    error_px=float(quality.error_px[frame]),
                )
            )
    return out


def _covariance(quality: PoseQuality, min_noise_px: float) -> FloatArray:
    """Covariance (F,6,6) from the inliers' information and their own spread; huge where there is no inverse.

    Views that disagree with a pose are evidence against it: the sigmas grow as the inliers' share falls.
    (room131, frames off by more than 10 cm: 5 of 7 then lie beyond the limit, none of 7 without.)

    A left perturbation of cam_from_gauge is a right one of gauge_from_cam with the sign turned: the
    covariance is the same.
    """
    noise_px = np.maximum(1.4826 * np.nan_to_num(quality.noise_px), min_noise_px)
    solvable = np.linalg.matrix_rank(quality.information) == 6
    information = np.where(solvable[:, None, None], quality.information, np.eye(6) / _UNCONSTRAINED_VARIANCE)
    sigma_px = noise_px / np.maximum(quality.inlier_weight_ratio, _WEIGHT_RATIO_FLOOR)
    return np.asarray(np.linalg.inv(information) * MAP_COVARIANCE_SCALE * sigma_px[:, None, None] ** 2)
