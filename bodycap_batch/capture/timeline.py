"""Compute the times of a camera's frames, and join the times of successive chapters.

The times come from the container of each video, or from sidecar files: text files of timestamps.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
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
"""Maximum size, bytes, of a sidecar file that is read."""
_CLOCK_RESOLUTION_NS = 2 * _NS
"""Maximum error, nanoseconds, of the difference between the creation times of two files. Creation times are
rounded to whole seconds. In addition, they are the time at which the camera began to write the file, not the
time of the first exposure."""
_MAX_ABS_NS = 1 << 62
"""Maximum absolute value, nanoseconds, of a timestamp; about 146 years. With this limit, sums of times and
offsets fit into 64 bits."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Timeline:
    """The frame times of one camera, after joining its chapters.

    Attributes:
        times_ns: (N,) time of every frame on the clock of the camera, nanoseconds.
        usable: (N,) True if the frame is later than all earlier frames. Otherwise the chapter of the frame
            repeats the end of the previous chapter, and the frame is not used.
        notes: Notes for the user about gaps and overlaps between chapters.
    """

    times_ns: IntArray
    usable: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class ChapterClock:
    """Clock of a camera = time in the file of a chapter · rate + shift_s."""

    rate: float
    shift_s: float

    def camera_s(self, file_s: float) -> float:
        """Return a time on the clock of the camera, seconds."""
        return file_s * self.rate + self.shift_s


def clock_of_chapter(file_ns: IntArray, camera_ns: IntArray) -> ChapterClock:
    """Return how times in the file of a chapter become times on the clock of the camera.

    Usually the two differ by a constant. If a sidecar file gives the times, the clocks may run at different
    rates. If the sidecar file contains pauses that the file does not contain, only the first frame is common
    to both.

    Args:
        file_ns: (N,) time of every frame of the chapter in the file, nanoseconds.
        camera_ns: (N,) time of every frame on the clock of the camera, nanoseconds: see `join_chapters`.
    """
    shift_s = (int(camera_ns[0]) - int(file_ns[0])) / 1e9
    own = (file_ns - file_ns[0]) / 1e9
    difference = (camera_ns - camera_ns[0]) / 1e9 - own
    if len(own) < 3 or np.abs(difference).max() < 1e-6:
        return ChapterClock(1.0, shift_s)
    slope, constant = np.polyfit(own, difference, 1)
    frame_s = float(np.median(np.diff(own)))
    if np.abs(difference - slope * own - constant).max() > 0.5 * frame_s:
        return ChapterClock(1.0, shift_s)
    return ChapterClock(1.0 + slope, shift_s + constant - slope * float(file_ns[0]) / 1e9)


def read_timestamps(path: Path) -> IntArray:
    """Read a sidecar file, which contains the time in seconds of one frame on each line.

    Empty lines and comments, which start with ``#``, are ignored.

    Returns:
        (N,) times, nanoseconds.

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
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise CaptureError(
            f"the timestamps cannot be read ({error})",
            path=path,
            hint="give a text file with one time in seconds on each line",
        ) from error
    times: list[int] = []
    for number, line in enumerate(lines, start=1):
        text = line.split("#", 1)[0].strip()
        if text:
            times.append(_parse_seconds(text, path, number))
            if len(times) > 1 and times[-1] <= times[-2]:
                raise CaptureError(
                    f"time {text} is not later than the previous time",
                    path=path,
                    line=number,
                    hint="write one time in seconds for each frame; each time must be later than the time "
                    "before",
                )
    return np.array(times, dtype=np.int64)


def _parse_seconds(text: str, path: Path, line: int) -> int:
    """Convert a text with seconds to nanoseconds, exactly.

    A float64 is not used, because its resolution for Unix times is only 200 ns.
    """
    try:
        value = Decimal(text)
        if value.is_finite() and abs(value.adjusted()) < 12 and abs(value * _NS) < _MAX_ABS_NS:
            return round(value * _NS)
    except InvalidOperation:
        pass
    raise CaptureError(
        f"{text[:40]!r} is not a time in seconds", path=path, line=line, hint="write one number on each line"
    )


def join_chapters(videos: tuple[VideoFile, ...], sidecars: tuple[Path, ...]) -> Timeline:
    """Compute the times of the frames of all chapters on the clock of the camera.

    Sidecar files have priority over the containers. Without sidecar files, the timestamps of the containers
    are used. If the timestamps of a chapter start again at zero, the chapter is placed directly after the
    previous chapter. If the creation times show that more than two seconds are missing between the two
    chapters, there is a gap of this length.

    Args:
        videos: The chapters in the order of the recording.
        sidecars: One sidecar file for all chapters, one sidecar file for each chapter, or none. It may have
            more times than its video has frames if the end of the video is missing.

    Raises:
        CaptureError: A sidecar file does not match its video.
    """
    if len(sidecars) == len(videos):
        parts = [_sidecar_times(path, (v,)) for path, v in zip(sidecars, videos, strict=True)]
        return _join_parts(videos, parts)
    if len(sidecars) == 1:
        times = _sidecar_times(sidecars[0], videos)
        return _join_parts(videos, np.split(times, np.cumsum([len(video.pts) for video in videos])[:-1]))
    return _join_parts(videos, _container_times(videos))


def _sidecar_times(path: Path, videos: Sequence[VideoFile]) -> IntArray:
    """Read a sidecar file and check that it has one time for each frame of some chapters."""
    times, frames = read_timestamps(path), sum(len(video.pts) for video in videos)
    if videos[-1].missing_end:
        times = times[:frames]
    if len(times) != frames:
        raise CaptureError(
            f"there are {len(times)} timestamps for {frames} frames",
            path=path,
            hint="write one line for each frame of the video, or export the video and the timestamps "
            "again from the same recording",
        )
    return times


def _container_times(videos: tuple[VideoFile, ...]) -> list[IntArray]:
    """Return the frame times of each chapter from the containers.

    If the timestamps of a chapter start again at zero, the chapter is moved to the end of the previous
    chapter.
    """
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
    """Return the time that is missing between two chapters, according to their creation times.

    The result is 0 if the creation times are unknown, or if the missing time is not longer than the error of
    the creation times.
    """
    if before.created_s is None or video.created_s is None:
        return 0
    gap = round((video.created_s - before.created_s) * _NS) - before.duration_ns
    return gap if gap > _CLOCK_RESOLUTION_NS else 0


def _join_parts(videos: tuple[VideoFile, ...], parts: list[IntArray]) -> Timeline:
    """Join the frame times of all chapters, and find the usable frames, gaps and overlaps."""
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
            notes.append(
                f"there is {kind} {abs(gap_ns) / _NS:.2f} s between {before.path.name} and {video.path.name}"
            )
    return Timeline(times_ns=times, usable=usable, notes=tuple(notes))
