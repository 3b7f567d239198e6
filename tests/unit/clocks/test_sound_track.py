"""Reading a camera's sound: the time of its samples on the camera's clock, gaps, chapters, damage."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.capture.frame_index import index_video
from bodycap_batch.capture.timeline import join_chapters
from bodycap_batch.clocks.sound_track import RATE_HZ, read_sound_file, read_sound_track
from tests.sounds import burst, burst_time, wind_noise, write_video_with_sound

TOLERANCE_S = 0.0015
"""AAC smears a burst by some samples before its start."""


def read(*paths, sidecars=()):
    videos = tuple(index_video(path) for path in paths)
    return read_sound_track("torso", videos, join_chapters(videos, tuple(sidecars)).times_ns)


FORMATS = [(48_000, "mono"), (44_100, "stereo"), (48_000, "5.1"), (8_000, "mono"), (96_000, "mono")]


@pytest.mark.parametrize(("rate_hz", "layout"), FORMATS)
def test_the_time_of_a_burst_survives_rate_and_channels(tmp_path, rate_hz, layout):
    channels = {"mono": 1, "stereo": 2, "5.1": 6}[layout]
    samples = np.tile(burst(1.5, 0.8, rate_hz), (channels, 1))
    found = read(write_video_with_sound(tmp_path / "a.mp4", samples, rate_hz, layout=layout))
    assert not found.problem
    assert found.start_s == pytest.approx(0.0, abs=1e-4)  # the priming of the encoder is no sound
    assert burst_time(found) == pytest.approx(0.8, abs=TOLERANCE_S)
    assert found.top_hz == min(rate_hz, RATE_HZ) / 2


def test_an_edit_list_moves_the_sound(tmp_path):
    path = write_video_with_sound(tmp_path / "a.mp4", burst(1.5, 0.8, 48_000), 48_000)
    data = bytearray(path.read_bytes())
    # The entry of the sound: its media time is the priming of 1024 samples.
    at = data.index((1024).to_bytes(4, "big"), data.rindex(b"elst"))
    data[at : at + 4] = (2112).to_bytes(4, "big")
    path.write_bytes(data)
    assert burst_time(read(path)) == pytest.approx(0.8 - (2112 - 1024) / 48_000, abs=TOLERANCE_S)


def test_sound_that_starts_later_than_the_picture(tmp_path):
    found = read(write_video_with_sound(tmp_path / "a.mp4", burst(1.5, 0.8), sound_start_s=0.5, seconds=2.0))
    assert 0.4 < found.start_s < 0.502  # some encoders keep the priming before late sound
    assert burst_time(found) == pytest.approx(1.3, abs=TOLERANCE_S)


def test_a_variable_frame_rate_does_not_move_the_sound(tmp_path):
    frames = np.cumsum([0, *np.random.default_rng(1).integers(30, 250, 12)]).tolist()
    found = read(write_video_with_sound(tmp_path / "a.mp4", burst(2.0, 1.5), frame_times=frames))
    assert len(found.pieces) == 1
    assert burst_time(found) == pytest.approx(1.5, abs=TOLERANCE_S)


def test_a_gap_keeps_the_times_behind_it(tmp_path):
    path = write_video_with_sound(tmp_path / "a.mkv", burst(2.0, 1.5), gap=(1.0, 0.4), seconds=2.4)
    found = read(path)
    assert len(found.pieces) == 2
    assert burst_time(found) == pytest.approx(1.9, abs=0.003)  # Matroska rounds to 1 ms
    assert "1 gap" in found.notes[0]


def test_chapters_share_one_clock(tmp_path):
    first = write_video_with_sound(tmp_path / "a1.mp4", np.zeros(16_000, np.float32))
    second = write_video_with_sound(tmp_path / "a2.mp4", burst(1.0, 0.4))
    assert burst_time(read(first, second)) == pytest.approx(1.4, abs=TOLERANCE_S)


def test_a_sidecar_file_moves_the_sound(tmp_path):
    path = write_video_with_sound(tmp_path / "a.mp4", burst(2.0, 1.5))
    sidecar = tmp_path / "a.txt"
    sidecar.write_text("\n".join(f"{100 + 1.001 * 0.1 * index:.6f}" for index in range(20)))
    assert burst_time(read(path, sidecars=[sidecar])) == pytest.approx(100 + 1.5 * 1.001, abs=TOLERANCE_S)


def test_a_sidecar_file_with_pauses_keeps_the_start(tmp_path):
    path = write_video_with_sound(tmp_path / "a.mp4", burst(2.0, 1.5))
    sidecar = tmp_path / "a.txt"
    sidecar.write_text("\n".join(f"{7 + 0.1 * index + (3 if index > 4 else 0):.6f}" for index in range(20)))
    assert burst_time(read(path, sidecars=[sidecar])) == pytest.approx(8.5, abs=TOLERANCE_S)


def test_no_sound_and_silence_have_a_reason(tmp_path):
    assert "no sound" in read(write_video_with_sound(tmp_path / "a.mp4", None)).problem
    assert "silent" in read(write_video_with_sound(tmp_path / "b.mp4", np.zeros(16_000, np.float32))).problem


def test_damaged_packets_are_skipped(tmp_path):
    path = write_video_with_sound(tmp_path / "a.mp4", burst(4.0, 3.5))
    data = bytearray(path.read_bytes())
    start = data.index(b"mdat") + 4
    size = int.from_bytes(data[start - 8 : start - 4], "big")
    # The sound of the middle of the file; the pictures before it are not decoded.
    middle = start + 2 * size // 3
    data[middle : middle + 300] = bytes(np.random.default_rng(0).integers(0, 256, 300, dtype=np.uint8))
    path.write_bytes(data)
    found = read_sound_file(path)
    assert found.pieces
    assert found.end_s == pytest.approx(4.0, abs=0.1)


def test_a_track_gives_samples_anywhere(tmp_path):
    found = read(write_video_with_sound(tmp_path / "a.mp4", burst(1.0, 0.5)))
    around = found.samples(-1.0, 3 * RATE_HZ)
    assert len(around) == 3 * RATE_HZ
    assert not around[: RATE_HZ - 1].any()
    assert np.array_equal(around[RATE_HZ : RATE_HZ + 100], found.samples(0.0, 100))


def test_wind_below_the_band_is_removed(tmp_path):
    rng = np.random.default_rng(0)
    loud = np.clip(0.5 * wind_noise(32_000, RATE_HZ, rng), -0.9, 0.9) + 0.01 * rng.standard_normal(32_000)
    found = read(write_video_with_sound(tmp_path / "a.mp4", loud.astype(np.float32)))
    samples = found.samples(0.0, 32_000)
    power = np.abs(np.fft.rfft(samples)) ** 2
    # 40 Hz lies below the limit, 1 kHz above it; each bin is 0.5 Hz wide.
    assert power[40:160].mean() < 0.1 * power[300:600].mean() + power[1000:3000].mean()
    assert abs(samples[:50]).max() < 200  # the sound starts gradually
