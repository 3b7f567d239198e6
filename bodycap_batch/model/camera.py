"""The intrinsics of a camera: projection and inverse projection.

Pixel coordinates follow COLMAP: the centre of the first pixel is at (0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from bodycap_batch.core.arrays import FloatArray, set_array

if TYPE_CHECKING:
    import pycolmap

CV2_PIXEL_OFFSET_PX = 0.5
"""Offset, pixels, that is added to OpenCV's pixel coordinates to get COLMAP's pixel coordinates. In OpenCV,
the centre of the first pixel is at (0, 0)."""

_MODELS = {
    "SIMPLE_PINHOLE": (1, 3),
    "PINHOLE": (2, 4),
    "SIMPLE_RADIAL": (1, 4),
    "RADIAL": (1, 5),
    "OPENCV": (2, 8),
    "FULL_OPENCV": (2, 12),
    "OPENCV_FISHEYE": (2, 8),
    "SIMPLE_RADIAL_FISHEYE": (1, 4),
    "RADIAL_FISHEYE": (1, 5),
    "THIN_PRISM_FISHEYE": (2, 12),
    "FOV": (2, 5),
    "EUCM": (2, 6),
}
"""Numbers of focal lengths and of all parameters of each COLMAP camera model. The focal lengths come first,
then the principal point. Source: COLMAP, sensor/models.h."""

_MIN_DEPTH = 1e-9
"""Minimum depth, in the unit of the points, of a point that is projected to the image. Derivation: the limit
avoids a division by zero."""

CAMERA_MODELS = tuple(_MODELS)


def parameter_count(model: str) -> int:
    """Return the number of parameters of a COLMAP camera model.

    Raises:
        KeyError: The model is unknown.
    """
    return _MODELS[model][1]


def focal_count(model: str) -> int:
    """Return the number of focal lengths, 1 or 2, of a COLMAP camera model."""
    return _MODELS[model][0]


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """Intrinsics of one camera at one image size, for projecting points and for computing viewing rays.

    Attributes:
        model: Name of the COLMAP camera model.
        width_px: Image width.
        height_px: Image height.
        params: Parameters of the model in COLMAP's order. Lengths are in pixels with COLMAP's origin.
        refine: True if the parameters are only an initial guess that mapping may refine.
        sideways: True if the rows of the sensor are the columns of the image, as for a phone that was held
            upright. Only the rolling-shutter correction uses this value.
    """

    model: str
    width_px: int
    height_px: int
    params: FloatArray
    refine: bool = False
    sideways: bool = False

    def __post_init__(self) -> None:
        if self.model not in _MODELS:
            raise ValueError(f"unknown camera model {self.model!r}; known: {', '.join(CAMERA_MODELS)}")
        set_array(self, "params", (parameter_count(self.model),))
        if self.width_px <= 0 or self.height_px <= 0 or self.focal_px <= 0:
            raise ValueError("image size and focal length must be positive")

    @property
    def focal_px(self) -> float:
        """Focal length in pixels; the mean of the two axes if the model has two focal lengths."""
        return float(np.mean(self.params[: focal_count(self.model)]))

    @property
    def focal_ratio(self) -> float:
        """Ratio of the focal length along x to that along y; 1 if the model has one focal length."""
        return float(self.params[0] / self.params[focal_count(self.model) - 1])

    @property
    def principal_point_px(self) -> tuple[float, float]:
        """Principal point (cx, cy) in pixels."""
        first = focal_count(self.model)
        return float(self.params[first]), float(self.params[first + 1])

    def to_pycolmap(self) -> pycolmap.Camera:
        """Return the same intrinsics as a pycolmap camera."""
        import pycolmap

        return pycolmap.Camera(
            model=self.model, width=self.width_px, height=self.height_px, params=self.params.tolist()
        )

    def project(self, x_in_cam: FloatArray) -> FloatArray:
        """Project points from the camera frame to the image.

        Args:
            x_in_cam: (N,3) points in the camera frame.

        Returns:
            The pixels (N,2); NaN for a point behind the camera.
        """
        points = np.asarray(x_in_cam, dtype=np.float64).reshape(-1, 3)
        out = np.full((len(points), 2), np.nan)
        front = points[:, 2] > _MIN_DEPTH
        if front.any():
            out[front] = self.to_pycolmap().img_from_cam(points[front])
        return out

    def unproject(self, px: FloatArray) -> FloatArray:
        """Return the viewing rays of pixels.

        Args:
            px: (N,2) pixels.

        Returns:
            The undistorted image coordinates (N,2): the x and y of each ray at depth 1. NaN for a pixel for
            which the camera model has no inverse.
        """
        pixels = np.ascontiguousarray(px, dtype=np.float64).reshape(-1, 2)
        if len(pixels) == 0:
            return np.zeros((0, 2))
        return np.asarray(self.to_pycolmap().cam_from_img(pixels))

    def scaled(self, width_px: int, height_px: int) -> Camera:
        """Return the intrinsics of the same camera at another image size.

        Scaling is exact because COLMAP's pixel coordinates start at the corner of the image. There is one
        exception: if the scale factors of width and height differ, and the model has only one focal length,
        this focal length is multiplied by the mean of both factors.
        """
        scale_x, scale_y = width_px / self.width_px, height_px / self.height_px
        params = self.params.copy()
        count = focal_count(self.model)
        params[:count] *= 0.5 * (scale_x + scale_y) if count == 1 else (scale_x, scale_y)
        params[count : count + 2] *= scale_x, scale_y
        return replace(self, width_px=width_px, height_px=height_px, params=params)


_TWO_FOCAL_MODEL = {
    "SIMPLE_PINHOLE": ("PINHOLE", 0),
    "SIMPLE_RADIAL": ("OPENCV", 1),
    "RADIAL": ("OPENCV", 2),
    "SIMPLE_RADIAL_FISHEYE": ("OPENCV_FISHEYE", 1),
    "RADIAL_FISHEYE": ("OPENCV_FISHEYE", 2),
}
"""By name of a camera model with one focal length: the name of the corresponding model with two focal
lengths, and the number of distortion parameters. This number is the same in both models."""


def with_two_focal_lengths(camera: Camera) -> Camera:
    """Return the same intrinsics in a camera model that has a separate focal length for each axis.

    Only a camera with two focal lengths can be scaled exactly by different factors in width and height. If
    there is no corresponding model with two focal lengths, the camera is returned unchanged.
    """
    if camera.model not in _TWO_FOCAL_MODEL:
        return camera
    model, distortion_count = _TWO_FOCAL_MODEL[camera.model]
    focal, cx, cy, *distortion = camera.params
    params = np.zeros(parameter_count(model))
    params[:4] = focal, focal, cx, cy
    params[4 : 4 + distortion_count] = distortion[:distortion_count]
    return replace(camera, model=model, params=params)
