"""Poses of the pictures that are solved again with the sensor, also with the help of other cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.config.options import TelemetryOptions
from bodycap_batch.inertial import use_sensor
from bodycap_batch.model.geometry import Similarity, so3_exp
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.telemetry.streams import GYROSCOPE, saturated_stretches
from tests.inertial import Hand, Sensor, solved

SECONDS = 6.0
GAUGE = Similarity(2.7, so3_exp([0.4, -1.1, 0.3]), np.array([5.0, -3.0, 2.0]))


def errors_m(hand: Hand, path: Trajectory) -> np.ndarray:
    """Return the errors (N,) of all frames, metres; NaN for lost frames."""
    truth = GAUGE.apply_to_poses(hand.poses(path.seconds))
    return np.linalg.norm(path.gauge_from_cam[:, :3, 3] - truth[:, :3, 3], axis=1) / GAUGE.scale


def moved(path: Trajectory, frames: range, shift_m: float) -> Trajectory:
    poses = path.gauge_from_cam.copy()
    poses[frames.start : frames.stop, :3, 3] += GAUGE.scale * shift_m
    return replace(path, gauge_from_cam=poses)


def test_poses_come_nearer_to_the_truth_and_keep_status_and_covariance() -> None:
    hand = Hand(1)
    path = solved(hand, SECONDS, gauge_from_world=GAUGE)
    used = use_sensor(path, Sensor().samples(hand, SECONDS), TelemetryOptions())
    before_m, after_m = (np.sqrt(np.mean(errors_m(hand, each) ** 2)) for each in (path, used.trajectory))
    # The positions of 0.8 s have a common error of a fifth of the noise of one; the sensor adds to it.
    assert 0.1 * before_m < after_m < 0.6 * before_m
    assert used.camera.solved == len(path.status)
    assert used.camera.figures()["frames_solved_again"] == used.camera.solved
    assert used.trajectory.status == path.status
    assert (used.trajectory.covariance == path.covariance).all()


def test_poses_with_larger_errors_than_stated_are_solved_and_their_gaps_filled() -> None:
    """Where most poses contradict the sensor, their covariances are enlarged."""
    hand, lost = Hand(1), [*range(60, 66), *range(110, 116)]
    path = solved(hand, SECONDS, lost=lost, gauge_from_world=GAUGE)
    poses = path.gauge_from_cam.copy()
    poses[:, :3, 3] += np.random.default_rng(7).normal(0.0, 0.007 * GAUGE.scale, (len(poses), 3))
    path = replace(path, gauge_from_cam=poses)
    used = use_sensor(path, Sensor().samples(hand, SECONDS), TelemetryOptions())
    localised = path.localised
    before_m, after_m = (
        np.sqrt(np.mean(errors_m(hand, each)[localised] ** 2)) for each in (path, used.trajectory)
    )
    assert used.camera.solved == localised.sum()
    variance = [np.trace(each.covariance[:, 3:, 3:], axis1=1, axis2=2) for each in (path, used.trajectory)]
    assert np.median(variance[1][localised] / variance[0][localised]) > 1.5
    # 48 poses of a window determine nine unknowns; the vertical and the scale have errors, too.
    assert after_m < 0.6 * before_m
    assert used.camera.filled == len(lost)
    assert errors_m(hand, used.trajectory)[lost].max() < 2.5 * before_m


@pytest.mark.slow
def test_poses_that_contradict_the_sensor_are_replaced() -> None:
    hand, wrong = Hand(1), range(80, 84)
    path = moved(solved(hand, SECONDS, lost=[77, 78, 79], gauge_from_world=GAUGE), wrong, 0.2)
    used = use_sensor(path, Sensor().samples(hand, SECONDS), TelemetryOptions())
    assert {used.trajectory.status[frame] for frame in range(77, 84)} == {FrameStatus.INERTIAL}
    assert (used.camera.filled, used.camera.replaced) == (3, 4)
    assert errors_m(hand, used.trajectory).max() < 0.01
    kept = use_sensor(path, Sensor().samples(hand, SECONDS), TelemetryOptions(gaps=False)).trajectory
    assert kept.registered[list(wrong)].all()
    assert (kept.gauge_from_cam[list(wrong)] == path.gauge_from_cam[list(wrong)]).all()


def test_a_sensor_that_does_not_describe_the_motion_moves_nothing() -> None:
    hand = Hand(1)
    path = solved(hand, SECONDS, gauge_from_world=GAUGE)
    shaken = Sensor(force_noise=20.0).samples(hand, SECONDS)
    assert use_sensor(path, shaken, TelemetryOptions()).trajectory is path
    good = Sensor().samples(hand, SECONDS)
    assert use_sensor(path, good, TelemetryOptions(smoothing=False)).trajectory is path


@pytest.mark.slow
def test_a_camera_with_short_stretches_uses_the_vertical_and_the_scale_of_another() -> None:
    hand, other = Hand(1), Hand(4)
    lost = [frame for start in range(12, 170, 18) for frame in range(start, start + 6)]
    path = solved(hand, SECONDS, lost=lost, gauge_from_world=GAUGE)
    samples = Sensor().samples(hand, SECONDS)
    alone = use_sensor(path, samples, TelemetryOptions())
    assert alone.camera.filled == 0
    whole = solved(other, SECONDS, gauge_from_world=GAUGE, seed=5), Sensor().samples(other, SECONDS, 5)
    together = use_sensor(path, samples, TelemetryOptions(), [whole])
    assert together.camera.filled == len(lost)
    assert np.nanmax(errors_m(hand, together.trajectory)) < 0.02
    elsewhere = replace(whole[0], gauge="map-1"), whole[1]
    assert use_sensor(path, samples, TelemetryOptions(), [elsewhere]).camera.filled == 0


@pytest.mark.slow
def test_a_sensor_at_the_end_of_its_range_is_not_believed_there() -> None:
    hand = Hand(1, turn_rad=1.6)
    path = solved(hand, SECONDS, gauge_from_world=GAUGE)
    telemetry = Sensor().samples(hand, SECONDS)
    gyro = telemetry.streams[GYROSCOPE]
    range_rad_s = 0.8 * float(np.abs(gyro.values).max())
    values = np.clip(gyro.values, -range_rad_s, range_rad_s)
    gaps_s = saturated_stretches(GYROSCOPE, gyro.times_s, values)
    assert len(gaps_s) == 1
    found = []
    for gaps in ((), gaps_s):
        clipped = replace(gyro, values=values, gaps_s=gaps)
        streams = {**telemetry.streams, GYROSCOPE: clipped}
        used = use_sensor(path, replace(telemetry, streams=streams), TelemetryOptions())
        found.append((used.camera.solved, float(errors_m(hand, used.trajectory).max())))
    before_m = float(errors_m(hand, path).max())
    assert found[1][0] == len(path.status) > found[0][0]
    assert found[1][1] < 1.05 * before_m


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([0.0, 1.0, 5.0, 5.0, 5.0, 1.0], ((1.0, 5.0),)),  # a plateau at the largest value
        ([0.0, 1.0, 5.0, 4.0, 5.0, 1.0], ()),  # two peaks
        ([0.0, 2.0, 2.0, 2.0, 2.0, 1.0], ()),  # no sensor has such a small range
        ([5.0, -5.0, 0.0, 0.0, -5.0, -5.0], ((0.0, 2.0), (3.0, 5.0))),  # both ends of the range
    ],
)
def test_only_plateaus_at_the_largest_value_are_the_end_of_a_range(
    values: list[float], expected: tuple[tuple[float, float], ...]
) -> None:
    column = np.array(values)
    table = np.column_stack([column, np.zeros((6, 2))])
    assert saturated_stretches(GYROSCOPE, np.arange(6.0), table) == expected
    assert saturated_stretches("MAGN", np.arange(6.0), table) == ()
