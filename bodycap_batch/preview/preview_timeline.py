"""The times that the preview shows, and the preview's frame rate."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from bodycap_batch.core.arrays import IntArray, set_array

MAX_FRAMES = 720
"""Frames of the preview: 48 seconds at 15 frames per second, a minute at 12.

A person has the patience for that, and rendering takes little time compared with mapping.
"""
MIN_FPS = 12
"""Lowest frame rate at which the preview is played, frames per second. Evidence: none."""
_TARGET_FPS = 15.0
"""Frames per second that are enough to follow a body. Evidence: docs/decisions/report.md."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PreviewTimeline:
    """The times to show.

    Attributes:
        times_ns: (F,) common time of each frame of the preview, evenly spaced.
        fps: Frames per second of the preview.
        speed: Seconds of the capture in one second of the preview; at least 1.
    """

    times_ns: IntArray
    fps: Fraction
    speed: float

    def __post_init__(self) -> None:
        set_array(self, "times_ns", (None,), np.int64)


def make_timeline(start_ns: int, stop_ns: int, fps: float) -> PreviewTimeline:
    """Spread at most `MAX_FRAMES` frames evenly over an interval.

    Args:
        start_ns: First time, common time.
        stop_ns: Last time, common time.
        fps: Rate of the motion or of the videos. Above 22 only every second, third ... frame is shown.
    """
    rate = Fraction(fps).limit_denominator(1001)
    # The rate may come from rounded times. A hundredth of a frame more ensures that the last one is included.
    available = int(Fraction(stop_ns - start_ns, 10**9) * rate + Fraction(1, 100)) + 1
    stride = max(1, round(fps / _TARGET_FPS), -(-available // MAX_FRAMES))
    shown_rate = rate / stride
    step_ns = 10**9 / shown_rate
    count = -(-available // stride)
    times = [min(start_ns + round(index * step_ns), stop_ns) for index in range(count)]
    played_rate = max(shown_rate, min(rate, Fraction(MIN_FPS)))
    return PreviewTimeline(
        times_ns=np.array(times, dtype=np.int64), fps=played_rate, speed=float(played_rate / shown_rate)
    )
