"""Viewing rays of a lens, computed by inverting the lens distortion at every pixel.

This module follows the published formulas of the camera models. Only the renderer uses it. The estimators
project points with another implementation, so tests can detect an error in either implementation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.model.camera import Camera

_NEWTON_STEPS = 30
"""Maximum number of Newton steps of an inversion."""
_DERIVATIVE_STEP = 1e-6
"""Step of the central differences that give numerical derivatives, as a length in the image plane at depth 1.
"""
_CONVERGED = 1e-9
"""Maximum error of an inversion that is treated as converged, as a length in the image plane at depth 1."""
_BRANCH_SAMPLES = 8
"""Number of test points on the line from the image centre to a solution of the inversion. A solution is valid
only if the Jacobian of the distortion has a positive determinant at all test points."""
_BLOCK = 1 << 13
"""Number of points that are inverted together. A block of this size fits into the processor's cache."""
SINGLE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
"""Names of the camera models with one focal length for both axes."""

Distortion = Callable[[FloatArray], FloatArray]
"""Function that maps points (...,2) of the ideal image plane to the distorted image plane, both at depth 1.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class RayGrid:
    """The viewing rays of all pixels of a lens.

    Attributes:
        in_cam: (H,W,3) unit directions in the camera frame (x right, y down, z forward).
        per_px_x: (H,W,3) change of the direction for a step of one pixel to the right.
        per_px_y: (H,W,3) change of the direction for a step of one pixel down.
        valid: (H,W) True for a pixel with a viewing ray. At the other pixels the distortion has no inverse.
        planes: (9,H,W) components of `in_cam`, `per_px_x` and `per_px_y` as float32, for the renderer.
    """

    in_cam: FloatArray
    per_px_x: FloatArray
    per_px_y: FloatArray
    valid: BoolArray
    planes: npt.NDArray[np.float32]


def is_fisheye(model: str) -> bool:
    """Return True if a model distorts an equidistant image plane.

    In such a plane, the distance of a point from the centre is the angle between its ray and the optical
    axis.
    """
    return model.endswith("FISHEYE")


def _rational(plane: FloatArray, radial: FloatArray, p1: float, p2: float) -> FloatArray:
    """Return points (...,2) after distortion by Brown's model with a rational radial term.

    `radial` holds the coefficients k1 to k6.

    Sources: Brown, "Decentering distortion of lenses", 1966; OpenCV for the rational term.
    """
    x, y = plane[..., 0], plane[..., 1]
    r2 = x * x + y * y
    k1, k2, k3, k4, k5, k6 = radial
    gain = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return np.stack(
        [
            x * gain + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * gain + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def _thin_prism(plane: FloatArray, params: FloatArray) -> FloatArray:
    """Return points (...,2) of an equidistant plane after radial, tangential and thin-prism distortion.

    Source: Weng, Cohen, Herniou, "Camera calibration with distortion models", PAMI 1992.
    """
    k1, k2, p1, p2, k3, k4, sx1, sy1 = params
    u, v = plane[..., 0], plane[..., 1]
    r2 = u * u + v * v
    gain = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    return np.stack(
        [
            u * gain + 2 * p1 * u * v + p2 * (r2 + 2 * u * u) + sx1 * r2,
            v * gain + 2 * p2 * u * v + p1 * (r2 + 2 * v * v) + sy1 * r2,
        ],
        axis=-1,
    )


def _field_of_view(plane: FloatArray, omega_rad: float) -> FloatArray:
    """Return points (...,2) of a perspective plane after distortion by a wide-angle model with one parameter.

    Source: Devernay, Faugeras, "Straight lines have to be straight", MVA 2001.
    """
    radius = np.linalg.norm(plane, axis=-1, keepdims=True)
    slope = 2 * np.tan(omega_rad / 2)
    gain = np.where(
        radius > 1e-9, np.arctan(radius * slope) / np.maximum(radius, 1e-9) / omega_rad, slope / omega_rad
    )
    return np.asarray(plane * gain)


def _enhanced_unified(plane: FloatArray, alpha: float, beta: float) -> FloatArray:
    """Return points (...,2) of a perspective plane after projection onto an ellipsoid and from there.

    Source: Khomutenko, Garcia, Martinet, "An enhanced unified camera model", RA-L 2016.
    """
    squared = (plane * plane).sum(axis=-1, keepdims=True)
    return np.asarray(plane / (alpha * np.sqrt(beta * squared + 1.0) + 1.0 - alpha))


def distortion_of(camera: Camera) -> Distortion:
    """Return the distortion function of a camera."""
    extra = camera.params[(3 if camera.model in SINGLE_FOCAL else 4) :]
    if camera.model == "FOV":
        return lambda plane: _field_of_view(plane, float(extra[0]))
    if camera.model == "EUCM":
        return lambda plane: _enhanced_unified(plane, float(extra[0]), float(extra[1]))
    if camera.model == "THIN_PRISM_FISHEYE":
        return lambda plane: _thin_prism(plane, extra)
    radial, p1, p2 = np.zeros(6), 0.0, 0.0
    if camera.model in ("OPENCV", "FULL_OPENCV"):
        radial[:2], (p1, p2) = extra[:2], extra[2:4]
        radial[2 : 2 + len(extra) - 4] = extra[4:]
    elif camera.model == "OPENCV_FISHEYE":
        prism = np.concatenate([extra[:2], [0.0, 0.0], extra[2:], [0.0, 0.0]])
        return lambda plane: _thin_prism(plane, prism)
    else:
        radial[: len(extra)] = extra
    return lambda plane: _rational(plane, radial, p1, p2)


def focal_and_centre(camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Return the focal lengths (2,) and the principal point (2,) of a camera in pixels."""
    if camera.model in SINGLE_FOCAL:
        return np.repeat(camera.params[:1], 2), np.asarray(camera.params[1:3])
    return np.asarray(camera.params[:2]), np.asarray(camera.params[2:4])


def _jacobian(distort: Distortion, plane: FloatArray) -> FloatArray:
    """Return the derivative (N,2,2) of a distortion with respect to the points (N,2).

    It is computed by central differences.
    """
    columns = []
    for axis in range(2):
        step = np.zeros(2)
        step[axis] = _DERIVATIVE_STEP
        columns.append((distort(plane + step) - distort(plane - step)) / (2 * _DERIVATIVE_STEP))
    return np.stack(columns, axis=-1)


def undistort(distort: Distortion, distorted: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Invert a distortion for points (N,2) by Newton's method.

    Returns:
        The ideal points (N,2), and a mask (N,). The mask is True for a point with a valid inverse:
        the Jacobian of the distortion has a positive determinant on the line from the image centre to the
        ideal point.
    """
    found = [
        _undistort_block(distort, distorted[start : start + _BLOCK])
        for start in range(0, len(distorted), _BLOCK)
    ]
    if not found:
        return distorted.copy(), np.zeros(0, dtype=bool)
    planes, valid = zip(*found, strict=True)
    return np.concatenate(planes), np.concatenate(valid)


def _undistort_block(distort: Distortion, distorted: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Invert a distortion for a block of points (N,2). Return the same results as `undistort`."""
    plane = distorted.copy()
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON_STEPS):
            residual = distort(plane) - distorted
            if np.nanmax(np.abs(residual), initial=0.0) < 1e-14:
                break
            jacobian = _jacobian(distort, plane)
            det = _determinant(jacobian)
            det = np.where(np.abs(det) < 1e-12, 1e-12, det)
            step_x = (jacobian[:, 1, 1] * residual[:, 0] - jacobian[:, 0, 1] * residual[:, 1]) / det
            step_y = (jacobian[:, 0, 0] * residual[:, 1] - jacobian[:, 1, 0] * residual[:, 0]) / det
            step = np.stack([step_x, step_y], axis=-1)
            length = np.linalg.norm(step, axis=-1, keepdims=True)
            plane = plane - step * np.minimum(1.0, 0.5 / np.maximum(length, 1e-300))
        valid = np.abs(distort(plane) - distorted).max(axis=-1, initial=0.0) < _CONVERGED
        for fraction in np.linspace(1.0 / _BRANCH_SAMPLES, 1.0, _BRANCH_SAMPLES):
            valid &= _determinant(_jacobian(distort, plane * fraction)) > 0
    return plane, np.asarray(valid)


def _determinant(matrices: FloatArray) -> FloatArray:
    """Return the determinants (N,) of matrices (N,2,2)."""
    return np.asarray(matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0])


def project(camera: Camera, in_cam: FloatArray) -> FloatArray:
    """Return the pixel positions (N,2) of points (N,3) in the camera frame, with COLMAP's pixel origin."""
    focal, centre = focal_and_centre(camera)
    across = np.linalg.norm(in_cam[:, :2], axis=1, keepdims=True)
    if is_fisheye(camera.model):
        angle = np.arctan2(across, in_cam[:, 2:])
        plane = in_cam[:, :2] * (angle / np.maximum(across, 1e-12))
    else:
        plane = in_cam[:, :2] / np.maximum(in_cam[:, 2:], 1e-6)
    return np.asarray(distortion_of(camera)(plane) * focal + centre)


def ray_grid(camera: Camera, margin_px: int = 0) -> RayGrid:
    """Return the viewing rays through the centres of all pixels.

    In COLMAP's pixel coordinates, the centre of the first pixel is (0.5, 0.5).

    Args:
        camera: The camera.
        margin_px: Width (px) of an additional border around the image.
    """
    focal, centre = focal_and_centre(camera)
    # An additional ring of pixels around the image allows central differences at all pixels.
    x, y = np.meshgrid(
        *(
            np.arange(-1 - margin_px, side + margin_px + 1) + 0.5
            for side in (camera.width_px, camera.height_px)
        ),
        indexing="xy",
    )
    distorted = (np.stack([x, y], axis=-1) - centre) / focal
    plane, valid = undistort(distortion_of(camera), distorted.reshape(-1, 2))
    if is_fisheye(camera.model):
        angle = np.linalg.norm(plane, axis=-1, keepdims=True)
        valid &= angle[:, 0] < np.pi
        direction = np.concatenate([plane * np.sinc(angle / np.pi), np.cos(angle)], axis=-1)
    else:
        direction = np.concatenate([plane, np.ones((len(plane), 1))], axis=-1)
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    direction = np.where(valid[:, None], direction, [0.0, 0.0, 1.0]).reshape(*x.shape, 3)
    in_cam = direction[1:-1, 1:-1]
    per_px_x = (direction[1:-1, 2:] - direction[1:-1, :-2]) / 2
    per_px_y = (direction[2:, 1:-1] - direction[:-2, 1:-1]) / 2
    planes = np.concatenate([part.transpose(2, 0, 1) for part in (in_cam, per_px_x, per_px_y)])
    return RayGrid(
        in_cam=in_cam,
        per_px_x=per_px_x,
        per_px_y=per_px_y,
        valid=valid.reshape(x.shape)[1:-1, 1:-1],
        planes=np.ascontiguousarray(planes, dtype=np.float32),
    )
