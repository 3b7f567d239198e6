"""Files of text with inertial samples."""

import numpy as np
import pytest

from bodycap_batch.capture.frame_index import index_video
from bodycap_batch.check import check_path
from bodycap_batch.config.job import load_job_with_origins
from bodycap_batch.config.sample_files import samples_beside
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
        ("a.imu.csv", "", 1, "is empty"),
        ("a.imu.csv", "t,gx\n", 1, "names the columns"),
        ("a.imu.csv", HEADER, None, "fewer than two"),
        ("a.imu.csv", HEADER + "0,1,2,3,4,5,6\n1,2,3\n", 3, "7 numbers"),
        ("a.imu.csv", HEADER + "0,1,2,3,4,5,6\n1,2,3,x,4,5,6\n", 3, "7 numbers"),
        ("a.imu.csv", HEADER + "0,1,2,3,4,5,6\n\n0,1,2,3,4,5,6\n", 4, "not later"),
        ("a.imu.csv", HEADER + "0,1,2,3,4,5,6\n1,nan,2,3,4,5,6\n", 3, "plausible"),
        ("a.imu.csv", HEADER + "0,1,2,3,4,5,6\n1e300,1,2,3,4,5,6\n", 3, "plausible"),
        ("a.imu.csv", HEADER + "0,1,2,3,4,5,6\n1,1,2,3,4,5,6\n" + 3 * "text\n", 4, "3 of 5 lines"),
        ("a.gcsv", "", 1, "is empty"),
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


def _lines(count=100, step=0.005, first=0.0):
    return [f"{first + i * step:.6f},0.1,{0.01 * i:.4f},-0.3,0,-9.81,0.5" for i in range(count)]


@pytest.mark.parametrize(
    "line",
    [
        "0.25",
        "0.252,1,2",
        "0.252,1,2,x,4,5,6",
        "0.252,1,2,nan,4,5,6",
        "0.252,1,2,1e30,4,5,6",
        "0.245000,0.1,0.4900,-0.3,0,-9.81,0.5",
        "0.100,1,2,3,4,5,6",
        "99999,1,2,3,4,5,6",
        "-99999,1,2,3,4,5,6",
        "0.252,1,2,3,4,5,60.253,1,2,3,4,5,6",
    ],
)
@pytest.mark.parametrize("place", [0, 50, 100])
def test_a_wrong_line_costs_one_line(tmp_path, line, place):
    lines = _lines()
    lines.insert(place, line)
    path = tmp_path / "a.imu.csv"
    path.write_text(HEADER + "\n".join(lines))
    telemetry = read_imu_file(path)
    np.testing.assert_allclose(telemetry.gyro.times_s, np.arange(100) / 200, atol=1e-9)
    (note,) = telemetry.notes
    assert note.startswith(f"a.imu.csv: 1 line is not used: line {place + 2}, {line[:40]!r} ")


def test_comments_and_empty_lines_are_no_wrong_lines(tmp_path):
    path = tmp_path / "a.imu.csv"
    path.write_text("# a logger\n\n" + HEADER + "\n# a pause\n\n".join(_lines()))
    assert read_imu_file(path).notes == ()


def test_a_time_that_is_stated_twice_costs_the_second_line(tmp_path):
    path = tmp_path / "a.imu.csv"
    path.write_text(HEADER + "0,1,0,0,0,0,0\n1,2,0,0,0,0,0\n1,3,0,0,0,0,0\n2,4,0,0,0,0,0\n")
    assert read_imu_file(path).gyro.values[:, 0].tolist() == [1, 2, 4]


GYROFLOW = "GYROFLOW IMU LOG\nversion,1.3\nid,logger\norientation,XYZ\n"


@pytest.mark.parametrize(
    "text",
    [
        "GYROFLOW IMU LOG\nt,gx,gy,gz\n0,1,2,3\n5,1,2,3\n10,1,2,3\n",
        GYROFLOW + "tscale,0.001\nt,gx,gy,gz\n0,1,2,3\n5,1,2,3\n10,1,2,3\n",
        GYROFLOW + "TScale, 1e-6 \ntime,rx,ry,rz\n0,1,2,3\n5000,1,2,3\n10000,1,2,3\n",
        "\n  CAMERA IMU LOG\n  version:1.3\n  tscale:0.001\n  t,gx,gy,gz\n  0,1,2,3\n  5,1,2,3\n  10,1,2,3\n",
        "GYROFLOW IMU LOG;;;\ntscale;0,001;;\nt;gx;gy;gz\n0;1,0;2,0;3\n5,0;1;2;3\n10;1;2;3\n",
        "GYROFLOW IMU LOG,,,\ntscale,0.001,,\nt,gx,gy,gz,\n0,1,2,3,\n5,1,2,3,\n10,1,2,3,\n",
        '"GYROFLOW IMU LOG"\n"tscale","0.001"\n"t","gx","gy","gz"\n"0","1","2","3"\n5,1,2,3\n10,1,2,3\n',
        "GYROFLOW IMU LOG\nt\tgx\tgy\tgz\n0\t1\t2\t3\n5\t1\t2\t3\n10\t1\t2\t3\n",
        "GYROFLOW IMU LOG\nt,ax,ay,az,gz,gy,gx\n0,0,0,1,3,2,1\n5,0,0,1,3,2,1\n10,0,0,1,3,2,1\n",
        "GYROFLOW IMU LOG\nt,gx,gy,gz,ax,ay,az,mx,my,mz\n0,1,2,3,0,0,1,7,7,7\n5,1,2,3,0,0,1,7,7,7\n"
        "10,1,2,3,0,0,1,7,7,7\n",
    ],
)
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_gyroflow_files_of_different_writers(tmp_path, text, end, encoding):
    path = tmp_path / "torso.gcsv"
    path.write_bytes(text.replace("\n", end).encode(encoding))
    telemetry = read_imu_file(path)
    np.testing.assert_allclose(telemetry.gyro.times_s, [0, 0.005, 0.01])
    np.testing.assert_allclose(telemetry.gyro.values, [[1, 2, 3]] * 3)
    if telemetry.accelerometer is not None:
        np.testing.assert_allclose(telemetry.accelerometer.values, [[0, 0, 9.80665]] * 3)
    assert telemetry.notes == ()


@pytest.mark.parametrize("factor", [1.0, 1e3, 1e6, 1e9])
@pytest.mark.parametrize("rate_hz", [50, 200, 1600])
def test_times_in_another_unit_are_seen_from_the_duration_of_the_video(tmp_path, factor, rate_hz):
    path = tmp_path / "a.imu.csv"
    path.write_text(HEADER + "\n".join(_lines(10 * rate_hz, factor / rate_hz)))
    telemetry = read_imu_file(path, (0.0, 9.0))
    assert telemetry.gyro.rate_hz == pytest.approx(rate_hz, rel=1e-3)
    assert len(telemetry.notes) == (factor != 1.0)
    path.write_text(HEADER.replace("t_s", "t_ms") + "\n".join(_lines(10 * rate_hz, 1e3 / rate_hz)))
    assert read_imu_file(path, (0.0, 9.0)).notes == ()


def test_a_gyroflow_file_without_scale_may_have_seconds(tmp_path):
    path = tmp_path / "torso.gcsv"
    path.write_text("GYROFLOW IMU LOG\nt,gx,gy,gz\n" + "".join(f"{i / 200},1,2,3\n" for i in range(2000)))
    assert read_imu_file(path, (0.0, 9.0)).gyro.rate_hz == pytest.approx(200)


def test_a_longer_log_and_a_slow_sensor_keep_their_unit(tmp_path):
    path = tmp_path / "a.imu.csv"
    path.write_text(HEADER + "\n".join(_lines(20_000, 0.02)))
    assert read_imu_file(path, (0.0, 9.0)).gyro.rate_hz == pytest.approx(50)
    path.write_text(HEADER + "\n".join(_lines(50, 0.2)))
    assert read_imu_file(path, (0.0, 9.0)).gyro.rate_hz == pytest.approx(5)


def test_samples_of_another_time_are_refused(tmp_path):
    with pytest.raises(CaptureError, match="from 1000"):
        read_imu_file(_csv(tmp_path / "a.imu.csv", first=1000.0), (0.0, 9.0))


def test_the_files_beside_a_video_are_found_by_either_name(tmp_path):
    video = write_video(tmp_path / "GX010001.mp4", [textured_frame(i) for i in range(20)])
    assert samples_beside([video], "torso") is None
    by_camera = _csv(tmp_path / "torso.imu.csv")
    assert samples_beside([video], "torso") == by_camera
    assert samples_beside([video]) is None
    by_video = _csv(tmp_path / "GX010001.GCSV")
    assert samples_beside([video]) == by_video
    index = index_video(video)
    assert read_telemetry([index], index.times_ns(), by_camera).source == "imu.csv file"
    assert read_telemetry([index], index.times_ns()).source == "none"


@pytest.mark.parametrize("place", ["beside the link", "beside its target", "in the job"])
@pytest.mark.parametrize("kind", ["file", "folder"])
def test_samples_of_a_linked_video_are_used(tmp_path, place, kind):
    card, walk = tmp_path / "card", tmp_path / "walk"
    walk.mkdir()
    target = card / "GX010001.mp4" if kind == "file" else card / "clips"
    name = "torso.mp4" if kind == "file" else "torso"
    video = target if kind == "file" else target / "GX010001.mp4"
    video.parent.mkdir(parents=True)
    write_video(video, [textured_frame(i) for i in range(20)])
    (walk / name).symlink_to(target)
    where = {"beside the link": walk / "torso", "beside its target": target.with_suffix("")}
    path = where.get(place, card / "any").with_suffix(".gcsv")
    path.write_text("GYROFLOW IMU LOG\nt,gx,gy,gz\n" + "".join(f"{5 * i},1,2,3\n" for i in range(100)))
    if place == "in the job":
        (walk / "job.yaml").write_text(
            f"capture: {{cameras: [{{name: torso, video: {name}, samples: ../card/any.gcsv}}]}}"
        )
    loaded = load_job_with_origins(walk)
    assert loaded.job.capture.cameras[0].samples.samefile(path)
    assert f"inertial samples: {path.name} (from the " in "\n".join(loaded.origins["torso"].lines())
    assert loaded.unused_files() == ()
    assert "\n".join(check_path(walk).lines()).count("gcsv") == 1


def test_a_gap_is_listed(tmp_path):
    path = tmp_path / "a.imu.csv"
    times = [i / 100 for i in range(100)] + [2 + i / 100 for i in range(100)]
    path.write_text(HEADER + "".join(f"{t:.3f},0,0,0,0,0,0\n" for t in times))
    gyro = read_imu_file(path).gyro
    assert len(gyro.gaps_s) == 1
    assert gyro.gaps_s[0] == pytest.approx((0.99, 2.0))
    assert gyro.rate_hz == pytest.approx(100.0, rel=1e-6)
