"""Where two cameras on one bone sit relative to each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.model.geometry import make_transform, rotation_angle_rad, so3_exp
from bodycap_batch.model.relative_pose import estimate_relative_pose, mean_rotation
from bodycap_batch.model.scene import FrameStatus, Trajectory

COUNT = 61
FRAME_NS = 33_333_333
BLIND = range(24, 37)
FIRST_FROM_SECOND = make_transform(so3_exp([0.1, np.radians(50.0), -0.05]), [0.12, 0.02, -0.05])


def _path() -> np.ndarray:
    """map_from_cam (F,4,4) of a body that walks, turns and sways."""
    t = np.arange(COUNT) / 30.0
    turns = so3_exp(np.stack([0.1 * np.sin(4 * t), 0.5 * t, 0.1 * np.cos(5 * t)], axis=1))
    return make_transform(turns, np.stack([0.5 * t, 0.05 * np.sin(6 * t), 0.3 * t], axis=1))


def _paths() -> dict[str, np.ndarray]:
    return {"torso": _path(), "torso_2": _path() @ FIRST_FROM_SECOND}


def _trajectories() -> tuple[Trajectory, Trajectory]:
    """Poses of two cameras, a little off; the first one has none in `BLIND`."""
    first, second = (_trajectory(name, path) for name, path in _paths().items())
    return first, second


def _trajectory(name: str, path: np.ndarray) -> Trajectory:
    rng = np.random.default_rng(3)
    lost = np.array([name == "torso" and frame in BLIND for frame in range(COUNT)])
    noisy = path @ make_transform(so3_exp(rng.normal(0, 1e-3, (COUNT, 3))), rng.normal(0, 4e-3, (COUNT, 3)))
    return Trajectory(
        camera=name,
        gauge="map-0",
        frame_numbers=np.arange(COUNT),
        times_ns=np.arange(COUNT) * FRAME_NS,
        gauge_from_cam=np.where(lost[:, None, None], np.nan, noisy),
        covariance=np.where(lost[:, None, None], np.nan, 1e-5 * np.eye(6)),
        status=tuple(FrameStatus.FEW_TRACKS if each else FrameStatus.REGISTERED for each in lost),
        inliers=np.zeros(COUNT, np.int64),
        error_px=np.zeros(COUNT),
    )


def test_the_mean_relative_pose_is_robust_and_reports_its_spread() -> None:
    first, second = _trajectories()
    poses = second.gauge_from_cam.copy()
    poses[::4, :3, 3] += 1.0
    poses[::4, :3, :3] = poses[::4, :3, :3] @ so3_exp([0.0, 0.5, 0.0])
    path = replace(second, gauge_from_cam=poses)
    found = estimate_relative_pose(first, path, 0)
    assert found.instants == COUNT - len(BLIND)
    off = found.first_from_second[:3, :3].T @ FIRST_FROM_SECOND[:3, :3]
    assert rotation_angle_rad(off) < 2e-3
    np.testing.assert_allclose(found.first_from_second[:3, 3], FIRST_FROM_SECOND[:3, 3], atol=0.006)
    # Both poses' 1 mrad and 4 mm an axis: medians of three axes √2 · 1.54 times that.
    assert 1e-3 < found.spread_rad < 5e-3
    assert 4e-3 < found.spread < 2e-2
    # Covariances of 1e-5 rad² an axis are stated for both.
    np.testing.assert_allclose(found.explained_rad, 1.538 * np.sqrt(2e-5), rtol=1e-9)


def test_in_another_map_no_instant_tells() -> None:
    first, second = _trajectories()
    found = estimate_relative_pose(first, replace(second, gauge="map-1"), 0)
    assert found.instants == 0
    assert np.isnan(found.spread)


def test_the_mean_rotation_of_equal_ones_is_theirs() -> None:
    turn = so3_exp([0.3, -2.0, 1.0])
    np.testing.assert_allclose(mean_rotation(np.tile(turn, (5, 1, 1))), turn, atol=1e-9)
