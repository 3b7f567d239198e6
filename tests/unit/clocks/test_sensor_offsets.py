"""Offsets of clocks from inertial sensors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.clocks.sensor_offsets import measure_sensor_offset
from bodycap_batch.clocks.sensor_signals import SensorTrack, sensor_track
from bodycap_batch.telemetry.streams import ACCELEROMETER, GYROSCOPE, CameraTelemetry
from bodycap_batch.telemetry.text_files import read_imu_file
from tests.shaken import write_samples

TOLERANCE_S = 0.02
"""The standard deviation of an accepted offset is at least this."""


@pytest.fixture(scope="module")
def track(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sensors")

    def made(camera: str, body: int, start_s: float, seconds: float, own: float = 0.5) -> SensorTrack:
        path = write_samples(folder, camera, body=body, start_s=start_s, seconds=seconds, own=own)
        return sensor_track(camera, read_imu_file(path))

    return made


@pytest.mark.parametrize(("start_s", "seconds"), [(3.4, 12.0), (0.0, 20.0), (9.0, 10.0)])
def test_the_offset_of_two_cameras_on_a_body_is_found(track, start_s, seconds):
    torso, palm = track("torso", 5, 2.0, 15.0), track("left_palm", 5, start_s, seconds)
    found = measure_sensor_offset(torso, palm)
    assert found.accepted, found.reason
    # Time of the torso = time of the palm + the difference of their starts.
    assert found.offset_s == pytest.approx(start_s - 2.0, abs=TOLERANCE_S)
    assert TOLERANCE_S <= found.sigma_s < 0.04
    assert 0.0 < found.pivot_s < seconds
    turned = measure_sensor_offset(palm, torso)
    assert turned.offset_s == pytest.approx(-found.offset_s, abs=1e-4)


def test_cameras_of_one_model_have_a_smaller_sigma(track):
    torso, palm = (replace(track(name, 5, 0.0, 15.0), model="one") for name in ("torso", "left_palm"))
    unlike = measure_sensor_offset(torso, replace(palm, model="another"))
    assert measure_sensor_offset(torso, palm).sigma_s < unlike.sigma_s


@pytest.mark.parametrize("seed", range(8))
def test_unrelated_bodies_are_refused(track, seed):
    found = measure_sensor_offset(track("torso", 5, 0.0, 15.0), track("left_palm", 50 + seed, 0.0, 15.0))
    assert not found.accepted
    assert found.reason


def test_one_signal_alone_is_not_enough(track):
    torso, palm = track("torso", 5, 0.0, 12.0), track("left_palm", 5, 0.0, 12.0)
    other = track("right_palm", 70, 0.0, 12.0)
    assert measure_sensor_offset(torso, palm).accepted
    for part in ({"turn": other.turn}, {"vertical": other.vertical}):
        assert not measure_sensor_offset(torso, replace(palm, **part)).accepted


def test_a_motion_that_repeats_is_refused(track):
    torso = track("torso", 5, 0.0, 6.0)
    vertical, turn = np.tile(torso.vertical, 3), np.tile(torso.turn, 3)
    repeated = replace(torso, camera="left_palm", vertical=vertical, turn=turn)
    found = measure_sensor_offset(torso, repeated)
    assert not found.accepted
    assert "several offsets" in found.reason


def test_halves_that_contradict_each_other_are_refused(track):
    torso, palm = track("torso", 5, 0.0, 30.0), track("left_palm", 5, 0.0, 30.0)
    middle = len(palm.vertical) // 2
    # The clock of the palm's camera jumps by 0.15 s: a tenth of a second is missing in its video.
    cut = replace(
        palm,
        vertical=np.delete(palm.vertical, range(middle, middle + 15)),
        turn=np.delete(palm.turn, range(middle, middle + 15)),
    )
    assert measure_sensor_offset(torso, palm).accepted
    found = measure_sensor_offset(torso, cut)
    assert found.reason == "the two halves of the common time give different offsets"


def test_short_recordings_are_refused(track):
    short = track("left_palm", 5, 0.0, 3.0)
    assert short.problem == "the inertial samples last less than 4 s"
    part = replace(track("torso", 5, 0.0, 6.0), vertical=np.zeros(300), turn=np.zeros(300))
    assert "less than 4 s" in measure_sensor_offset(part, part).reason


def test_a_still_camera_is_refused(track):
    torso = track("torso", 5, 0.0, 10.0)
    still = replace(torso, camera="tripod", vertical=np.full(1000, 9.81), turn=np.zeros(1000))
    assert not measure_sensor_offset(torso, still).accepted


def test_what_a_camera_lacks_is_named(tmp_path):
    path = write_samples(tmp_path, "torso", body=5, start_s=0.0, seconds=8.0)
    whole = read_imu_file(path)

    def problem(telemetry: CameraTelemetry) -> str:
        return sensor_track("torso", telemetry).problem

    streams = dict(whole.streams)
    assert problem(CameraTelemetry()) == "there are no samples of an accelerometer"
    assert "a gyroscope" in problem(replace(whole, streams={ACCELEROMETER: streams[ACCELEROMETER]}))
    assert "axes" in problem(replace(whole, axes_known=False))
    lost = replace(streams[GYROSCOPE], gaps_s=((1.0, 4.0),))
    assert problem(replace(whole, streams={**streams, GYROSCOPE: lost})).startswith("3.0 s of the inertial")
    assert problem(whole) == ""
