"""All frames of a camera are solved; points on the wearer lose their weight."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert, make_transform, so3_exp
from bodycap_batch.model.scene import FrameStatus, Map
from bodycap_batch.registration.poses import observations, trajectory
from bodycap_batch.registration.poses.observations import PointReliability
from bodycap_batch.registration.poses.pnp import AcceptanceCriteria, FramePose
from bodycap_batch.registration.poses.trajectory import solve_camera
from bodycap_batch.registration.tracking.klt import Tracks

LENS = Camera(model="PINHOLE", width_px=640, height_px=480, params=np.array([420.0, 420.0, 320.0, 240.0]))
CRITERIA = AcceptanceCriteria(max_error_px=2.2, min_inliers=15, max_sigma_depth=0.05)
COUNT = 31
KEYFRAMES = [0, 30]


def _path() -> np.ndarray:
    """A camera that turns by half a degree and moves by 4 mm a frame."""
    return np.array(
        [
            make_transform(so3_exp([0.0, np.radians(0.5) * k, 0.0]), [0.004 * k, 0.0, 0.0])
            for k in range(COUNT)
        ]
    )


def _capture(worn: int, rng: np.random.Generator) -> tuple[Map, Tracks]:
    """60 points of a room at 3 to 5 m, and `worn` points on the wearer that move relative to it."""
    path = _path()
    rays = np.column_stack([rng.uniform(-0.5, 0.5, 60 + worn), rng.uniform(-0.4, 0.4, 60 + worn)])
    x_in_cam = np.column_stack([rays, np.ones(60 + worn)]) * rng.uniform(3.0, 5.0, (60 + worn, 1))
    points = x_in_cam @ path[15, :3, :3].T + path[15, :3, 3]

    def view(frame: int) -> np.ndarray:
        cam_from_map = invert(path[frame])
        px = LENS.project(points @ cam_from_map[:3, :3].T + cam_from_map[:3, 3])
        px[60:, 0] += 4.0 * np.sin(frame / 3.0)
        return px + rng.normal(0, 0.2, px.shape)

    number = len(points)
    scene_map = Map(
        gauge="map-0",
        cameras={"torso": LENS},
        keyframe_camera=("torso", "torso"),
        keyframe_frame=np.array(KEYFRAMES),
        map_from_cam=path[KEYFRAMES],
        points=points,
        colors=np.zeros((number, 3), np.uint8),
        point_error_px=np.zeros(number),
        obs_keyframe=np.repeat([0, 1], number),
        obs_point=np.tile(np.arange(number), 2),
        obs_feature=np.tile(np.arange(number), 2),
        obs_px=np.concatenate([view(frame) for frame in KEYFRAMES]),
    )
    inner = [frame for frame in range(COUNT) if frame not in KEYFRAMES]
    tracks = Tracks(
        frame=np.repeat(inner, number),
        keyframe=np.zeros(number * len(inner), np.int64),
        feature=np.tile(np.arange(number), len(inner)),
        px=np.concatenate([view(frame) for frame in inner]).astype(np.float32),
    )
    return scene_map, tracks


def _solve(scene_map: Map, tracks: Tracks) -> list[FramePose]:
    camera = cast(
        "CaptureCamera",
        SimpleNamespace(name="torso", times_ns=np.arange(COUNT) * 33_333_333, rotation_chain=None),
    )
    return solve_camera(camera, scene_map, tracks, CRITERIA)


def _error_m(poses: list[FramePose]) -> float:
    found = trajectory.pose_array(poses)
    return float(np.sqrt(((found[:, :3, 3] - _path()[:, :3, 3]) ** 2).sum(axis=1).mean()))


def test_keyframes_and_frames_between_them_are_solved() -> None:
    scene_map, tracks = _capture(0, np.random.default_rng(0))
    poses = _solve(scene_map, tracks)
    keyframe = [index for index, pose in enumerate(poses) if pose.status is FrameStatus.KEYFRAME]
    assert keyframe == KEYFRAMES
    assert all(pose.status.localised for pose in poses)
    # 60 points at 0.2 px, 420 px and 4 m: 4 m · 0.2/420/√60 ≈ 0.25 mm, some ten times that along the turn.
    assert 0.0002 < _error_m(poses) < 0.005


def test_points_that_move_with_the_wearer_do_not_pull_the_poses() -> None:
    scene_map, tracks = _capture(30, np.random.default_rng(1))
    poses = _solve(scene_map, tracks)
    assert all(pose.status.localised for pose in poses)
    # If it followed them, by up to 4 px at 4 m and 420 px, the camera would be off by 2.7 cm on average.
    assert _error_m(poses) < 0.005


def test_a_point_is_weighted_by_the_ratio_of_frames_that_agree() -> None:
    point = np.array([0, 1, 2] * 6)
    posed = np.repeat([True, True, True, True, True, False], 3)
    agrees = np.ones(18, dtype=bool)
    agrees[[1, 4, 7]] = False
    agrees[[2, 5, 8, 11, 14]] = False
    reliability = PointReliability.zero(3)
    reliability.add(point[:9], posed[:9], agrees[:9])
    # Three observations of a point are too few to lower its weight.
    np.testing.assert_array_equal(reliability.agreement(point), np.ones(18))
    reliability.add(point[9:], posed[9:], agrees[9:])
    np.testing.assert_allclose(reliability.agreement(point[:3]), [1.0, 0.4, 0.0])


def test_blocks_of_frames_give_the_same_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    scene_map, tracks = _capture(30, np.random.default_rng(1))
    whole = trajectory.pose_array(_solve(scene_map, tracks))
    monkeypatch.setattr(observations, "BLOCK_FRAMES", 7)
    np.testing.assert_allclose(trajectory.pose_array(_solve(scene_map, tracks)), whole, atol=1e-12)


def test_an_uncertain_readout_time_makes_the_poses_uncertain() -> None:
    scene_map, tracks = _capture(0, np.random.default_rng(3))
    exact = replace(scene_map, readout_s={"torso": 0.002})
    estimated = replace(exact, readout_sigma_s={"torso": 0.02})
    known, unknown = (
        np.array([pose.covariance for pose in _solve(each, tracks)]) for each in (exact, estimated)
    )
    # The frame turns by 0.26 rad/s; a readout that is 20 ms longer would turn the edges by 1.1 px.
    ratio = np.trace(unknown[:, :3, :3], axis1=1, axis2=2) / np.trace(known[:, :3, :3], axis1=1, axis2=2)
    assert (ratio > 1.01).all()
    assert np.median(ratio) > 1.05
