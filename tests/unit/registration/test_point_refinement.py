"""Weak poses next to lost intervals are removed, and points are refined from the remaining poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert, make_transform, so3_exp, transform_points
from bodycap_batch.model.rolling_shutter import px_at_mid_row
from bodycap_batch.model.scene import FrameStatus, Map, Trajectory
from bodycap_batch.registration.recovery import point_refinement
from bodycap_batch.registration.recovery.point_refinement import refine_points, remove_weak_boundary_poses

COUNT, LOST = 40, range(18, 24)
MIN_INLIERS = 15
LENS = Camera(model="PINHOLE", width_px=640, height_px=480, params=np.array([420.0, 420.0, 320.0, 240.0]))
NOISE_PX = 0.5
WRONG_M = 0.3


def _path(inliers: dict[int, int] | None = None, status: dict[int, FrameStatus] | None = None) -> Trajectory:
    """A camera that moves in front of a wall, with lost frames in the middle."""
    frames = np.arange(COUNT)
    centres = np.column_stack([0.05 * frames - 1.0, 0.4 * np.sin(frames / 5.0), 0.3 * np.cos(frames / 6.0)])
    poses = make_transform(so3_exp(np.outer(np.sin(frames / 4.0), [0.05, 0.1, 0.02])), centres)
    covariance = np.tile(np.eye(6) * 1e-6, (COUNT, 1, 1))
    known = [FrameStatus.FEW_TRACKS if frame in LOST else FrameStatus.REGISTERED for frame in range(COUNT)]
    for frame, value in (status or {}).items():
        known[frame] = value
    posed = np.array([each.localised for each in known])[:, None, None]
    seen = np.full(COUNT, 100)
    for frame, number in (inliers or {}).items():
        seen[frame] = number
    return Trajectory(
        camera="torso",
        gauge="map-0",
        frame_numbers=frames,
        times_ns=frames * 33_333_333,
        gauge_from_cam=np.where(posed, poses, np.nan),
        covariance=np.where(posed, covariance, np.nan),
        status=tuple(known),
        inliers=seen,
        error_px=np.full(COUNT, 0.5),
    )


def _taken(path: Trajectory) -> list[int]:
    after = remove_weak_boundary_poses(path, MIN_INLIERS)
    taken = np.flatnonzero(path.localised & ~after.localised).tolist()
    assert all(after.status[frame] is FrameStatus.UNCONFIRMED for frame in taken)
    return list(taken)


def test_weak_poses_next_to_a_lost_interval_are_removed() -> None:
    assert _taken(_path({16: 17, 17: 40, 24: 59})) == [16, 17, 24]


def test_a_well_supported_end_protects_weak_poses_behind_it() -> None:
    assert _taken(_path({16: 17, 17: 60, 24: 60, 25: 17})) == []


def test_weak_poses_far_from_lost_frames_and_at_the_ends_of_a_video_stay() -> None:
    assert _taken(_path({0: 15, 5: 15, 30: 15, COUNT - 1: 15})) == []


def test_a_path_with_few_inliers_everywhere_is_kept() -> None:
    taken = _taken(_path(dict.fromkeys(range(COUNT), 30)))
    reach = point_refinement._MAX_BOUNDARY_FRAMES
    assert taken == [*range(LOST[0] - reach, LOST[0]), *range(LOST[-1] + 1, LOST[-1] + 1 + reach)]


def test_a_path_without_lost_frames_stays() -> None:
    found = dict.fromkeys(LOST, FrameStatus.REGISTERED)
    assert _taken(_path(dict.fromkeys(range(COUNT), 15), found)) == []


def _true_points() -> np.ndarray:
    return np.random.default_rng(5).uniform([-2.0, -1.0, 2.5], [2.0, 1.0, 4.0], (300, 3))


def _map(path: Trajectory, *, readout_s: float = 0.0) -> Map:
    """Every third frame is a keyframe. One of them is misplaced, together with the points it triangulated."""
    truth, points = _path(status=dict.fromkeys(LOST, FrameStatus.REGISTERED)), _true_points()
    frames = np.arange(0, COUNT, 3)
    poses = truth.gauge_from_cam[frames].copy()
    rng, rows, point, px = np.random.default_rng(6), [], [], []
    for row, frame in enumerate(frames.tolist()):
        seen_px = LENS.project(transform_points(invert(poses[row]), points))
        inside = np.flatnonzero(((seen_px > 0) & (seen_px < (640, 480))).all(axis=1))
        inside = inside[rng.random(len(inside)) < 0.3]
        velocity = _velocity_px_s(truth, frame, points[inside])
        rows.append(np.full(len(inside), row))
        point.append(inside)
        px.append(px_at_mid_row(LENS, seen_px[inside], velocity, -readout_s))
    keyframe_of, which = np.concatenate(rows), np.concatenate(point)
    wrong = int(np.flatnonzero(frames == 15)[0])
    poses[wrong, :3, 3] += (WRONG_M, 0.0, 0.0)
    placed = points.copy()
    placed[which[keyframe_of == wrong]] += (WRONG_M, 0.0, 0.0)
    seen_px = np.concatenate(px) + rng.normal(0.0, NOISE_PX, (len(which), 2))
    return Map(
        gauge="map-0",
        cameras={"torso": LENS},
        keyframe_camera=("torso",) * len(frames),
        keyframe_frame=frames,
        map_from_cam=poses,
        points=placed,
        colors=np.zeros((len(points), 3), np.uint8),
        point_error_px=np.zeros(len(points)),
        obs_keyframe=keyframe_of,
        obs_point=which,
        obs_feature=np.arange(len(which)),
        obs_px=seen_px,
        readout_s={"torso": readout_s} if readout_s else {},
    )


def _velocity_px_s(path: Trajectory, frame: int, points: np.ndarray) -> np.ndarray:
    """Image velocities (N,2) of points, from the frames before and after a frame, as far as they exist."""
    first, last = max(frame - 1, 0), min(frame + 1, len(path.times_ns) - 1)
    earlier, later = (
        LENS.project(transform_points(invert(path.gauge_from_cam[at]), points)) for at in (first, last)
    )
    return np.asarray((later - earlier) / (1e-9 * (path.times_ns[last] - path.times_ns[first])))


def _off_m(scene: Map) -> np.ndarray:
    """Errors of the points that at least three keyframes see."""
    seen = np.bincount(scene.obs_point, minlength=len(scene.points)) > 2
    return np.asarray(np.linalg.norm(scene.points - _true_points(), axis=1)[seen])


def test_points_move_to_agree_with_the_poses_of_frames() -> None:
    path = _path()
    before = _map(path)
    after = refine_points(before, [path])
    assert np.percentile(_off_m(before), 90) > 0.9 * WRONG_M
    # Half a pixel at 420 pixels' focal length and 3 m is 4 mm across; along the line of sight it is more.
    assert np.median(_off_m(after)) < 0.02
    assert np.percentile(_off_m(after), 95) < 0.1
    assert after.gauge == before.gauge
    np.testing.assert_allclose(after.map_from_cam[5], path.gauge_from_cam[15])


def test_keyframes_of_lost_frames_keep_their_pose_and_lose_their_observations() -> None:
    path = _path()
    before = _map(path)
    after = refine_points(before, [path])
    lost = np.flatnonzero(np.isin(before.keyframe_frame, LOST))
    assert len(lost) == 2
    np.testing.assert_array_equal(after.map_from_cam[lost], before.map_from_cam[lost])
    assert not np.isin(after.obs_keyframe, lost).any()
    assert np.bincount(after.obs_point)[np.unique(after.obs_point)].min() >= 2


def test_observations_that_agree_with_no_position_are_removed() -> None:
    path = _path()
    before = _map(path)
    px = before.obs_px.copy()
    first = np.unique(before.obs_point, return_index=True)[1]
    often = first[np.bincount(before.obs_point)[before.obs_point[first]] > 5][:20]
    px[often] += 40.0
    after = refine_points(replace(before, obs_px=px), [path])
    kept = set(after.obs_feature.tolist())
    assert not kept & set(before.obs_feature[often].tolist())
    assert np.median(_off_m(after)) < 0.02


def test_keyframes_of_a_camera_in_another_gauge_keep_pose_and_observations() -> None:
    path = _path()
    before = _map(path)
    after = refine_points(before, [replace(path, gauge="map-1")])
    np.testing.assert_array_equal(after.map_from_cam, before.map_from_cam)
    assert np.isin(after.obs_keyframe, np.flatnonzero(np.isin(before.keyframe_frame, LOST))).any()


def test_a_rolling_shutter_is_undone() -> None:
    path = _path(status=dict.fromkeys(LOST, FrameStatus.REGISTERED))
    rolled = _map(path, readout_s=0.03)
    off = [
        np.median(_off_m(refine_points(replace(rolled, readout_s=each), [path])))
        for each in ({}, rolled.readout_s)
    ]
    assert off[1] < 0.02
    assert off[1] < 0.5 * off[0]


def test_chunks_give_the_same_points(monkeypatch: pytest.MonkeyPatch) -> None:
    path = _path()
    whole = refine_points(_map(path), [path])
    monkeypatch.setattr(point_refinement, "_CHUNK_ROWS", 50)
    parts = refine_points(_map(path), [path])
    np.testing.assert_allclose(parts.points, whole.points, atol=1e-9)
    np.testing.assert_array_equal(parts.obs_feature, whole.obs_feature)


def test_a_map_without_observations_stays() -> None:
    path = _path()
    scene = _map(path)
    none = replace(
        scene,
        obs_keyframe=scene.obs_keyframe[:0],
        obs_point=scene.obs_point[:0],
        obs_feature=scene.obs_feature[:0],
        obs_px=scene.obs_px[:0],
    )
    np.testing.assert_array_equal(refine_points(none, [path]).points, scene.points)


def test_the_scale_of_the_map_changes_nothing() -> None:
    path, factor = _path(), 0.1
    small = _map(path)
    poses, known = small.map_from_cam.copy(), path.gauge_from_cam.copy()
    poses[:, :3, 3] *= factor
    known[:, :3, 3] *= factor
    covariance = path.covariance.copy()
    covariance[:, 3:] *= factor
    covariance[:, :, 3:] *= factor
    scaled = refine_points(
        replace(small, map_from_cam=poses, points=small.points * factor),
        [replace(path, gauge_from_cam=known, covariance=covariance)],
    )
    np.testing.assert_allclose(scaled.points / factor, refine_points(small, [path]).points, atol=1e-6)
