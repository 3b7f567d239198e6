"""Generated sound: the same for the same seed, and as loud and as late as stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.clocks.sound_track import read_sound_file
from bodycap_batch.synthetic.sound import SOURCES, Microphone, make_scene, record
from tests.sounds import write_sound

RATE_HZ = 16_000


def test_the_same_seed_gives_the_same_sound():
    first, again = (make_scene(0.0, 3.0, seed=5, rate_hz=RATE_HZ, sources=SOURCES) for _ in range(2))
    assert all(np.array_equal(first.sources[name], again.sources[name]) for name in SOURCES)
    microphone = Microphone(seed=1, seconds=3.0, noise_ratio_db=0.0)
    heard = record(first, microphone)
    assert np.array_equal(heard, record(again, microphone))
    assert not np.array_equal(heard, record(first, replace(microphone, seed=2)))
    assert all(np.abs(source).max() > 0.0 for source in first.sources.values())


def test_the_ratio_of_sound_to_noise_is_that_of_the_powers_in_the_band():
    scene = make_scene(0.0, 4.0, seed=6, rate_hz=RATE_HZ)
    clean = record(scene, Microphone(seed=1, seconds=4.0, gain_db=-30.0))
    noisy = record(scene, Microphone(seed=1, seconds=4.0, gain_db=-30.0, noise_ratio_db=-6.0))

    def power(samples):
        return float((np.abs(np.fft.rfft(samples)[800:24_000]) ** 2).sum())

    assert 10 * np.log10(power(clean) / power(noisy - clean)) == pytest.approx(-6.0, abs=0.3)


def test_a_clock_moves_the_sound():
    scene = make_scene(-1.0, 6.0, seed=7, rate_hz=RATE_HZ, sources=("voice",))
    early = record(scene, Microphone(seed=1, seconds=4.0))
    late = record(scene, Microphone(seed=1, seconds=3.0, offset_s=1.0))
    # The same microphone one second later, apart from the noise: the arm swings alike in common time.
    assert np.abs(early[RATE_HZ:] - late).max() < 1e-4
    drifted = record(scene, Microphone(seed=1, seconds=4.0, drift_ppm=1000.0))
    # At the loudest moment after a second, a clock that is slow by 0.1 % is behind by that part of the time.
    loud = RATE_HZ + int(np.abs(early[RATE_HZ:60_000]).argmax())
    then = round(loud / 1.001)
    assert np.corrcoef(early[loud - 80 : loud + 80], drifted[then - 80 : then + 80])[0, 1] > 0.7


def test_clipping_and_files(tmp_path):
    scene = make_scene(0.0, 2.0, seed=8, rate_hz=48_000)
    loud = record(scene, Microphone(seed=1, seconds=2.0, gain_db=30.0, clip=0.5))
    assert np.abs(loud).max() == 0.5
    track = read_sound_file(write_sound(tmp_path / "a.m4a", loud, 48_000))
    assert track.end_s == pytest.approx(2.0, abs=0.05)
