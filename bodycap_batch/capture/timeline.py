"""Times of a camera's frames: from the container or from sidecar files, chapters joined."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from bodycap_batch.capture.video import VideoFile
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.errors import CaptureError

_NS = 1_000_000_000
"""Nanoseconds per second."""
_MAX_BYTES = 256 << 20
"""Bytes: largest sidecar file that is read."""
_CLOCK_RESOLUTION_NS = 2 * _NS
"""Nanoseconds: exactness of creation times. They are whole seconds, and cameras record the start of writing,
not of the exposure."""
_MAX_ABS_NS = 1 << 62
"""Nanoseconds, about 146 years: sums of times and offsets stay inside int64."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Timeline:
    """Frame times of one camera's joined chapters.

    Attributes:
        times_ns: (N,) time of every frame on the camera's own clock.
        usable: (N,) False for frames that a later chapter repeats.
        notes: Gaps and overlaps found.
    """

    times_ns: IntArray
    usable: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]
    notes: tuple[str, ...]


def read_timestamps(path: Path) -> IntArray:
    """Read a sidecar file: seconds, one line per frame; empty lines and ``#`` comments are skipped.

    Returns:
        (N,) nanoseconds.

    Raises:
        CaptureError: The file is unreadable, or a line is not a number or does not increase. The error names
            the line.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise CaptureError(
                "too large for a file of timestamps", path=path, hint="one time in seconds on each line"
            )
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise CaptureError(
            f"cannot read the timestamps ({error})", path=path, hint="a text file of seconds"
        ) from error
    times: list[int] = []
    for number, line in enumerate(lines, start=1):
        text = line.split("#", 1)[0].strip()
        if text:
            times.append(_parse_seconds(text, path, number))
            if len(times) > 1 and times[-1] <= times[-2]:
                raise CaptureError(
                    f"time {text} does not come after the one before",
                    path=path,
                    line=number,
                    hint="one time for each frame, in seconds, increasing",
                )
    return np.array(times, dtype=np.int64)


def _parse_seconds(text: str, path: Path, line: int) -> int:
    """Return seconds as exact nanoseconds: a float64 of Unix time resolves only 200 ns."""
    try:
        value = Decimal(text)
        if value.is_finite() and abs(value.adjusted()) < 12 and abs(value * _NS) < _MAX_ABS_NS:
            return round(value * _NS)
    except InvalidOperation:
        pass
    raise CaptureError(
        f"{text[:40]!r} is not a time in seconds", path=path, line=line, hint="one number on each line"
    )


def join_chapters(videos: tuple[VideoFile, ...], sidecars: tuple[Path, ...]) -> Timeline:
    """Put the frames of all chapters on the camera's clock.

    Sidecar files have priority: one for all chapters, or one for each. Without them the exact timestamps of
    the containers are used. Chapters that start again at zero follow each other without a gap, unless their
    creation times show that more than two seconds are missing.

    Raises:
        CaptureError: A sidecar file does not match its video.
    """
    if len(sidecars) == len(videos):
        parts = [_sidecar_times(path, len(v.pts)) for path, v in zip(sidecars, videos, strict=True)]
        return _join_parts(videos, parts)
    if len(sidecars) == 1:
        times = _sidecar_times(sidecars[0], sum(len(video.pts) for video in videos))
        return _join_parts(videos, np.split(times, np.cumsum([len(video.pts) for video in videos])[:-1]))
    return _join_parts(videos, _container_times(videos))


def _sidecar_times(path: Path, frames: int) -> IntArray:
    """Read a sidecar file and check its number of lines."""
    times = read_timestamps(path)
    if len(times) != frames:
        raise CaptureError(
            f"{len(times)} timestamps for {frames} frames",
            path=path,
            hint="one line for each frame of the video; export both again from the same recording",
        )
    return times


def _container_times(videos: tuple[VideoFile, ...]) -> list[IntArray]:
    """Return the times of each chapter, moved behind the previous chapter if it starts again at zero."""
    parts = [videos[0].times_ns()]
    for before, video in itertools.pairwise(videos):
        own, start = video.times_ns(), int(parts[-1][0])
        is_continuous = int(own[0]) > start + before.duration_ns // 2
        shift = (
            0
            if is_continuous
            else start + before.duration_ns + _missing_between_ns(before, video) - int(own[0])
        )
        parts.append(own + shift)
    return parts


def _missing_between_ns(before: VideoFile, video: VideoFile) -> int:
    """Return the time lost between two chapters according to their creation times; 0 if these are unknown."""
    if before.created_s is None or video.created_s is None:
        return 0
    gap = round((video.created_s - before.created_s) * _NS) - before.duration_ns
    return gap if gap > _CLOCK_RESOLUTION_NS else 0


def _join_parts(videos: tuple[VideoFile, ...], parts: list[IntArray]) -> Timeline:
    """Concatenate chapters; frames that are not later than all earlier frames are not usable."""
    times = np.concatenate(parts)
    latest = np.maximum.accumulate(times)
    usable = np.ones(len(times), dtype=bool)
    usable[1:] = times[1:] > latest[:-1]
    notes = []
    for (before, start), (video, part) in itertools.pairwise(zip(videos, parts, strict=True)):
        frame_ns = float(np.median(np.diff(start))) if len(start) > 1 else before.duration_ns
        gap_ns = int(part[0]) - (int(start[-1]) + frame_ns)
        if abs(gap_ns) > 1.5 * frame_ns:
            kind = "a gap of" if gap_ns > 0 else "an overlap of"
            notes.append(f"{kind} {abs(gap_ns) / _NS:.2f} s between {before.path.name} and {video.path.name}")
    return Timeline(times_ns=times, usable=usable, notes=tuple(notes))
