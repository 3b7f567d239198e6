"""Read a file of timestamps, and find its unit by comparing its times with those of the video."""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from itertools import pairwise
from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.core.text_encoding import decode_text

NS = 1_000_000_000
"""Nanoseconds per second."""
_MAX_BYTES = 256 << 20
"""Maximum size, bytes, of a sidecar file that is read."""
_MAX_ABS_NS = 1 << 62
"""Maximum absolute value, nanoseconds, of a timestamp; about 146 years. With this limit, sums of times and
offsets fit into 64 bits."""
_MAX_DIGITS = 20
"""Maximum number of digits before the decimal point. Unix times in nanoseconds have 19."""
_UNITS = (
    (1, "seconds"),
    (1_000, "milliseconds"),
    (1_000_000, "microseconds"),
    (10_000_000, "units of 100 ns"),
    (NS, "nanoseconds"),
)
"""Units of timestamps: number of units per second, and name."""
_MAX_UNIT_ERROR = 2.5
"""Maximum ratio of the frame interval of the sidecar file, in the right unit, to that of the video, or its
inverse. Origin: below the square root of 10, the smallest ratio of two units. A camera that drops every
second frame gives 2."""
_SECONDS_RANGE = (1 / 40, 10.0)
"""Range of the same ratio in which times are accepted as seconds. Origin: 960 frames per second played at 24
give 1/40; a camera that drops nine of ten frames of its nominal rate gives 10."""
_MAX_NUMBERED_S = 0.5
"""Maximum frame interval of the video, seconds, at which whole numbers in steps of 1 are frame numbers."""


def read_timestamps(path: Path) -> tuple[Decimal, ...]:
    """Read a sidecar file, which contains the time of one frame on each line.

    Empty lines and comments, which start with ``#``, are ignored.

    Raises:
        CaptureError: The file cannot be read, a line is not a number, or a time is not later than the
            previous time. The error names the line.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise CaptureError(
                "the file is too large for a file of timestamps",
                path=path,
                hint="write one time in seconds on each line",
            )
        lines = decode_text(path.read_bytes()).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise CaptureError(
            f"the timestamps cannot be read ({error})",
            path=path,
            hint="give a text file with one time in seconds on each line",
        ) from error
    times: list[Decimal] = []
    for number, line in enumerate(lines, start=1):
        text = line.split("#", 1)[0].strip()
        if text:
            times.append(_parse_time(text, path, number))
            if len(times) > 1 and times[-1] <= times[-2]:
                raise CaptureError(
                    f"time {text} is not later than the previous time",
                    path=path,
                    line=number,
                    hint="write one time in seconds for each frame; each time must be later than the time "
                    "before",
                )
    return tuple(times)


def _parse_time(text: str, path: Path, line: int) -> Decimal:
    """Convert a text to a number, exactly: the resolution of a float64 for Unix times is only 200 ns."""
    try:
        value = Decimal(text)
        if value.is_finite() and abs(value.adjusted()) < _MAX_DIGITS:
            return value
    except InvalidOperation:
        pass
    raise CaptureError(
        f"{text[:40]!r} is not a time in seconds", path=path, line=line, hint="write one number on each line"
    )


def sidecar_times(
    path: Path, chapters: Sequence[IntArray], *, is_cut: bool = False
) -> tuple[list[IntArray], str]:
    """Read the times of frames from a sidecar file.

    Args:
        path: The sidecar file.
        chapters: For each chapter that the file describes, the (N,) times of its frames according to the
            video, nanoseconds.
        is_cut: True if the end of the video is missing: the times of the missing frames are left out.

    Returns:
        For each chapter, the (N,) times of its frames, nanoseconds; and a note about the unit, empty if it is
        seconds.

    Raises:
        CaptureError: The file cannot be read, does not have one time for each frame, or contradicts the
            video.
    """
    values = read_timestamps(path)
    frames = sum(len(times) for times in chapters)
    if is_cut:
        values = values[:frames]
    if len(values) != frames:
        raise CaptureError(
            f"there are {len(values)} timestamps for {frames} frames",
            path=path,
            hint="write one line for each frame of the video, or export the video and the timestamps "
            "again from the same recording",
        )
    unit_ns, note = _unit(path, values, chapters)
    times = [round(value * unit_ns) for value in values]
    if max(map(abs, times), default=0) >= _MAX_ABS_NS or len(set(times)) < len(times):
        raise CaptureError(
            f"the times up to {values[-1]} are too large, or too close to each other",
            path=path,
            hint="write seconds since the start of the video, or a Unix time in seconds",
        )
    starts = np.cumsum([len(part) for part in chapters])[:-1]
    return np.split(np.array(times, dtype=np.int64), starts), note


def _unit(path: Path, values: Sequence[Decimal], chapters: Sequence[IntArray]) -> tuple[Decimal, str]:
    """Return the unit of times, nanoseconds, and a note; the note is empty if the unit is clearly seconds.

    Medians of the frame intervals are compared, so that gaps do not matter.
    """
    inside = np.concatenate([np.arange(len(times)) > 0 for times in chapters])
    steps = np.array([float(after - before) for before, after in pairwise(values)])
    own = np.concatenate([np.diff(times) for times in chapters])
    if not len(own):
        return Decimal(NS), ""
    step, own_s = float(np.median(steps[inside[1:]])), float(np.median(own)) / NS
    video_s = sum(int(times[-1] - times[0]) for times in chapters) / NS
    what = (
        f"the {len(values)} times in {path.name} span {values[-1] - values[0]}, where the video lasts "
        f"{video_s:.2f} s"
    )
    if step == 1.0 and own_s < _MAX_NUMBERED_S and all(value == int(value) for value in values):
        usual = own[np.abs(own - np.median(own)) <= 0.5 * np.median(own)]
        return Decimal(float(usual.mean())), f"{what}: they are read as frame numbers"
    for per_second, name in _UNITS:
        ratio = step / per_second / own_s
        if 1.0 / _MAX_UNIT_ERROR <= ratio <= _MAX_UNIT_ERROR:
            note = f"{what}: they are read as {name}" if per_second > 1 else ""
            return Decimal(NS) / per_second, note
    if _SECONDS_RANGE[0] <= step / own_s <= _SECONDS_RANGE[1]:
        return Decimal(NS), f"{what}: they are read as seconds, so the video is played at another speed"
    raise CaptureError(
        f"{what}: in no unit from seconds to nanoseconds do the two agree",
        path=path,
        hint="write the time of each frame in seconds, or remove the file to use the times of the video",
    )
