"""The relative poses that the benchmark of the mappers gives to the global mapper."""

from __future__ import annotations

import numpy as np

from bodycap_batch.model.geometry import rotation_angle_rad, so3_exp
from tests.bench.mappers import sampson, unambiguous_pose

FOCAL_PX = 500.0
TURN, SHIFT = so3_exp([0.02, 0.15, 0.01]), np.array([0.8, 0.1, 0.2])


def _matches(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit directions (N,3) of points in both cameras, with noise of 0.3 px."""
    rng = np.random.default_rng(0)
    out = []
    for in_cam in (points, points @ TURN.T + SHIFT):
        rays = in_cam / in_cam[:, 2:]
        rays[:, :2] += rng.normal(scale=0.3 / FOCAL_PX, size=(len(rays), 2))
        out.append(rays / np.linalg.norm(rays, axis=1, keepdims=True))
    return out[0], out[1]


def test_points_at_many_depths_have_one_relative_pose() -> None:
    points = np.random.default_rng(1).uniform([-2.0, -1.5, 2.0], [2.0, 1.5, 8.0], (150, 3))
    first, second = _matches(points)
    pose = unambiguous_pose(first, second, FOCAL_PX)
    assert pose is not None
    assert np.degrees(rotation_angle_rad(pose[:, :3].T @ TURN)) < 0.5
    assert pose[:, 3] @ SHIFT / np.linalg.norm(SHIFT) > 0.999
    assert FOCAL_PX * np.median(np.abs(sampson(pose, first, second))) < 0.5


def test_a_plane_and_few_matches_give_no_pose() -> None:
    """The homography of a plane that is seen from the front has two relative poses."""
    points = np.random.default_rng(2).uniform([-1.0, -0.8, 4.0], [1.0, 0.8, 4.0], (150, 3))
    first, second = _matches(points)
    assert unambiguous_pose(first, second, FOCAL_PX) is None
    assert unambiguous_pose(first[:19], second[:19], FOCAL_PX) is None
