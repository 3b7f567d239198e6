"""One frame's pose from tracked map points, with the covariance that the data support."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bodycap_batch.arrays import BoolArray, FloatArray
from bodycap_batch.camera import Camera
from bodycap_batch.geometry import invert, make_transform
from bodycap_batch.scene import FrameStatus

if TYPE_CHECKING:
    import pycolmap

_MIN_INLIER_RATIO = 0.3
_MIN_NOISE_PX = 0.3
_RAY_STEP = 1e-4
_REFINEMENTS = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseLimits:
    """What makes a pose acceptable.

    Attributes:
        max_error_px: RANSAC's inlier threshold.
        min_inliers: Fewest inliers.
        max_sigma_depth: Largest centre sigma as a share of the median depth.
        seed: RANSAC's seed.
    """

    max_error_px: float
    min_inliers: int
    max_sigma_depth: float
    seed: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class FramePose:
    """Outcome of one frame.

    Attributes:
        status: REGISTERED or the reason why not.
        gauge_from_cam: (4,4), None unless registered.
        covariance: (6,6) as `Trajectory` has it.
        inliers: Number of inliers.
        error_px: Mean reprojection error of the inliers.
    """

    status: FrameStatus
    gauge_from_cam: FloatArray | None = None
    covariance: FloatArray | None = None
    inliers: int = 0
    error_px: float = float("nan")


def solve_pose(camera: Camera, points: FloatArray, px: FloatArray, limits: PoseLimits) -> FramePose:
    """Pose of a calibrated camera from map points (N,3) seen at pixels (N,2).

    Source: Lebeda, Matas, Chum, "Fixing the locally optimized RANSAC", BMVC 2012, as in COLMAP; then
        non-linear refinement over the inliers with a Cauchy loss.
    """
    import pycolmap

    if len(points) < limits.min_inliers:
        return FramePose(status=FrameStatus.FEW_TRACKS)
    model = camera.to_pycolmap()
    estimation, refinement = _pycolmap_options(limits)
    found = pycolmap.estimate_and_refine_absolute_pose(px, points, model, estimation, refinement)
    if found is None:
        return FramePose(status=FrameStatus.FEW_INLIERS)
    pose = found["cam_from_world"]
    for _ in range(_REFINEMENTS):
        cam_from_gauge = _as_matrix(pose)
        inlier = _residuals(camera, cam_from_gauge, points, px)[1] < limits.max_error_px
        if inlier.sum() < limits.min_inliers:
            break
        # From the sampled inliers to all of them: the answer no longer hangs on the samples.
        refined = pycolmap.refine_absolute_pose(pose, px, points, inlier, model, refinement)
        if refined is None:
            break
        pose = refined["cam_from_world"]
    return judge_pose(camera, _as_matrix(pose), points, px, limits)


def _as_matrix(pose: pycolmap.Rigid3d) -> FloatArray:
    matrix = np.asarray(pose.matrix())
    return make_transform(matrix[:, :3], matrix[:, 3])


def _residuals(
    camera: Camera, cam_from_gauge: FloatArray, points: FloatArray, px: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residual (N,2), its length (N,) (infinite behind the camera) and the points in the camera frame."""
    x_in_cam = points @ cam_from_gauge[:3, :3].T + cam_from_gauge[:3, 3]
    residual = camera.project(x_in_cam) - px
    return residual, np.nan_to_num(np.linalg.norm(residual, axis=1), nan=np.inf), x_in_cam


def judge_pose(
    camera: Camera, cam_from_gauge: FloatArray, points: FloatArray, px: FloatArray, limits: PoseLimits
) -> FramePose:
    """Count a pose's inliers, estimate its covariance, and accept or refuse it."""
    residual, error, x_in_cam = _residuals(camera, cam_from_gauge, points, px)
    inlier = error < limits.max_error_px
    count = int(inlier.sum())
    if count < max(limits.min_inliers, _MIN_INLIER_RATIO * len(points)):
        return FramePose(status=FrameStatus.FEW_INLIERS, inliers=count)
    covariance = _covariance(camera, x_in_cam, residual, inlier)
    sigma = np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])
    mean_error = float(error[inlier].mean())
    if not sigma < limits.max_sigma_depth * np.median(x_in_cam[inlier, 2]):
        return FramePose(status=FrameStatus.UNCONSTRAINED, inliers=count, error_px=mean_error)
    return FramePose(
        status=FrameStatus.REGISTERED,
        gauge_from_cam=invert(cam_from_gauge),
        covariance=covariance,
        inliers=count,
        error_px=mean_error,
    )


def _pycolmap_options(
    limits: PoseLimits,
) -> tuple[pycolmap.AbsolutePoseEstimationOptions, pycolmap.AbsolutePoseRefinementOptions]:
    import pycolmap

    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.ransac.max_error = limits.max_error_px
    estimation.ransac.random_seed = limits.seed
    estimation.ransac.max_num_trials = 2000
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.loss_function_scale = 0.5 * limits.max_error_px
    return estimation, refinement


def _covariance(camera: Camera, x_in_cam: FloatArray, residual: FloatArray, inlier: BoolArray) -> FloatArray:
    """Inverse of the Gauss–Newton information at the solution, scaled by the inliers' own spread.

    A right perturbation (rotation ω, translation v) of gauge_from_cam moves a point in the camera frame
    by −ω × x − v.
    """
    x, y, z = x_in_cam[inlier].T
    zero = np.zeros_like(x)
    skew = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    motion = np.concatenate([skew, np.broadcast_to(-np.eye(3), skew.shape)], axis=2)
    row_u = np.stack([1 / z, zero, -x / z**2], axis=1)
    row_v = np.stack([zero, 1 / z, -y / z**2], axis=1)
    jacobian = _lens_jacobian(camera, x_in_cam[inlier]) @ np.stack([row_u, row_v], axis=1) @ motion
    information = np.einsum("nij,nik->jk", jacobian, jacobian)
    spread = 1.4826 * np.median(np.abs(residual[inlier]))
    noise_px = max(float(spread), _MIN_NOISE_PX)
    if np.linalg.matrix_rank(information) < 6:
        return np.asarray(np.eye(6) * np.inf)
    return np.asarray(np.linalg.inv(information) * noise_px**2)


def _lens_jacobian(camera: Camera, x_in_cam: FloatArray) -> FloatArray:
    """Derivative (N,2,2) of the pixel by the ray (x/z, y/z), by central differences."""
    rays = x_in_cam[:, :2] / x_in_cam[:, 2:]
    columns = []
    for step in np.eye(2) * _RAY_STEP:
        moved = [np.column_stack([rays + sign * step, np.ones(len(rays))]) for sign in (1.0, -1.0)]
        columns.append((camera.project(moved[0]) - camera.project(moved[1])) / (2.0 * _RAY_STEP))
    return np.stack(columns, axis=2)
