"""Clocks: sidecars, chapters, offsets, the window, rolling shutter."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bodycap_batch.capture import CaptureCamera, open_camera, open_capture
from bodycap_batch.capture.sidecar_times import read_timestamps
from bodycap_batch.config.folder import natural_key
from bodycap_batch.config.job import load_job
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.model.camera_clock import ClockRelation
from bodycap_batch.model.rolling_shutter import row_delay
from tests.videos import textured_frame, write_video

FRAMES = [textured_frame(index) for index in range(12)]
FRAME_NS = 1e9 / 30


def opened(*videos: Path, camera: dict[str, object] | None = None, **capture: object) -> CaptureCamera:
    config = CameraConfig(name="torso", video=videos, calibration="auto", **(camera or {}))
    return open_camera(CaptureConfig(cameras=(config,), **capture), config)


def test_common_time_is_camera_time_plus_offset(tmp_path: Path) -> None:
    camera = opened(write_video(tmp_path / "a.mp4", FRAMES))
    assert camera.times_ns[0] == 0
    assert (camera.common_times_ns() == camera.times_ns).all()
    camera = replace(camera, clock=ClockRelation(offset_s=0.12, drift_ppm=100.0))
    shift_ns = camera.common_times_ns() - camera.times_ns
    np.testing.assert_allclose(shift_ns, 120_000_000 + 1e-4 * camera.times_ns, atol=1.0)


def test_rows_are_exposed_one_after_the_other(tmp_path: Path) -> None:
    camera = opened(
        write_video(tmp_path / "a.mp4", FRAMES), camera={"offset_s": 0.12, "rolling_shutter_s": 0.020}
    )
    delay_s = (
        row_delay(camera.camera, np.array([[5.0, 0.0], [5.0, 24.0], [5.0, 48.0]])) * camera.rolling_shutter_s
    )
    np.testing.assert_allclose(delay_s, [-0.01, 0.0, 0.01])


def test_a_turned_sensor_is_read_the_other_way(tmp_path: Path) -> None:
    rolling = {"rolling_shutter_s": 0.02}
    upside_down = opened(write_video(tmp_path / "a.mp4", FRAMES, rotation=180), camera=rolling)
    assert upside_down.rolling_shutter_s == -0.02
    assert (upside_down.camera.sideways, upside_down.may_be_sideways) == (False, False)


@pytest.mark.parametrize("rotation", [90, 270])
def test_a_quarter_turn_shows_the_sensors_rows_as_columns(tmp_path: Path, rotation: int) -> None:
    bars = np.zeros((12, 48, 64, 3), np.uint8)
    bars[:, :8] = 255  # the sensor's first rows
    path = write_video(tmp_path / "a.mp4", list(bars), rotation=rotation)
    camera = opened(path, camera={"rolling_shutter_s": 0.02})
    _, shown = next(camera.grey_frames())
    first, last = (4, 44) if shown[:, 4].mean() > shown[:, 44].mean() else (44, 4)
    delay_s = row_delay(camera.camera, np.array([[first, 5.0], [last, 5.0]])) * camera.rolling_shutter_s
    assert delay_s[0] < 0.0 < delay_s[1]
    assert (camera.camera.sideways, camera.may_be_sideways, camera.notes) == (True, True, ())
    # Not stated, the data tell which way it is read.
    free = opened(path)
    assert (free.camera.sideways, free.may_be_sideways, free.rolling_shutter_known) == (False, True, False)


def test_the_window_is_on_the_common_clock(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", FRAMES)
    camera = opened(path, camera={"offset_s": 10.0}, start_s=10.1, end_s=10.2)
    # Frames 3 (0.1 s) to 6 (0.2 s).
    assert camera.frame_numbers.tolist() == [3, 4, 5, 6]
    assert [index for index, _ in camera.grey_frames()] == [0, 1, 2, 3]
    with pytest.raises(CaptureError, match=r"runs from 10\.00 s to 10\.37 s"):
        opened(path, camera={"offset_s": 10.0}, start_s=0.1, end_s=0.2)


def test_a_sidecar_decides(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", FRAMES)
    start = 1305031102175304000
    times = start + np.cumsum(np.arange(12) % 3 + 1) * 11_000_001
    sidecar = tmp_path / "a.timestamps.txt"
    sidecar.write_text("# seconds\n\n" + "".join(f"{t // 10**9}.{t % 10**9:09d}\n" for t in times.tolist()))
    camera = opened(path, camera={"timestamps": (sidecar,)})
    # Unix time in nanoseconds survives exactly: a float64 of seconds would be 100 ns off.
    assert camera.times_ns.tolist() == times.tolist()


@pytest.mark.parametrize(
    ("lines", "message", "line"),
    [
        ("0.0\n0.1\nhalf\n", "is not a time", 3),
        ("0.0\n0.1\n0.1\n", "is not later than", 3),
        ("0.2\n0.1\n", "is not later than", 2),
        ("nan\n", "is not a time", 1),
        ("1e400\n", "is not a time", 1),
        ("0\n1\n2\n", "3 timestamps for 12 frames", None),
        ("", "0 timestamps for 12 frames", None),
    ],
)
def test_bad_sidecars_are_refused(tmp_path: Path, lines: str, message: str, line: int | None) -> None:
    path = write_video(tmp_path / "a.mp4", FRAMES)
    sidecar = tmp_path / "a.timestamps.txt"
    sidecar.write_text(lines)
    with pytest.raises(CaptureError, match=message) as caught:
        opened(path, camera={"timestamps": (sidecar,)})
    assert caught.value.path == str(sidecar)
    assert caught.value.line == line
    assert caught.value.hint


@given(st.binary(max_size=60) | st.text("0123456789.+-eE#\n naif", max_size=60).map(str.encode))
def test_any_sidecar_gives_times_or_a_typed_error(
    tmp_path_factory: pytest.TempPathFactory, data: bytes
) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzz.timestamps.txt"
    path.write_bytes(data)
    try:
        times = read_timestamps(path)
    except CaptureError:
        return
    assert all(before < after for before, after in pairwise(times))


def test_chapters_follow_one_another(tmp_path: Path) -> None:
    videos = [write_video(tmp_path / f"GX0{k}0123.MP4", FRAMES[:5]) for k in (1, 2, 3)]
    camera = opened(*videos)
    assert camera.notes == ()
    assert camera.frame_numbers.tolist() == list(range(15))
    assert np.abs(camera.times_ns - np.arange(15) * FRAME_NS).max() <= 1.0
    picked = dict(camera.read([4, 5, 12]))
    assert list(picked) == [4, 5, 12]
    assert np.array_equal(picked[5], dict(camera.read([0]))[0])


def test_a_gap_between_chapters_is_reported_and_kept(tmp_path: Path) -> None:
    first = write_video(tmp_path / "a1.mp4", FRAMES, metadata={"creation_time": "2026-03-01T10:00:00Z"})
    second = write_video(tmp_path / "a2.mp4", FRAMES, metadata={"creation_time": "2026-03-01T10:00:20Z"})
    camera = opened(first, second)
    assert camera.times_ns[12] == pytest.approx(20e9, abs=2)
    assert camera.notes == ("there is a gap of 19.60 s between a1.mp4 and a2.mp4",)


def test_the_same_creation_time_says_nothing(tmp_path: Path) -> None:
    stamp = {"creation_time": "2026-03-01T10:00:00Z"}
    camera = opened(*(write_video(tmp_path / f"a{k}.mp4", FRAMES, metadata=stamp) for k in (1, 2)))
    assert camera.notes == ()
    assert camera.times_ns[12] == pytest.approx(0.4e9, abs=2)


def test_frames_repeated_by_the_next_chapter_are_used_once(tmp_path: Path) -> None:
    videos = [write_video(tmp_path / f"a{k}.mp4", FRAMES[:6]) for k in (1, 2)]
    sidecars = (tmp_path / "a1.timestamps.txt", tmp_path / "a2.timestamps.txt")
    sidecars[0].write_text("".join(f"{k * 0.1:.3f}\n" for k in range(6)))
    sidecars[1].write_text("".join(f"{k * 0.1 + 0.35:.3f}\n" for k in range(6)))
    camera = opened(*videos, camera={"timestamps": sidecars})
    assert (np.diff(camera.times_ns) > 0).all()
    # 0.35 and 0.45 of the second chapter lie before the first one's last frame at 0.5 s.
    assert camera.frame_numbers.tolist() == [0, 1, 2, 3, 4, 5, 8, 9, 10, 11]
    assert "overlap" in camera.notes[-1]
    assert [index for index, _ in camera.grey_frames()] == list(range(10))


def test_chapters_of_two_sizes_are_refused(tmp_path: Path) -> None:
    first = write_video(tmp_path / "a1.mp4", FRAMES[:3])
    second = write_video(tmp_path / "a2.mp4", [textured_frame(0, 96, 48)] * 3)
    with pytest.raises(CaptureError, match="96×48"):
        opened(first, second)


def test_chapter_names_sort_the_way_cameras_count() -> None:
    names = [
        "GX020123.MP4",
        "GOPR0007.MP4",
        "clip10.mp4",
        "GX010124.MP4",
        "GP010007.MP4",
        "clip9.mp4",
        "GX010123.MP4",
    ]
    ordered = [path.name for path in sorted(map(Path, names), key=natural_key)]
    gopro = [name for name in ordered if name.startswith("G")]
    assert gopro == ["GOPR0007.MP4", "GP010007.MP4", "GX010123.MP4", "GX020123.MP4", "GX010124.MP4"]
    assert ordered.index("clip9.mp4") < ordered.index("clip10.mp4")


def test_a_camera_folder_of_chapters_and_its_sidecar(tmp_path: Path) -> None:
    for k in (2, 1):
        write_video(tmp_path / "torso" / f"GX0{k}0042.MP4", FRAMES[:4])
    (tmp_path / "torso.timestamps.txt").write_text("".join(f"{k / 20}\n" for k in range(8)))
    job = load_job(tmp_path)
    assert [path.name for path in job.capture.cameras[0].video] == ["GX010042.MP4", "GX020042.MP4"]
    camera = open_capture(job.capture).camera("torso")
    assert camera.times_ns.tolist() == [k * 50_000_000 for k in range(8)]
    with pytest.raises(KeyError):
        open_capture(job.capture).camera("head")
