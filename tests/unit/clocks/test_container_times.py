"""Times in containers: creation time and timecode as a first guess, and models of cameras."""

from __future__ import annotations

import pytest

from bodycap_batch.capture.frame_index import index_video
from bodycap_batch.clocks.container_times import (
    ContainerTime,
    expected_offset,
    read_container_time,
    timecode_seconds,
)
from bodycap_batch.clocks.reasons import duration_text
from bodycap_batch.clocks.sound_track import Recorder
from tests.gpmf import Sensor, item, nested, payloads, write_gopro
from tests.videos import textured_frame

DAY_S = 86_400.0


def start(created_s=None, timecode_s=None, first_frame_s=0.0, gps_s=None):
    return ContainerTime(
        first_frame_s=first_frame_s,
        created_s=created_s,
        timecode_s=timecode_s,
        frame_s=1 / 30,
        gps_s=gps_s,
    )


def test_gps_time_comes_before_clocks_that_were_set_by_hand():
    one = start(1000.0, 3600.0, first_frame_s=2.0, gps_s=50_000.0)
    found = expected_offset(one, start(5000.0, 7200.0, gps_s=50_003.5))
    assert found is not None
    assert found.offset_s == 5.5
    assert found.sigma_s < 1.0
    alone = expected_offset(one, start(1005.0))
    assert alone is not None
    assert alone.offset_s == 7.0


@pytest.mark.parametrize(("fix", "known"), [(3, True), (2, True), (0, False)])
def test_gps_time_of_the_first_frame(tmp_path, fix, known):
    gps = nested(
        "STRM",
        *(item("GPSF", "L", [fix]), item("GPSU", "c", "240131120000.250"), item("GPSP", "S", [150])),
        item("SCAL", "l", [10_000_000, 10_000_000, 1000, 1000, 100]),
        item("GPS5", "l", [[425000000, -87000000, 58512, 1200, 150]] * 10, 5),
    )
    frames = [textured_frame(index) for index in range(30)]
    path = write_gopro(tmp_path / "GX010001.MP4", frames, payloads(Sensor(), 3, extra=[gps]))
    found = read_container_time([index_video(path)], 0.0)
    if known:
        # The first fix is at the start of the file.
        assert found.gps_s == pytest.approx(1_706_702_400.25, abs=0.1)
    else:
        assert found.gps_s is None


def test_the_camera_that_started_later_has_the_larger_offset():
    found = expected_offset(start(1000.0), start(1005.0))
    assert found is not None
    assert found.offset_s == 5.0
    assert found.sigma_s >= 2.0
    assert not found.contradicts(-2.0)
    assert found.contradicts(50.0)


def test_the_time_of_the_first_frame_counts():
    found = expected_offset(start(1000.0, first_frame_s=7.0), start(1005.0, first_frame_s=1.0))
    assert found is not None
    assert found.offset_s == 11.0


def test_the_timecode_is_more_exact_where_it_agrees():
    both = expected_offset(start(1000.0, 3600.0), start(1005.0, 3604.5))
    assert both is not None
    assert both.offset_s == 4.5
    assert both.sigma_s < 2.1
    apart = expected_offset(start(1000.0, 3600.0), start(1005.0, 7200.0))
    assert apart is not None
    assert apart.offset_s == 5.0


def test_the_timecode_alone_passes_midnight():
    found = expected_offset(start(None, DAY_S - 2.0), start(None, 3.0))
    assert found is not None
    assert found.offset_s == pytest.approx(5.0)


def test_nothing_is_known_without_times():
    assert expected_offset(start(), start(1000.0)) is None


def test_dates_days_apart():
    found = expected_offset(start(0.0), start(3 * DAY_S))
    assert found is not None
    assert found.are_dates_apart()
    assert duration_text(found.offset_s) == "3.0 days"
    assert duration_text(-7200.0) == "2.0 hours"
    assert duration_text(12.34) == "12.3 s"


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("01:00:02:15", 3602.5), ("01:00:02;15", 3602.5), ("00:00:00:00", None), ("", None), ("noon", None)],
)
def test_timecodes(text, seconds):
    assert timecode_seconds(text, 30.0) == seconds


def test_cameras_are_alike_by_model_or_else_by_encoder():
    def recorder(model="", encoder=("mp4", "aac"), rate_hz=48_000):
        return Recorder(model=model, encoder=encoder, rate_hz=rate_hz)

    assert recorder("HD5").is_like(recorder("HD5", ("mp4", "pcm")))
    assert not recorder("HD5").is_like(recorder("H19"))
    assert recorder().is_like(recorder())
    assert not recorder().is_like(recorder(rate_hz=44_100))
    assert not recorder().is_like(recorder(encoder=("mov", "aac")))
    assert not recorder("HD5").is_like(recorder())
