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
    evidence: float = 0.0
    error_px: float = float("nan")


def solve_poses(
    lenses: Sequence[Camera],
    views: Observations,
    px: FloatArray,
    start: FloatArray,
    limits: AcceptanceCriteria,
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
    known = np.asarray(np.isfinite(start).all(axis=(1, 2)))
    poses = refine_poses(views, np.where(known[:, None, None], start, np.eye(4)), limits.max_error_px)
    count = np.diff(views.bounds)
    found = accept_poses(views, poses, limits)
    for frame in np.flatnonzero(count >= limits.min_inliers).tolist():
        if known[frame] and found[frame].evidence >= TRUSTED_WEIGHT_RATIO:
            continue
        alone = views.of_frame(frame)
        some = alone.weight >= MIN_COUNTED_WEIGHT
        if some.sum() < limits.min_inliers:
            some[:] = True
        sampled = _ransac(lenses, alone, some, px[views.rows(frame)], limits)
        if sampled is not None:
            refined = refine_poses(alone, sampled[None], limits.max_error_px)
            found[frame] = max(
                found[frame], *accept_poses(alone, refined, limits), key=lambda pose: pose.evidence
            )
    return found


def _ransac(
    lenses: Sequence[Camera], views: Observations, some: BoolArray, px: FloatArray, limits: AcceptanceCriteria
) -> FloatArray | None:
    """Pose (4,4) of one frame from some of its views; of its rig where several cameras see them."""
    seen, px = views.points[some], px[some]
    if views.member is None or views.cam_from_rig is None:
        return ransac_pose(lenses[0], seen, px, limits)
    member = views.member[some]
    if len(np.unique(member)) > 1:
        return _ransac_rig_pose(lenses, views.cam_from_rig, member, seen, px, limits)
    pose = ransac_pose(lenses[member[0]], seen, px, limits)
    return None if pose is None else np.asarray(invert(views.cam_from_rig[member[0]]) @ pose)


def _ransac_rig_pose(
    lenses: Sequence[Camera],
    cam_from_rig: FloatArray,
    member: IntArray,
    points: FloatArray,
    px: FloatArray,
    limits: AcceptanceCriteria,
) -> FloatArray | None:
    """Pose rig_from_gauge (4,4) from map points (N,3) that its cameras `member` (N,) see at pixels (N,2).

    Source: Hee Lee et al., "Minimal solutions for pose estimation of a multi-camera system", ISRR 2013, as
        in COLMAP.
    """
    import pycolmap

    options = pycolmap.RANSACOptions()
    options.max_error = limits.max_error_px
    options.random_seed = limits.seed
    options.max_num_trials = _MAX_TRIALS
    places = [pycolmap.Rigid3d(pose[:3]) for pose in cam_from_rig]
    cameras = [lens.to_pycolmap() for lens in lenses]
    found = pycolmap.estimate_generalized_absolute_pose(px, points, member.tolist(), places, cameras, options)
    if found is None:
        return None
    matrix = np.asarray(found["rig_from_world"].matrix())
    return make_transform(matrix[:, :3], matrix[:, 3])


def ransac_pose(
    camera: Camera, points: FloatArray, px: FloatArray, limits: AcceptanceCriteria
) -> FloatArray | None:
    """Pose cam_from_gauge (4,4) of a calibrated camera from map points (N,3) seen at pixels (N,2).

    Source: Lebeda, Matas, Chum, "Fixing the locally optimized RANSAC", BMVC 2012, as in COLMAP.
    """
    import pycolmap

    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = limits.max_error_px
    options.ransac.random_seed = limits.seed
    options.ransac.max_num_trials = _MAX_TRIALS
    found = pycolmap.estimate_absolute_pose(px, points, camera.to_pycolmap(), options)
    if found is None:
        return None
    matrix = np.asarray(found["cam_from_world"].matrix())
    return make_transform(matrix[:, :3], matrix[:, 3])


def accept_poses(
    views: Observations, cam_from_gauge: FloatArray, limits: AcceptanceCriteria
) -> list[FramePose]:
    """Count the inliers of poses (F,4,4), estimate their covariance, and accept or refuse them."""
    fits = evaluate_poses(views, cam_from_gauge, limits.max_error_px)
    covariance = _covariance(fits, limits.min_noise_px)
    sigma = np.sqrt(np.linalg.eigvalsh(covariance[:, 3:, 3:])[:, -1])
    constrained = sigma < limits.max_sigma_depth * fits.depth
    gauge_from_cam = invert(cam_from_gauge)
    out = []
    for frame, count in enumerate(np.diff(views.bounds).tolist()):
        inliers = int(fits.inliers[frame])
        if count < limits.min_inliers:
            out.append(FramePose(status=FrameStatus.FEW_TRACKS))
        elif inliers < limits.min_inliers or fits.evidence[frame] < _MIN_INLIER_WEIGHT_RATIO:
            evidence = float(fits.evidence[frame])
            out.append(FramePose(status=FrameStatus.FEW_INLIERS, inliers=inliers, evidence=evidence))
        else:
            good = bool(constrained[frame])
            out.append(
                FramePose(
                    status=FrameStatus.REGISTERED if good else FrameStatus.UNCONSTRAINED,
                    gauge_from_cam=gauge_from_cam[frame] if good else None,
                    covariance=covariance[frame] if good else None,
                    inliers=inliers,
                    evidence=float(fits.evidence[frame]),
                    error_px=float(fits.error_px[frame]),
                )
            )
    return out


def _covariance(fits: PoseQuality, min_noise_px: float) -> FloatArray:
    """Covariance (F,6,6) from the inliers' information and their own spread; huge where there is no inverse.

    Views that disagree with a pose are evidence against it: the sigmas grow as the inliers' share falls.
    (room131, frames off by more than 10 cm: 5 of 7 then lie beyond the limit, none of 7 without.)

    A left perturbation of cam_from_gauge is a right one of gauge_from_cam with the sign turned: the
    covariance is the same.
    """
    noise_px = np.maximum(1.4826 * np.nan_to_num(fits.noise_px), min_noise_px)
    solvable = np.linalg.matrix_rank(fits.information) == 6
    safe = np.where(solvable[:, None, None], fits.information, np.eye(6) / _UNCONSTRAINED_VARIANCE)
    sigma_px = noise_px / np.maximum(fits.evidence, _WEIGHT_RATIO_FLOOR)
    return np.asarray(np.linalg.inv(safe) * MAP_COVARIANCE_SCALE * sigma_px[:, None, None] ** 2)
