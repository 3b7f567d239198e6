"""Telemetry of GoPro cameras: rates, axes, units, lost payloads, chapters, timelapse, damage."""

import os
import struct
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.capture.frame_index import index_video, index_videos
from bodycap_batch.capture.timeline import join_chapters
from bodycap_batch.formats.gpmf import Damage, gopro_model, read_items
from bodycap_batch.telemetry import read_telemetry
from bodycap_batch.telemetry.gopro import gopro_telemetry, has_telemetry_track, read_gpmf_payloads
from bodycap_batch.telemetry.streams import EXPOSURE
from tests.fuzzing import DEFAULT_FRACTION, FRACTION_VARIABLE
from tests.gpmf import Sensor, header, item, nested, payloads, raw, with_wide_offsets, write_gopro
from tests.videos import textured_frame

FPS = 30000 / 1001


def _read(track, settings=None, firmware=""):
    return gopro_telemetry(read_gpmf_payloads(track), settings or {}, firmware, FPS)


def _turn(times):
    """Rates in GoPro's axes: x left, y back, z up."""
    return np.stack([0.3 + 0 * times, 0.5 * np.sin(times), 0.7 * np.cos(times)], axis=1)


def test_rates_times_units_and_axes():
    telemetry = _read(payloads(Sensor(rate_hz=201.9), 20, _turn))
    gyro, force = telemetry.gyro, telemetry.accelerometer
    assert telemetry.notes == ()
    assert telemetry.model == "HERO11 Black"
    assert telemetry.axes_known
    assert gyro.unit == "rad/s"
    assert force.unit == "m/s²"
    # Stamps are whole microseconds.
    assert gyro.rate_hz == pytest.approx(201.9, abs=1e-3)
    # The times of payloads in the file are nominal: their start is off by up to half a sample.
    truth = np.arange(len(gyro.times_s)) / 201.9
    assert np.abs(gyro.times_s - truth).max() < 0.005
    # The camera's x is right, y down, z forward.
    np.testing.assert_allclose(gyro.values, -_turn(truth)[:, [0, 2, 1]], atol=0.0006)
    np.testing.assert_allclose(force.values, np.tile([0.0, -9.8, 0.0], (len(truth), 1)), atol=0.003)
    assert gyro.gaps_s == ()


@pytest.mark.parametrize("axes", ["ZXY", "XzY", "YxZ", "yXZ", "zyx"])
def test_stated_axes_give_the_same_vectors(axes):
    # "zyx" mirrors, and no sensor is mirrored; the file's word is taken.
    values = _read(payloads(Sensor(axes=axes), 3, _turn)).gyro.values
    expected = _read(payloads(Sensor(), 3, _turn)).gyro.values
    np.testing.assert_allclose(values, expected, atol=0.0011)


@pytest.mark.parametrize(
    ("device", "firmware", "axes"),
    [
        ("Camera", "HD5.02.02", "ZXY"),
        ("Hero6 Black", "", "YxZ"),
        ("Hero7 Black", "", "YxZ"),
        ("Fusion", "", "yXZ"),
    ],
)
def test_axes_of_old_models_are_known(device, firmware, axes):
    shortened = [
        (_without_orin(data), *when) for data, *when in payloads(Sensor(axes=axes, device=device), 3, _turn)
    ]
    telemetry = _read(shortened, firmware=firmware)
    assert telemetry.axes_known
    np.testing.assert_allclose(
        telemetry.gyro.values, _read(payloads(Sensor(), 3, _turn)).gyro.values, atol=0.0011
    )


def _without_orin(data):
    """Rename the axes of a payload, so that they are not found."""
    return data.replace(b"ORIN", b"XXXX")


def test_unknown_axes_are_reported():
    telemetry = _read([(_without_orin(data), *when) for data, *when in payloads(Sensor(device="Camera"), 3)])
    assert not telemetry.axes_known
    assert telemetry.gyro is not None


@pytest.mark.parametrize(
    ("settings", "firmware", "device", "model"),
    [
        ({"MINF": "HERO9 Black"}, "HD9.01", "Camera", "HERO9 Black"),
        ({}, "HD5.02.02.00.00", "Camera", "HERO5 Black"),
        ({}, "H22.01.10", "", "HERO11 Black"),
        ({}, "", "Hero7 Black", "Hero7 Black"),
        ({}, "XX1", "Camera", ""),
    ],
)
def test_the_model_may_be_known_from_the_firmware_alone(settings, firmware, device, model):
    assert gopro_model(settings, firmware, device) == model


def test_a_lost_payload_is_a_gap_and_moves_no_later_sample():
    track = payloads(Sensor(), 12, _turn)
    whole, cut = _read(track).gyro, _read(track[:5] + track[6:]).gyro
    assert len(cut.gaps_s) == 1
    start, end = cut.gaps_s[0]
    assert (start, end) == pytest.approx((5.0, 6.0), abs=0.03)
    assert cut.rate_hz == pytest.approx(whole.rate_hz, rel=1e-5)
    # The mean of the payloads' times has one term less.
    assert cut.times_s[-1] == pytest.approx(whole.times_s[-1], abs=0.002)


def test_a_lost_payload_of_a_stream_without_counters_is_a_gap():
    exposure = nested("STRM", item("SHUT", "f", [0.001] * 30))
    track = payloads(Sensor(), 12, extra=[exposure])
    stream = _read(track[:5] + track[6:]).streams[EXPOSURE]
    assert stream.rate_hz == pytest.approx(FPS, rel=1e-6)
    assert stream.gaps_s[0] == pytest.approx((5.005 - 1 / FPS, 6.006), abs=1e-6)


def test_without_stamps_the_rate_comes_from_the_times_in_the_file():
    gyro = _read(payloads(Sensor(rate_hz=403.8, stamps=False), 30, _turn)).gyro
    # Each payload starts at a whole sample, up to 2.5 ms after its time; over 30 s this is below 1e-4.
    assert gyro.rate_hz == pytest.approx(403.8, rel=1e-4)


def test_a_timelapse_is_reported_and_its_inertial_samples_are_not_used():
    exposure = nested("STRM", item("SHUT", "f", [0.001] * 30))
    telemetry = _read(payloads(Sensor(), 5, _turn, extra=[exposure], stamp_scale=30.0))
    assert telemetry.is_timelapse
    assert set(telemetry.streams) == {"SHUT"}
    assert any("timelapse" in note for note in telemetry.notes)
    few = _read(payloads(Sensor(rate_hz=30.0, stamps=False), 5, _turn))
    assert few.is_timelapse
    assert few.gyro is None


def test_gps_exposure_and_other_streams():
    gps5 = nested(
        "STRM",
        *(item("GPSF", "L", [3]), item("GPSU", "c", "240131120000.250"), item("GPSP", "S", [150])),
        item("SCAL", "l", [10_000_000, 10_000_000, 1000, 1000, 100]),
        item("GPS5", "l", [[425000000, -87000000, 58512, 1200, 150]] * 10, 5),
    )
    row = struct.pack(">lllllllHH", 425000000, -87000000, 58512, 1200, 150, 8796, 43_200_250, 120, 2)
    gps9 = nested(
        "STRM",
        item("TYPE", "c", "lllllllSS"),
        item("SCAL", "l", [10_000_000, 10_000_000, 1000, 1000, 100, 1, 1000, 100, 1]),
        raw("GPS9", "?", 32, 10, row * 10),
    )
    other = nested("STRM", item("STNM", "c", "Scene"), raw("SCEN", "?", 4, 6, b"\0" * 24))
    old = _read(payloads(Sensor(), 3, extra=[gps5, other]))
    assert old.gps.start_utc == "2024-01-31T12:00:00.250Z"
    assert old.gps.fix.tolist() == [3] * 30
    assert old.gps.dilution[0] == pytest.approx(1.5)
    np.testing.assert_allclose(old.gps.latitude_longitude_deg[0], [42.5, -8.7])
    np.testing.assert_allclose(old.gps.speed_m_s[0], [1.2, 1.5])
    assert old.other_streams == {"SCEN Scene": 18}
    new = _read(payloads(Sensor(), 3, extra=[gps5, gps9]))
    assert new.gps.fix[0] == 2
    assert new.gps.dilution[0] == pytest.approx(1.2)
    assert new.gps.start_utc == "2024-01-31T12:00:00.250Z"


def test_tables_of_64_bit_offsets_are_read(tmp_path):
    """Files over 4 GB have co64 instead of stco."""
    frames = [textured_frame(index % 40) for index in range(90)]
    short = write_gopro(tmp_path / "GX010001.MP4", frames, payloads(Sensor(), 3, _turn))
    wide = tmp_path / "GX020001.MP4"
    wide.write_bytes(with_wide_offsets(short.read_bytes()))
    assert b"stco" not in wide.read_bytes()
    assert wide.read_bytes().count(b"co64") == short.read_bytes().count(b"stco") >= 2
    one, other = (_telemetry(path) for path in (short, wide))
    assert one.gyro is not None
    assert other.gyro is not None
    np.testing.assert_array_equal(other.gyro.values, one.gyro.values)
    np.testing.assert_array_equal(other.gyro.times_s, one.gyro.times_s)
    assert has_telemetry_track(wide)


def _telemetry(path):
    video = index_video(path)
    return read_telemetry([video], video.times_ns())


def test_a_video_with_a_track_and_its_chapters(tmp_path):
    frames = [textured_frame(index % 40) for index in range(90)]
    paths = [
        write_gopro(tmp_path / f"GX0{number}0001.MP4", frames, payloads(Sensor(), 3, _turn), handler=handler)
        for number, handler in ((1, "\tGoPro MET"), (2, "edited"))
    ]
    videos = tuple(index_video(path) for path in paths)
    times = join_chapters(videos, ()).times_ns
    telemetry = read_telemetry(videos, times)
    assert telemetry.source == "GPMF"
    gyro = telemetry.gyro
    assert gyro.times_s[-1] == pytest.approx(6.0, abs=0.02)
    # The second chapter starts with the 91st frame, 3.003 s after the first.
    assert len(gyro.times_s) == pytest.approx(2 * 606, abs=2)
    np.testing.assert_allclose(gyro.values[610], gyro.values[610 - 606], atol=0.01)


def test_telemetry_of_joined_recordings_is_not_used_for_the_second_one(tmp_path):
    frames = [textured_frame(index % 40) for index in range(90)]
    path = write_gopro(tmp_path / "a.mp4", frames, payloads(Sensor(), 3, _turn))
    path.write_bytes(2 * path.read_bytes())
    videos = index_videos([path])
    telemetry = read_telemetry(videos, join_chapters(videos, ()).times_ns)
    assert len(videos) == 2
    assert telemetry.gyro.times_s[-1] == pytest.approx(3.0, abs=0.02)
    assert "the telemetry of the first of the joined recordings" in telemetry.notes[0]


def test_the_vectors_of_a_turned_video_are_in_the_axes_of_the_shown_image(tmp_path):
    path = write_gopro(
        tmp_path / "a.mp4", [textured_frame(index) for index in range(30)], payloads(Sensor(), 1, _turn)
    )
    video = index_video(path)
    upright = read_telemetry([video], video.times_ns()).gyro.values
    upside_down = replace(video, orientation=((-1, 0), (0, -1)))
    turned = read_telemetry([upside_down], video.times_ns()).gyro.values
    np.testing.assert_allclose(turned, upright * [-1, -1, 1])


def test_a_file_without_telemetry(tmp_path):
    path = write_gopro(tmp_path / "a.mp4", [textured_frame(index) for index in range(20)], [])
    videos = (index_video(path),)
    telemetry = read_telemetry(videos, videos[0].times_ns())
    assert telemetry.source == "none"
    assert telemetry.streams == {}
    assert telemetry.notes == ()


# --- damage ---------------------------------------------------------------------------------------------


def _deep(depth):
    data = item("GYRO", "s", [1, 2, 3], 3)
    for _ in range(depth):
        data = header("STRM", 0, 4, len(data) // 4) + data if len(data) < 4 * 65535 else data
    return data


DAMAGED = {
    "cut": (lambda data: data[: len(data) // 2], "cut off"),
    "wrong length": (lambda data: data.replace(b"GYROs\x06", b"GYROs\xff"), "cut off"),
    "zero length": (lambda data: data.replace(b"GYROs\x06", b"GYROs\x00"), "wrong type or size"),
    "wrong type": (lambda data: data.replace(b"GYROs\x06", b"GYROc\x06"), "wrong type or size"),
    "no key": (lambda data: data[:8] + b"\x01\x02\x03\x04" + data[12:], "no readable key"),
    "zero scale": (lambda data: data.replace(struct.pack(">h", 1000), b"\0\0"), "scale of the stream GYRO"),
    "nested": (lambda data: _deep(1000), "belongs to no device"),
    "nested in a device": (
        lambda data: header("DEVC", 0, 4, len(_deep(1000)) // 4) + _deep(1000),
        "too deeply",
    ),
}


@pytest.mark.parametrize("kind", DAMAGED)
def test_damage_of_one_payload_is_noted_and_the_others_are_used(kind):
    damage, words = DAMAGED[kind]
    track = payloads(Sensor(), 8, _turn)
    data, start, duration = track[3]
    telemetry = _read([*track[:3], (damage(data), start, duration), *track[4:]])
    assert any(words in note for note in telemetry.notes), telemetry.notes
    assert telemetry.gyro.rate_hz == pytest.approx(201.9, rel=0.002)
    assert len(telemetry.gyro.times_s) > 1300


@pytest.mark.parametrize("scale", [np.nan, np.inf, -np.inf, 0.0])
def test_a_scale_that_is_no_number_gives_no_stream(scale):
    bad = nested("STRM", item("SCAL", "f", [scale]), item("SHUT", "f", [0.001] * 30))
    telemetry = _read(payloads(Sensor(), 3, extra=[bad]))
    assert "SHUT" not in telemetry.streams
    assert any("scale of the stream SHUT" in note for note in telemetry.notes)
    assert telemetry.gyro is not None


def test_clocks_that_run_backwards():
    track = payloads(Sensor(), 8, _turn)
    back = [(data, 1.001 * (10 - number), 1.001) for number, (data, _, _) in enumerate(track)]
    telemetry = _read(back)
    assert any("run backwards" in note for note in telemetry.notes)
    stamp = b"STMPJ\x08\x00\x01"
    stamped = []
    for number, (data, start, duration) in enumerate(track):
        old = stamp + data.split(stamp)[1][:8]
        new = stamp + struct.pack(">Q", 9_000_000 - 100_000 * number)
        stamped.append((data.replace(old, new), start, duration))
    telemetry = _read(stamped)
    assert any("stamps of the telemetry run backwards" in note for note in telemetry.notes)
    assert telemetry.gyro.rate_hz == pytest.approx(201.9, rel=0.002)
    assert (np.diff(telemetry.gyro.times_s) > 0).all()


def _broken(rng, track):
    """Return a track with random damage: bytes changed, cut, inserted, doubled; times shuffled."""
    out = []
    for data, start, duration in track:
        content = bytearray(data)
        for _ in range(int(rng.integers(0, 6))):
            where = int(rng.integers(0, max(1, len(content))))
            kind = int(rng.integers(0, 6))
            if kind == 0 and content:
                content[where] = int(rng.integers(0, 256))
            elif kind == 1:
                content = content[:where]
            elif kind == 2:
                content[where:where] = rng.bytes(int(rng.integers(1, 40)))
            elif kind == 3:
                content[where : where + int(rng.integers(1, 200))] = b""
            elif kind == 4:
                key = str(rng.choice(["DEVC", "STRM", "GYRO", "SCAL", "TYPE", "GPS9", "TSMP", "STMP"]))
                shape = ([0, 99, 115, 63, 102], [0, 1, 6, 255], [0, 1, 65535])
                content[where : where + 8] = header(key, *(int(rng.choice(options)) for options in shape))
            else:
                content += content[where:]
        times = [(start, duration)] * 8
        times += [(start - 5.0, duration), (np.nan, 0.0), (start, -1.0), (1e18, 1e18), (start, 0.0)]
        out.append((bytes(content), *times[int(rng.integers(0, len(times)))]))
    return out


def _fuzz(seed, count):
    rng = np.random.default_rng(seed)
    exposure = nested("STRM", item("SHUT", "f", [0.001] * 30))
    gps = nested("STRM", item("TYPE", "c", "lllllllSS"), raw("GPS9", "?", 32, 2, b"\1" * 64))
    tracks = [
        payloads(Sensor(rate_hz=50.0, stamps=stamps, axes=axes), 3, _turn, extra=[exposure, gps])
        for stamps in (True, False)
        for axes in ("ZXY", "")
    ]
    for _ in range(count):
        telemetry = _read(_broken(rng, tracks[int(rng.integers(0, 4))]), {"EISA": "Y"}, "HD5")
        for stream in telemetry.streams.values():
            assert np.isfinite(stream.values).all()
            assert np.isfinite(stream.times_s).all()
        assert all(isinstance(note, str) for note in telemetry.notes)


def test_some_hundred_damaged_tracks():
    _fuzz(1, 400)


@pytest.mark.slow
def test_thousands_of_damaged_tracks():
    """Twenty thousand with ``make fuzz``, and the same fraction of them as of its other inputs without."""
    _fuzz(2, round(20_000 * float(os.environ.get(FRACTION_VARIABLE, DEFAULT_FRACTION))))


def test_memory_is_bounded():
    # Eight megabytes of the shortest items, and of containers in containers.
    for data in (
        header("STRM", 0, 0, 0) * (1 << 20),
        _deep(10_000),
        header("TYPE", 63, 255, 65535) * 900_000,
    ):
        tracemalloc.start()
        read_items(data[: 8 << 20], Damage())
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 40 << 20


def test_a_long_damaged_track_ends():
    telemetry = _read([(header("DEVC", 0, 255, 65535) * 3, 0.1 * number, 0.1) for number in range(5_000)])
    assert any("(15000 times)" in note or "(5000 times)" in note for note in telemetry.notes)
