"""Compute the reprojection residuals of a model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.mapping.reconstruction.conversion import camera_from_pycolmap
from bodycap_batch.model.geometry import make_transform

if TYPE_CHECKING:
    import pycolmap

_NO_PROJECTION_PX = 1e3
"""Residual (px) that is used if a point has no projection. It is as large as the residual of a point that is
projected far outside the image."""


def image_residuals_px(model: pycolmap.Reconstruction, image: Any, feature: IntArray) -> FloatArray:
    """Return the residuals (N,2) of some features of an image: observed minus projected position, px.

    Args:
        model: The reconstruction.
        image: A registered image of the reconstruction.
        feature: (N,) indices of features of the image that observe a point of the reconstruction.
    """
    pose = np.asarray(image.cam_from_world().matrix())
    cam_from_map = make_transform(pose[:, :3], pose[:, 3])
    points = image.points2D
    observations = [points[index] for index in feature.tolist()]
    x_in_map = np.array([model.point3D(point.point3D_id).xyz for point in observations]).reshape(-1, 3)
    observed = np.array([point.xy for point in observations]).reshape(-1, 2)
    camera = camera_from_pycolmap(image.camera)
    projected = camera.project(x_in_map @ cam_from_map[:3, :3].T + cam_from_map[:3, 3])
    return np.nan_to_num(observed - projected, nan=_NO_PROJECTION_PX)


def median_residual_px(model: pycolmap.Reconstruction) -> float:
    """Return the median absolute value of the x and y residuals (px) of all observations.

    The result is 0 for a model without observations.
    """
    parts = [np.zeros((0, 2))]
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        feature = np.array(image.get_observation_point2D_idxs(), dtype=np.int64)
        parts.append(image_residuals_px(model, image, feature))
    residuals = np.concatenate(parts)
    return float(np.median(np.abs(residuals))) if len(residuals) else 0.0
