"""Fit intrinsics to views of a board.

Pixels have OpenCV's origin: the centre of the first pixel is (0, 0).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from bodycap_batch.calibration.board_detection import BoardCorners
from bodycap_batch.core.arrays import FloatArray

ImageSize = tuple[int, int]
_FISHEYE_INITIAL_FOCALS = (0.5, 0.35, 0.7)
"""Initial focal lengths of the fisheye model, as fractions of the picture's long side. Each value is tried.
Evidence: none."""
_MAX_VIEW_ERROR_RATIO = 3.0
"""Maximum ratio of a view's error to the median error of all views. A view with a larger ratio is an outlier:
the picture is blurred or a corner is wrong. Evidence: none."""
_MIN_OUTLIER_ERROR_PX = 0.3
"""Minimum error of an outlier view, in px of a picture with a long side of 640 px. A view with a smaller
error is always kept. Evidence: none."""
_MIN_FIT_VIEWS = 6
"""Minimum number of views that must remain if outlier views are removed. If fewer views would remain, the
outlier views are kept. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class IntrinsicsFit:
    """Intrinsics fitted to views of a board.

    Attributes:
        model: COLMAP's name of the camera model: PINHOLE, OPENCV or OPENCV_FISHEYE.
        matrix: (3,3) camera matrix with focal lengths and principal point, px.
        distortion: Distortion coefficients of the camera model, in OpenCV's order.
        rms_px: Root mean square reprojection error over the corners of all used views, px.
        view_rms_px: Root mean square reprojection error of each used view, px.
        focal_sigma_px: Standard deviations of the two focal lengths, px.
        kept: Indices of the used views.
    """

    model: str
    matrix: FloatArray
    distortion: FloatArray
    rms_px: float
    view_rms_px: tuple[float, ...]
    focal_sigma_px: tuple[float, float]
    kept: tuple[int, ...] = ()

    @property
    def params(self) -> list[float]:
        """Parameters of the camera model in COLMAP's order, with COLMAP's pixel origin."""
        fx, fy = self.matrix[0, 0], self.matrix[1, 1]
        centre = self.matrix[:2, 2] + 0.5
        return [float(value) for value in (fx, fy, *centre, *self.distortion)]


def fit_intrinsics(model: str, views: Sequence[BoardCorners], size: ImageSize) -> IntrinsicsFit | None:
    """Fit intrinsics to views, remove outlier views, and fit again.

    Args:
        model: COLMAP's name of the camera model: PINHOLE, OPENCV or OPENCV_FISHEYE.
        views: Corners of the board in each view.
        size: Width and height of the pictures, px.

    Returns:
        The fit, or None if the model cannot be fitted to these views.

    Source: Z. Zhang, "A flexible new technique for camera calibration", PAMI 2000. The fisheye model is from
        Kannala, Brandt, "A generic camera model and calibration method", PAMI 2006. OpenCV implements both.
    """
    kept = list(range(len(views)))
    fit = None
    for _ in range(3):
        chosen = [views[index] for index in kept]
        fit = _fit_fisheye(chosen, size) if model == "OPENCV_FISHEYE" else _fit_pinhole(model, chosen, size)
        if fit is None:
            return None
        errors = np.array(fit.view_rms_px)
        limit = max(
            _MAX_VIEW_ERROR_RATIO * float(np.median(errors)), _MIN_OUTLIER_ERROR_PX * max(size) / 640.0
        )
        good = [index for index, error in zip(kept, errors, strict=True) if error <= limit]
        fit = replace(fit, kept=tuple(kept))
        if len(good) == len(kept) or len(good) < _MIN_FIT_VIEWS:
            return fit
        kept = good
    return fit


def _fit_pinhole(model: str, views: Sequence[BoardCorners], size: ImageSize) -> IntrinsicsFit | None:
    flags = cv2.CALIB_FIX_K3
    if model == "PINHOLE":
        flags |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_ZERO_TANGENT_DIST
    on_board = [view.board_m.astype(np.float32) for view in views]
    px = [view.px.astype(np.float32) for view in views]
    try:
        rms, matrix, distortion, _, _, sigmas, _, view_errors = cv2.calibrateCameraExtended(
            on_board, px, size, None, None, flags=flags
        )
    except cv2.error:
        return None
    if not _is_plausible(matrix, size):
        return None
    count = 0 if model == "PINHOLE" else 4
    deviation = np.asarray(sigmas).ravel()
    return IntrinsicsFit(
        model=model,
        matrix=np.asarray(matrix, dtype=np.float64),
        distortion=np.asarray(distortion, dtype=np.float64).ravel()[:count],
        rms_px=float(rms),
        view_rms_px=tuple(float(value) for value in np.asarray(view_errors).ravel()),
        focal_sigma_px=(float(deviation[0]), float(deviation[1])),
    )


def _fit_fisheye(views: Sequence[BoardCorners], size: ImageSize) -> IntrinsicsFit | None:
    """Fit the fisheye model from several initial focal lengths and return the best fit.

    OpenCV's own initial focal length is not used, because it assumes a field of view of 180 degrees along the
    long side.
    """
    fits = [_fit_fisheye_from(start * max(size), views, size) for start in _FISHEYE_INITIAL_FOCALS]
    found = [fit for fit in fits if fit is not None]
    return min(found, key=lambda fit: fit.rms_px) if found else None


def _fit_fisheye_from(
    focal_px: float, views: Sequence[BoardCorners], size: ImageSize
) -> IntrinsicsFit | None:
    matrix = np.array([[focal_px, 0, 0.5 * size[0] - 0.5], [0, focal_px, 0.5 * size[1] - 0.5], [0, 0, 1]])
    flags = cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW | cv2.CALIB_USE_INTRINSIC_GUESS
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-9)
    try:
        _, matrix, distortion, rotations, translations = cv2.fisheye.calibrate(
            [view.board_m[None] for view in views],  # OpenCV's fisheye functions need (1,N,3) and (1,N,2)
            [view.px[None] for view in views],
            size,
            matrix,
            np.zeros(4),
            flags=flags,
            criteria=criteria,
        )
    except cv2.error:
        return None
    if not _is_plausible(matrix, size) or not np.isfinite(distortion).all():
        return None
    return _fisheye_fit_with_errors(
        views, matrix, distortion, list(zip(rotations, translations, strict=True))
    )


def _fisheye_fit_with_errors(
    views: Sequence[BoardCorners],
    matrix: FloatArray,
    distortion: FloatArray,
    poses: Sequence[tuple[Any, Any]],
) -> IntrinsicsFit:
    """Return a fisheye fit with its reprojection errors and the standard deviations of its focal lengths.

    The standard deviations come from the normal equations after the poses of the board are eliminated.

    Source: Triggs et al., "Bundle adjustment: a modern synthesis", 1999 (the Schur complement).
    """
    errors, reduced, total, count = [], np.zeros((8, 8)), 0.0, 0
    for view, (rotation, translation) in zip(views, poses, strict=True):
        projected, jacobian = cv2.fisheye.projectPoints(
            view.board_m[None], rotation, translation, matrix, distortion
        )
        difference = projected.reshape(-1, 2) - view.px
        errors.append(float(np.sqrt((difference**2).sum(axis=1).mean())))
        total, count = total + float((difference**2).sum()), count + len(difference)
        lens, pose = jacobian[:, :8], jacobian[:, 8:14]
        mixed = pose.T @ lens
        reduced += lens.T @ lens - mixed.T @ np.linalg.pinv(pose.T @ pose) @ mixed
    freedom = max(1, 2 * count - 8 - 6 * len(views))
    covariance = np.linalg.pinv(reduced) * total / freedom
    return IntrinsicsFit(
        model="OPENCV_FISHEYE",
        matrix=np.asarray(matrix, dtype=np.float64),
        distortion=np.asarray(distortion, dtype=np.float64).ravel(),
        rms_px=float(np.sqrt(total / max(count, 1))),
        view_rms_px=tuple(errors),
        focal_sigma_px=(float(np.sqrt(covariance[0, 0])), float(np.sqrt(covariance[1, 1]))),
    )


def _is_plausible(matrix: Any, size: ImageSize) -> bool:
    """Return whether the field of view, the ratio of focal lengths and the principal point are plausible."""
    focal = np.array([matrix[0, 0], matrix[1, 1]])
    centre = np.array([matrix[0, 2], matrix[1, 2]]) / np.array(size)
    sane = np.isfinite(matrix).all() and (focal > 0.1 * max(size)).all() and (focal < 12 * max(size)).all()
    return bool(
        sane and abs(focal[0] / focal[1] - 1) < 0.2 and (centre > 0.15).all() and (centre < 0.85).all()
    )
