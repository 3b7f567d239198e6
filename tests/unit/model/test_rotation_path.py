"""The rotation of a camera from matches of adjacent frames, and pixels moved to one instant by it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import numpy.typing as npt
import pytest

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.frame_matches import FrameMatches
from bodycap_batch.model.geometry import invert, make_transform, so3_exp, so3_log, transform_points
from bodycap_batch.model.rotation_fit import fit_rotation_path
from bodycap_batch.model.rotation_path import PosePath, RotationPath, TurningShutter, rotate_to_mid_row

LENS = Camera(model="PINHOLE", width_px=640, height_px=480, params=np.array([400.0, 400.0, 320.0, 240.0]))
FRAMES = 40
FRAME_S = 1 / 30
READOUT_S = 0.02
TIMES_NS = np.round(np.arange(FRAMES) * FRAME_S * 1e9).astype(np.int64)
NOISE_PX = 0.2
SHAKE_RAD = 0.02


def poses_at(time_s: npt.ArrayLike, sway_m: float = 0.0, shake_rad: float = 0.0) -> FloatArray:
    """A hand thrown about, up to 15° a frame, that may shake 11 times a second: map_from_cam (N,4,4)."""
    phase = 2 * np.pi * np.atleast_1d(np.asarray(time_s, dtype=np.float64))
    turn = [0.5 * np.sin(1.1 * phase), 0.9 * np.sin(1.3 * phase + 1.0), 0.4 * np.cos(0.9 * phase)]
    centre = sway_m * np.stack([np.sin(1.2 * phase), np.cos(phase), np.sin(0.8 * phase)], axis=1)
    shake = shake_rad * np.stack([np.sin(11 * phase), np.sin(13 * phase + 2.0), 0 * phase], axis=1)
    return make_transform(so3_exp(np.stack(turn, axis=1)) @ so3_exp(shake), centre)


def seen(frame: int, points: FloatArray, sway_m: float = 0.0, shake_rad: float = 0.0) -> FloatArray:
    """Pixels (N,2) of points, each where it is when its own row is exposed; NaN outside the image."""
    return _seen(frame, points.tobytes(), sway_m, shake_rad)


@cache
def _seen(frame: int, points: bytes, sway_m: float, shake_rad: float) -> FloatArray:
    """Return the pixels of points (float64, x y z); the points of a test are seen by several functions."""
    out = np.full((len(points) // 24, 2), np.nan)
    in_map = np.frombuffer(points).reshape(-1, 3)
    middle = invert(poses_at(frame * FRAME_S, sway_m, shake_rad))[0]
    in_cam = transform_points(middle, in_map)
    # The corners of the image are 45 degrees off its axis, and the camera turns by a few degrees meanwhile.
    ahead = np.flatnonzero(in_cam[:, 2] > 0.3 * np.linalg.norm(in_cam, axis=1))
    delay = np.zeros(len(ahead))
    for _ in range(12):
        cam_from_map = invert(poses_at(frame * FRAME_S + delay, sway_m, shake_rad))
        px = LENS.project(
            np.einsum("mij,mj->mi", cam_from_map[:, :3, :3], in_map[ahead]) + cam_from_map[:, :3, 3]
        )
        delay = (np.nan_to_num(np.clip(px[:, 1] / 480.0, 0, 1), nan=0.5) - 0.5) * READOUT_S
    inside = ((px > 0) & (px < (640, 480))).all(axis=1)
    out[ahead[inside]] = px[inside]
    out.flags.writeable = False
    return out


def directions(count: int, seed: int = 3) -> FloatArray:
    """Directions (N,3) all around."""
    rays = np.random.default_rng(seed).normal(size=(count, 3))
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def matches_of(
    points: FloatArray, *, wrong: float = 0.0, lost: int = -1, sway_m: float = 0.0
) -> FrameMatches:
    """Matches of all frames with noise; some of them wrong, and none from the frame `lost` to the next."""
    rng = np.random.default_rng(5)
    px = [seen(frame, points, sway_m) for frame in range(FRAMES)]
    frames: list[IntArray] = []
    first, second = [], []
    for frame in range(FRAMES - 1):
        both = np.flatnonzero(np.isfinite(px[frame]).all(axis=1) & np.isfinite(px[frame + 1]).all(axis=1))
        if frame == lost:
            continue
        later = px[frame + 1][both] + rng.normal(0, NOISE_PX, (len(both), 2))
        bad = rng.uniform(size=len(both)) < wrong
        later[bad] = rng.uniform((0, 0), (640, 480), (int(bad.sum()), 2))
        frames.append(np.full(len(both), frame))
        first.append(px[frame][both])
        second.append(later)
    return FrameMatches(
        camera="head",
        frame=np.concatenate(frames),
        first_px=np.concatenate(first).astype(np.float32),
        second_px=np.concatenate(second).astype(np.float32),
    )


def error_at_mid_row(path: RotationPath, points: FloatArray) -> FloatArray:
    """Largest distance (px) of each frame's moved pixels from the pixels at the instant of the middle row."""
    out = np.zeros(FRAMES)
    for frame in range(FRAMES):
        px = seen(frame, points)
        rows = np.flatnonzero(np.isfinite(px).all(axis=1))
        moved = rotate_to_mid_row(LENS, path, np.full(len(rows), frame), px[rows], READOUT_S)
        rotation = poses_at(frame * FRAME_S)[0, :3, :3]
        out[frame] = np.linalg.norm(moved - LENS.project(points[rows] @ rotation), axis=1).max()
    return out


def test_pixels_of_a_turning_camera_are_moved_to_one_instant_by_matches_alone() -> None:
    points = 100.0 * directions(4000)
    path = fit_rotation_path(matches_of(points), LENS, TIMES_NS, READOUT_S)
    nothing = RotationPath.from_steps(
        TIMES_NS, np.tile(np.eye(3), (FRAMES - 1, 1, 1)), np.zeros(FRAMES - 1, bool)
    )
    # A row at the edge is moved by up to a third of the turn of a frame: 30 px and more. What remains is the
    # spline's error between frames and the noise of 0.2 px, of some 60 matches and at the edge of the image.
    assert np.median(error_at_mid_row(nothing, points)) > 15.0
    error = error_at_mid_row(path, points)
    assert np.median(error[1:-1]) < 0.5
    assert error[1:-1].max() < 2.0


def test_wrong_matches_do_not_disturb_the_rotation() -> None:
    points = 100.0 * directions(4000)
    path = fit_rotation_path(matches_of(points, wrong=0.4), LENS, TIMES_NS, READOUT_S)
    assert (path.segment == 0).all()
    assert np.median(error_at_mid_row(path, points)[1:-1]) < 1.0


def test_a_step_without_matches_starts_a_new_segment_and_its_ends_are_still_corrected() -> None:
    points = 100.0 * directions(4000)
    path = fit_rotation_path(matches_of(points, lost=19), LENS, TIMES_NS, READOUT_S)
    assert path.segment.tolist() == [0] * 20 + [1] * 20
    # The rate at the ends comes from the rows of these frames: they are exposed one after another.
    assert error_at_mid_row(path, points)[[19, 20]].max() < 4.0


def test_matches_of_one_point_alone_give_no_rotation_and_no_error() -> None:
    same = np.tile(np.array([[100.0, 200.0]], np.float32), (30, 1))
    matches = FrameMatches(camera="head", frame=np.repeat([0, 1], 15), first_px=same, second_px=same)
    path = fit_rotation_path(matches, LENS, TIMES_NS[:3], READOUT_S)
    assert np.allclose(so3_log(path.rotation), 0.0, atol=1e-9)


def test_poses_move_near_points_by_the_translation_too() -> None:
    sway_m = 0.4
    rng = np.random.default_rng(2)
    points = directions(3000, seed=4) * rng.uniform(1.5, 4.0, (3000, 1))
    poses = poses_at(np.arange(FRAMES) * FRAME_S, sway_m)
    path = PosePath.create(poses, TIMES_NS)
    turning = path.rotation
    whole, turned = [], []
    for frame in range(2, FRAMES - 2):
        px = seen(frame, points, sway_m)
        rows = np.flatnonzero(np.isfinite(px).all(axis=1))
        at = np.full(len(rows), frame)
        cam_from_map = invert(poses[frame])
        true_px = LENS.project(points[rows] @ cam_from_map[:3, :3].T + cam_from_map[:3, 3])
        whole.append(path.px_at_mid_row(LENS, at, points[rows], px[rows], READOUT_S) - true_px)
        turned.append(rotate_to_mid_row(LENS, turning, at, px[rows], READOUT_S) - true_px)
    # The spline through true poses is off by the fourth derivative of the motion alone.
    assert np.linalg.norm(np.concatenate(whole), axis=1).max() < 0.7
    assert np.percentile(np.linalg.norm(np.concatenate(turned), axis=1), 90) > 2.0


def test_matches_replace_the_rotation_where_poses_are_missing() -> None:
    points = 100.0 * directions(4000)
    from_matches = fit_rotation_path(matches_of(points), LENS, TIMES_NS, READOUT_S)
    poses = poses_at(np.arange(FRAMES) * FRAME_S)
    poses[[10, 11, 25]] = np.nan
    path = PosePath.create(poses, TIMES_NS, from_matches).rotation
    assert (path.segment == 0).all()
    assert error_at_mid_row(path, points)[1:-1].max() < 2.0
    alone = PosePath.create(poses, TIMES_NS).rotation
    assert len(np.unique(alone.segment)) > 1


def test_a_gap_in_time_ends_a_segment() -> None:
    times = TIMES_NS.copy()
    times[20:] += 1_000_000_000
    poses = poses_at(np.arange(FRAMES) * FRAME_S)
    path = PosePath.create(poses, times)
    assert path.rotation.segment.tolist() == [0] * 20 + [1] * 20


@pytest.mark.parametrize("count", [1, 2])
def test_a_video_of_few_frames_is_not_moved_without_matches(count: int) -> None:
    none = np.zeros((0, 2), np.float32)
    matches = FrameMatches(camera="head", frame=np.zeros(0, np.int64), first_px=none, second_px=none)
    path = fit_rotation_path(matches, LENS, TIMES_NS[:count], READOUT_S)
    px = np.array([[10.0, 20.0], [600.0, 470.0]])
    moved = rotate_to_mid_row(LENS, path, np.zeros(2, np.int64), px, READOUT_S)
    assert np.allclose(moved, px)


def test_columns_are_exposed_one_after_another_in_a_sideways_image() -> None:
    rate = np.tile([0.0, 3.0, 0.0], (3, 1))
    path = RotationPath.from_steps(
        TIMES_NS[:3], np.tile(so3_exp([0.0, -0.1, 0.0]), (2, 1, 1)), np.ones(2, bool)
    )
    path = replace(path, rate=rate)
    px = np.array([[320.0, 40.0], [40.0, 240.0]])
    upright = rotate_to_mid_row(LENS, path, np.ones(2, np.int64), px, READOUT_S)
    sideways = rotate_to_mid_row(replace(LENS, sideways=True), path, np.ones(2, np.int64), px, READOUT_S)
    assert np.linalg.norm(upright - px, axis=1) == pytest.approx([9.8, 0.0], abs=1.0)
    assert np.linalg.norm(sideways - px, axis=1) == pytest.approx([0.0, 15.5], abs=1.5)


def test_the_rows_of_a_frame_tell_a_shake_that_its_neighbours_do_not() -> None:
    rng = np.random.default_rng(2)
    points = directions(1500, seed=4) * rng.uniform(1.5, 4.0, (1500, 1))
    poses = poses_at(np.arange(FRAMES) * FRAME_S, 0.4, SHAKE_RAD)
    noise = so3_exp(rng.normal(0.0, 0.0008, (FRAMES, 3)))  # 0.3 px
    measured = poses @ make_transform(noise, np.zeros(3))
    frames, seen_px, true_px, observed = [], [], [], []
    for frame in range(FRAMES):
        px = seen(frame, points, 0.4, SHAKE_RAD)
        rows = np.flatnonzero(np.isfinite(px).all(axis=1))
        cam_from_map = invert(poses[frame])
        frames.append(np.full(len(rows), frame))
        observed.append(points[rows])
        seen_px.append(px[rows])
        true_px.append(LENS.project(points[rows] @ cam_from_map[:3, :3].T + cam_from_map[:3, 3]))
    at, point, px = np.concatenate(frames), np.concatenate(observed), np.concatenate(seen_px)
    noisy_px = px + rng.normal(0.0, 0.4, px.shape)
    noisy_px[::20] += 40.0
    spline = PosePath.create(measured, TIMES_NS)
    fitted = spline.with_fitted_rates(LENS, at, point, noisy_px, READOUT_S)
    error = [
        np.linalg.norm(path.px_at_mid_row(LENS, at, point, px, READOUT_S) - np.concatenate(true_px), axis=1)
        for path in (spline, fitted)
    ]
    # 0.02 rad · 2π · 11 Hz · 10 ms · 400 px are 5 px at an edge. Some 150 observations of 0.4 px tell the
    # velocity to 0.1 px there; its change inside the frame remains.
    assert np.percentile(error[0], 90) > 3.0
    assert np.percentile(error[1], 90) < 1.0


def test_the_rows_of_a_frame_tell_how_its_velocity_changes_during_the_readout() -> None:
    rng = np.random.default_rng(7)
    path = PosePath.create(poses_at(np.arange(FRAMES) * FRAME_S, 0.4), TIMES_NS)
    rate, acceleration = path.rotation.rate.copy(), np.zeros((FRAMES, 3))
    rate[20] += [6.0, -4.0, 3.0]
    acceleration[20] = [120.0, -80.0, 60.0]
    path = replace(path, rotation=replace(path.rotation, rate=rate))
    true = replace(path, rotation=replace(path.rotation, acceleration=acceleration))
    px, depth = rng.uniform((20, 20), (620, 460), (200, 2)), rng.uniform(1.5, 4.0, (200, 1))
    frame = np.full(200, 20)
    moved, points = px, np.zeros((200, 3))
    for _ in range(10):  # The depth at the instant of the middle row depends on the moved pixel.
        rays = np.column_stack([LENS.unproject(moved), np.ones(200)])
        points = transform_points(path.map_from_cam[20], depth * rays)
        moved = true.px_at_mid_row(LENS, frame, points, px, READOUT_S)
    noisy_px = px + rng.normal(0.0, 0.4, px.shape)
    fitted = path.with_fitted_rates(LENS, frame, points, noisy_px, READOUT_S)
    error = [
        np.percentile(
            np.linalg.norm(each.px_at_mid_row(LENS, frame, points, px, READOUT_S) - moved, axis=1), 90
        )
        for each in (path, fitted)
    ]
    # 0.5 · 156 rad/s² · (10 ms)² · 400 px are 3 px at an edge, and half of that with the neighbours kept.
    # Some 200 observations of 0.4 px tell the unknowns of a frame to 0.2 px there.
    assert error[0] > 1.0
    assert error[1] < 0.5


def test_smooth_motion_is_not_disturbed_by_fitted_rates() -> None:
    rng = np.random.default_rng(2)
    points = directions(800, seed=4) * rng.uniform(1.5, 4.0, (800, 1))
    poses = poses_at(np.arange(FRAMES) * FRAME_S, 0.4)
    px = [seen(frame, points, 0.4) for frame in range(FRAMES)]
    rows = [np.flatnonzero(np.isfinite(each).all(axis=1)) for each in px]
    frame = np.concatenate([np.full(len(each), number) for number, each in enumerate(rows)])
    point = np.concatenate([points[each] for each in rows])
    noisy_px = np.concatenate([each[at] for each, at in zip(px, rows, strict=True)])
    noisy_px += rng.normal(0.0, 0.4, noisy_px.shape)
    path = PosePath.create(poses, TIMES_NS)
    change = (
        path.with_fitted_rates(LENS, frame, point, noisy_px, READOUT_S).rotation.rate - path.rotation.rate
    )
    # 0.05 rad/s · 10 ms · 400 px: 0.2 px at an edge.
    assert np.median(np.linalg.norm(change, axis=1)[2:-2]) < 0.05


@pytest.mark.parametrize("lost", [[], [17, 18]])
def test_velocities_at_the_ends_of_runs_do_not_depend_on_the_poses_there(lost: list[int]) -> None:
    poses = poses_at(np.arange(FRAMES) * FRAME_S, 0.4)
    poses[lost] = np.nan
    ends = [0, FRAMES - 1] + ([lost[0] - 1, lost[-1] + 1] if lost else [])
    disturbed = poses.copy()
    disturbed[ends] = disturbed[ends] @ make_transform(so3_exp([0.02, -0.03, 0.01]), [0.03, 0.02, -0.05])
    right, wrong = (PosePath.create(each, TIMES_NS) for each in (poses, disturbed))
    assert np.allclose(wrong.velocity[ends], right.velocity[ends], atol=1e-9)
    assert np.allclose(wrong.rotation.rate[ends], right.rotation.rate[ends], atol=1e-9)
    # The path turns by 8 rad/s and moves at 3 m/s.
    later, earlier = (poses_at(np.arange(FRAMES) * FRAME_S + delay, 0.4) for delay in (1e-5, -1e-5))
    rate = so3_log(np.swapaxes(earlier[:, :3, :3], 1, 2) @ later[:, :3, :3]) / 2e-5
    velocity = (later - earlier)[:, :3, 3] / 2e-5
    # Its velocity changes by up to 0.8 m/s in a frame interval.
    assert np.linalg.norm(right.velocity - velocity, axis=1)[ends].max() < 1.3
    assert np.linalg.norm(right.rotation.rate - rate, axis=1)[ends].max() < 3.0


def test_observations_correct_an_extrapolated_rate() -> None:
    points = directions(1500, seed=4) * np.random.default_rng(2).uniform(1.5, 4.0, (1500, 1))
    poses = poses_at(np.arange(FRAMES) * FRAME_S, 0.4)
    path = PosePath.create(poses, TIMES_NS)
    rate = path.rotation.rate.copy()
    rate[[0, 20]] += [1.5, -1.0, 0.5]
    path = replace(path, rotation=replace(path.rotation, rate=rate))
    px = [seen(frame, points, 0.4) for frame in range(FRAMES)]
    rows = [np.flatnonzero(np.isfinite(each).all(axis=1)) for each in px]
    frame = np.concatenate([np.full(len(each), number) for number, each in enumerate(rows)])
    point = np.concatenate([points[each] for each in rows])
    seen_px = np.concatenate([each[at] for each, at in zip(px, rows, strict=True)])
    fitted = path.with_fitted_rates(LENS, frame, point, seen_px, READOUT_S).rotation.rate
    for wrong in (0, 20):  # Both deviate from their neighbours.
        later, earlier = (poses_at(wrong * FRAME_S + delay, 0.4)[0, :3, :3] for delay in (1e-5, -1e-5))
        assert np.linalg.norm(fitted[wrong] - so3_log(earlier.T @ later) / 2e-5) < 0.8


def test_a_frame_with_few_observations_keeps_its_rate() -> None:
    poses = poses_at(np.arange(FRAMES) * FRAME_S, 0.4)
    path = PosePath.create(poses, TIMES_NS)
    points = np.tile([[0.0, 0.0, 3.0]], (5, 1))
    found = path.with_fitted_rates(LENS, np.full(5, 7), points, np.full((5, 2), 200.0), READOUT_S)
    assert np.array_equal(found.rotation.rate, path.rotation.rate)


def test_a_turned_pixel_is_found_again_in_the_picture() -> None:
    points = 100.0 * directions(1500)
    path = fit_rotation_path(matches_of(points), LENS, TIMES_NS, READOUT_S)
    shutter = TurningShutter(LENS, path, READOUT_S)
    frame = np.repeat(np.arange(FRAMES), 40)
    px = np.random.default_rng(6).uniform((40, 40), (600, 440), (len(frame), 2))
    back = shutter.px_in_picture(frame, shutter.px_at_mid_row(frame, px))
    # A turn of 15 degrees a frame moves edge rows by 30 px. After four rounds the row is known to a tenth.
    assert np.abs(back - px).max() < 0.2


def test_the_turn_between_two_frames_is_known_only_within_a_segment() -> None:
    path = fit_rotation_path(matches_of(100.0 * directions(1500), lost=19), LENS, TIMES_NS, READOUT_S)
    turn = path.turn(4, 5)
    assert turn is not None
    true = poses_at(np.array([4, 5]) * FRAME_S)[:, :3, :3]
    assert np.linalg.norm(so3_log(turn @ true[0].T @ true[1])) < 0.01
    assert path.turn(19, 20) is None
    assert path.is_known(19)
    assert path.is_known(20)


def test_an_extrapolated_velocity_is_uncertain_where_the_camera_turns_fast() -> None:
    points = 100.0 * directions(4000)
    path = fit_rotation_path(matches_of(points, lost=19), LENS, TIMES_NS, READOUT_S)
    shutter = TurningShutter(LENS, path, READOUT_S)
    assert shutter.uncertainty(10) == 0.0
    # Half of some 5 rad/s over the root mean square of the delays, 0.29 readout times.
    for frame in (19, 20):
        assert 0.005 < shutter.uncertainty(frame) < 0.04
    assert replace(shutter, path=replace(path, rate=0.0 * path.rate)).uncertainty(19) == 0.0


def test_expected_errors_of_velocities_are_larger_where_a_path_jerks_or_ends() -> None:
    times_s = np.arange(FRAMES) * FRAME_S
    smooth = PosePath.create(poses_at(times_s, sway_m=0.3), TIMES_NS).velocity_errors()
    jerking = poses_at(times_s, sway_m=0.3)
    jerking[20, :3, :3] = jerking[20, :3, :3] @ so3_exp(np.array([0.05, 0.0, 0.0]))
    jerking[20, :3, 3] += 0.05
    errors = PosePath.create(jerking, TIMES_NS).velocity_errors()
    for before, after in zip(smooth, errors, strict=True):
        assert after[19] > 3.0 * before[19]
        assert after[10] == pytest.approx(before[10], rel=0.2)
        assert (after > 0.0).all()
    # The velocities of the first and the last frame are extrapolated.
    assert smooth[0][[0, -1]].min() > 2.0 * np.median(smooth[0])
    assert smooth[2][[0, -1]].min() > 2.0 * np.median(smooth[2])


def test_without_neighbouring_poses_the_velocity_is_as_uncertain_as_the_camera_is_fast() -> None:
    poses = poses_at(np.arange(FRAMES) * FRAME_S, sway_m=0.3)
    sparse = np.full_like(poses, np.nan)
    sparse[::4] = poses[::4]
    speed = np.linalg.norm(np.diff(poses[::4, :3, 3], axis=0), axis=1) / (4 * FRAME_S)
    velocity = PosePath.create(sparse, TIMES_NS).velocity_errors()[2]
    assert np.median(velocity) > 0.3 * speed.max() > 0.0


def test_a_path_without_poses_expects_the_largest_error_of_its_rates() -> None:
    rate, change, velocity = PosePath.create(np.full((FRAMES, 4, 4), np.nan), TIMES_NS).velocity_errors()
    assert (rate == 2.0).all()
    assert (change > 0.0).all()
    assert (velocity == 0.0).all()
