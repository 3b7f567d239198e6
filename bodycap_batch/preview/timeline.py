"""Which instants of a capture the preview shows, and how fast."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from bodycap_batch.core.arrays import IntArray, set_array

MAX_FRAMES = 720
"""48 seconds at 15 pictures a second, a minute at 12: what a person looks through, and what is rendered in a
time that does not matter beside the map's."""
MIN_FPS = 12
_USUAL_FPS = 15.0
"""Enough to follow a body. At 30 the preview of an easy walk took as long as the walk's map."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Timeline:
    """Instants to show.

    Attributes:
        times_ns: (F,) common time of each picture, evenly spaced.
        fps: Pictures a second of the preview.
        speed: How many seconds of the capture pass in one of the preview; at least 1.
    """

    times_ns: IntArray
    fps: Fraction
    speed: float

    def __post_init__(self) -> None:
        set_array(self, "times_ns", (None,), np.int64)


def make_timeline(start_ns: int, stop_ns: int, fps: float) -> Timeline:
    """Spread at most `MAX_FRAMES` pictures evenly over a stretch of time.

    Args:
        start_ns: First instant, common time.
        stop_ns: Last instant.
        fps: Rate of the motion or of the videos; above 22 only every second, third ... instant is taken.
    """
    rate = Fraction(fps).limit_denominator(1001)
    # A hundredth of a picture more: a rate taken from rounded times must not lose the last one.
    whole = int(Fraction(stop_ns - start_ns, 10**9) * rate + Fraction(1, 100)) + 1
    stride = max(1, round(fps / _USUAL_FPS), -(-whole // MAX_FRAMES))
    shown = rate / stride
    step_ns = 10**9 / shown
    count = -(-whole // stride)
    times = [min(start_ns + round(index * step_ns), stop_ns) for index in range(count)]
    played = max(shown, min(rate, Fraction(MIN_FPS)))
    return Timeline(times_ns=np.array(times, dtype=np.int64), fps=played, speed=float(played / shown))
