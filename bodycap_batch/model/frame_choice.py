"""Choose the frame of a video that is shown at a time."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import IntArray


def nearest_frames(frame_times_ns: IntArray, times_ns: IntArray, nominal_fps: float) -> IntArray:
    """Return the index (F,) of the frame nearest to each time.

    The index is −1 for a time before the start or after the end of the video.

    Args:
        frame_times_ns: (N,) times of the frames of the video, nanoseconds, increasing.
        times_ns: (F,) times, nanoseconds, on the same clock.
        nominal_fps: Frames per second of the video.
    """
    if not len(frame_times_ns):
        return np.full(len(times_ns), -1, dtype=np.int64)
    after = np.clip(np.searchsorted(frame_times_ns, times_ns), 1, max(1, len(frame_times_ns) - 1))
    after = np.minimum(after, len(frame_times_ns) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(
        np.abs(frame_times_ns[before] - times_ns) <= np.abs(frame_times_ns[after] - times_ns), before, after
    )
    several = len(frame_times_ns) > 1
    interval = np.median(np.diff(frame_times_ns)) if several else 1e9 / nominal_fps
    start, end = frame_times_ns[0] - 0.5 * interval, frame_times_ns[-1] + 0.5 * interval
    return np.asarray(np.where((times_ns >= start) & (times_ns <= end), nearest, -1), dtype=np.int64)
