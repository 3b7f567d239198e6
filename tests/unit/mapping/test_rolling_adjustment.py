"""Keyframes of a rolling shutter, adjusted together with their velocities."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.mapping.reconstruction.reduced_system import CommonPoints
from bodycap_batch.mapping.reconstruction.rolling_adjustment import (
    MotionErrors,
    RollingMap,
    RowObservations,
    _derivatives,
    _moved,
    _normal_equations,
    _prior,
    _residuals,
    adjust_with_velocities,
    correction_ratios,
    px_at_mid_row,
    readout_errors,
    usual_residual_px,
    velocity_squares,
)
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import (
    align_points,
    invert,
    make_transform,
    so3_exp,
    so3_log,
    transform_points,
)
from bodycap_batch.model.rolling_shutter import row_delay
from bodycap_batch.model.rotation_path import PosePath

LENS = Camera(model="PINHOLE", width_px=640, height_px=480, params=np.array([400.0, 400.0, 320.0, 240.0]))
READOUT_S = 0.02
FRAME_S = 1 / 30
FRAMES = 40
KEYFRAMES = np.array([1, 2, 4, 5, 8, 9, 11, 14, 15, 17, 18, 21, 23, 24, 27, 29, 30, 32, 35, 36, 38])
NOISE_PX = 0.2
EXACT = 1e-6


def poses_at(time_s: npt.ArrayLike) -> FloatArray:
    """A hand that moves by half a metre and shakes at 7 Hz: no path through frames follows it."""
    phase = 2 * np.pi * np.asarray(time_s, dtype=np.float64)
    shake = 7.3 * phase
    centre = [0.5 * np.sin(0.7 * phase), 0.3 * np.cos(1.1 * phase), 0.2 * np.sin(0.9 * phase)]
    turn = [
        0.25 * np.sin(0.8 * phase) + 0.03 * np.sin(shake),
        0.3 * np.cos(0.6 * phase) + 0.03 * np.cos(1.1 * shake),
        0.2 * np.sin(phase),
    ]
    return make_transform(so3_exp(np.stack(turn, axis=1)), np.stack(centre, axis=1))


def scene(*, shrunk: bool = False) -> tuple[RowObservations, RollingMap, MotionErrors]:
    """Observations of a wall, the true map, and the expected errors of the path through the true frames."""
    rng = np.random.default_rng(3)
    points = rng.uniform((-4, -3, 3), (4, 3, 6), (400, 3))
    times_s = np.arange(FRAMES) * FRAME_S
    path = PosePath.create(poses_at(times_s), np.round(times_s * 1e9).astype(np.int64), shrunk=shrunk)
    keyframe, point, px = [], [], []
    for number, frame in enumerate(KEYFRAMES.tolist()):
        delay = np.zeros(len(points))
        for _ in range(5):
            seen = LENS.project(transform_points(invert(poses_at(times_s[frame] + delay)), points))
            delay = (np.clip(seen[:, 1] / 480.0, 0, 1) - 0.5) * READOUT_S
        inside = np.flatnonzero(((seen > 0) & (seen < (640, 480))).all(axis=1))
        keyframe.append(np.full(len(inside), number))
        point.append(inside)
        px.append(seen[inside] + rng.normal(0, NOISE_PX, (len(inside), 2)))
    k, pixels = np.concatenate(keyframe), np.concatenate(px)
    frame_of = KEYFRAMES[k]
    turn, shift = path.turn_and_shift(LENS, frame_of, pixels, READOUT_S)
    rate, change, velocity = (each[KEYFRAMES] for each in path.velocity_errors())
    seen_rows = RowObservations(
        lenses=[LENS],
        lens=np.zeros(len(KEYFRAMES), np.int64),
        keyframe=k,
        point=np.concatenate(point),
        px=pixels,
        delay_s=row_delay(LENS, pixels) * READOUT_S,
        turn=turn,
        shift=shift,
        noise_px=0.7,
        interval_s=np.full(len(KEYFRAMES), FRAME_S),
        readout=np.zeros(len(KEYFRAMES), np.int64),
        informative=np.ones(len(KEYFRAMES), bool),
        common_points=CommonPoints.of(k, np.concatenate(point)),
    )
    truth = RollingMap(
        cam_from_map=invert(poses_at(times_s[KEYFRAMES])),
        points=points,
        velocities=np.zeros((len(KEYFRAMES), 9)),
        readout_ratio=np.ones(1),
    )
    errors = MotionErrors(
        rate=3.0 * rate,
        rate_change=3.0 * change,
        velocity=velocity,
        readout_ratio=np.ones(1),
        readout=np.full(1, EXACT),
    )
    return seen_rows, truth, errors


def centre_error(found: RollingMap, truth: RollingMap) -> float:
    """Root mean square error of the keyframes' centres under the best similarity, map units."""
    here, there = (invert(each.cam_from_map)[:, :3, 3] for each in (found, truth))
    fit = align_points(here, there)
    return float(np.sqrt(((fit.apply(here) - there) ** 2).sum(axis=1).mean()))


def adjusted(seen: RowObservations, start: RollingMap, errors: MotionErrors) -> RollingMap:
    """Return the map after an adjustment with a wide loss, and one with the width of the usual residual."""
    found = adjust_with_velocities(seen, start, errors, 4.0 * seen.noise_px)
    return adjust_with_velocities(seen, found, errors, usual_residual_px(seen, found))


def test_derivatives_are_those_of_the_residuals() -> None:
    seen, truth, _ = scene()
    rng = np.random.default_rng(1)
    found = replace(truth, velocities=0.3 * rng.standard_normal(truth.velocities.shape))
    residual, valid = _residuals(seen, found)
    by_keyframe, by_point = _derivatives(seen, found, valid)
    nothing = np.zeros((len(found.points), 3))
    for axis in range(15):
        step = np.zeros((len(KEYFRAMES), 15))
        step[:, axis] = 1e-6
        change = (_residuals(seen, found.moved(step, nothing, np.zeros(1)))[0] - residual) / 1e-6
        assert change == pytest.approx(by_keyframe[:, :, axis], abs=0.02, rel=1e-3)
    for axis in range(3):
        step = nothing.copy()
        step[:, axis] = 1e-6
        moved = found.moved(np.zeros((len(KEYFRAMES), 15)), step, np.zeros(1))
        change = (_residuals(seen, moved)[0] - residual) / 1e-6
        assert change == pytest.approx(by_point[:, :, axis], abs=0.02, rel=1e-3)
    moved = found.moved(np.zeros((len(KEYFRAMES), 15)), nothing, np.full(1, 1e-6))
    change = (_residuals(seen, moved)[0] - residual) / 1e-6
    assert change == pytest.approx(by_keyframe[:, :, 15], abs=0.02, rel=1e-3)


def rate_errors(found: RollingMap) -> FloatArray:
    """Errors (K,) of the angular velocities of the keyframes with their corrections, rad/s."""
    times_s = np.arange(FRAMES) * FRAME_S
    path = PosePath.create(poses_at(times_s), np.round(times_s * 1e9).astype(np.int64))
    before, after = (poses_at(times_s[KEYFRAMES] + step)[:, :3, :3] for step in (-1e-4, 1e-4))
    true = so3_log(np.swapaxes(before, 1, 2) @ after) / 2e-4
    return np.asarray(np.linalg.norm(path.rotation.rate[KEYFRAMES] + found.velocities[:, :3] - true, axis=1))


def test_velocities_that_the_path_does_not_contain_are_found() -> None:
    seen, truth, errors = scene(shrunk=True)
    found = adjusted(seen, truth, errors)
    # The shake turns by 1.4 rad/s at most. The rows of 150 points determine it to some 0.1 rad/s.
    assert np.median(rate_errors(truth)) > 0.1
    assert np.median(rate_errors(found)) < 0.5 * np.median(rate_errors(truth))
    # Seen at one instant, the points lie where the true poses show them, but for the gauge.
    pose = truth.cam_from_map[seen.keyframe]
    in_cam = np.einsum("mij,mj->mi", pose[:, :3, :3], truth.points[seen.point]) + pose[:, :3, 3]
    off, corrected = (
        np.median(np.linalg.norm(LENS.project(in_cam) - px, axis=1))
        for px in (seen.px, px_at_mid_row(seen, found))
    )
    assert corrected < 0.5 * off


def with_readout_ratio(seen: RowObservations, ratio: float) -> RowObservations:
    """Return observations whose expected motion is that of another readout time."""
    parts = {name: ratio * getattr(seen, name) for name in ("delay_s", "turn", "shift")}
    return replace(seen, **parts)


@pytest.mark.parametrize("ratio", [0.8, 1.2])
def test_a_wrong_readout_time_is_corrected(ratio: float) -> None:
    seen, truth, errors = scene()
    wrong = with_readout_ratio(seen, ratio)
    loose = replace(errors, readout=np.full(1, 0.5))
    found = adjusted(wrong, truth, loose)
    off = float(found.readout_ratio[0]) * ratio - 1.0
    # The spline is some per cent too slow for a shake of 7 Hz at 30 frames/s.
    assert abs(off) < 0.05
    assert 0.02 < correction_ratios(wrong, found)[0] < 0.5


def test_the_error_of_a_readout_time_is_the_stated_one() -> None:
    seen, truth, errors = scene()
    some = seen.point < 100
    rows = {name: getattr(seen, name)[some] for name in ("keyframe", "point", "px", "delay_s")}
    common_points = CommonPoints.of(rows["keyframe"], rows["point"])
    seen = replace(seen, **rows, turn=seen.turn[some], shift=seen.shift[some], common_points=common_points)
    truth = replace(truth, points=truth.points[:100])
    times_s = KEYFRAMES[seen.keyframe] * FRAME_S
    moved = truth.cam_from_map[seen.keyframe] @ poses_at(times_s + seen.delay_s)
    exact = replace(seen, turn=so3_log(moved[:, :3, :3]), shift=moved[:, :3, 3], noise_px=NOISE_PX)
    # The path is exact, and the velocities are expected to be nearly so. Only noise is left.
    small = {name: 0.02 * getattr(errors, name) for name in ("rate", "rate_change", "velocity")}
    loose = replace(errors, readout=np.full(1, 0.5), **small)
    clean = seen.px + _residuals(exact, truth)[0]
    rng = np.random.default_rng(4)
    deviations = []
    for _ in range(12):
        noisy = replace(exact, px=clean + rng.normal(0, NOISE_PX, clean.shape))
        width_px = usual_residual_px(noisy, truth)
        found = adjust_with_velocities(noisy, truth, loose, width_px)
        deviations.append((found.readout_ratio[0] - 1.0) / readout_errors(noisy, found, loose, width_px)[0])
    # The mean of twelve squares with an expected value of 1 has a standard deviation of 0.4.
    assert 0.3 < float(np.mean(np.square(deviations))) < 2.0


def test_a_step_is_made_longer_while_the_cost_falls() -> None:
    seen, truth, errors = scene()
    system = _normal_equations(seen, truth, _prior(seen, errors), 1.0)

    def after_step(costs: list[float]) -> tuple[FloatArray, float]:
        each = iter(costs)
        moved, cost = _moved(truth, system, 1e-4, lambda _: next(each))
        assert moved is not None
        return moved.points - truth.points, cost

    single, _ = after_step([1.0, 2.0])
    longest, cost = after_step([5.0, 4.0, 3.0, 3.5])
    assert cost == 3.0
    assert longest == pytest.approx(2.25 * single)


def test_a_readout_time_that_is_known_otherwise_counts_as_an_observation() -> None:
    seen, truth, errors = scene()
    expected = replace(errors, readout_ratio=np.full(1, 1.2), readout=np.full(1, EXACT))
    width_px = usual_residual_px(seen, truth)
    found = adjust_with_velocities(seen, truth, expected, width_px)
    assert found.readout_ratio == pytest.approx(1.2, abs=1e-4)
    assert readout_errors(seen, found, expected, width_px) == pytest.approx(EXACT, rel=0.01)


def test_a_camera_that_does_not_move_determines_no_readout_time() -> None:
    seen, truth, errors = scene()
    still = with_readout_ratio(seen, 0.0)
    expected = replace(errors, readout=np.full(1, 0.3))
    assert readout_errors(still, truth, expected, 1.0) == pytest.approx(0.3)
    assert correction_ratios(still, truth) == [0.0]


def test_a_keyframe_that_does_not_determine_the_readout_time_does_not_depend_on_it() -> None:
    seen, truth, _ = scene()
    part = replace(seen, informative=np.arange(len(KEYFRAMES)) % 2 == 0)
    longer = replace(truth, readout_ratio=np.full(1, 1.1))
    changed = np.abs(_residuals(part, longer)[0] - _residuals(part, truth)[0]).max(axis=1) > 1e-9
    assert (changed == part.informative_observations).mean() > 0.99
    assert not changed[~part.informative[part.keyframe]].any()


def test_without_a_shutter_nothing_but_noise_is_adjusted() -> None:
    seen, truth, errors = scene()
    rng = np.random.default_rng(2)
    pose = truth.cam_from_map[seen.keyframe]
    in_cam = np.einsum("mij,mj->mi", pose[:, :3, :3], truth.points[seen.point]) + pose[:, :3, 3]
    nothing = np.zeros(len(seen.px))
    still = replace(
        seen,
        px=LENS.project(in_cam) + rng.normal(0, NOISE_PX, seen.px.shape),
        delay_s=nothing,
        turn=np.zeros_like(seen.turn),
        shift=np.zeros_like(seen.shift),
    )
    found = adjust_with_velocities(still, truth, errors, usual_residual_px(still, truth))
    assert np.abs(found.velocities).max() < 1e-9
    # 0.2 px at 400 px and 4 m is 2 mm; 150 points determine a keyframe to a fraction of it.
    assert centre_error(found, truth) < 0.002
    assert px_at_mid_row(still, found) == pytest.approx(still.px, abs=1e-6)


def test_the_errors_of_velocities_are_told_by_their_corrections() -> None:
    seen, truth, errors = scene(shrunk=True)
    found = adjusted(seen, truth, errors)
    noise = replace(seen, noise_px=NOISE_PX)
    squares, variances = velocity_squares(noise, found, errors)
    told = np.sqrt((squares + variances)[:, 0])
    true = rate_errors(truth) / np.sqrt(3.0)
    assert 0.5 < np.sqrt((told**2).mean() / (true**2).mean()) < 2.0


def test_a_point_behind_the_camera_keeps_its_pixel_and_moves_nothing() -> None:
    seen, truth, errors = scene()
    behind = replace(truth, points=truth.points.copy())
    lost = int(seen.point[0])
    behind.points[lost] = (0.0, 0.0, -50.0)
    found = adjust_with_velocities(seen, behind, errors, usual_residual_px(seen, behind))
    rows = seen.point == lost
    assert np.isfinite(found.cam_from_map).all()
    assert np.isfinite(found.points).all()
    assert (px_at_mid_row(seen, found)[rows] == seen.px[rows]).all()
