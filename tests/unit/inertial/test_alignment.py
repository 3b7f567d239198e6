"""Delay, rotation, bias and rate of a sensor, from the solved poses of its camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.inertial import align_sensor
from bodycap_batch.inertial.samples import pinned_orientations
from bodycap_batch.model.geometry import Similarity, rotation_angle_rad, so3_exp
from bodycap_batch.model.gyro_rates import GyroOrientation
from bodycap_batch.telemetry.streams import GYROSCOPE, CameraTelemetry
from tests.inertial import Hand, Sensor, solved

SECONDS = 8.0
GAUGE = Similarity(2.7, so3_exp([0.4, -1.1, 0.3]), np.array([5.0, -3.0, 2.0]))


@pytest.mark.parametrize("seed", range(4))
def test_the_relation_is_found_within_its_sigmas(seed):
    hand, sensor = Hand(seed), Sensor()
    aligned = align_sensor(
        solved(hand, SECONDS, gauge_from_world=GAUGE, seed=seed), sensor.samples(hand, SECONDS)
    )
    fit = aligned.fit
    assert fit is not None
    # 240 rotations with a noise of 0.2° each: delay and rotation are known to 0.3 ms and 0.2°.
    assert abs(fit.delay_s - sensor.late_s) < max(4.0 * fit.delay_sigma_s, 2e-4)
    assert fit.delay_sigma_s < 1e-3
    turned = rotation_angle_rad(fit.cam_from_sensor @ so3_exp(sensor.turn_rad).T)
    assert turned < max(4.0 * np.linalg.norm(fit.rotation_sigma_rad), np.radians(0.1))
    assert np.degrees(np.linalg.norm(fit.rotation_sigma_rad)) < 0.6
    off = np.abs(fit.bias_rad_s - sensor.gyro_bias)
    # A rotation error of 0.2° over each of seven seconds: 0.0013 rad/s.
    assert (off < np.maximum(4.0 * fit.bias_sigma_rad_s, 0.001)).all()
    assert fit.bias_sigma_rad_s.max() < 0.005
    assert abs(fit.focal_ratio - 1.0) < 0.004


def test_the_samples_are_in_the_axes_and_on_the_clock_of_the_camera():
    hand = Hand(1)
    sensor = Sensor(gyro_noise=0.0, force_noise=0.0)
    samples = align_sensor(solved(hand, SECONDS), sensor.samples(hand, SECONDS)).samples
    assert samples is not None
    perfect = Sensor(
        turn_rad=(0, 0, 0), late_s=0.0, gyro_bias=(0, 0, 0), force_bias=(0, 0, 0), gyro_noise=0, force_noise=0
    )
    truth = perfect.samples(hand, SECONDS)
    inside = slice(150, 1500)
    for axis in range(3):
        true = np.interp(samples.times_s, truth.gyro.times_s, truth.gyro.values[:, axis])
        assert np.abs(samples.rate_rad_s[inside, axis] - true[inside]).max() < 0.04


def test_a_sensor_of_another_recording_is_not_used():
    aligned = align_sensor(solved(Hand(1), SECONDS), Sensor().samples(Hand(2), SECONDS))
    assert aligned.comparison.verdict == "unknown"
    assert aligned.samples is None
    assert aligned.fit is None


def test_a_stabilised_video_is_named():
    telemetry = Sensor().samples(Hand(1), SECONDS)
    still = solved(Hand(1, turn_rad=0.05), SECONDS)
    aligned = align_sensor(still, telemetry)
    assert aligned.comparison.verdict == "stabilised"
    assert "the camera stabilised the video" in aligned.comparison.reason
    assert aligned.samples is None


def test_without_a_gyroscope_nothing_is_estimated():
    telemetry = Sensor().samples(Hand(1), SECONDS)
    without = replace(telemetry, streams={k: v for k, v in telemetry.streams.items() if k != GYROSCOPE})
    for each in (without, CameraTelemetry()):
        aligned = align_sensor(solved(Hand(1), SECONDS), each)
        assert aligned.comparison.reason == "the camera recorded no gyroscope"
        assert aligned.fit is None


def test_too_few_poses_give_no_relation():
    lost = [frame for frame in range(240) if frame > 18]
    aligned = align_sensor(solved(Hand(1), SECONDS, lost=lost), Sensor().samples(Hand(1), SECONDS))
    assert aligned.comparison.verdict == "unknown"
    assert aligned.fit is None


def test_orientations_follow_the_gyroscope_between_the_frames():
    hand, times_s = Hand(3), np.arange(0.0, 4.0, 0.005)
    truth = hand.poses(times_s)[:, :3, :3]
    rate = (
        Sensor(turn_rad=(0, 0, 0), late_s=0.0, gyro_bias=(0, 0, 0), gyro_noise=0.0)
        .samples(hand, 4.0)
        .streams[GYROSCOPE]
    )
    oriented = GyroOrientation(rate.times_s, rate.values)
    frame_s = np.concatenate([np.arange(0.0, 1.0, 0.1), np.arange(2.0, 4.0, 0.1)])
    found = pinned_orientations(oriented, frame_s, hand.poses(frame_s)[:, :3, :3], times_s)
    off = np.degrees(rotation_angle_rad(np.swapaxes(found, 1, 2) @ truth))
    assert off[times_s < 3.9].max() < 0.05
