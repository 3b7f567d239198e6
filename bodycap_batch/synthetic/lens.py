"""The viewing rays of the pixels of a lens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.model.camera import Camera


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


def ray_grid(camera: Camera, margin_px: int = 0) -> RayGrid:
    """Return the viewing rays through the centres of all pixels.

    In COLMAP's pixel coordinates, the centre of the first pixel is (0.5, 0.5).

    Args:
        camera: The camera.
        margin_px: Width (px) of an additional border around the image.
    """
    # An additional ring of pixels around the image allows central differences at all pixels.
    x, y = np.meshgrid(
        *(
            np.arange(-1 - margin_px, side + margin_px + 1) + 0.5
            for side in (camera.width_px, camera.height_px)
        ),
        indexing="xy",
    )
    rays = camera.to_pycolmap().cam_ray_from_img(np.stack([x, y], axis=-1).reshape(-1, 2))
    valid = np.isfinite(rays).all(axis=1)
    direction = np.where(valid[:, None], rays, [0.0, 0.0, 1.0]).reshape(*x.shape, 3)
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
