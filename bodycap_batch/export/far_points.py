"""Find the points of a map whose depth the pictures hardly determine, such as points behind a window."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.model.scene import Map

_MAX_DEPTH_SIGMA = 0.1
"""Maximum standard deviation of the depth of a certain point, relative to the median distance of all points
from their cameras. Evidence: docs/decisions/export.md."""


def is_far(scene: Map) -> BoolArray:
    """Return (P,) True for each far point: its depth is uncertain, and it is farther than all certain points.

    The standard deviation of a depth grows with the square of the distance. So points that are far from all
    cameras are uncertain, and points that were seen from nearly one place. The certain points are the room:
    it reaches from the median of all points to the farthest certain point. Uncertain points in it are kept.
    """
    sigma, distance = depth_sigma(scene)
    known = np.isfinite(distance)
    if not known.any():
        return np.zeros(len(scene.points), dtype=bool)
    certain = sigma <= _MAX_DEPTH_SIGMA * float(np.median(distance[known]))
    from_middle = np.linalg.norm(scene.points - np.median(scene.points, axis=0), axis=1)
    reach = float(from_middle[certain].max()) if certain.any() else np.inf
    return np.asarray(~certain & (from_middle > reach))


def depth_sigma(scene: Map) -> tuple[FloatArray, FloatArray]:
    """Return (P,) the standard deviation of each point along its most uncertain direction, and its distance.

    The rays of all observations determine the point. Each pixel has the reprojection error of the point, and
    at least that of the whole map. The distance is that to the nearest camera that observes the point. Both
    are in the unit of the map, and infinity for a point that the rays do not determine.
    """
    focal_px = np.array([scene.cameras[name].focal_px for name in scene.keyframe_camera])
    ray = scene.points[scene.obs_point] - scene.map_from_cam[scene.obs_keyframe, :3, 3]
    distance = np.maximum(np.linalg.norm(ray, axis=1), np.finfo(np.float64).tiny)
    ray /= distance[:, None]
    sigma_px = np.maximum(scene.point_error_px, max(scene.mean_error_px(), 1e-9))[scene.obs_point]
    weight = (focal_px[scene.obs_keyframe] / (sigma_px * distance)) ** 2
    information = np.zeros((len(scene.points), 3, 3))
    np.add.at(
        information,
        scene.obs_point,
        weight[:, None, None] * (np.eye(3) - ray[:, :, None] * ray[:, None, :]),
    )
    nearest = np.full(len(scene.points), np.inf)
    np.minimum.at(nearest, scene.obs_point, distance)
    least = np.maximum(np.linalg.eigvalsh(information)[:, 0], 0.0)
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / np.sqrt(least)), nearest
