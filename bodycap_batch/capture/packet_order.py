"""Compare the order of the packets in a file with their times, and find where the times start again.

Two recordings that were joined byte by byte, or a camera that set its clock back, give a file whose times
start again. Sorted by time, the frames of both parts would be mixed.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import IntArray

_MAX_REORDERED = 32
"""Maximum number of later frames that a codec stores before a frame. Origin: twice the size of the picture
buffer of H.264 and H.265, which is 16 frames."""
_MIN_OVERFLOW_TICKS = 1 << 32
"""Minimum jump forward, in units of the time base, that is no time. Origin: times of MPEG have 33 bits. The
demuxer adds 2^33 to a time that starts again at a smaller number, because it treats it as an overflow."""

_UNKNOWN_WAIT = 4
"""Maximum number of frame intervals that the first frame of a codec that reorders frames waits, if the
container does not state it. Origin: usual encoders of H.264 and H.265 reorder up to four frames."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PacketTimes:
    """What the packets of a video stream say about the times of its frames, in units of the time base.

    Attributes:
        pts: (N,) timestamps of the frames, increasing.
        key_pts: (K,) timestamps of the key frames, increasing.
        end: End of the last frame.
        restarts: For each place at which the times start again, the number of the packet, and what is added
            to the timestamps from there on. The first frame after it follows the last frame before it after
            the usual frame interval.
        start: Timestamp of the start of the file. It is 0 if the file states how much later its first frame
            is, else the timestamp of the first frame.
        lost: Number of packets without a time, or with the time of another frame.
    """

    pts: IntArray
    key_pts: IntArray
    end: int
    restarts: tuple[tuple[int, int], ...]
    start: int
    lost: int


def sort_packets(
    packets: IntArray, first_dts: int | None, untimed: int = 0, *, has_zero: bool = True
) -> PacketTimes:
    """Find the times of the frames from the packets of a video stream.

    Args:
        packets: (N,3) timestamp, duration and 1 for each key frame, in the order of the file.
        first_dts: Decoding timestamp of the first packet; None if it is unknown.
        untimed: Number of further packets, without a timestamp.
        has_zero: False for MPEG transport and program streams, whose times start at an arbitrary number.
    """
    stored, durations, is_key = packets[:, 0], packets[:, 1], packets[:, 2] > 0
    longest = np.inf if has_zero else _MIN_OVERFLOW_TICKS
    first = [0, *_restarts(stored.tolist(), is_key.tolist(), longest), len(stored)]
    steps = np.concatenate([np.diff(np.unique(stored[i:j])) for i, j in itertools.pairwise(first)])
    step = int(np.median(steps)) if len(steps) else int(durations[0])
    pts, restarts, end = stored.copy(), [], int(stored[: first[1]].max()) + step
    for start, stop in itertools.pairwise(first[1:]):
        shift = end - int(stored[start:stop].min())
        restarts.append((start, shift))
        pts[start:stop] += shift
        end = int(pts[start:stop].max()) + step
    unique = np.unique(pts)
    last = int((pts + durations).max())
    # A file without an edit list starts with the time that the first frame waits until its order is known.
    waits = bool((np.diff(stored[: first[1]]) < 0).any())
    delay = waits * _UNKNOWN_WAIT * step if first_dts is None else int(stored[0]) - first_dts
    return PacketTimes(
        pts=unique,
        key_pts=np.unique(pts[is_key]),
        end=last if last > int(unique[-1]) else end,
        restarts=tuple(restarts),
        start=0 if has_zero and abs(int(unique[0])) > delay + step // 2 else int(unique[0]),
        lost=untimed + len(pts) - len(unique),
    )


def _restarts(pts: list[int], is_key: list[bool], longest: float) -> Iterator[int]:
    """Yield the index of each packet at which the times start again."""
    start, latest = 0, pts[0]
    for index, (time, key) in enumerate(zip(pts, is_key, strict=True)):
        window = index - _MAX_REORDERED
        is_early = time < latest and (key or (window >= start and time < min(pts[window:index])))
        if is_early or time - latest >= longest:
            yield index
            start = index
            latest = time
        latest = max(latest, time)
