"""Choose the times that the preview shows, and the preview's frame rate."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from bodycap_batch.core.arrays import IntArray, set_array

MAX_SECONDS = 60
"""Maximum length of the preview, seconds. A user watches a film of this length to its end. Rendering such a
film takes little time compared with mapping."""
MIN_FPS = 12
"""Minimum frame rate at which the preview is played, frames per second. If the motion or the videos have a
lower rate, the preview is played at their rate. Evidence: none."""
MAX_FRAMES = MAX_SECONDS * MIN_FPS
"""Maximum number of frames in the preview.

With this number of frames, the preview lasts 48 seconds at 15 frames per second, or `MAX_SECONDS` at
`MIN_FPS`. A preview that is played at a lower rate has fewer frames."""
_TARGET_FPS = 15.0
"""Preferred frame rate of the preview, frames per second. At this rate a user can follow the motion of the
body. Evidence: docs/decisions/report.md."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PreviewTimeline:
    """The times that the preview shows.

    Attributes:
        times_ns: (F,) common time of each frame of the preview in nanoseconds, evenly spaced.
        fps: Frames per second of the preview.
        speed: Number of seconds of the capture that one second of the preview shows; at least 1.
    """

    times_ns: IntArray
    fps: Fraction
    speed: float

    def __post_init__(self) -> None:
        set_array(self, "times_ns", (None,), np.int64)


def make_timeline(start_ns: int, stop_ns: int, fps: float) -> PreviewTimeline:
    """Return a timeline of at most `MAX_SECONDS` with frames that are evenly spaced in an interval of time.

    Args:
        start_ns: Start of the interval in common time, nanoseconds.
        stop_ns: End of the interval in common time, nanoseconds.
        fps: Frame rate of the motion or of the videos, frames per second. If the rate is at least 22.5 or the
            interval is long, only every k-th frame is shown, with k of 2 or more.
    """
    rate = Fraction(fps).limit_denominator(1001)
    # The rate may be computed from rounded times. A hundredth of a frame is added, so that rounding never
    # removes the last frame.
    played_at_least = min(rate, Fraction(MIN_FPS))
    available = int(Fraction(stop_ns - start_ns, 10**9) * rate + Fraction(1, 100)) + 1
    stride = max(1, round(fps / _TARGET_FPS), -(-available // max(1, int(MAX_SECONDS * played_at_least))))
    shown_rate = rate / stride
    step_ns = 10**9 / shown_rate
    count = -(-available // stride)
    times = [min(start_ns + round(index * step_ns), stop_ns) for index in range(count)]
    played_rate = max(shown_rate, played_at_least)
    return PreviewTimeline(
        times_ns=np.array(times, dtype=np.int64), fps=played_rate, speed=float(played_rate / shown_rate)
    )
