"""Telemetry of real cameras: the samples that GoPro publishes, and files of text beside rendered captures."""

import struct
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.capture import open_camera
from bodycap_batch.capture.frame_index import index_video
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.config.sample_files import samples_beside
from bodycap_batch.model.geometry import rotation_angle_rad, rotation_from_quat_xyzw
from bodycap_batch.telemetry import compare_picture_and_gyro, read_telemetry
from bodycap_batch.telemetry.gopro import gopro_telemetry, read_gpmf_payloads
from bodycap_batch.telemetry.picture_orientation import recorded_turns
from bodycap_batch.telemetry.picture_rotation import WORK_PX

pytestmark = pytest.mark.data


def _read(path: Path):
    video = index_video(path)
    return read_telemetry([video], video.times_ns(), samples_beside([path]))


def test_a_drone_clip_without_stabilisation(data_root):
    telemetry = _read(data_root / "gopro" / "karma.mp4")
    assert telemetry.model == "HERO5 Black"
    assert telemetry.notes == ()
    counts = {key: len(stream.times_s) for key, stream in telemetry.streams.items()}
    assert counts == {"ACCL": 2397, "GYRO": 4795, "ISOG": 361, "SHUT": 361}
    assert telemetry.gyro.rate_hz == pytest.approx(2 * telemetry.accelerometer.rate_hz, rel=0.002)
    # The drone flies level: the specific force is upwards, against the camera's y axis.
    mean = telemetry.accelerometer.values.mean(axis=0)
    assert np.linalg.norm(mean) == pytest.approx(9.8, abs=0.4)
    assert -mean[1] > 9.0


def test_a_walk_with_horizon_lock(data_root):
    telemetry = _read(data_root / "gopro" / "max-heromode.mp4")
    assert telemetry.model == "GoPro Max"
    assert (telemetry.lens_mode, telemetry.stabilisation) == ("Wide", "HS HLevel")
    counts = {key: len(stream.times_s) for key, stream in telemetry.streams.items()}
    assert {
        "GYRO": 2082,
        "ACCL": 2082,
        "CORI": 316,
        "IORI": 316,
        "GRAV": 316,
        "SHUT": 316,
    }.items() <= counts.items()
    assert telemetry.gyro.rate_hz == pytest.approx(197.45, abs=0.05)
    assert telemetry.gps.start_utc.startswith("2019-11-18T23:45:14")
    # Gravity and the mean specific force agree on the vertical.
    force = telemetry.accelerometer.values.mean(axis=0)
    up = telemetry.streams["GRAV"].values.mean(axis=0)
    cosine = force @ up / np.linalg.norm(force) / np.linalg.norm(up)
    assert cosine > np.cos(np.radians(5.0))


@pytest.mark.parametrize(
    ("name", "model", "streams", "gps"),
    [
        ("hero5", "", {"ACCL": 199, "GYRO": 399, "SHUT": 24}, 18),
        ("hero6", "Hero6 Black", {"ACCL": 204, "GYRO": 204, "SHUT": 30}, 17),
        ("hero7", "Hero7 Black", {"ACCL": 3369, "GYRO": 3369, "SHUT": 509, "SROT": 509}, 308),
        ("hero11", "HERO11 Black", {"ACCL": 2192, "GYRO": 2192, "CORI": 274, "IORI": 274, "GRAV": 274}, 110),
    ],
)
def test_raw_tracks_of_other_models(data_root, name, model, streams, gps):
    telemetry = _read_raw(data_root / "gopro" / f"{name}.raw")
    assert telemetry.model == model
    assert telemetry.axes_known
    assert telemetry.notes == ()
    assert streams.items() <= {key: len(each.times_s) for key, each in telemetry.streams.items()}.items()
    assert len(telemetry.gps.times_s) == gps
    # People walk: on the average, the specific force is that of gravity.
    assert np.linalg.norm(telemetry.accelerometer.values, axis=1).mean() == pytest.approx(9.8, abs=2.5)


def _read_raw(path: Path):
    data, track, offset = path.read_bytes(), [], 0
    while offset + 8 <= len(data):
        size, count = struct.unpack_from(">BH", data, offset + 5)
        end = offset + 8 + (size * count + 3) // 4 * 4
        track.append((data[offset:end], 1.001 * len(track), 1.001))
        offset = end
    return gopro_telemetry(read_gpmf_payloads(track), {}, "", 30000 / 1001)


@pytest.mark.parametrize("name", ["hero11.raw", "max-heromode.mp4"])
def test_recorded_orientations_have_the_same_axes_and_direction(data_root, name):
    path = data_root / "gopro" / name
    telemetry = _read_raw(path) if path.suffix == ".raw" else _read(path)
    times_s = telemetry.streams["IORI"].times_s
    turns, known = recorded_turns(telemetry, times_s)
    assert known.all()
    quat_wxyz = telemetry.streams["CORI"].values * [1.0, -1.0, -1.0, -1.0]
    camera = rotation_from_quat_xyzw(quat_wxyz[:, [1, 2, 3, 0]])

    def step_deg(rotations):
        steps = np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:]
        return np.degrees(rotation_angle_rad(steps)).mean()

    # Pictures turn less from frame to frame than their camera. Any other direction adds to its turns.
    assert step_deg(camera @ turns) < 0.6 * step_deg(camera)
    assert step_deg(camera @ np.swapaxes(turns, 1, 2)) > 1.5 * step_deg(camera)


def _compare(path: Path):
    config = CameraConfig(name=path.stem, video=(path,), calibration="auto")
    camera = open_camera(CaptureConfig(cameras=(config,), work_px=WORK_PX), config)
    return compare_picture_and_gyro(camera, _read(path))


def test_pictures_and_gyroscope_agree_on_the_clip_without_stabilisation(data_root):
    result = _compare(data_root / "gopro" / "karma.mp4")
    assert result.verdict == "agrees"
    assert result.best.r_squared > 0.98
    assert result.best.delay_s == pytest.approx(-0.016, abs=0.003)


def test_stabilisation_is_named_and_undone_on_the_clip_that_has_it(data_root):
    result = _compare(data_root / "gopro" / "max-heromode.mp4")
    assert result.verdict == "stabilised"
    assert result.best.r_squared > 0.95
    # The stated axes are right to the accuracy of the mounting.
    turned = np.degrees(np.linalg.norm(result.best.cam_from_sensor - np.eye(3)) / np.sqrt(2))
    assert turned < 3.0


@pytest.mark.parametrize(
    ("capture", "camera"),
    [("roll131", "torso"), ("roll131", "left_palm"), ("clocks05", "head"), ("clocks05", "right_palm")],
)
def test_delays_of_rendered_captures(data_root, capture, camera):
    # 8 ms; a rolling shutter of 12 ms and the path of the camera disturb it.
    result = _compare(data_root / capture / f"{camera}.mp4")
    assert result.verdict == "agrees"
    assert result.best.delay_s == pytest.approx(0.008, abs=0.003)


@pytest.mark.parametrize("capture", ["roll131", "clocks05"])
def test_files_beside_rendered_captures(data_root, capture):
    telemetry = _read(data_root / capture / "torso.mp4")
    assert telemetry.source == "imu.csv file"
    assert telemetry.gyro.rate_hz == pytest.approx(200.0, rel=0.01)
