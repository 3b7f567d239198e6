"""Measure the difference between the clocks of two cameras from their inertial sensors.

The vertical accelerations and the turn rates of two places of a body resemble each other. For each offset,
the correlations give the likelihood that the two recordings are related. An offset is accepted if it is much
more probable than all others, if unrelated recordings do not resemble each other so much, and if both halves
of the common time support it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.clocks.clock_pair import ClockPair
from bodycap_batch.clocks.sensor_signals import RATE_HZ, SensorTrack
from bodycap_batch.core.arrays import FloatArray, IntArray

_VERTICAL_HZ, _TURN_HZ = (0.3, 4.0), (0.2, 3.0)
"""Frequencies, Hz, in which vertical accelerations and turn rates are compared. Evidence:
docs/decisions/clocks.md."""
_MIN_COMMON_S = 4.0
"""Minimum common time of two recordings for an offset, seconds. Evidence: docs/decisions/clocks.md."""
_NEAR_S = 0.15
"""Difference, seconds, up to which two offsets belong to the same peak. Origin: half a period of the highest
frequency that is compared."""
_MEMORY_S = 3.0
"""Maximum lag, seconds, of the correlation of a signal with itself that reduces the number of independent
samples. Origin: three steps or more."""
_MAX_CORRELATION = 0.95
"""Correlation above which a higher one is no further evidence. Evidence: none."""
_MIN_LOG_ODDS = 9.0
"""Minimum logarithm of the likelihood of the peak over that of the best other offset. Evidence:
docs/decisions/clocks.md."""
_MIN_SCORE = 10.0
"""Minimum logarithm of the likelihood of the peak over that of unrelated recordings. Evidence:
docs/decisions/clocks.md."""
_MIN_SIGNAL_SCORES = (2.5, 1.0)
"""The same of the vertical accelerations alone and of the turn rates alone: one signal may agree by chance.
Evidence: docs/decisions/clocks.md."""
_HALF_RANGE_S = 0.3
"""Range, seconds, around an offset in which each half of the common time is compared. Origin: half a step."""
_MAX_HALF_DROP, _MIN_HALF_SCORE = 3.0, 0.5
"""Maximum logarithm of the likelihood of another offset in a half of the common time over that of the offset,
and its minimum over that of unrelated recordings. Evidence: docs/decisions/clocks.md."""
_MAX_SIGMA_S = 0.04
"""Maximum standard deviation, seconds, of an accepted offset. Origin: that of offsets from the motion."""
_LIMB_LAG_SIGMA_S = 0.020
"""Standard deviation, seconds, of an offset that more motion does not reduce: a limb moves ahead of the trunk
or follows it. Evidence: docs/decisions/clocks.md."""
_UNLIKE_SIGMA_S = 0.015
"""Standard deviation, seconds, of the offset of a camera of another model. Origin: the delay of the samples
relative to the picture is some 10 ms and differs between models."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorOffset(ClockPair):
    """What the inertial sensors of two cameras say about their clocks.

    `pivot_s` is the middle of the common time. The drift is not measured.

    Attributes:
        evidence: Logarithm of the likelihood over that of unrelated recordings.
        log_odds: Logarithm of the likelihood over that of the best other offset.
    """

    log_odds: float = 0.0


@dataclass(frozen=True, slots=True)
class _Signal:
    """One signal of both cameras, filtered.

    Attributes:
        first: (N,) samples of the first camera.
        second: (M,) samples of the second camera.
        memory: Number of samples that count as one independent sample.
    """

    first: FloatArray
    second: FloatArray
    memory: float

    def likelihood(self, correlation: FloatArray, count: FloatArray | float) -> FloatArray:
        """Return the logarithm of the likelihood over that of unrelated samples, for correlations (K,)."""
        limited = np.clip(correlation, 0.0, _MAX_CORRELATION)
        return np.asarray(-0.5 * count / self.memory * np.log1p(-(limited**2)))


def measure_sensor_offset(first: SensorTrack, second: SensorTrack) -> SensorOffset:
    """Measure the difference between the clocks of two cameras.

    Args:
        first: The signals of the first camera, without a problem.
        second: The signals of the second camera, without a problem.
    """
    outcome = SensorOffset(first=first.camera, second=second.camera)
    signals = [
        _filtered(first.vertical, second.vertical, _VERTICAL_HZ),
        _filtered(first.turn, second.turn, _TURN_HZ),
    ]
    lags = np.arange(-(len(second.vertical) - 1), len(first.vertical), dtype=np.int64)
    ends = np.minimum(lags + len(second.vertical), len(first.vertical))
    counts = ends - np.maximum(lags, 0)
    possible = counts >= _MIN_COMMON_S * RATE_HZ
    if not possible.any():
        return replace(outcome, reason=f"the inertial samples last less than {_MIN_COMMON_S:g} s")
    lags, counts = lags[possible], counts[possible].astype(np.float64)
    scores = np.array([signal.likelihood(_correlations(signal, lags, counts), counts) for signal in signals])
    total = scores.sum(axis=0)
    peak = int(total.argmax())
    far = np.abs(lags - lags[peak]) > _NEAR_S * RATE_HZ
    log_odds = float(total[peak] - total[far].max(initial=0.0))
    shift, spread = _vertex(total, peak)
    sigma_s = float(np.hypot(spread / RATE_HZ, _LIMB_LAG_SIGMA_S))
    if not (first.model and first.model == second.model):
        sigma_s = float(np.hypot(sigma_s, _UNLIKE_SIGMA_S))
    offset_s = first.start_s - second.start_s + (lags[peak] + shift) / RATE_HZ
    middle_s = first.start_s + (max(lags[peak], 0) + 0.5 * counts[peak]) / RATE_HZ
    outcome = replace(
        outcome,
        pivot_s=float(middle_s - offset_s),
        offset_s=float(offset_s),
        sigma_s=sigma_s,
        evidence=float(total[peak]),
        log_odds=log_odds,
    )
    reason = _refusal(outcome, scores[:, peak], signals, int(lags[peak]))
    return replace(outcome, accepted=not reason, reason=reason)


def _refusal(found: SensorOffset, scores: FloatArray, signals: list[_Signal], lag: int) -> str:
    """Return why an offset is refused; "" if it is not."""
    if found.evidence < _MIN_SCORE or (scores < _MIN_SIGNAL_SCORES).any():
        return "accelerations and turns resemble each other no more than those of unrelated recordings do"
    if found.log_odds < _MIN_LOG_ODDS:
        return "several offsets suit the accelerations almost equally well"
    begin, end = max(lag, 0), min(lag + len(signals[0].second), len(signals[0].first))
    middle = (begin + end) // 2
    for half in ((begin, middle), (middle, end)):
        here, best = _half_scores(signals, lag, *half)
        if here < _MIN_HALF_SCORE or best - here > _MAX_HALF_DROP:
            return "the two halves of the common time give different offsets"
    if found.sigma_s > _MAX_SIGMA_S:
        return f"the accelerations determine the offset only to {1e3 * found.sigma_s:.0f} ms"
    return ""


def _filtered(first: FloatArray, second: FloatArray, band_hz: tuple[float, float]) -> _Signal:
    """Return one signal of both cameras in a band of frequencies."""
    from scipy.signal import butter, sosfiltfilt

    sections = butter(2, band_hz, "bandpass", fs=RATE_HZ, output="sos")
    one, two = (np.asarray(sosfiltfilt(sections, each - each.mean())) for each in (first, second))
    length = min(len(one), len(two), round(_MEMORY_S * RATE_HZ))
    # Bartlett: the variance of the correlation of two unrelated signals.
    product = _own_correlation(one, length) * _own_correlation(two, length)
    return _Signal(one, two, max(1.0, float(1.0 + 2.0 * product[1:].sum())))


def _own_correlation(values: FloatArray, length: int) -> FloatArray:
    """Return the correlation (length,) of a signal with itself at lags from 0."""
    size = 1 << (len(values) + length).bit_length()
    spectrum = np.fft.rfft(values, size)
    product = np.fft.irfft(spectrum * np.conj(spectrum), size)[:length]
    return np.asarray(product / max(float(product[0]), 1e-12))


def _correlations(signal: _Signal, lags: IntArray, counts: FloatArray) -> FloatArray:
    """Return the correlation coefficient (K,) of the common samples at each lag.

    At lag k, sample i + k of the first camera meets sample i of the second one.
    """
    first, second = signal.first, signal.second
    size = 1 << (len(first) + len(second)).bit_length()
    moved = np.fft.irfft(np.fft.rfft(first, size) * np.conj(np.fft.rfft(second, size)), size)
    products = moved[lags]  # negative lags are at the end
    begin = np.maximum(lags, 0)
    end = begin + counts.astype(np.int64)
    sums: list[FloatArray] = []
    squares: list[FloatArray] = []
    for values, shift in ((first, np.zeros_like(lags)), (second, lags)):
        for kept, powers in ((sums, values), (squares, values**2)):
            running = np.concatenate([[0.0], np.cumsum(powers)])
            kept.append(running[end - shift] - running[begin - shift])
    spread = [square - total**2 / counts for total, square in zip(sums, squares, strict=True)]
    product = products - sums[0] * sums[1] / counts
    return np.asarray(product / np.sqrt(np.maximum(spread[0] * spread[1], 1e-18)))


def _half_scores(signals: list[_Signal], lag: int, begin: int, end: int) -> tuple[float, float]:
    """Return the score of a part of the first recording at a lag, and the best one near it."""
    reach = round(_HALF_RANGE_S * RATE_HZ)
    scores = np.zeros(2 * reach + 1)
    for signal in signals:
        for index in range(len(scores)):
            other = begin - lag - (index - reach)
            low, high = max(0, -other), min(end - begin, len(signal.second) - other)
            if high - low < 0.5 * (end - begin):
                continue
            one = signal.first[begin + low : begin + high]
            two = signal.second[other + low : other + high]
            one, two = one - one.mean(), two - two.mean()
            norm = float(np.sqrt((one @ one) * (two @ two)))
            correlation = np.array([float(one @ two) / max(norm, 1e-18)])
            scores[index] += float(signal.likelihood(correlation, high - low)[0])
    return float(scores[reach]), float(scores.max())


def _vertex(scores: FloatArray, peak: int) -> tuple[float, float]:
    """Return where a parabola through the scores near a peak has its vertex, relative to it, and the spread.

    Both are in samples. The scores are logarithms of likelihoods, so the spread is a standard deviation.
    """
    near = np.arange(max(0, peak - 3), min(len(scores), peak + 4))
    if len(near) < 3:
        return 0.0, float("inf")
    curvature, slope, _ = np.polyfit(near - peak, scores[near], 2)
    if curvature >= 0.0:
        return 0.0, float("inf")
    return float(np.clip(-0.5 * slope / curvature, -2.0, 2.0)), float(1.0 / np.sqrt(-2.0 * curvature))
