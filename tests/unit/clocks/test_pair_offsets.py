"""Pairs of cameras: offsets and drifts of generated sound, and what must be refused."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.clocks.pair_offsets import measure_pair
from bodycap_batch.clocks.sound_track import RATE_HZ, SoundTrack
from bodycap_batch.synthetic.sound import cloth_noise
from tests.sounds import heard, scene, track, wind_noise

WAY_S = 0.004
"""The way of sound to two cameras on one body differs by up to 1.3 m."""


@pytest.fixture(scope="module")
def room():
    return scene(3, 12.0)


@pytest.fixture(scope="module")
def torso(room):
    return heard(room, 1, 12.0)


def test_an_offset_is_found(room, torso):
    palm = heard(room, 2, 12.0, 0.731)
    pair = measure_pair(track(torso), track(palm, "b"))
    assert pair.accepted, pair.reason
    assert pair.offset_s == pytest.approx(0.731, abs=WAY_S)
    assert pair.rival_ratio > 3.0
    assert not pair.drift_measured
    assert pair.curve is not None
    # The curve has its peak near the offset; exactly there would be a copy of the result.
    assert pair.curve_lags_s[pair.curve.argmax()] == pytest.approx(pair.offset_s, abs=0.003)


def test_the_order_of_the_cameras_turns_the_sign(room, torso):
    palm = heard(room, 2, 9.0, 0.731)
    one = measure_pair(track(torso), track(palm, "b"))
    other = measure_pair(track(palm, "b"), track(torso))
    assert (one.first, one.second, other.first) == ("a", "b", "b")
    assert other.offset_s == pytest.approx(-one.offset_s, abs=1e-9)
    assert other.accepted


def test_the_start_of_a_clock_does_not_matter(room, torso):
    palm = heard(room, 2, 12.0, 0.731)
    pair = measure_pair(track(torso, start_s=1000.0), track(palm, "b", start_s=-3.0))
    assert pair.offset_s == pytest.approx(0.731 + 1003.0, abs=WAY_S)


def test_drift_is_measured_from_a_minute_on():
    seconds = 75.0
    room = scene(4, seconds)
    tracks = [track(heard(room, 1, seconds)), track(heard(room, 2, seconds, 0.4, drift_ppm=80.0), "b")]
    pair = measure_pair(*tracks)
    assert pair.accepted, pair.reason
    assert pair.drift_measured
    # The way of sound changes by about 1 ms in 69 s.
    assert pair.drift_ppm == pytest.approx(80.0, abs=35.0)
    assert 3.0 < pair.drift_sigma_ppm < 35.0
    assert pair.offset_s - 80e-6 * pair.pivot_s == pytest.approx(0.4, abs=WAY_S)


def test_clipped_and_quiet_sound(room, torso):
    loud = heard(room, 2, 12.0, 0.5, gain_db=15.0, clip=0.3)
    assert (np.abs(loud) >= 0.3).mean() > 0.01
    quiet = heard(room, 3, 12.0, -0.4, gain_db=-45.0)
    pair = measure_pair(track(loud), track(quiet, "b"))
    assert pair.accepted, pair.reason
    assert pair.offset_s == pytest.approx(-0.9, abs=WAY_S)


def test_wind_over_the_voice(room, torso):
    rng = np.random.default_rng(0)
    wind = 0.3 * wind_noise(len(torso), RATE_HZ, rng)
    palm = np.clip(heard(room, 2, 12.0, 0.731) + wind, -1, 1)
    pair = measure_pair(track(torso), track(palm, "b"))
    assert pair.accepted, pair.reason
    assert pair.offset_s == pytest.approx(0.731, abs=WAY_S)


def test_wind_alone_is_refused():
    winds = [0.3 * wind_noise(12 * RATE_HZ, RATE_HZ, np.random.default_rng(seed)) for seed in (1, 2)]
    pair = measure_pair(track(winds[0]), track(winds[1], "b"))
    assert not pair.accepted
    assert pair.reason


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    "sources", [("voice", "steps", "claps", "distant"), ("claps", "distant"), ("steps",)]
)
def test_another_take_is_refused(seed, sources):
    takes = [heard(scene(seed + 10 * take, 8.0, sources), 5 + take, 8.0) for take in (0, 1)]
    pair = measure_pair(track(takes[0]), track(takes[1], "b"))
    assert not pair.accepted


def test_repeating_music_is_refused():
    room = scene(6, 16.0, ("music",))
    music = [heard(room, seed, 16.0, offset, noise_ratio_db=20.0) for seed, offset in ((1, 0.0), (2, 0.7))]
    pair = measure_pair(track(music[0]), track(music[1], "b"))
    assert not pair.accepted
    assert "repeats" in pair.reason


def test_a_voice_over_repeating_music_gives_the_offset_or_none():
    room = scene(7, 16.0, ("music", "voice", "claps"))
    pair = measure_pair(track(heard(room, 1, 16.0)), track(heard(room, 2, 16.0, 0.7), "b"))
    assert not pair.accepted or pair.offset_s == pytest.approx(0.7, abs=WAY_S)


def test_the_expected_offset_is_searched_first_and_not_believed(room, torso):
    palm = track(heard(room, 2, 12.0, 0.731), "b")
    right = measure_pair(track(torso), palm, (0.0, 2.0))
    wrong = measure_pair(track(torso), palm, (4.0, 5.0))
    assert right.accepted
    assert right.offset_s == pytest.approx(0.731, abs=WAY_S)
    assert wrong.accepted
    assert wrong.offset_s == pytest.approx(0.731, abs=WAY_S)


def test_one_short_common_moment_of_long_recordings():
    room = scene(8, 40.0)
    first, second = heard(room, 1, 25.0), heard(room, 2, 25.0, 13.0)
    pair = measure_pair(track(first), track(second, "b"))
    assert pair.accepted, pair.reason
    assert pair.offset_s == pytest.approx(13.0, abs=WAY_S)


@pytest.mark.parametrize("expected_s", [None, (128.0, 136.0)])
def test_a_camera_that_starts_minutes_later(expected_s):
    """The second camera starts 132 s after the first, which ends 12 s later."""
    room = scene(9, 24.0)
    alone = 0.1 * cloth_noise(132 * RATE_HZ, RATE_HZ, np.random.default_rng(9))
    first = np.concatenate([alone, heard(room, 1, 12.0)])
    second = heard(room, 2, 24.0)
    pair = measure_pair(track(first), track(second, "b"), expected_s)
    assert pair.accepted, pair.reason
    assert pair.offset_s == pytest.approx(132.0, abs=WAY_S)
    turned = measure_pair(track(second, "b"), track(first))
    assert turned.offset_s == pytest.approx(-132.0, abs=WAY_S)


@pytest.mark.parametrize("seed", [3, 4])
def test_twenty_seconds_with_loud_cloth_noise_are_enough(seed):
    room = scene(40 + seed, 20.0)
    one, other = (
        heard(room, 2 * seed + each, 20.0, offset, noise_ratio_db=-6.0)
        for each, offset in ((0, 0.0), (1, 1.3))
    )
    pair = measure_pair(track(one), track(other, "b"))
    assert pair.accepted, pair.reason
    assert pair.offset_s == pytest.approx(1.3, abs=WAY_S)


def test_a_low_sample_rate_limits_the_band(room, torso):
    palm = heard(room, 2, 12.0, 0.731, band_hz=(100.0, 3400.0))
    narrow = SoundTrack(camera="b", pieces=track(palm).pieces, top_hz=4000.0)
    pair = measure_pair(track(torso), narrow)
    assert pair.accepted, pair.reason
    assert pair.offset_s == pytest.approx(0.731, abs=WAY_S)
