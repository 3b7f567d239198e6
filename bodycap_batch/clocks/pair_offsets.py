"""Measure the difference between the clocks of two cameras from their sound.

Windows of one sound are searched for in all of the other. The best lags are then examined with windows along
the whole common time: the offsets of these windows must lie on one line, whose slope is the drift.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.clocks.joint_offsets import MAX_DRIFT_PPM, ClockPair
from bodycap_batch.clocks.phase_correlation import (
    PEAK_WIDTH_S,
    Peak,
    find_peaks,
    log_chance,
    phase_correlation,
    phase_spectrum,
    smoothed_energy,
    transform_size,
)
from bodycap_batch.clocks.sound_track import RATE_HZ, Samples, SoundTrack
from bodycap_batch.core.arrays import BoolArray, FloatArray

MIN_DRIFT_SPAN_S = 40.0
"""Least time, seconds, between the first and the last window from which the drift is measured. Origin: about
a minute of sound; the way of sound changes by 1 ms, which is 20 ppm of this time."""
_WINDOW_S = 6.0
"""Duration of a window, seconds. Origin: at 50 ppm two clocks move by 0.3 ms in it, which is less than
`SMOOTHING_S`. Evidence: docs/decisions/clocks.md."""
_FEW_WINDOWS = 3
"""Least number of windows into which the common time is divided at first. Evidence: none."""
_MIN_WINDOW_S = 1.0
"""Least duration of a window, seconds. With cloth noise, many short windows, of which some lie between the
bursts of the noise, show more than a few long ones. Evidence: docs/decisions/clocks.md."""
_MAX_WINDOWS = 24
"""Maximum number of windows along the common time. More windows hardly improve the line. Evidence: none."""
_SEARCHES = (1, 3, 8, 12)
"""Number of windows in each round of the search. The search ends as soon as an offset is accepted, or two
offsets pass every test but the comparison with each other. Evidence: docs/decisions/clocks.md."""
_EXAMINED_CHANNELS = 2
"""Maximum number of combinations of two channels that are examined. The others have less clear peaks."""
_CHANCE_HEIGHT = 4.0
"""Height of the highest peak of a window of unrelated sounds, σ. Evidence: docs/decisions/clocks.md."""
_CANDIDATES = 6
"""Number of peaks of each searched window that are examined."""
_MIN_CANDIDATE_RATIO = 0.5
"""Least height of a peak, relative to the highest one of the same window, of which the windows are examined.
Origin: the inverse of the ratio below which two offsets count as equally good."""
_BLOCK = 1 << 19
"""Size of the transform, samples, in which a window is searched for in a long sound; 33 s. Origin: limits the
memory to some megabytes."""
_AGREEMENT_S = 0.003
"""Maximum difference, seconds, of a window's offset from the line of the others. Origin: between the ears of
a body the way of sound differs by up to 3 ms, which changes as the arms move."""
_CLEAR_LOG_CHANCE = float(np.log(0.01))
"""Logarithm of the probability below which the peak of a window counts. At most one of a hundred windows of
unrelated sounds has such a peak."""
_MAX_LOG_CHANCE = float(np.log(1e-3))
"""Logarithm of the maximum probability that unrelated sounds give the peaks of an accepted offset. The other
conditions reduce the probability further. Evidence: docs/decisions/clocks.md."""
_MIN_RIVAL_RATIO = 2.0
"""Least ratio of the summed heights of the accepted lag to those of any other lag. Evidence:
docs/decisions/clocks.md."""
_MIN_CHANNELS_RATIO = 4.0
"""The same ratio, if several channels were compared: hum of the mains is in many dead channels. Evidence:
docs/decisions/clocks.md."""
_MIN_AGREEING = 0.6
"""Least fraction of the windows with a clear peak that must agree with the line. Evidence: none."""
_SCATTER_FLOOR_S = 0.0003
"""Least standard deviation, seconds, of the offset of a window. Origin: the smoothing of the correlation."""
_SLOW_S = 0.0003
"""Standard deviation, seconds, of the change of the way of sound from the start to the end of a recording.
Evidence: docs/decisions/clocks.md."""
_FINE_UP_TO_S = 60.0
"""Maximum duration of the shorter sound, seconds, with which many short windows are examined, too. Longer
sound has enough windows of the usual duration. Evidence: docs/decisions/clocks.md."""
_CURVE_S = 0.03
"""Lag, seconds, before and after the peak, in the curve for the picture."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ChunkOffset:
    """The offset that one window of sound gives.

    Attributes:
        time_s: Middle of the window on the second camera's clock, seconds.
        offset_s: Time on the first camera's clock − time on the second camera's clock, seconds.
        height: Height of the peak, in σ of the noise.
        agrees: True if the peak is clear and the offset is on the line of the pair.
    """

    time_s: float
    offset_s: float
    height: float
    agrees: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class PairOffset(ClockPair):
    """What the sound of two cameras says about their clocks; `sigma_s` is without the way of sound.

    Attributes:
        channels: Name of the compared channel of each camera; "" for the mono mix of its first sound stream.
        evidence: Summed heights of the windows that agree, σ.
        rival_ratio: `evidence` over that of the best other lag.
        log_chance: Logarithm of the probability that unrelated sounds give this result.
        chunks: The offsets of the windows.
        curve_lags_s: (N,) offsets of the curve, seconds.
        curve: (N,) mean energy of the correlations of the windows, relative to its mean.
    """

    channels: tuple[str, str] = ("", "")
    rival_ratio: float = 0.0
    log_chance: float = 0.0
    chunks: tuple[ChunkOffset, ...] = ()
    curve_lags_s: FloatArray | None = None
    curve: FloatArray | None = None


def measure_channels(
    first: Sequence[SoundTrack], second: Sequence[SoundTrack], expected_s: tuple[float, float] | None = None
) -> PairOffset:
    """Measure the difference between the clocks of two cameras from any of their channels.

    All combinations of two channels are searched; only the clearest ones are examined. Each combination is
    one more trial, in which unrelated sounds may resemble each other.

    Args:
        first: Channels of the first camera, without a problem; at least one.
        second: Channels of the second camera, without a problem; at least one.
        expected_s: See `measure_pair`.
    """
    pairs = list(itertools.product(first, second))
    if len(pairs) > 1:
        pairs.sort(key=lambda pair: -_clearness(*pair))
    found = [measure_pair(*pair, expected_s, len(pairs)) for pair in pairs[:_EXAMINED_CHANNELS]]
    return next((pair for pair in found if pair.accepted), found[0])


def _clearness(first: SoundTrack, second: SoundTrack) -> float:
    """Return the ratio of the two highest peaks, in the clearest of some windows of the shorter sound."""
    one, two = sorted((first, second), key=lambda track: track.end_s - track.start_s)
    starts = _search_starts(one)[: sum(_SEARCHES[:2])]
    heights = [[*(peak.height for peak in peaks), 0.0, 0.0] for peaks, _ in _search(one, starts, two, None)]
    ratios = (highest / max(next_one, _CHANCE_HEIGHT) for highest, next_one, *_ in heights)
    return max(ratios, default=0.0)


def measure_pair(
    first: SoundTrack,
    second: SoundTrack,
    expected_s: tuple[float, float] | None = None,
    trials: int = 1,
) -> PairOffset:
    """Measure the difference between the clocks of two cameras.

    Args:
        first: Sound of the first camera, without a problem.
        second: Sound of the second camera, without a problem.
        expected_s: Least and greatest offset that is searched first, seconds. If nothing is found there, all
            offsets are searched.
        trials: Number of pairs of sounds of these cameras that are compared.
    """
    # Windows are taken from the shorter sound, because most of the longer one may be alone.
    if second.end_s - second.start_s < first.end_s - first.start_s:
        swapped = None if expected_s is None else (-expected_s[1], -expected_s[0])
        return _turned(measure_pair(second, first, swapped, trials))
    best = _measure(first, second, expected_s, trials)
    if expected_s is not None and not best.accepted:
        found = _measure(first, second, None, trials)
        if found.accepted or found.log_chance < best.log_chance:
            best = found
    return best


def _turned(pair: PairOffset) -> PairOffset:
    """Return the same result with the cameras exchanged."""
    chunks = tuple(
        replace(chunk, time_s=chunk.time_s + chunk.offset_s, offset_s=-chunk.offset_s)
        for chunk in pair.chunks
    )
    return replace(
        pair,
        first=pair.second,
        second=pair.first,
        channels=(pair.channels[1], pair.channels[0]),
        pivot_s=pair.pivot_s + pair.offset_s,
        offset_s=-pair.offset_s,
        drift_ppm=-pair.drift_ppm / (1.0 + 1e-6 * pair.drift_ppm),
        chunks=chunks,
        curve_lags_s=None if pair.curve_lags_s is None else -pair.curve_lags_s[::-1],
        curve=None if pair.curve is None else pair.curve[::-1].copy(),
    )


def _measure(
    first: SoundTrack, second: SoundTrack, limits: tuple[float, float] | None, trials: int
) -> PairOffset:
    starts = _search_starts(first)
    examined: list[_Candidate] = []
    searched: list[tuple[float, Peak, float]] = []
    done = 0
    outcome = PairOffset(
        first=first.camera, second=second.camera, reason="no window of the sound has a clear peak"
    )
    for size in _SEARCHES:
        batch, done = starts[done : done + size], done + size
        if not batch:
            break
        for start_s, (peaks, lags) in zip(batch, _search(first, batch, second, limits), strict=True):
            for peak in peaks:
                is_high = peak.height >= _MIN_CANDIDATE_RATIO * peaks[0].height
                if is_high and not _is_known(examined, peak.lag_s):
                    searched.append((start_s, peak, lags * len(starts) * trials))
                    examined.append(_examine(first, second, *searched[-1], _FEW_WINDOWS))
        if examined:
            outcome = _decide(first, second, examined, trials)
        if examined and not outcome.accepted and first.end_s - first.start_s <= _FINE_UP_TO_S:
            # The second examination counts as twice the number of lags.
            finer = [
                _examine(first, second, start_s, peak, 2 * lags, _MAX_WINDOWS)
                for start_s, peak, lags in searched
            ]
            found = _decide(first, second, finer, trials)
            outcome = found if found.accepted else outcome
        if outcome.accepted or _repeats(examined):
            break
    return outcome


def _search_starts(track: SoundTrack) -> list[float]:
    """Return the starts of the windows for the search, seconds: the loudest of each part of the sound.

    Windows that are far from each other come first.
    """
    times, levels = track.levels()
    duration = track.end_s - track.start_s
    if duration <= 1.5 * _WINDOW_S or len(times) < 2:
        return [track.start_s]
    parts = min(sum(_SEARCHES), max(1, int(duration / _WINDOW_S)))
    loudness = np.convolve(levels, np.ones(round(_WINDOW_S / 0.1)), "full")[round(_WINDOW_S / 0.1) - 1 :]
    starts = []
    edges = np.linspace(track.start_s, track.end_s - _WINDOW_S, parts + 1)
    for low, high in itertools.pairwise(edges.tolist()):
        inside = np.flatnonzero((times >= low) & (times <= high))
        if len(inside) and loudness[inside].max() > 0:
            starts.append(float(times[inside[loudness[inside].argmax()]]))
    order = sorted(range(len(starts)), key=lambda index: (index * 0.618034 + 0.5) % 1.0)
    return [starts[index] for index in order]


def _search(
    first: SoundTrack, starts_s: Sequence[float], second: SoundTrack, limits: tuple[float, float] | None
) -> list[tuple[list[Peak], int]]:
    """Search windows of the first sound in all of the second.

    Returns:
        For each window: the highest peaks, whose lag is the offset of the pair, and the number of lags.
    """
    count = min(round(1.5 * _WINDOW_S * RATE_HZ), round((first.end_s - first.start_s) * RATE_HZ))
    count = count if len(starts_s) == 1 and count < 1.5 * _WINDOW_S * RATE_HZ else round(_WINDOW_S * RATE_HZ)
    margin = count - round(_MIN_WINDOW_S * RATE_HZ)
    begin_s, end_s = second.start_s - margin / RATE_HZ, second.end_s + margin / RATE_HZ
    if limits is not None:
        begin_s = max(begin_s, min(starts_s) - limits[1])
        end_s = min(end_s, max(starts_s) - limits[0] + count / RATE_HZ)
    total = round((end_s - begin_s) * RATE_HZ)
    found: list[tuple[list[Peak], int]] = [([], 0) for _ in starts_s]
    if total <= count:
        return found
    size = transform_size(total) if total <= _BLOCK else _BLOCK
    top_hz = min(first.top_hz, second.top_hz)
    windows = [phase_spectrum(first.samples(start, count), size, top_hz) for start in starts_s]
    times = [first.sample_time(start) for start in starts_s]
    step = size - count
    for block in range(0, total - count, step):
        block_s = begin_s + block / RATE_HZ
        spectrum = phase_spectrum(second.samples(block_s, size), size, top_hz)
        if not spectrum.any():
            continue
        block_s = second.sample_time(block_s)
        for index, window in enumerate(windows):
            lags = min(step, total - count - block)
            correlation = phase_correlation(window, spectrum, size)[:lags]
            peaks = [
                Peak(times[index] - block_s - peak.lag_s, peak.height)
                for peak in find_peaks(correlation, 0, _CANDIDATES)
            ]
            if limits is not None:
                peaks = [peak for peak in peaks if limits[0] <= peak.lag_s <= limits[1]]
            best = sorted([*found[index][0], *peaks], key=lambda each: -each.height)[:_CANDIDATES]
            found[index] = best, found[index][1] + lags
    return found


@dataclass(frozen=True, slots=True)
class _Candidate:
    """An offset of the search, examined along the whole common time.

    Attributes:
        lag_s: Offset in the window of the search, seconds.
        height: Height of the peak in the search, σ.
        lags: Number of lags of the search.
        times_s: (W,) middles of the windows on the second camera's clock, seconds.
        offsets_s: (W,) their offsets, seconds.
        heights: (W,) heights of their peaks, σ.
        log_chances: (W,) logarithms of the probabilities of these peaks for unrelated sounds.
        agrees: (W,) True if the window has a clear peak on the line.
    """

    lag_s: float
    height: float
    lags: float
    times_s: FloatArray
    offsets_s: FloatArray
    heights: FloatArray
    log_chances: FloatArray
    agrees: BoolArray

    @property
    def evidence(self) -> float:
        """Summed heights of the windows that agree."""
        return float(self.heights[self.agrees].sum())

    @property
    def log_chance(self) -> float:
        """Logarithm of the probability that the windows of unrelated sounds have such heights together.

        The sum of the heights of W windows has a standard deviation of √W. A single window counts at most
        twice as much as the next one.
        """
        heights = np.sort(self.heights[self.agrees])
        if len(heights) < 2:
            return 0.0
        summed = float(np.minimum(heights, 2.0 * heights[-2]).sum())
        return log_chance(summed / float(np.sqrt(len(self.heights))), self.lags)

    def refusal(self) -> str:
        """Return why this offset is refused, whatever the others are; "" if it is not."""
        agreeing, clear = int(self.agrees.sum()), int((self.log_chances < _CLEAR_LOG_CHANCE).sum())
        if agreeing < 2:
            return "fewer than two windows of the sound agree on an offset"
        if agreeing < _MIN_AGREEING * clear:
            return f"only {agreeing} of {clear} windows of the sound agree on an offset"
        if self.log_chance > _MAX_LOG_CHANCE:
            return "the sounds resemble each other no more than unrelated sounds do"
        return ""


def _is_known(examined: Sequence[_Candidate], lag_s: float) -> bool:
    """Return True if an examined candidate has this offset."""
    found = (np.append(each.offsets_s[each.agrees], each.lag_s) for each in examined)
    return any((np.abs(offsets_s - lag_s) < PEAK_WIDTH_S).any() for offsets_s in found)


def _examine(
    first: SoundTrack, second: SoundTrack, start_s: float, peak: Peak, lags: float, windows: int
) -> _Candidate:
    """Examine an offset with at least a number of windows along the common time, if it is long enough."""
    offset = peak.lag_s
    begin, end = max(first.start_s, second.start_s + offset), min(first.end_s, second.end_s + offset)
    searched = min(_WINDOW_S, first.end_s - first.start_s)
    anchor = start_s + 0.5 * searched
    length = min(_WINDOW_S, max((end - begin) / windows, _MIN_WINDOW_S))
    middles = _middles((begin, end), length, anchor, windows)
    rows = []
    for middle in middles:
        reach_s = 0.006 + 1e-6 * MAX_DRIFT_PPM * abs(middle - anchor)
        found = _window_peak(first, second, middle, length, offset, reach_s)
        # Most of the reach serves to find the drift: on a given line only ±_AGREEMENT_S remains.
        near = 2 * _AGREEMENT_S * RATE_HZ
        rows.append((middle - found.lag_s, found.lag_s, found.height, log_chance(found.height, near)))
    times, offsets, heights, chances = np.array(rows).T
    clear = chances < _CLEAR_LOG_CHANCE
    agrees = clear & _on_best_line(times, offsets, heights * clear)
    return _Candidate(offset, peak.height, lags, times, offsets, heights, chances, agrees)


def _middles(common: tuple[float, float], length: float, anchor: float, windows: int) -> list[float]:
    """Return the middles of windows that do not overlap the window of the search, nor each other, seconds.

    If the common time is shorter than the least number of windows of full length, it is divided evenly
    instead.
    """
    begin, end = common
    if end - begin <= windows * _WINDOW_S:
        count = max(1, int((end - begin) / length + 1e-6))
        return [begin + (index + 0.5) * (end - begin) / count for index in range(count)]
    step = max(length, (end - begin) / _MAX_WINDOWS)
    # A window may protrude from the common time by a third of its length.
    low = int(np.ceil((begin + length / 6 - anchor) / step))
    high = int(np.floor((end - length / 6 - anchor) / step))
    return [anchor + index * step for index in range(low, high + 1)]


def _window_peak(
    first: SoundTrack, second: SoundTrack, middle_s: float, length_s: float, offset_s: float, reach_s: float
) -> Peak:
    """Return the highest peak of a window near an offset; its lag is the offset of the pair."""
    correlation, zero_s = _window_correlation(first, second, middle_s, length_s, offset_s)
    half = len(correlation) // 2
    shift = round((offset_s - zero_s) * RATE_HZ)
    reach = round(reach_s * RATE_HZ)
    peaks = find_peaks(correlation, -half, 1, (-shift - reach, -shift + reach))
    return Peak(zero_s - peaks[0].lag_s, peaks[0].height) if peaks else Peak(offset_s, 0.0)


def _window_correlation(
    first: SoundTrack, second: SoundTrack, middle_s: float, length_s: float, offset_s: float
) -> tuple[Samples, float]:
    """Return the correlation of two windows at lags around 0, and the offset at which the lag is 0."""
    count = round(length_s * RATE_HZ)
    start = middle_s - 0.5 * length_s
    top_hz = min(first.top_hz, second.top_hz)
    size = transform_size(2 * count)
    one = phase_spectrum(first.samples(start, count), size, top_hz)
    two = phase_spectrum(second.samples(start - offset_s, count), size, top_hz)
    zero_s = first.sample_time(start) - second.sample_time(start - offset_s)
    half = count // 2
    correlation = phase_correlation(one, two, size)
    return np.concatenate([correlation[-half:], correlation[: half + 1]]), zero_s


def _on_best_line(times: FloatArray, offsets: FloatArray, weights: FloatArray) -> BoolArray:
    """Return which windows (W,) lie on the line that the greatest weight of windows lies on."""
    if not weights.any():
        return np.zeros(len(times), bool)
    span = float(np.ptp(times))
    slopes = np.arange(0.0, MAX_DRIFT_PPM * 1e-6 + 1e-12, max(0.5 * _AGREEMENT_S / max(span, 1.0), 2e-6))
    if span < MIN_DRIFT_SPAN_S:
        slopes = slopes[:1]
    best, most = np.zeros(len(times), bool), 0.0
    limited = np.minimum(weights, 3.0 * float(np.median(weights[weights > 0])))
    for slope in np.concatenate([-slopes[:0:-1], slopes]).tolist():
        rest = offsets - slope * times
        for centre in rest[weights > 0].tolist():
            on = np.abs(rest - centre) < _AGREEMENT_S
            support = float(limited[on].sum())
            if support > most:
                best, most = on, support
    return best


def _rival_ratio(examined: Sequence[_Candidate], best: _Candidate) -> float:
    """Return the evidence of the best candidate over that of the second one."""
    return best.evidence / max([each.evidence for each in examined if each is not best] + [1.0])


def _repeats(examined: Sequence[_Candidate]) -> bool:
    """Return True if two offsets, neither of which is much better, pass all tests of a single offset."""
    passing = [each for each in examined if not each.refusal()]
    if len(passing) < 2:
        return False
    return _rival_ratio(passing, max(passing, key=lambda each: each.evidence)) < _MIN_RIVAL_RATIO


def _decide(first: SoundTrack, second: SoundTrack, examined: Sequence[_Candidate], trials: int) -> PairOffset:
    """Accept or refuse the best candidate."""
    best = max(examined, key=lambda each: each.evidence)
    ratio = _rival_ratio(examined, best)
    reason = best.refusal()
    if not reason and ratio < (_MIN_RIVAL_RATIO if trials == 1 else _MIN_CHANNELS_RATIO):
        reason = "several offsets suit the sound equally well: it repeats"
    chunks = tuple(
        ChunkOffset(time_s=time, offset_s=offset, height=height, agrees=bool(agrees))
        for time, offset, height, agrees in zip(
            best.times_s.tolist(), best.offsets_s.tolist(), best.heights.tolist(), best.agrees, strict=True
        )
    )
    pair = PairOffset(
        first=first.camera,
        second=second.camera,
        accepted=not reason,
        reason=reason,
        channels=(first.name, second.name),
        evidence=best.evidence,
        rival_ratio=ratio,
        log_chance=best.log_chance,
        chunks=chunks,
    )
    pair = _with_line(pair, best)
    lags, curve = _mean_curve(first, second, best, pair)
    return replace(pair, curve_lags_s=lags, curve=curve)


def _with_line(pair: PairOffset, candidate: _Candidate) -> PairOffset:
    """Return the pair with offset and drift of the windows that agree."""
    if not candidate.agrees.any():
        return replace(pair, pivot_s=float(candidate.times_s.mean()), offset_s=candidate.lag_s)
    times, offsets = candidate.times_s[candidate.agrees], candidate.offsets_s[candidate.agrees]
    pivot = float(times.mean())
    span = float(np.ptp(times))
    is_long = span >= MIN_DRIFT_SPAN_S and len(times) >= 4
    weights = np.ones(len(times))
    slope, constant = 0.0, float(np.median(offsets))
    for _ in range(5):
        if is_long:
            slope, constant = (float(v) for v in np.polyfit(times - pivot, offsets, 1, w=np.sqrt(weights)))
        else:
            constant = float(np.average(offsets, weights=weights))
        rest = offsets - constant - slope * (times - pivot)
        scale = max(1.4826 * float(np.median(np.abs(rest))), _SCATTER_FLOOR_S)
        weights = 1.0 / (1.0 + (rest / (2.0 * scale)) ** 2)
    sigma_s = scale / float(np.sqrt(weights.sum()))
    pair = replace(pair, pivot_s=pivot, offset_s=constant, sigma_s=sigma_s)
    if not is_long:
        return pair
    lever = float(np.sqrt((weights * (times - pivot) ** 2).sum()))
    drift_sigma = float(np.hypot(scale / lever, _SLOW_S / span))
    return replace(pair, drift_ppm=1e6 * slope, drift_sigma_ppm=1e6 * drift_sigma, drift_measured=True)


def _mean_curve(
    first: SoundTrack, second: SoundTrack, candidate: _Candidate, pair: PairOffset
) -> tuple[FloatArray, FloatArray]:
    """Return offsets (N,) and the mean energy (N,) of some windows' correlations, for the picture."""
    reach = round(_CURVE_S * RATE_HZ)
    chosen = np.flatnonzero(candidate.agrees if candidate.agrees.any() else candidate.heights >= 0)[:8]
    length = min(_WINDOW_S, first.end_s - first.start_s)
    total = np.zeros(2 * reach + 1)
    for index in chosen.tolist():
        time = float(candidate.times_s[index])
        offset = pair.offset_s + 1e-6 * pair.drift_ppm * (time - pair.pivot_s)
        correlation, zero_s = _window_correlation(first, second, time + offset, length, offset)
        at = len(correlation) // 2 + round((zero_s - offset) * RATE_HZ)
        energy = smoothed_energy(correlation**2) / max(float((correlation**2).mean()), 1e-20)
        part = energy[max(0, at - reach) : at + reach + 1][::-1]
        if len(part) == len(total):
            total += part / len(chosen)
    return pair.offset_s + (np.arange(2 * reach + 1) - reach) / RATE_HZ, total
