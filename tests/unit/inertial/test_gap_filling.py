"""Poses of lost frames from the inertial sensor: errors, sigmas, refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from bodycap_batch.config.options import TelemetryOptions
from bodycap_batch.formats.dataclass_files import read_dataclass, write_dataclass
from bodycap_batch.inertial import use_sensor
from bodycap_batch.inertial.gap_solver import CONSTANTS, Constants, Stretch, solve_stretch
from bodycap_batch.inertial.preintegration import SensorNoise, preintegrate, steps_between
from bodycap_batch.inertial.samples import InertialSamples
from bodycap_batch.model.geometry import Similarity, rotation_angle_rad, so3_exp, so3_log
from bodycap_batch.model.inertial_camera import InertialCamera
from bodycap_batch.model.scene import FrameStatus
from tests.inertial import NOISE_M, Hand, Sensor, solved

SECONDS = 12.0
ONLY_GAPS = TelemetryOptions(smoothing=False)
GAUGE = Similarity(2.7, so3_exp([0.4, -1.1, 0.3]), np.array([5.0, -3.0, 2.0]))
EXACT = Sensor(
    turn_rad=(0, 0, 0), late_s=0.0, gyro_bias=(0, 0, 0), force_bias=(0, 0, 0), gyro_noise=0, force_noise=0
)


def _lost(gap_frames: int, first: int = 60, every: int = 70) -> list[int]:
    return [frame + start for start in range(first, 330 - gap_frames, every) for frame in range(gap_frames)]


@cache
def _filled(gap_frames):
    """Return the path of a hand with equal gaps, and what its sensor gives; no test changes them."""
    return _used(Hand(1), Sensor(), _lost(gap_frames))


def _used(hand, sensor, lost, options=ONLY_GAPS, seed=2):
    path = solved(hand, SECONDS, lost=lost, gauge_from_world=GAUGE, seed=seed)
    return path, use_sensor(path, sensor.samples(hand, SECONDS, seed), options)


def _errors(hand, found, frames, gauge=GAUGE):
    """Return position errors (N,3) (gauge units, axes of the camera) and rotation errors (N,3), radians."""
    truth = hand.poses(found.seconds)[frames]
    truth = truth if gauge is None else gauge.apply_to_poses(truth)
    mine_t = np.swapaxes(found.gauge_from_cam[frames][:, :3, :3], 1, 2)
    shift = np.einsum("nij,nj->ni", mine_t, truth[:, :3, 3] - found.gauge_from_cam[frames][:, :3, 3])
    return shift, so3_log(mine_t @ truth[:, :3, :3])


@pytest.mark.parametrize(("gap_frames", "most_m"), [(5, 0.006), (14, 0.01), (28, 0.025)])
def test_gaps_are_filled_near_the_truth_and_within_their_sigmas(gap_frames, most_m):
    hand, lost = Hand(1), _lost(gap_frames)
    path, used = _filled(gap_frames)
    found = used.trajectory
    assert used.camera.filled == len(lost)
    assert {found.status[frame] for frame in lost} == {FrameStatus.INERTIAL}
    assert not found.registered[lost].any()
    shift, turn = _errors(hand, found, lost)
    # The poses around a gap have a noise of 2 mm per axis.
    assert np.linalg.norm(shift, axis=1).max() / GAUGE.scale < most_m
    assert np.degrees(np.linalg.norm(turn, axis=1)).max() < 0.6
    covariance = found.covariance[lost]
    squared = np.einsum("ni,ni->n", shift, np.linalg.solve(covariance[:, 3:, 3:], shift[..., None])[..., 0])
    assert np.median(squared) < 2.0 * 2.37  # the median of χ² with three degrees of freedom
    sigma_m = np.sqrt(np.trace(covariance[:, 3:, 3:], axis1=1, axis2=2) / 3.0) / GAUGE.scale
    assert sigma_m.min() > 0.3 * NOISE_M
    assert sigma_m.max() < most_m
    kept = np.setdiff1d(np.arange(len(path.status)), lost)
    assert (found.gauge_from_cam[kept] == path.gauge_from_cam[kept]).all()


def test_a_spline_is_worse_by_far():
    from scipy.interpolate import CubicSpline

    hand, lost = Hand(1), _lost(28)
    path, used = _filled(28)
    kept = path.localised
    spline = CubicSpline(path.seconds[kept], path.gauge_from_cam[kept, :3, 3])(path.seconds[lost])
    truth = GAUGE.apply_to_poses(hand.poses(path.seconds))[lost, :3, 3]
    shift, _ = _errors(hand, used.trajectory, lost)
    assert np.linalg.norm(shift, axis=1).max() < 0.3 * np.linalg.norm(spline - truth, axis=1).max()


def test_long_gaps_and_the_ends_stay_lost():
    lost = [*range(100, 140), *range(200, 210), *range(3), *range(357, 360)]
    _, used = _used(Hand(1), Sensor(), lost)
    status = used.trajectory.status
    assert {status[frame] for frame in lost if not 200 <= frame < 210} == {FrameStatus.BLUR}
    assert {status[frame] for frame in range(200, 210)} == {FrameStatus.INERTIAL}


def test_two_poses_on_one_side_are_enough_but_one_is_not():
    hand, lost = Hand(1), [*range(340, 350), *range(352, 360)]
    _, used = _used(hand, Sensor(), lost)
    assert {used.trajectory.status[frame] for frame in range(340, 350)} == {FrameStatus.INERTIAL}
    shift, _ = _errors(hand, used.trajectory, list(range(340, 350)))
    assert np.linalg.norm(shift, axis=1).max() / GAUGE.scale < 0.02
    _, used = _used(hand, Sensor(), [*lost, 350])
    assert used.camera.filled == 0


def test_gaps_without_samples_stay_lost():
    hand, lost = Hand(1), _lost(10)
    path = solved(hand, SECONDS, lost=lost)
    telemetry = Sensor().samples(hand, SECONDS)
    streams = {}
    for key, stream in telemetry.streams.items():
        kept = (stream.times_s < 2.1) | (stream.times_s > 2.2)  # inside the first gap
        streams[key] = replace(
            stream, times_s=stream.times_s[kept], values=stream.values[kept], gaps_s=((2.1, 2.2),)
        )
    found = use_sensor(path, replace(telemetry, streams=streams), ONLY_GAPS).trajectory
    assert {found.status[frame] for frame in lost if frame < 100} == {FrameStatus.BLUR}
    assert {found.status[frame] for frame in lost if frame > 100} == {FrameStatus.INERTIAL}


def test_gaps_near_the_first_and_the_last_sample_are_filled():
    """The delay of a sensor leaves the first or the last frames of a clip without samples."""
    hand, lost = Hand(1), [*range(12, 22), *range(338, 348)]
    path = solved(hand, SECONDS, lost=lost)
    telemetry = Sensor().samples(hand, SECONDS)
    streams = {}
    for key, stream in telemetry.streams.items():
        kept = (stream.times_s > 0.05) & (stream.times_s < SECONDS - 0.05)
        streams[key] = replace(stream, times_s=stream.times_s[kept], values=stream.values[kept])
    found = use_sensor(path, replace(telemetry, streams=streams), ONLY_GAPS).trajectory
    assert {found.status[frame] for frame in lost} == {FrameStatus.INERTIAL}
    shift, _ = _errors(hand, found, lost, None)
    assert np.linalg.norm(shift, axis=1).max() < 0.01


@pytest.mark.slow
def test_wrong_poses_beside_a_gap_are_no_base_for_others():
    hand, lost = Hand(1), _lost(10)
    path = solved(hand, SECONDS, lost=lost)
    poses = path.gauge_from_cam.copy()
    poses[140:152, :3, 3] += 0.3  # most frames after the second gap
    used = use_sensor(replace(path, gauge_from_cam=poses), Sensor().samples(hand, SECONDS), ONLY_GAPS)
    assert {used.trajectory.status[frame] for frame in range(130, 140)} == {FrameStatus.BLUR}
    assert used.camera.refused == 10
    # The other gaps are filled: the wrong poses do not count as errors of the sensor.
    assert used.camera.filled == len(lost) - 10
    shift, _ = _errors(hand, used.trajectory, [frame for frame in lost if not 130 <= frame < 140], None)
    assert np.linalg.norm(shift, axis=1).max() < 0.01


@pytest.mark.parametrize("wrong", [slice(133, 134), slice(140, 146)])
@pytest.mark.slow
def test_a_few_wrong_poses_beside_a_gap_are_left_out(wrong):
    hand, lost = Hand(1), [*range(130, 133), *range(134, 140), *range(200, 210)]
    path = solved(hand, SECONDS, lost=lost)
    poses = path.gauge_from_cam.copy()
    poses[wrong, :3, 3] += 0.1  # between two gaps, or after both
    used = use_sensor(replace(path, gauge_from_cam=poses), Sensor().samples(hand, SECONDS), ONLY_GAPS)
    assert used.camera.filled == len(lost)
    shift, _ = _errors(hand, used.trajectory, lost, None)
    assert np.linalg.norm(shift, axis=1).max() < 0.01


def test_filling_is_switched_off_and_needs_an_accelerometer_that_agrees():
    hand, lost = Hand(1), _lost(10)
    path, used = _used(hand, Sensor(), lost, TelemetryOptions(gaps=False, smoothing=False))
    assert used.trajectory is path
    assert used.camera.windows is not None
    path, used = _used(hand, Sensor(), lost, TelemetryOptions(gravity=False, smoothing=False))
    assert used.camera.windows is None
    assert used.camera.filled == len(lost)
    telemetry = Sensor().samples(hand, SECONDS)
    without = replace(telemetry, streams={"GYRO": telemetry.streams["GYRO"]})
    assert use_sensor(path, without, ONLY_GAPS).trajectory is path
    noisy = Sensor(force_noise=20.0).samples(hand, SECONDS)
    refused = use_sensor(path, noisy, ONLY_GAPS).trajectory
    assert not refused.localised[lost].any()


def test_preintegration_follows_the_motion_and_its_derivatives_are_right():
    hand = Hand(2)
    streams = replace(EXACT, rate_hz=1000.0).samples(hand, 4.0).streams
    gyro, force = streams["GYRO"], streams["ACCL"]
    samples = InertialSamples(times_s=gyro.times_s, rate_rad_s=gyro.values, force_m_s2=force.values)
    nodes_s = np.array([1.0, 1.1, 1.35, 1.4])
    steps, noise, zero = steps_between(samples, nodes_s), SensorNoise(gyro=1e-3, force=1e-2), np.zeros(3)
    found = preintegrate(steps, zero, zero, noise)
    truth = hand.poses(nodes_s)
    turned = np.swapaxes(truth[:-1, :3, :3], 1, 2) @ truth[1:, :3, :3]
    assert np.degrees(rotation_angle_rad(np.swapaxes(found.rotation, 1, 2) @ turned)).max() < 0.01
    speed = (hand.poses(nodes_s + 1e-4) - hand.poses(nodes_s - 1e-4))[:, :3, 3] / 2e-4
    up = np.array([0.0, 0.0, 9.81])
    wide = found.seconds[:, None]
    moved = np.diff(truth[:, :3, 3], axis=0) - speed[:-1] * wide + 0.5 * up * wide**2
    moved = np.einsum("nji,nj->ni", truth[:-1, :3, :3], moved)
    assert found.position == pytest.approx(moved, abs=2e-4)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-4
        by_gyro = preintegrate(steps, step, zero, noise)
        by_force = preintegrate(steps, zero, step, noise)
        for changed, slopes in ((by_gyro, found.by_gyro_bias), (by_force, found.by_force_bias)):
            turn = so3_log(np.swapaxes(found.rotation, 1, 2) @ changed.rotation)
            measured = np.concatenate(
                [turn, changed.velocity - found.velocity, changed.position - found.position], axis=1
            )
            assert measured / 1e-4 == pytest.approx(slopes[:, :, axis], abs=2e-3)
    assert (np.linalg.eigvalsh(found.covariance) > 0.0).all()
    # White noise: the variance of the rotation is the density times the time.
    assert np.trace(found.covariance[:, :3, :3], axis1=1, axis2=2) == pytest.approx(3e-6 * found.seconds)


def test_the_derivatives_of_the_solver_lead_to_the_constants():
    """From a wrong start of all constants, the solver finds those that made the samples."""
    hand = Hand(3, turn_rad=1.0)
    sensor = replace(
        EXACT, gyro_bias=(0.01, -0.02, 0.015), force_bias=(0.1, -0.1, 0.05), lever_m=(0.02, 0.01, 0)
    )
    streams = sensor.samples(hand, 4.0).streams
    samples = InertialSamples(
        times_s=streams["GYRO"].times_s, rate_rad_s=streams["GYRO"].values, force_m_s2=streams["ACCL"].values
    )
    times_s = np.arange(0.5, 3.5, 1.0 / 30.0)
    known = np.ones(len(times_s), dtype=bool)
    known[40:60] = False
    mean = np.zeros(CONSTANTS)
    mean[8] = 9.6
    mean[9] = 0.05
    spread = np.repeat([0.05, 0.3, 0.5, 0.1, 0.05, 0.01, 0.05], [3, 3, 3, 1, 3, 1, 3])
    solution = solve_stretch(
        Stretch(
            times_s=times_s,
            gauge_from_cam=hand.poses(times_s),
            covariance=np.tile(np.eye(6) * 1e-8, (len(times_s), 1, 1)),
            known=known,
        ),
        samples,
        Constants(mean=mean, covariance=np.diag(spread**2)),
        SensorNoise(gyro=1e-4, force=1e-3),
    )
    wanted = np.zeros(CONSTANTS)
    wanted[:12] = [0.01, -0.02, 0.015, 0.1, -0.1, 0.05, 0.0, 0.0, 9.81, 0.0, 0.02, 0.01]
    tolerance = np.repeat([0.002, 0.03, 0.03, 0.01, 0.004, 0.001, 0.004], [3, 3, 3, 1, 3, 1, 3])
    assert (np.abs(solution.constants - wanted) < tolerance).all()
    off_m = (solution.gauge_from_cam - hand.poses(times_s))[~known, :3, 3]
    assert np.linalg.norm(off_m, axis=1).max() < 0.001


def test_what_a_sensor_gives_is_stored_and_read_back(tmp_path):
    _, used = _filled(14)
    write_dataclass(used.camera, tmp_path, "inertial")
    read = read_dataclass(InertialCamera, tmp_path, "inertial")
    assert read.figures() == used.camera.figures()
    assert read.windows is not None
    assert used.camera.windows is not None
    assert (read.windows.force == used.camera.windows.force).all()
    figures = json.loads(json.dumps(read.figures()))
    assert figures["delay_s"] == pytest.approx(0.008, abs=0.001)
    assert figures["frames_filled"] == read.filled > 0
    unknown = InertialCamera(camera="torso", gauge="map-0", source="GPMF", verdict="unknown", reason="dark")
    write_dataclass(unknown, tmp_path, "unknown")
    assert read_dataclass(InertialCamera, tmp_path, "unknown").figures() == unknown.figures()
