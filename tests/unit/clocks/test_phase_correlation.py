"""The correlation by phases: lags, heights, and how probable a height is for unrelated sounds."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.clocks.phase_correlation import (
    find_peaks,
    log_chance,
    phase_correlation,
    phase_spectrum,
    transform_size,
)
from bodycap_batch.clocks.sound_track import RATE_HZ
from tests.sounds import wind_noise


def correlated(first, second):
    size = transform_size(2 * len(first))
    correlation = phase_correlation(phase_spectrum(first, size), phase_spectrum(second, size), size)
    half = len(first)
    return np.concatenate([correlation[-half:], correlation[:half]]), -half


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_lag_is_found_between_samples(sign):
    rng = np.random.default_rng(0)
    fine = np.repeat(rng.standard_normal(40_000), 4)  # no energy above a quarter of the fine rate
    first = fine[4000:100_000:4] + 0.5 * rng.standard_normal(24_000)
    second = sign * fine[4000 - 402 : 100_000 - 402 : 4] + 0.5 * rng.standard_normal(24_000)
    peaks = find_peaks(*correlated(first.astype(np.float32), second.astype(np.float32)), 2)
    assert peaks[0].lag_s * RATE_HZ == pytest.approx(100.5, abs=1.0)
    assert peaks[0].height > 10 * peaks[1].height / 3


def test_loudness_and_colour_do_not_matter():
    rng = np.random.default_rng(1)
    common = rng.standard_normal(32_000)
    low = np.convolve(common, np.ones(4) / 4, "same")
    peaks = find_peaks(*correlated(low.astype(np.float32), (1e-3 * common).astype(np.float32)), 1)
    assert abs(peaks[0].lag_s) < 2.0 / RATE_HZ


def test_unrelated_noise_has_low_peaks():
    rng = np.random.default_rng(2)
    for _ in range(10):
        first, second = rng.standard_normal((2, 32_000)).astype(np.float32)
        (peak,) = find_peaks(*correlated(first, second), 1)
        # The largest of some 2,300 independent values lies at 3 to 5 sigma.
        assert 2.5 < peak.height < 6.0
        assert log_chance(peak.height, 64_000) > np.log(1e-3)


def test_two_different_bursts_in_silence_are_no_peak():
    rng = np.random.default_rng(3)
    sounds = 1e-3 * rng.standard_normal((2, 48_000)).astype(np.float32)
    decay = np.exp(-np.arange(1600) / 200)
    for sound, at in zip(sounds, (12_000, 31_000), strict=True):
        sound[at : at + 1600] += decay * rng.standard_normal(1600)
    (peak,) = find_peaks(*correlated(*sounds), 1)
    assert peak.height < 12.0


def test_cuts_through_strong_low_sounds_are_no_common_sound():
    """Both windows cut through wind. Without a taper the cuts are a peak of 20 sigma at lag 0."""
    rng = np.random.default_rng(5)
    winds = [20_000 * wind_noise(32_000, RATE_HZ, rng) + rng.standard_normal(32_000) for _ in range(2)]
    correlation, start = correlated(*(wind.astype(np.float32) for wind in winds))
    (peak,) = find_peaks(correlation, start, 1, (-20, 20))
    assert peak.height < 6.0


def test_peaks_within_limits():
    rng = np.random.default_rng(4)
    first = rng.standard_normal(16_000).astype(np.float32)
    correlation, start = correlated(first, np.roll(first, 500))
    assert find_peaks(correlation, start, 1)[0].lag_s * RATE_HZ == pytest.approx(500, abs=0.5)
    inside = find_peaks(correlation, start, 1, (-200, 200))[0]
    assert abs(inside.lag_s * RATE_HZ) <= 200.5
    assert inside.height < 6.0


def test_silence_has_no_peak():
    silence = np.zeros(1000, np.float32)
    assert find_peaks(*correlated(silence, silence), 3) == []


def test_the_chance_falls_with_height_and_grows_with_lags():
    assert log_chance(3.0, 1e6) == 0.0
    assert log_chance(9.0, 1e3) < log_chance(9.0, 1e6) < 0.0
    assert log_chance(20.0, 1e6) < log_chance(10.0, 1e6)
