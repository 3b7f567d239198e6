"""A calibrated camera. Pixels follow COLMAP: the centre of the first pixel is (0.5, 0.5)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from bodycap_batch.core.arrays import FloatArray, set_array

if TYPE_CHECKING:
    import pycolmap

CV2_PIXEL_OFFSET_PX = 0.5
"""COLMAP pixel = OpenCV pixel + this."""

_FOCAL_INDICES = {
    "SIMPLE_PINHOLE": (0,),
    "PINHOLE": (0, 1),
    "SIMPLE_RADIAL": (0,),
    "RADIAL": (0,),
    "OPENCV": (0, 1),
    "FULL_OPENCV": (0, 1),
    "OPENCV_FISHEYE": (0, 1),
    "SIMPLE_RADIAL_FISHEYE": (0,),
    "RADIAL_FISHEYE": (0,),
    "THIN_PRISM_FISHEYE": (0, 1),
    "FOV": (0, 1),
}
_PARAM_COUNT = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "FULL_OPENCV": 12,
    "OPENCV_FISHEYE": 8,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "THIN_PRISM_FISHEYE": 12,
    "FOV": 5,
}
CAMERA_MODELS = tuple(_PARAM_COUNT)


def parameter_count(model: str) -> int:
    """Number of parameters of a COLMAP camera model (KeyError if unknown)."""
    return _PARAM_COUNT[model]


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """Intrinsics of one lens at one image size.

    Attributes:
        model: COLMAP camera model name.
        width_px: Image width.
        height_px: Image height.
        params: The model's parameters in COLMAP's order, pixels and COLMAP's pixel origin.
        refine: True where the parameters are a guess that mapping may refine.
        sideways: True where the sensor's rows run along the picture's columns, as where a phone was held
            upright; a rolling shutter alone asks.
    """

    model: str
    width_px: int
    height_px: int
    params: FloatArray
    refine: bool = False
    sideways: bool = False

    def __post_init__(self) -> None:
        if self.model not in _PARAM_COUNT:
            raise ValueError(f"unknown camera model {self.model!r}; known: {', '.join(CAMERA_MODELS)}")
        set_array(self, "params", (_PARAM_COUNT[self.model],))
        if self.width_px <= 0 or self.height_px <= 0 or self.focal_px <= 0:
            raise ValueError("image size and focal length must be positive")

    @property
    def focal_px(self) -> float:
        """Mean focal length."""
        return float(np.mean([self.params[i] for i in _FOCAL_INDICES[self.model]]))

    @property
    def principal_point_px(self) -> tuple[float, float]:
        """Principal point (cx, cy)."""
        first = len(_FOCAL_INDICES[self.model])
        return float(self.params[first]), float(self.params[first + 1])

    def to_pycolmap(self) -> pycolmap.Camera:
        """Build the same camera for pycolmap."""
        import pycolmap

        return pycolmap.Camera(
            model=self.model, width=self.width_px, height=self.height_px, params=self.params.tolist()
        )

    def project(self, x_in_cam: FloatArray) -> FloatArray:
        """Project points (N,3) in the camera frame to pixels (N,2); NaN behind the camera."""
        points = np.asarray(x_in_cam, dtype=np.float64).reshape(-1, 3)
        out = np.full((len(points), 2), np.nan)
        front = points[:, 2] > 1e-9
        if front.any():
            out[front] = self.to_pycolmap().img_from_cam(points[front])
        return out

    def unproject(self, px: FloatArray) -> FloatArray:
        """Undistort pixels (N,2) to rays (N,2) at depth 1; NaN where the model has no inverse."""
        pixels = np.ascontiguousarray(px, dtype=np.float64).reshape(-1, 2)
        if len(pixels) == 0:
            return np.zeros((0, 2))
        return np.asarray(self.to_pycolmap().cam_from_img(pixels))

    def scaled(self, width_px: int, height_px: int) -> Camera:
        """The same lens at another image size (COLMAP's pixel origin scales exactly)."""
        scale_x, scale_y = width_px / self.width_px, height_px / self.height_px
        params = self.params.copy()
        focal = _FOCAL_INDICES[self.model]
        if len(focal) == 1:
            params[0] *= 0.5 * (scale_x + scale_y)
        else:
            params[0] *= scale_x
            params[1] *= scale_y
        params[len(focal)] *= scale_x
        params[len(focal) + 1] *= scale_y
        return replace(self, width_px=width_px, height_px=height_px, params=params)


_TWO_FOCAL_MODEL = {
    "SIMPLE_PINHOLE": ("PINHOLE", 0),
    "SIMPLE_RADIAL": ("OPENCV", 1),
    "RADIAL": ("OPENCV", 2),
    "SIMPLE_RADIAL_FISHEYE": ("OPENCV_FISHEYE", 1),
    "RADIAL_FISHEYE": ("OPENCV_FISHEYE", 2),
}


def with_two_focal_lengths(camera: Camera) -> Camera:
    """The same lens with a focal length per axis, so that both axes can scale on their own."""
    if camera.model not in _TWO_FOCAL_MODEL:
        return camera
    model, radial = _TWO_FOCAL_MODEL[camera.model]
    focal, cx, cy, *distortion = camera.params
    params = np.zeros(_PARAM_COUNT[model])
    params[:4] = focal, focal, cx, cy
    params[4 : 4 + radial] = distortion[:radial]
    return replace(camera, model=model, params=params)
