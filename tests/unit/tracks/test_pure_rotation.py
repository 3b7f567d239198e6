"""The rotations of a camera that hardly moves, from tracks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import nearest_rotation, rotation_angle_rad, so3_exp
from bodycap_batch.model.point_tracks import PointTracks
from bodycap_batch.model.scene import FrameStatus, Map, Trajectory
from bodycap_batch.tracks import measure_pure_rotation, pure_rotation, rotations_alone
from tests.scenes import small_map
from tests.unit.tracks.simulated import project, tracks_of_views

FRAMES, FPS = 30, 20
LENS = Camera(model="PINHOLE", width_px=640, height_px=480, params=np.array([420.0, 420.0, 320.0, 240.0]))
TIME_S = np.arange(FRAMES) / FPS
TRUE = so3_exp(np.stack([0.08 * np.sin(3 * TIME_S), 0.15 * np.sin(2 * TIME_S), 0.03 * TIME_S], axis=1))
HAND = 80
"""Number of points on the hand, which are the first tracks."""


def tracks(moved_m: float, hand_m: float = 0.0, seed: int = 4) -> PointTracks:
    """Return tracks of a room 1 to 3 m away, and of a hand before the camera, 0.4 m wide.

    Args:
        moved_m: How far the camera moves.
        hand_m: How far the hand moves.
        seed: Seed of the points and of the noise.
    """
    rng = np.random.default_rng(seed)
    room = rng.uniform((-4, -3, 1.0), (4, 3, 3), (600, 3))
    hand = rng.uniform((-0.2, -0.2, 0.55), (0.2, 0.2, 0.65), (HAND, 3))
    views = []
    for time, rotation in zip(TIME_S, TRUE, strict=True):
        centre = moved_m * np.array([np.sin(2.5 * time), np.sin(4 * time), np.cos(3 * time)])
        swung = hand + hand_m * np.array([np.sin(5 * time), np.cos(4 * time), 0.0])
        views.append(project(LENS, (np.concatenate([swung, room]) - centre) @ rotation))
    return tracks_of_views(LENS, views, rng)


def errors_deg(found: FloatArray) -> FloatArray:
    """Return the angles (N,) to the true rotations, after the best common turn."""
    common = nearest_rotation(np.sum(TRUE @ np.swapaxes(found, 1, 2), axis=0))
    return np.degrees(rotation_angle_rad(np.swapaxes(common @ found, 1, 2) @ TRUE))


@pytest.mark.parametrize("hand_m", [0.0, 0.15])
def test_the_rotations_of_a_camera_that_only_turns_are_exact(hand_m: float) -> None:
    found = measure_pure_rotation(tracks(0.0, hand_m), LENS)
    assert found is not None
    assert found.measured.all()
    errors = errors_deg(found.first_from_cam)
    assert errors.max() < (0.1 if hand_m else 0.05)
    assert (errors < 2.8 * np.degrees(found.sigma_rad)).all()


@pytest.mark.parametrize("seed", range(4))
def test_a_small_motion_is_part_of_the_sigma(seed: int) -> None:
    found = measure_pure_rotation(tracks(0.01, 0.15, seed), LENS)
    assert found is not None
    errors = errors_deg(found.first_from_cam)
    assert 0.1 < errors.max() < 0.6  # 1 cm in 1 m is 0.6 degrees
    # The region of 95 % of three axes is 2.8 sigma.
    assert (errors < 2.8 * np.degrees(found.sigma_rad)).mean() > 0.85
    assert np.degrees(found.sigma_rad).max() < 1.0


def test_a_camera_that_moves_has_no_pure_rotation() -> None:
    assert measure_pure_rotation(tracks(0.5), LENS) is None


def test_an_uncertain_lens_makes_the_angles_uncertain() -> None:
    exact, uncertain = (measure_pure_rotation(tracks(0.0), LENS, sigma) for sigma in (0.0, 0.2))
    assert exact is not None
    assert uncertain is not None
    assert uncertain.sigma_rad.max() > 1.5 * exact.sigma_rad.max()
    assert measure_pure_rotation(tracks(0.0), LENS, 5.0) is None


def test_frames_without_points_have_no_rotation() -> None:
    seen = tracks(0.0)
    dark = seen.outside((np.arange(FRAMES) == 7)[:, None, None])
    found = measure_pure_rotation(dark, LENS)
    assert found is not None
    assert np.flatnonzero(~found.measured).tolist() == [7]
    assert measure_pure_rotation(seen.outside(np.ones((1, 1), dtype=bool)), LENS) is None


def path_of(scene: Map, status: Sequence[FrameStatus]) -> Trajectory:
    """Return a path without poses of the camera of a map's first keyframe."""
    return Trajectory(
        camera=scene.keyframe_camera[0],
        gauge=scene.gauge,
        frame_numbers=np.arange(FRAMES),
        times_ns=(TIME_S * 1e9).astype(np.int64),
        gauge_from_cam=np.full((FRAMES, 4, 4), np.nan),
        covariance=np.full((FRAMES, 6, 6), np.nan),
        status=tuple(status),
        inliers=np.zeros(FRAMES, dtype=np.int64),
        error_px=np.full(FRAMES, np.nan),
    )


def test_a_path_of_rotations_alone_has_the_axes_of_its_map() -> None:
    found = measure_pure_rotation(tracks(0.0), LENS)
    assert found is not None
    scene = small_map()
    path = path_of(scene, [FrameStatus.FEW_TRACKS] * FRAMES)
    own = scene.keyframes_of(path.camera)
    turned = rotations_alone(path, found, scene)
    assert set(turned.status) == {FrameStatus.ROTATION_ONLY}
    assert not turned.localised.any()
    assert np.isnan(turned.gauge_from_cam[:, :3, 3]).all()
    assert np.allclose(turned.poses_at_origin()[:, :3, 3], 0.0)
    assert np.allclose(turned.covariance[:, :3, :3], found.sigma_rad[:, None, None] ** 2 * np.eye(3))
    assert np.isnan(turned.covariance[:, 3:, 3:]).all()
    # Of all common turns, the path has the one that is nearest to the keyframes of the map.
    frames, rotations = scene.keyframe_frame[own], scene.map_from_cam[own, :3, :3]
    mean = nearest_rotation(np.sum(rotations @ np.swapaxes(found.first_from_cam[frames], 1, 2), axis=0))
    assert np.allclose(turned.gauge_from_cam[:, :3, :3], mean @ found.first_from_cam)
    # Between its frames, the turn is the measured one.
    between = np.swapaxes(turned.gauge_from_cam[:-1, :3, :3], 1, 2) @ turned.gauge_from_cam[1:, :3, :3]
    expected = np.swapaxes(found.first_from_cam[:-1], 1, 2) @ found.first_from_cam[1:]
    assert np.allclose(between, expected)


def test_a_picture_that_is_not_of_its_time_gives_no_rotation() -> None:
    turn = measure_pure_rotation(tracks(0.0).outside((np.arange(FRAMES) == 9)[:, None, None]), LENS)
    assert turn is not None
    status = [FrameStatus.FEW_TRACKS] * FRAMES
    status[3], status[5], status[9] = FrameStatus.DAMAGED, FrameStatus.FROZEN, FrameStatus.OTHER_MAP
    turned = rotations_alone(path_of(small_map(), status), turn, small_map())
    assert (turned.status[3], turned.status[5]) == (FrameStatus.DAMAGED, FrameStatus.FROZEN)
    # The pose in a further map is withdrawn with the others of the camera.
    assert turned.status[9] is FrameStatus.UNCONSTRAINED
    assert turned.rotation_only.sum() == FRAMES - 3
    assert np.isnan(turned.gauge_from_cam[~turned.rotation_only]).all()


def test_a_part_of_many_tracks_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = tracks(0.0)
    monkeypatch.setattr(pure_rotation, "_MAX_OBSERVATIONS", len(seen.track) // 3)
    found = measure_pure_rotation(seen, LENS)
    assert found is not None
    assert found.measured.all()
    assert 0.0 < errors_deg(found.first_from_cam).max() < 0.1


def test_a_path_that_claims_a_rotation_must_have_one() -> None:
    with pytest.raises(ValueError, match="rotation"):
        Trajectory(
            camera="head",
            gauge="map-0",
            frame_numbers=np.arange(1),
            times_ns=np.arange(1),
            gauge_from_cam=np.full((1, 4, 4), np.nan),
            covariance=np.full((1, 6, 6), np.nan),
            status=(FrameStatus.ROTATION_ONLY,),
            inliers=np.zeros(1, dtype=np.int64),
            error_px=np.full(1, np.nan),
        )
