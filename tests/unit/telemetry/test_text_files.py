"""Files of text with inertial samples."""

import numpy as np
import pytest

from bodycap_batch.capture.frame_index import index_video
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.telemetry import read_telemetry
from bodycap_batch.telemetry.text_files import read_imu_file
from tests.videos import textured_frame, write_video

HEADER = "t_s,gx,gy,gz,ax,ay,az\n"


def _csv(path, count=100, rate=200.0, first=0.0):
    lines = [f"{first + i / rate:.6f},0.1,{0.01 * i:.4f},-0.3,0,-9.81,0.5" for i in range(count)]
    path.write_text(HEADER + "\n".join(lines) + "\n")
    return path


def test_columns_units_and_rate(tmp_path):
    telemetry = read_imu_file(_csv(tmp_path / "torso.imu.csv", rate=201.5, first=0.008))
    assert telemetry.source == "imu.csv file"
    assert telemetry.axes_known
    assert telemetry.gyro.rate_hz == pytest.approx(201.5, rel=1e-4)
    assert telemetry.gyro.times_s[0] == pytest.approx(0.008)
    np.testing.assert_allclose(telemetry.accelerometer.values[3], [0, -9.81, 0.5])
    np.testing.assert_allclose(telemetry.gyro.values[3], [0.1, 0.03, -0.3])


def test_gyroflow_scales_and_axes(tmp_path):
    path = tmp_path / "torso.gcsv"
    path.write_text(
        "GYROFLOW IMU LOG\nversion,1.3\nid,logger\norientation,YxZ\nvendor,maker\ntscale,0.001\n"
        "gscale,0.01\nascale,0.5\nt,gx,gy,gz,ax,ay,az\n0,100,200,300,0,2,0\n5,100,200,300,0,2,0\n"
        "10,100,200,300,0,2,0\n"
    )
    telemetry = read_imu_file(path)
    assert telemetry.gyro.rate_hz == pytest.approx(200.0)
    # Axis 1 is the file's y, axis 2 its negative x.
    np.testing.assert_allclose(telemetry.gyro.values[0], [2.0, -1.0, 3.0])
    np.testing.assert_allclose(telemetry.accelerometer.values[0], [9.80665, 0.0, 0.0])
    assert telemetry.model == "maker logger"
    assert not telemetry.axes_known


@pytest.mark.parametrize(
    ("name", "content", "line", "words"),
    [
        ("a.imu.csv", "", 1, "does not name the columns"),
        ("a.imu.csv", "t,gx\n", 1, "does not name the columns"),
        ("a.imu.csv", HEADER, None, "fewer than two"),
        ("a.imu.csv", HEADER + "0,1,2,3,4,5,6\n1,2,3\n", 3, "7 numbers"),
        ("a.imu.csv", HEADER + "0,1,2,3,4,5,6\n1,2,3,x,4,5,6\n", 3, "7 numbers"),
        ("a.imu.csv", HEADER + "0,1,2,3,4,5,6\n\n0,1,2,3,4,5,6\n", 4, "not later"),
        ("a.imu.csv", HEADER + "0,1,2,3,4,5,6\n1,nan,2,3,4,5,6\n", 3, "plausible"),
        ("a.imu.csv", HEADER + "0,1,2,3,4,5,6\n1e300,1,2,3,4,5,6\n", 3, "plausible"),
        ("a.gcsv", "hello\n", 1, "does not start"),
        ("a.gcsv", "GYROFLOW IMU LOG\nversion,1.3\n", None, "names the columns"),
        ("a.gcsv", "GYROFLOW IMU LOG\ntscale,0\nt,gx,gy,gz\n0,1,2,3\n1,1,2,3\n", None, "tscale"),
        ("a.gcsv", "GYROFLOW IMU LOG\ngscale,x\nt,gx,gy,gz\n0,1,2,3\n1,1,2,3\n", None, "gscale"),
    ],
)
def test_faults_are_named_with_their_line(tmp_path, name, content, line, words):
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(CaptureError) as raised:
        read_imu_file(path)
    assert words in raised.value.message
    assert raised.value.line == line
    assert raised.value.hint


def test_a_file_beside_the_video_is_found_by_either_name(tmp_path):
    video = index_video(write_video(tmp_path / "GX010001.mp4", [textured_frame(i) for i in range(20)]))
    assert read_telemetry([video], video.times_ns(), "torso").source == "none"
    _csv(tmp_path / "torso.imu.csv")
    assert read_telemetry([video], video.times_ns(), "torso").source == "imu.csv file"
    assert read_telemetry([video], video.times_ns()).source == "none"
    _csv(tmp_path / "GX010001.imu.csv")
    assert read_telemetry([video], video.times_ns()).source == "imu.csv file"


def test_a_gap_is_listed(tmp_path):
    path = tmp_path / "a.imu.csv"
    times = [i / 100 for i in range(100)] + [2 + i / 100 for i in range(100)]
    path.write_text(HEADER + "".join(f"{t:.3f},0,0,0,0,0,0\n" for t in times))
    gyro = read_imu_file(path).gyro
    assert len(gyro.gaps_s) == 1
    assert gyro.gaps_s[0] == pytest.approx((0.99, 2.0))
    assert gyro.rate_hz == pytest.approx(100.0, rel=1e-6)
