"""A map of rolling shutters, adjusted together with the motion of its cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.mapping.reconstruction.motion_adjustment import (
    _PASSES,
    AdjustedReadout,
    MotionAdjustment,
    _Readouts,
)
from bodycap_batch.mapping.reconstruction.reduced_system import CommonPoints
from bodycap_batch.mapping.reconstruction.rolling_adjustment import RollingMap, correction_ratios
from bodycap_batch.model.geometry import invert, make_transform, so3_exp
from tests.unit.mapping.test_rolling_adjustment import (
    FRAME_S,
    FRAMES,
    KEYFRAMES,
    LENS,
    NOISE_PX,
    READOUT_S,
    centre_error,
    poses_at,
    scene,
)

TIMES_NS = np.round(np.arange(FRAMES) * FRAME_S * 1e9).astype(np.int64)


def hand(points: int = 400) -> tuple[MotionAdjustment, RollingMap]:
    """Return the adjustment of a hand that shakes and sees a number of points, and the true map."""
    seen, truth, _ = scene()
    rows = seen.point < points
    adjustment = MotionAdjustment(
        lenses={"hand": LENS},
        poses={"hand": (poses_at(TIMES_NS * 1e-9), TIMES_NS)},
        rotations={},
        camera=("hand",) * len(KEYFRAMES),
        frame=KEYFRAMES,
        keyframe=seen.keyframe[rows],
        point=seen.point[rows],
        px=seen.px[rows],
    )
    return adjustment, replace(truth, points=truth.points[:points])


@pytest.mark.parametrize("ratio", [0.75, 1.25])
def test_a_wrong_readout_time_is_corrected(ratio: float) -> None:
    adjustment, truth = hand()
    found = adjustment.run(
        truth.cam_from_map, truth.points, {"hand": ratio * READOUT_S}, {"hand": (ratio * READOUT_S, 0.01)}
    )
    assert found is not None
    told = found.readouts["hand"]
    assert told.seconds == told.best_s
    assert told.sigma_s is not None
    assert abs(told.seconds - READOUT_S) < 3.0 * told.sigma_s < 0.0015


def test_the_readout_time_of_a_camera_that_is_upside_down_is_corrected() -> None:
    adjustment, truth = hand(120)
    # The pictures are upright again, so their last row is exposed first.
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    poses, times_ns = adjustment.poses["hand"]
    flipped = replace(
        adjustment, poses={"hand": (poses @ half_turn, times_ns)}, px=np.array([640.0, 480.0]) - adjustment.px
    )
    start_s = -0.8 * READOUT_S
    found = flipped.run(
        half_turn @ truth.cam_from_map, truth.points, {"hand": start_s}, {"hand": (start_s, 0.01)}
    )
    assert found is not None
    told = found.readouts["hand"]
    assert told.sigma_s is not None
    assert abs(told.seconds + READOUT_S) < 3.0 * told.sigma_s < 0.0015


@pytest.mark.parametrize("start_s", [0.0009, 0.0001, -0.0009])
def test_a_global_shutter_is_found_to_be_one(start_s: float) -> None:
    adjustment, truth = hand(120)
    in_cam = np.einsum(
        "mij,mj->mi", truth.cam_from_map[adjustment.keyframe, :3, :3], truth.points[adjustment.point]
    )
    in_cam += truth.cam_from_map[adjustment.keyframe, :3, 3]
    noise = np.random.default_rng(6).normal(0.0, NOISE_PX, adjustment.px.shape)
    still = replace(adjustment, px=LENS.project(in_cam) + noise)
    found = still.run(truth.cam_from_map, truth.points, {"hand": start_s}, {"hand": (start_s, 0.004)})
    assert found is not None
    told = found.readouts["hand"]
    assert told.seconds == 0.0
    assert told.sigma_s is not None
    assert abs(told.best_s) < 3.0 * told.sigma_s < 0.001
    # The map is adjusted for a global shutter.
    assert found.px_at_mid_row == pytest.approx(still.px, abs=0.01)


def test_a_given_readout_time_stays() -> None:
    adjustment, truth = hand(120)
    found = adjustment.run(truth.cam_from_map, truth.points, {"hand": 0.018}, {"hand": (0.018, 0.0)})
    assert found is not None
    assert found.readouts["hand"] == AdjustedReadout(seconds=0.018, best_s=0.018, sigma_s=None)


def test_a_readout_time_that_systematic_errors_exceed_stays() -> None:
    adjustment, truth = hand(120)
    found = adjustment.run(truth.cam_from_map, truth.points, {"hand": 0.018}, {"hand": (0.018, 1e-6)})
    assert found is not None
    assert found.readouts["hand"] == AdjustedReadout(seconds=0.018, best_s=0.018, sigma_s=None)


def test_a_camera_without_a_rolling_shutter_does_not_change_the_error_of_a_readout_time() -> None:
    adjustment, truth = hand()
    count, rows = len(KEYFRAMES), adjustment.keyframe
    both = replace(
        adjustment,
        lenses={"hand": LENS, "head": LENS},
        camera=(*adjustment.camera, *("head",) * (2 * count)),
        frame=np.tile(adjustment.frame, 3),
        keyframe=np.concatenate([rows, rows + count, rows + 2 * count]),
        point=np.tile(adjustment.point, 3),
        px=np.tile(adjustment.px, (3, 1)),
    )
    readouts = _Readouts.create({"hand": READOUT_S}, {"hand": (READOUT_S, 0.01)}, [])
    errors, ratios = [], []
    for times, each in ((1, adjustment), (3, both)):
        pose = np.tile(truth.cam_from_map, (times, 1, 1))
        common_points = CommonPoints.of(each.keyframe, each.point)
        seen, _ = each._observations(pose, readouts, NOISE_PX, common_points)
        moved = replace(truth, cam_from_map=pose, velocities=np.full((times * count, 9), 0.1))
        errors.append(each._systematic_errors(seen, readouts))
        ratios.append(correction_ratios(seen, moved))
    assert 1e-6 < errors[0] == pytest.approx(errors[1])
    assert 0.01 < ratios[0] == pytest.approx(ratios[1])


def test_few_keyframes_tell_no_readout_time() -> None:
    adjustment, truth = hand()
    rows = adjustment.keyframe < 3
    few = replace(
        adjustment,
        camera=adjustment.camera[:3],
        frame=adjustment.frame[:3],
        keyframe=adjustment.keyframe[rows],
        point=adjustment.point[rows],
        px=adjustment.px[rows],
    )
    found = few.run(truth.cam_from_map[:3], truth.points, {"hand": 0.018}, {"hand": (0.018, 0.01)})
    assert found is not None
    assert found.readouts["hand"].seconds == 0.018
    assert found.readouts["hand"].sigma_s is None


def test_a_path_that_is_exact_enough_is_left_alone() -> None:
    adjustment, truth = hand()
    start = truth.cam_from_map, truth.points
    assert adjustment.run(*start, {"hand": 1e-4}, {"hand": (1e-4, 1e-5)}) is None
    assert adjustment.run(*start, {}, {}) is None


def readouts_of(
    seconds: dict[str, float], expected: dict[str, tuple[float, float]], groups: list[list[str]]
) -> _Readouts:
    """Return readout times after a pass that has not changed them, with standard deviations of 0.1 ms."""
    readouts = _Readouts.create(seconds, expected, groups)
    ratio = readouts.seconds / readouts.scale_s
    return readouts.after_pass(ratio, np.full(len(ratio), 1e-4))


def test_equal_cameras_whose_readout_times_agree_share_one() -> None:
    groups = [["a", "b"], ["c", "d"], ["e", "other"]]
    readouts = readouts_of(
        {"a": 0.0100, "b": 0.0103, "c": 0.0101, "d": 0.0102, "e": 0.02},
        {"a": (0.01, 0.001), "b": (0.01, 0.002), "c": (0.01, 0.001), "d": (0.0102, 0.0), "e": (0.02, 0.001)},
        groups,
    )
    shared = readouts.shared(groups)
    at_s = {name: shared.seconds[index] for name, index in shared.number.items()}
    assert shared.number["a"] == shared.number["b"]
    assert at_s == pytest.approx({"a": 0.01015, "b": 0.01015, "c": 0.0101, "d": 0.0102, "e": 0.02})
    assert shared.expected_s[shared.number["a"]].tolist() == [0.01, 0.001]
    assert shared.best_s[shared.number["a"]] == pytest.approx(0.01015)
    assert shared.sigma_s[shared.number["a"]] == pytest.approx(1e-4 / np.sqrt(2.0))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_equal_cameras_with_other_readout_times_keep_them(sign: float) -> None:
    expected = {"a": (sign * 0.01, 0.001), "b": (sign * 0.011, 0.001)}
    readouts = readouts_of({"a": sign * 0.010, "b": sign * 0.011}, expected, [["a", "b"]])
    assert readouts.shared([["a", "b"]]).number == {"a": 0, "b": 1}


def test_only_equal_cameras_start_with_a_common_readout_time() -> None:
    seconds = dict.fromkeys(("a", "b", "c", "d"), 0.01)
    expected = {"a": (0.01, 0.001), "b": (0.01, 0.001), "c": (0.01, 0.001), "d": (0.01, 0.0)}
    readouts = _Readouts.create(seconds, expected, [["a", "b", "d"]])
    assert readouts.number == {"a": 0, "b": 0, "c": 1, "d": 2}
    assert readouts.constant.tolist() == [False, False, True]


def test_a_camera_whose_motion_is_too_smooth_follows_an_equal_camera() -> None:
    seconds = {"a": 0.01, "b": 0.01, "c": 0.02, "d": 0.02}
    expected = dict.fromkeys(seconds, (0.01, 0.001))
    readouts = _Readouts.create(seconds, {**expected, "d": (0.02, 0.0)}, [["a", "b", "c", "d"]], {"b", "c"})
    # No unknown readout time begins with that of c.
    assert readouts.number["a"] == readouts.number["b"]
    assert len(set(readouts.number.values())) == 3


def test_a_camera_whose_motion_is_too_smooth_does_not_change_the_readout_time() -> None:
    adjustment, truth = hand(120)
    count = len(KEYFRAMES)
    slower = replace(
        adjustment,
        lenses={"hand": LENS, "other": LENS},
        # The path of the other hand is wrong: it does not turn.
        poses={**adjustment.poses, "other": (np.tile(np.eye(4), (FRAMES, 1, 1)), TIMES_NS)},
        camera=(*adjustment.camera, *("other",) * count),
        frame=np.tile(adjustment.frame, 2),
        keyframe=np.concatenate([adjustment.keyframe, adjustment.keyframe + count]),
        point=np.tile(adjustment.point, 2),
        px=np.tile(adjustment.px, (2, 1)),
        equal_cameras=[["hand", "other"]],
        uninformative={"other"},
    )
    start_s = 0.9 * READOUT_S
    found = slower.run(
        np.tile(truth.cam_from_map, (2, 1, 1)),
        truth.points,
        {"hand": start_s, "other": start_s},
        {"hand": (start_s, 0.01), "other": (start_s, 0.01)},
    )
    assert found is not None
    told = found.readouts["hand"]
    assert told.sigma_s is not None
    assert found.readouts["other"] == told
    assert abs(told.seconds - READOUT_S) < 3.0 * told.sigma_s < 0.002


@pytest.mark.parametrize(
    ("seconds", "sigma_s", "left"),
    [(0.0009, 0.0005, 0.0), (-0.0009, 0.0005, 0.0), (0.0009, 0.0008, 0.0009), (0.018, 0.0005, 0.018)],
)
def test_a_short_readout_time_that_the_pictures_do_not_tell_is_none(
    seconds: float, sigma_s: float, left: float
) -> None:
    readouts = _Readouts.create({"a": seconds}, {"a": (seconds, sigma_s)}, []).kept(np.ones(1, bool))
    assert readouts.constant.all()
    assert readouts.seconds.tolist() == [left]
    assert readouts.best_s.tolist() == [seconds]
    assert np.isnan(readouts.sigma_s[0]) == (left != 0.0)


@pytest.mark.parametrize(
    ("seconds", "left"), [(0.0002, 0.0), (-0.0002, 0.0), (0.0005, 0.0005), (-0.0031, -0.0031)]
)
def test_a_short_readout_time_that_may_be_none_becomes_a_global_shutter(seconds: float, left: float) -> None:
    readouts = readouts_of({"a": seconds}, {"a": (seconds, 0.001)}, []).without_short_ones()
    assert readouts.seconds.tolist() == [left]
    assert readouts.best_s.tolist() == pytest.approx([seconds])
    assert readouts.constant.tolist() == [not left]


def test_the_frames_between_keyframes_move_with_them() -> None:
    adjustment, truth = hand()
    change = make_transform(so3_exp(np.array([0.0, 0.02, 0.0])), np.array([0.1, 0.0, 0.0]))
    map_from_cam = invert(truth.cam_from_map)
    moved = make_transform(change[:3, :3] @ map_from_cam[:, :3, :3], map_from_cam[:, :3, 3] + change[:3, 3])
    poses, times_ns = adjustment._moved_poses("hand", invert(moved))
    before, _ = adjustment.poses["hand"]
    assert (times_ns == TIMES_NS).all()
    assert poses[:, :3, 3] == pytest.approx(before[:, :3, 3] + change[:3, 3], abs=1e-6)
    assert poses[:, :3, :3] == pytest.approx(change[:3, :3] @ before[:, :3, :3], abs=1e-6)


def test_a_frame_is_moved_by_the_keyframes_beside_it() -> None:
    adjustment, truth = hand()
    moved = invert(truth.cam_from_map)
    last = len(KEYFRAMES) - 1
    moved[last, :3, 3] += (0.3, 0.0, 0.0)
    poses, _ = adjustment._moved_poses("hand", invert(moved))
    shift = (poses - adjustment.poses["hand"][0])[:, 0, 3]
    # Keyframes are frames 36 and 38, so frame 37 moves half as far, and frame 39 as far as frame 38.
    assert shift[[35, 36, 37, 38, 39]] == pytest.approx([0.0, 0.0, 0.15, 0.3, 0.3], abs=1e-6)


def test_a_keyframe_without_a_pose_in_the_path_moves_no_frame() -> None:
    adjustment, truth = hand()
    poses = adjustment.poses["hand"][0].copy()
    poses[KEYFRAMES] = np.nan
    lost = replace(adjustment, poses={"hand": (poses, TIMES_NS)})
    moved, _ = lost._moved_poses("hand", truth.cam_from_map)
    assert np.array_equal(moved, poses, equal_nan=True)


def scales_of(
    corrections: FloatArray, cameras: tuple[str, ...], seen: int = 20, before: float = 1.0, noise: float = 0.1
) -> FloatArray:
    """Return the factors of the expected errors, for keyframes with a number of observations each.

    Args:
        corrections: (K,3) velocities that the pictures tell, in the expected errors.
        cameras: Camera of each keyframe.
        seen: Number of observations of each keyframe.
        before: Factor with which the corrections of the first pass are estimated.
        noise: Standard deviation of what the pictures tell.
    """
    adjustment = MotionAdjustment(
        lenses={},
        poses={},
        rotations={},
        camera=cameras,
        frame=np.arange(len(cameras)),
        keyframe=np.repeat(np.arange(len(cameras)), seen),
        point=np.zeros(seen * len(cameras), np.int64),
        px=np.zeros((seen * len(cameras), 2)),
    )
    scales = np.full(corrections.shape, before)
    for _ in range(_PASSES):
        variance = 1.0 / (noise**-2 + scales**-2)
        scales = adjustment._error_scales((corrections * variance / noise**2) ** 2 + variance)
    return scales


@pytest.mark.parametrize("before", [0.3, 1.0, 3.0])
def test_each_camera_has_its_own_usual_error_and_a_violent_keyframe_a_larger_one(before: float) -> None:
    corrections = np.concatenate([np.full((20, 3), 0.2), np.full((20, 3), 2.0)])
    corrections[5] = 3.0
    scales = scales_of(corrections, ("a",) * 20 + ("b",) * 20, before=before)
    calm = np.delete(scales[:20], 5, axis=0)
    assert calm == pytest.approx(0.2, abs=0.06)
    assert scales[20:] == pytest.approx(2.0, rel=0.02)
    # The size of one keyframe follows from its own error and from the usual one.
    assert (scales[5] > 1.0).all()
    assert (scales[5] < 3.0).all()


def test_noise_is_no_error_of_a_velocity() -> None:
    rng = np.random.default_rng(8)
    # Without errors, the pictures tell only their noise.
    scales = scales_of(rng.normal(0.0, 0.1, (200, 3)), ("a",) * 200, before=0.3, noise=0.1)
    assert np.median(scales) < 0.15


@pytest.mark.parametrize("noise", [1.0, 10.0, 100.0])
def test_pictures_that_say_little_hardly_change_what_is_expected(noise: float) -> None:
    rng = np.random.default_rng(9)
    # The noise is twice what the adjustment assumes: its residuals do not show the errors that all of the
    # observations of a keyframe have in common.
    scales = scales_of(rng.normal(0.0, 2.0 * noise, (200, 3)), ("a",) * 200, before=0.3, noise=noise)
    assert np.median(scales) == pytest.approx(0.3, abs=0.1)


def test_keyframes_with_few_observations_tell_no_errors() -> None:
    scales = scales_of(np.full((4, 3), 5.0), ("a",) * 4, seen=3)
    assert (scales == scales_of(np.zeros((4, 3)), ("a",) * 4, seen=3)).all()


def test_the_errors_of_the_path_follow_from_the_adjustment() -> None:
    adjustment, truth = hand()
    found = adjustment.run(truth.cam_from_map, truth.points, {"hand": READOUT_S}, {"hand": (READOUT_S, 0.0)})
    assert found is not None
    scales = found.error_scales["hand"]
    between = np.setdiff1d(np.arange(FRAMES), KEYFRAMES)
    assert (scales[between] == 1.0).all()
    # The path through exact poses follows this shake nearly exactly.
    assert (scales[KEYFRAMES, 0] < 0.5).all()
    start = RollingMap(
        cam_from_map=found.cam_from_map,
        points=found.points,
        velocities=np.zeros((len(KEYFRAMES), 9)),
        readout_ratio=np.ones(1),
    )
    assert centre_error(start, truth) < 0.003
