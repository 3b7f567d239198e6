"""Correlate two sounds by the phases of their spectra (GCC-PHAT).

Each spectrum is divided by its magnitude, so that only phases remain. The inverse transform of the
cross-spectrum then has a sharp peak at the lag between the two sounds, whatever the response of the room and
the loudness of each frequency.

Source: Knapp and Carter, The generalized correlation method for estimation of time delay, 1976.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from bodycap_batch.clocks.sound_track import RATE_HZ, Samples

Spectrum = npt.NDArray[np.complex64]

BAND_HZ = (200.0, 6000.0)
"""Lowest and highest frequency, Hz, that is used. Origin: wind and handling are strong below, many encoders
remove what is above."""
PEAK_WIDTH_S = 0.02
"""Lag, seconds, within which two peaks of a correlation count as one. Origin: the strong early echoes of a
room arrive within some 20 ms of the direct sound."""
SMOOTHING_S = 0.0005
"""Standard deviation, seconds, of the weights that sum the energy of a correlation around a lag. Origin: arms
that swing and early echoes distribute the peak over about 1 ms. Evidence: docs/decisions/clocks.md."""
_NOISE_SPANS_S = (0.006, 0.02, 0.08, 0.25)
"""Lags, seconds, before and after a peak, within which the noise around the peak is measured. The largest of
these noises counts: two loud sounds that are not the same raise the noise where they meet. Evidence:
docs/decisions/clocks.md."""
_PEAK_CORE_S = 0.004
"""Lag, seconds, before and after a peak, that does not count as noise. Origin: the peak itself and the echoes
of the body."""
_TAPER_S = 0.064
"""Time, seconds, over which a window of sound starts and ends. Origin: a sudden cut is a sound by itself, and
correlates with every other cut. Evidence: docs/decisions/clocks.md."""
_TAPER = np.sin(0.5 * np.pi * np.linspace(0.0, 1.0, round(_TAPER_S * RATE_HZ), dtype=np.float32)) ** 2
"""Weights of the first samples of a window."""
_MIN_MAGNITUDE = 1e-3
"""Magnitude, relative to the median of the spectrum, below which a frequency counts as empty. Its phase is
that of rounding errors."""
_TAIL_FACTOR = 1.5
"""Factor by which the noise of a correlation of unrelated sounds has a wider tail than a normal distribution.
Evidence: docs/decisions/clocks.md."""
_FREEDOM = 2.0 * (BAND_HZ[1] - BAND_HZ[0]) * SMOOTHING_S * 2.0 * np.sqrt(np.pi)
"""Number of independent values whose energy is summed around a lag. Origin: the sampling theorem for the
band, and the effective length of Gaussian weights."""
_INDEPENDENT = 2.0 * (BAND_HZ[1] - BAND_HZ[0]) / RATE_HZ / _FREEDOM
"""Number of independent sums of energy per lag."""


@dataclass(frozen=True, slots=True)
class Peak:
    """A peak of a correlation.

    Attributes:
        lag_s: Lag of the peak, seconds: the second sound contains at t + lag_s what the first contains at t.
        height: Height over the noise, in σ of the noise.
    """

    lag_s: float
    height: float


def transform_size(samples: int) -> int:
    """Return a fast size of the transform for a number of samples."""
    return int(scipy.fft.next_fast_len(samples, real=True))


def phase_spectrum(samples: Samples, size: int, top_hz: float = RATE_HZ / 2) -> Spectrum:
    """Return the phases of a sound: its spectrum (size/2+1,) with magnitude 1 in the band, else 0.

    Args:
        samples: (N,) samples at `RATE_HZ`, padded with zeros to `size`.
        size: Size of the transform, samples.
        top_hz: Highest frequency that both recordings contain, Hz.
    """
    samples = samples.copy()
    count = min(len(_TAPER), len(samples) // 2)
    samples[:count] *= _TAPER[:count]
    samples[len(samples) - count :] *= _TAPER[:count][::-1]
    spectrum = scipy.fft.rfft(samples, size)
    low, high = (round(limit * size / RATE_HZ) for limit in (BAND_HZ[0], min(BAND_HZ[1], 0.9 * top_hz)))
    magnitude = np.abs(spectrum[low : high + 1])
    floor = _MIN_MAGNITUDE * float(np.median(magnitude)) + 1e-12
    out = np.zeros(size // 2 + 1, np.complex64)
    np.divide(spectrum[low : high + 1], np.maximum(magnitude, floor), out=out[low : high + 1])
    return out


def phase_correlation(first: Spectrum, second: Spectrum, size: int) -> Samples:
    """Return the correlation (size,) of two phase spectra; index k is a lag of k samples, modulo size."""
    return np.asarray(scipy.fft.irfft(np.conj(first) * second, size), np.float32)


def find_peaks(
    correlation: Samples, first_lag: int, count: int, within: tuple[int, int] | None = None
) -> list[Peak]:
    """Return the highest peaks of the energy of a correlation, the highest first.

    Args:
        correlation: (N,) correlation at successive lags. A sound with inverted sign has a negative peak.
        first_lag: Lag of the first value, samples.
        count: Maximum number of peaks.
        within: First and last lag of a peak, samples; None for all lags.
    """
    energy = correlation**2
    total = np.concatenate([[0.0], np.cumsum(energy, dtype=np.float64)])
    if total[-1] <= 0.0:
        return []
    begin, end = (0, len(energy)) if within is None else (within[0] - first_lag, within[1] - first_lag + 1)
    begin, end = max(begin, 0), min(end, len(energy))
    # The weights of the sum reach no farther than the margin.
    margin = round(4 * SMOOTHING_S * RATE_HZ)
    low, high = max(begin - margin, 0), min(end + margin, len(energy))
    height = np.zeros_like(energy)
    height[begin:end] = smoothed_energy(energy[low:high])[begin - low : end - low]
    width = round(PEAK_WIDTH_S * RATE_HZ)
    peaks = []
    for _ in range(count):
        index = int(height.argmax())
        if height[index] <= 0.0:
            break
        ratio = float(height[index]) / _noise_at(total, index)
        lag = first_lag + index + _parabola(height, index)
        peaks.append(Peak(lag / RATE_HZ, _sigmas_of_ratio(ratio)))
        height[max(0, index - width) : index + width + 1] = 0.0
    return peaks


def smoothed_energy(energy: Samples) -> Samples:
    """Return the energy of a correlation (N,), summed around each lag with Gaussian weights."""
    smoothed = scipy.ndimage.gaussian_filter1d(energy, SMOOTHING_S * RATE_HZ, mode="constant", truncate=3.0)
    return np.asarray(smoothed, np.float32)


def log_chance(height: float, lags: float) -> float:
    """Return the natural logarithm of the probability that unrelated sounds have a peak of this height.

    The largest of N independent values exceeds a height with a probability of at most N times that of a
    single value.

    Args:
        height: Height of the peak, in σ of the noise.
        lags: Number of lags that were searched.
    """
    single = float(scipy.special.log_ndtr(-height / _TAIL_FACTOR)) + float(
        np.log(max(lags * _INDEPENDENT, 1.0))
    )
    return min(0.0, single)


def _noise_at(total: npt.NDArray[np.float64], index: int) -> float:
    """Return the mean energy of the noise at an index: the largest of those of several spans around it.

    Args:
        total: (N+1,) cumulative energy of the correlation.
        index: Index of the peak.
    """
    last, core = len(total) - 1, round(_PEAK_CORE_S * RATE_HZ)
    noise = float(total[-1]) / last
    for span_s in _NOISE_SPANS_S:
        reach = core + round(span_s * RATE_HZ)
        a, b = max(0, index - reach), max(0, index - core)
        c, d = min(last, index + core), min(last, index + reach)
        count = (b - a) + (d - c)
        if count >= reach - core:
            noise = max(noise, float(total[b] - total[a] + total[d] - total[c]) / count)
    return noise


def _sigmas_of_ratio(ratio: float) -> float:
    """Return how many σ of a normal distribution an energy lies above the mean energy of the noise.

    Source: Wilson and Hilferty, The distribution of chi-square, 1931.
    """
    spread = 2.0 / (9.0 * _FREEDOM)
    return float(max(0.0, (ratio ** (1 / 3) - (1.0 - spread)) / np.sqrt(spread)))


def _parabola(values: Samples, index: int) -> float:
    """Return the position of the maximum relative to the index, samples: that of a parabola."""
    if not 0 < index < len(values) - 1:
        return 0.0
    before, at, after = (float(values[index + step]) for step in (-1, 0, 1))
    curvature = before - 2 * at + after
    return 0.0 if curvature >= 0.0 else float(np.clip(0.5 * (before - after) / curvature, -0.5, 0.5))
