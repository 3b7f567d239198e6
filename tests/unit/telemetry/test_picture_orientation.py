"""Stabilised pictures: drawn records, poses that are turned back, and sensors that contradict a record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.config.options import TelemetryOptions
from bodycap_batch.formats.mp4_writer import DataTrack
from bodycap_batch.inertial import use_sensor
from bodycap_batch.model.geometry import quat_xyzw_from_rotation, rotation_angle_rad
from bodycap_batch.model.picture_turns import PictureTurns
from bodycap_batch.synthetic.stabilisation import orientation_track, turn_of_pictures
from bodycap_batch.telemetry.gopro import gopro_telemetry, read_gpmf_payloads
from bodycap_batch.telemetry.picture_orientation import (
    UNRECORDED_SIGMA_RAD,
    recorded_turns,
    turns_of_pictures,
)
from bodycap_batch.telemetry.streams import GYROSCOPE, IMAGE_ORIENTATION, CameraTelemetry
from tests.inertial import NOISE_RAD, Hand, Sensor, solved

SECONDS = 8.0
OFF = TelemetryOptions(gravity=False, smoothing=False, gaps=False, gps=False)
MAX_ROUNDING_RAD = 6e-5
"""The values of a quaternion are rounded to 1/32767, so each is wrong by 1.5e-5 at most: 2 · √3 · 1.5e-5."""


def _stabilised(hand: Hand):
    """Return the true path of a camera, the turns of its pictures, and the path of the pictures."""
    path = solved(hand, SECONDS)
    turns = turn_of_pictures(hand.poses, path.seconds)
    exact = PictureTurns(mode="", cam_from_picture=turns, sigma_rad=np.zeros(len(turns)))
    return path, turns, exact.picture_path(path)


def _telemetry(track: DataTrack) -> CameraTelemetry:
    return gopro_telemetry(read_gpmf_payloads(track.payloads), {"EISE": "Y"}, "", 30.0)


def test_drawn_turns_smooth_the_pictures_within_the_crop():
    hand = Hand(1)
    path, turns, pictures = _stabilised(hand)
    angle = np.degrees(rotation_angle_rad(turns))
    assert 2.0 < np.sqrt((angle**2).mean()) < angle.max() < 6.0
    steps = [
        rotation_angle_rad(
            np.swapaxes(each.gauge_from_cam[:-1, :3, :3], 1, 2) @ each.gauge_from_cam[1:, :3, :3]
        )
        for each in (path, pictures)
    ]
    assert np.median(steps[1]) < np.median(steps[0])
    np.testing.assert_allclose(pictures.gauge_from_cam[:, :3, 3], path.gauge_from_cam[:, :3, 3], atol=1e-12)


def test_a_drawn_record_turns_the_poses_back_exactly():
    hand = Hand(2)
    path, turns, pictures = _stabilised(hand)
    telemetry = _telemetry(orientation_track(path.times_ns, hand.poses(path.seconds), turns))
    found = turns_of_pictures(telemetry, path.seconds)
    assert found is not None
    assert found.recorded.all()
    back = found.camera_path(pictures)
    error = np.swapaxes(back.gauge_from_cam[:, :3, :3], 1, 2) @ path.gauge_from_cam[:, :3, :3]
    assert rotation_angle_rad(error).max() < MAX_ROUNDING_RAD
    np.testing.assert_allclose(back.gauge_from_cam[:, :3, 3], path.gauge_from_cam[:, :3, 3], atol=1e-12)
    np.testing.assert_allclose(back.covariance, path.covariance, atol=1e-9)
    again = found.picture_path(back)
    np.testing.assert_allclose(again.gauge_from_cam, pictures.gauge_from_cam, atol=1e-12)
    # The record of the camera's own orientation has the same axes: both together turn as the pictures do.
    quat = telemetry.streams["CORI"].values[:, [1, 2, 3, 0]] * [-1, -1, -1, 1]
    true = quat_xyzw_from_rotation(
        hand.poses(path.seconds[:1])[0, :3, :3].T @ hand.poses(path.seconds)[:, :3, :3]
    )
    cosine = np.abs((quat * true).sum(axis=1)) / np.linalg.norm(quat, axis=1)
    assert 2.0 * np.arccos(np.minimum(cosine, 1.0)).max() < 2.0 * MAX_ROUNDING_RAD


def test_frames_without_a_record_keep_their_pose_and_get_a_sigma():
    path, turns, pictures = _stabilised(Hand(3))
    half = len(turns) // 2
    telemetry = _telemetry(orientation_track(path.times_ns[:half], path.gauge_from_cam[:half], turns[:half]))
    found = turns_of_pictures(telemetry, path.seconds)
    assert found is not None
    assert found.recorded.sum() == half
    back = found.camera_path(pictures)
    np.testing.assert_array_equal(back.gauge_from_cam[half:], pictures.gauge_from_cam[half:])
    sigma = np.sqrt(back.covariance[half:, 0, 0])
    np.testing.assert_allclose(sigma, np.hypot(UNRECORDED_SIGMA_RAD, NOISE_RAD), rtol=1e-9)
    np.testing.assert_allclose(found.picture_path(back).covariance, pictures.covariance, atol=1e-12)
    assert f"of {len(turns) - half} of {len(turns)} frames" in found.says()


def test_no_stabilisation_no_turns():
    times_s = np.arange(10) / 30.0
    assert turns_of_pictures(CameraTelemetry(), times_s) is None
    assert turns_of_pictures(CameraTelemetry(stabilisation="off"), times_s) is None
    turns, known = recorded_turns(CameraTelemetry(), times_s)
    assert not known.any()
    np.testing.assert_array_equal(turns, np.tile(np.eye(3), (10, 1, 1)))


@pytest.mark.parametrize("stabilised", [True, False])
def test_what_the_job_states_counts(stabilised):
    times_s = np.arange(10) / 30.0
    stated = CameraTelemetry(stabilisation="off" if stabilised else "HS High").with_statement(
        stabilised=stabilised
    )
    found = turns_of_pictures(stated, times_s)
    assert (found is not None) == stabilised
    assert CameraTelemetry(stabilisation="HS High").with_statement(stabilised=None).is_stabilised


def _recorded_sensor(hand: Hand, turns, path) -> CameraTelemetry:
    """Return the telemetry of a stabilised camera: a gyroscope, an accelerometer and the record."""
    sensor = Sensor().samples(hand, SECONDS)
    record = _telemetry(orientation_track(path.times_ns, hand.poses(path.seconds), turns))
    return replace(sensor, stabilisation="HS High", streams={**sensor.streams, **record.streams})


def test_a_sensor_is_used_with_poses_that_are_turned_back():
    hand = Hand(1)
    path, turns, pictures = _stabilised(hand)
    telemetry = _recorded_sensor(hand, turns, path)
    used = use_sensor(pictures, telemetry, OFF)
    assert used.camera.verdict == "agrees"
    assert used.camera.turns is not None
    assert used.camera.turns.recorded.all()
    assert used.trajectory is pictures
    relation, plain = (
        used.camera.relation,
        use_sensor(path, Sensor().samples(hand, SECONDS), OFF).camera.relation,
    )
    assert relation is not None
    assert plain is not None
    assert relation.delay_s == pytest.approx(plain.delay_s, abs=1e-4)
    solved_again = use_sensor(pictures, telemetry, TelemetryOptions())
    assert solved_again.camera.solved > 0
    error = np.linalg.norm(
        solved_again.trajectory.gauge_from_cam[:, :3, 3] - hand.poses(path.seconds)[:, :3, 3], axis=1
    )
    # The noise of the poses is 2 mm per axis; the sensor reduces it.
    assert np.sqrt((error**2).mean()) < 0.002 * np.sqrt(3.0)
    true = hand.poses(path.seconds)[:, :3, :3] @ turns
    off = np.swapaxes(solved_again.trajectory.gauge_from_cam[:, :3, :3], 1, 2) @ true
    assert np.degrees(np.median(rotation_angle_rad(off))) < 0.15 * np.sqrt(3.0)


def test_a_record_that_the_sensor_contradicts_is_not_used():
    hand = Hand(1)
    path, turns, pictures = _stabilised(hand)
    telemetry = _recorded_sensor(hand, turns[::-1], path)
    used = use_sensor(pictures, telemetry, OFF)
    assert used.camera.turns is not None
    assert not used.camera.turns.recorded.any()
    assert "without a record" in used.camera.turns.says()


def test_a_sensor_shows_stabilisation_that_nothing_states():
    hand = Hand(1)
    telemetry = Sensor().samples(hand, SECONDS)
    still = solved(Hand(1, turn_rad=0.05), SECONDS)
    found = use_sensor(still, telemetry, OFF).camera
    assert found.verdict == "stabilised"
    assert found.turns is not None
    assert not found.turns.recorded.any()
    assert use_sensor(solved(hand, SECONDS), telemetry, OFF).camera.turns is None
    # Fast movements hide turns of some degrees from the comparison, but not from the settings.
    _, _, pictures = _stabilised(hand)
    hidden = use_sensor(pictures, replace(telemetry, stabilisation="HS High"), OFF).camera
    assert hidden.verdict == "stabilised"
    assert hidden.relation is None
    assert hidden.turns is not None
    without = {key: stream for key, stream in telemetry.streams.items() if key != GYROSCOPE}
    assert IMAGE_ORIENTATION not in without
    stated = use_sensor(still, replace(telemetry, streams=without, stabilisation="HS High"), OFF).camera
    assert stated.turns is not None
