"""Fit the clock of a stream: the time of each sample, from the times of the payloads that hold them.

A payload holds the samples of about a second. Its time in the file is a multiple of the nominal second, while
the true rate of a sensor differs from the nominal rate by up to 1 %. Therefore a line is fitted: time of the
first sample of a payload = start + number of the sample / rate.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray

_MAX_RATE_DIFFERENCE = 0.05
"""Maximum relative difference of the payloads' own stamps from their times in the file. With a larger
difference, the recording is a timelapse or slow motion. Origin: clocks differ by 0.01 %; 1 % is usual for
rates, since times in the file are nominal."""
_OUTLIER_RATIO = 6.0
"""Residual of a payload from the line, as a multiple of the median residual, above which the payload is left
out of the fit. Evidence: none."""
_LEAST_RESIDUAL_S = 0.001
"""Residual (seconds) below which no payload is left out: the resolution of the times of a payload."""
_FIT_ROUNDS = 4
"""Number of fits; each leaves out the payloads with large residuals of the fit before. Evidence: none."""
_MAX_LOST_S = 3600.0
"""Maximum gap (seconds) between two payloads that their sample counters may show. A longer one is damage.
Evidence: none."""
MAX_SAMPLES = 50_000_000
"""Maximum number of samples of a stream. A gyroscope of 400 Hz gives 35 million in a day."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Payload:
    """What the clock needs from one payload of a stream.

    Attributes:
        time_s: Time of the payload in the file, seconds.
        duration_s: Duration of the payload in the file, seconds.
        count: Number of samples.
        stamp_s: The payload's own stamp (STMP or TICK) on a clock with another origin, seconds; None if there
            is none.
        total: Number of samples up to the end of this payload (TSMP); None if it is not given.
    """

    time_s: float
    duration_s: float
    count: int
    stamp_s: float | None = None
    total: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamClock:
    """The times of the samples of a stream.

    Attributes:
        start_s: Time of sample number 0 in the file, seconds.
        rate_hz: Samples per second.
        first: (P,) number of the first sample of each payload. Lost samples are counted, too.
        stamp_ratio: Seconds of the payloads' own stamps per second of the file; 1 without stamps.
        notes: Notes for the user.
    """

    start_s: float
    rate_hz: float
    first: IntArray
    stamp_ratio: float = 1.0
    notes: tuple[str, ...] = ()

    @property
    def is_timelapse(self) -> bool:
        """True if the stamps contradict the times in the file."""
        return abs(self.stamp_ratio - 1.0) > _MAX_RATE_DIFFERENCE

    def times_s(self, counts: Sequence[int]) -> FloatArray:
        """Return the time of each sample in the file, seconds, in the order of the payloads.

        Args:
            counts: Number of samples of each payload.
        """
        numbers = [first + np.arange(count) for first, count in zip(self.first.tolist(), counts, strict=True)]
        return np.asarray(self.start_s + np.concatenate(numbers) / self.rate_hz)


def fit_stream_clock(payloads: Sequence[Payload]) -> StreamClock | None:
    """Fit the clock of a stream.

    Args:
        payloads: The payloads with samples, with increasing times.

    Returns:
        The clock; None if the payloads determine no rate.
    """
    counts = np.array([payload.count for payload in payloads], dtype=np.int64)
    times = np.array([payload.time_s for payload in payloads])
    first = _first_samples(payloads, counts)
    if len(payloads) == 1:
        if payloads[0].duration_s <= 0:
            return None
        return StreamClock(
            start_s=float(times[0]), rate_hz=float(counts[0] / payloads[0].duration_s), first=first
        )
    step_s = _robust_slope(first, times)
    if not step_s > 0:
        return None
    notes: list[str] = []
    ratio = 1.0
    if all(payload.stamp_s is not None for payload in payloads):
        stamps = np.array([payload.stamp_s for payload in payloads], dtype=np.float64)
        stamp_step_s = _robust_slope(first, stamps)
        if not stamp_step_s > 0 or (np.diff(stamps) <= 0).any():
            notes.append("the time stamps of the telemetry run backwards and are not used")
        else:
            ratio = stamp_step_s / step_s
            if abs(ratio - 1.0) <= _MAX_RATE_DIFFERENCE:
                step_s = stamp_step_s
    start_s = float(np.median(times - first * step_s)) if notes else float(np.mean(times - first * step_s))
    return StreamClock(
        start_s=start_s, rate_hz=1.0 / step_s, first=first, stamp_ratio=ratio, notes=tuple(notes)
    )


def _first_samples(payloads: Sequence[Payload], counts: IntArray) -> IntArray:
    """Return the number of the first sample of each payload.

    The counters of the payloads show where samples were lost. Without counters, or with counters that
    contradict themselves, the times of the payloads in the file show where payloads are missing.
    """
    totals = [payload.total for payload in payloads]
    if all(total is not None for total in totals):
        counted = np.array(totals, dtype=np.int64) - counts
        counted -= counted[0]
        lost = np.diff(counted) - counts[:-1]
        duration_s = payloads[-1].time_s + payloads[-1].duration_s - payloads[0].time_s
        rate_hz = float(counts.sum()) / max(duration_s, 1e-9)
        is_plausible = (lost >= 0).all() and (lost <= _MAX_LOST_S * rate_hz).all()
        if is_plausible and counted[-1] < MAX_SAMPLES:
            return counted
    lost = np.array([_missing_between(one, other) for one, other in itertools.pairwise(payloads)], np.int64)
    return np.concatenate([[0], np.cumsum(counts[:-1] + lost)])


def _missing_between(payload: Payload, after: Payload) -> int:
    """Return the number of samples that are missing between two payloads, according to their times."""
    gap_s = after.time_s - payload.time_s - payload.duration_s
    if not 0.5 * payload.duration_s < gap_s <= _MAX_LOST_S or payload.duration_s <= 0:
        return 0
    return min(round(payload.count * gap_s / payload.duration_s), MAX_SAMPLES)


def _robust_slope(first: IntArray, times_s: FloatArray) -> float:
    """Return the seconds per sample of the line that fits most payloads; 0 if there is none."""
    keep = np.ones(len(first), dtype=bool)
    x = first.astype(np.float64)
    slope = 0.0
    for _ in range(_FIT_ROUNDS):
        if keep.sum() < 2 or np.ptp(x[keep]) == 0:
            return 0.0
        centre_x, centre_t = x[keep].mean(), times_s[keep].mean()
        offset = x[keep] - centre_x
        slope = float(offset @ (times_s[keep] - centre_t) / (offset @ offset))
        residual = np.abs(times_s - centre_t - slope * (x - centre_x))
        keep = residual <= max(_OUTLIER_RATIO * float(np.median(residual)), _LEAST_RESIDUAL_S)
    return slope
