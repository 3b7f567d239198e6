"""How far a model's keypoints lie from where its points are projected."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.mapping.reconstruction.conversion import camera_from_pycolmap
from bodycap_batch.model.geometry import make_transform

if TYPE_CHECKING:
    import pycolmap

_NO_PROJECTION_PX = 1e3


def image_residuals_px(model: pycolmap.Reconstruction, image: Any, feature: IntArray) -> FloatArray:
    """Observed minus projected (N,2), px, of an image's features that see a point; far where it cannot."""
    pose = np.asarray(image.cam_from_world().matrix())
    cam_from_map = make_transform(pose[:, :3], pose[:, 3])
    points = image.points2D
    seen = [points[index] for index in feature.tolist()]
    x_in_map = np.array([model.point3D(point.point3D_id).xyz for point in seen]).reshape(-1, 3)
    observed = np.array([point.xy for point in seen]).reshape(-1, 2)
    projected = camera_from_pycolmap(image.camera).project(
        x_in_map @ cam_from_map[:3, :3].T + cam_from_map[:3, 3]
    )
    return np.nan_to_num(observed - projected, nan=_NO_PROJECTION_PX)


def median_residual_px(model: pycolmap.Reconstruction) -> float:
    """Median of all observations' absolute residuals along an axis; 0 without observations."""
    parts = [np.zeros((0, 2))]
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        feature = np.array(image.get_observation_point2D_idxs(), dtype=np.int64)
        parts.append(image_residuals_px(model, image, feature))
    every = np.concatenate(parts)
    return float(np.median(np.abs(every))) if len(every) else 0.0
