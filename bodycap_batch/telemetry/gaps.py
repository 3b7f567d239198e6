"""Find the stretches without measurements: no samples, or a sensor at the end of its range."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import FloatArray, runs
from bodycap_batch.telemetry.streams import ACCELEROMETER, GYROSCOPE

_MAX_GAP_RATIO = 1.5
"""Distance of two samples, as a multiple of the sample interval, above which there is a gap."""
_LEAST_RANGES = {GYROSCOPE: 4.3, ACCELEROMETER: 19.4}
"""Least range of a sensor, by key of its stream: rad/s and m/s². Origin: 250 degrees per second and 2 g are
the smallest ranges that makers offer, less 1 %."""
_RELATIVE_ROUNDING = 1e-4
"""Largest relative difference of two values at the end of a range. Origin: three steps of 16 bits."""
_LEAST_SAMPLES = 2
"""Least number of successive samples at the largest value: a single one is a peak of the motion."""


def gaps_of(
    key: str, times_s: FloatArray, values: FloatArray, rate_hz: float
) -> tuple[tuple[float, float], ...]:
    """Return start and end (seconds) of each stretch without measurements.

    Args:
        key: Key of the stream.
        times_s: (N,) times of the samples, seconds.
        values: (N,C) values along the axes of the sensor.
        rate_hz: Samples per second.
    """
    wide = np.flatnonzero(np.diff(times_s) > _MAX_GAP_RATIO / rate_hz)
    gaps = ((float(times_s[index]), float(times_s[index + 1])) for index in wide)
    return (*gaps, *saturated_stretches(key, times_s, values))


def saturated_stretches(key: str, times_s: FloatArray, values: FloatArray) -> tuple[tuple[float, float], ...]:
    """Return start and end (seconds) of each stretch in which a sensor was at the end of its range.

    A stretch lasts from the last measurement before it to the first one after it.

    Args:
        key: Key of the stream, `GYROSCOPE` or `ACCELEROMETER`; other streams have no such stretches.
        times_s: (N,) times of the samples, seconds.
        values: (N,C) values along the axes of the sensor.
    """
    least = _LEAST_RANGES.get(key)
    if least is None or not len(values):
        return ()
    at_end = np.zeros(len(values), dtype=bool)
    for column in np.abs(values).T:
        largest = float(np.nanmax(column, initial=0.0))
        if largest >= least:
            for start, stop in runs(column >= (1.0 - _RELATIVE_ROUNDING) * largest):
                at_end[start:stop] |= stop - start >= _LEAST_SAMPLES
    last = len(times_s) - 1
    return tuple(
        (float(times_s[max(start - 1, 0)]), float(times_s[min(stop, last)])) for start, stop in runs(at_end)
    )
