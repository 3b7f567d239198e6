"""Small exact maps for tests of the stages after mapping."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert, make_transform, transform_points
from bodycap_batch.model.scene import Map


def small_map(gauge: str = "map-0", *, seed: int = 11, points: int = 60, noise_px: float = 0.0) -> Map:
    """Return a map of two cameras with three and two keyframes and one cloud of points."""
    rng = np.random.default_rng(seed)
    lens = {
        "torso": Camera(
            model="SIMPLE_PINHOLE", width_px=640, height_px=480, params=np.array([500.0, 320, 240])
        ),
        "left_palm": Camera(
            model="PINHOLE", width_px=640, height_px=480, params=np.array([480.0, 490, 318, 242])
        ),
    }
    cloud = rng.uniform([-1, -1, 4], [1, 1, 6], size=(points, 3))
    names = ("torso", "torso", "torso", "left_palm", "left_palm")
    frames = np.array([8, 0, 4, 2, 6])
    turns = Rotation.from_rotvec(rng.normal(scale=0.05, size=(5, 3))).as_matrix()
    map_from_cam = make_transform(turns, rng.normal(scale=0.3, size=(5, 3)))
    keyframe, point, pixels = [], [], []
    for index, name in enumerate(names):
        seen = np.flatnonzero(rng.random(points) < 0.7)
        x_in_cam = transform_points(invert(map_from_cam[index]), cloud[seen])
        focal = lens[name].params[[0, 0]] if name == "torso" else lens[name].params[:2]
        pixels.append(x_in_cam[:, :2] / x_in_cam[:, 2:] * focal + lens[name].params[-2:])
        keyframe.append(np.full(len(seen), index))
        point.append(seen)
    exact = np.concatenate(pixels)
    return Map(
        gauge=gauge,
        cameras=lens,
        keyframe_camera=names,
        keyframe_frame=frames,
        map_from_cam=map_from_cam,
        points=cloud,
        colors=rng.integers(0, 256, size=(points, 3)).astype(np.uint8),
        point_error_px=np.full(points, noise_px),
        obs_keyframe=np.concatenate(keyframe),
        obs_point=np.concatenate(point),
        obs_feature=rng.permutation(len(exact)),
        obs_px=exact + rng.normal(scale=max(noise_px, 1e-300), size=exact.shape),
    )
