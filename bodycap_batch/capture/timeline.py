"""Compute the times of a camera's frames, and join the times of successive chapters.

The times come from the container of each video, or from sidecar files: text files of timestamps.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bodycap_batch.capture.capture_rate import slow_motion
from bodycap_batch.capture.sidecar_times import NS, sidecar_times
from bodycap_batch.capture.video import VideoFile
from bodycap_batch.core.arrays import IntArray

_CLOCK_RESOLUTION_NS = 2 * NS
"""Maximum error, nanoseconds, of the difference between the creation times of two files. Creation times are
rounded to whole seconds. In addition, they are the time at which the camera began to write the file, not the
time of the first exposure."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Timeline:
    """The frame times of one camera, after joining its chapters.

    Attributes:
        times_ns: (N,) time of every frame on the clock of the camera, nanoseconds.
        usable: (N,) True if the frame is later than all earlier frames. Otherwise the chapter of the frame
            repeats the end of the previous chapter, and the frame is not used.
        notes: Notes for the user about times that contradict each other, and about gaps and overlaps between
            chapters.
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


def join_chapters(videos: tuple[VideoFile, ...], sidecars: tuple[Path, ...]) -> Timeline:
    """Compute the times of the frames of all chapters on the clock of the camera.

    All that states a time is compared here: sidecar files, the containers, the order of their packets, and
    the rate at which the pictures were taken. Sidecar files have priority over the containers. Without
    sidecar files, the timestamps of the containers are used. If the timestamps of a chapter start again at
    zero, the chapter is placed directly after the previous chapter. If the creation times show that more than
    two seconds are missing between the two chapters, there is a gap of this length.

    Args:
        videos: The chapters in the order of the recording.
        sidecars: One sidecar file for all chapters, one sidecar file for each chapter, or none. It may have
            more times than its video has frames if the end of the video is missing.

    Raises:
        CaptureError: A sidecar file does not match its video.
    """
    own = [_real_times(video) for video in videos]
    notes = [f"{video.path.name}: {note}" for video in videos for note in video.notes]
    if sidecars:
        by_file: dict[Path | None, list[IntArray]] = {}
        for video, (times, _) in zip(videos, own, strict=True):
            by_file.setdefault(video.path if len(sidecars) > 1 else None, []).append(times)
        is_cut = bool(videos[-1].missing_end)
        read = [
            sidecar_times(path, group, is_cut=is_cut)
            for path, group in zip(sidecars, by_file.values(), strict=True)
        ]
        parts = [part for group, _ in read for part in group]
        notes += [note for _, note in read if note]
    else:
        parts = _container_times(videos, own)
        notes += dict.fromkeys(note for video in videos if (note := slow_motion(video)[1]))
        notes += _restart_notes(videos)
    return _join_parts(videos, parts, notes)


def _real_times(video: VideoFile) -> tuple[IntArray, int]:
    """Return the frame times (N,) of a file and its duration, in real nanoseconds.

    Times and duration in the file differ from these in slow motion.
    """
    ratio, _ = slow_motion(video)
    if ratio == 1.0:
        return video.times_ns(), video.duration_ns
    return np.round(video.times_ns() / ratio).astype(np.int64), round(video.duration_ns / ratio)


def _restart_notes(videos: tuple[VideoFile, ...]) -> list[str]:
    """Return a note about each file whose times start again, with the numbers of the frames."""
    restarts: dict[Path, list[int]] = {}
    first = 0
    for video in videos:
        at = [first + packet for packet, _ in video.restarts]
        restarts.setdefault(video.path, []).extend([first, *at] if video.part and video.part[0] else at)
        first += len(video.pts)
    return [
        f"the times in {path.name} start again at frame {', '.join(map(str, at))}, as in a file of "
        f"{len(at) + 1} recordings that were joined. Unless the file states the time between them, each is "
        "taken to follow directly the one before. If time passed, give the recordings as separate files, or "
        "write a file of timestamps"
        for path, at in restarts.items()
        if at
    ]


def _container_times(videos: tuple[VideoFile, ...], own: list[tuple[IntArray, int]]) -> list[IntArray]:
    """Return the frame times of each chapter on the clock of the camera, from the containers.

    If the timestamps of a chapter start again at zero, the chapter is moved to the end of the previous
    chapter.

    Args:
        videos: The chapters.
        own: The frame times of each chapter in its file, and its duration, real nanoseconds.
    """
    shift = -round(videos[0].start_pts * videos[0].time_base * NS / slow_motion(videos[0])[0])
    parts = [own[0][0] + shift]
    for index, (times, _) in enumerate(own[1:], start=1):
        start, duration_ns = int(own[index - 1][0][0]), own[index - 1][1]
        if int(times[0]) <= start + duration_ns // 2:
            missing_ns = _missing_between_ns(videos[index - 1], videos[index], duration_ns)
            shift = int(parts[-1][0]) + duration_ns + missing_ns - int(times[0])
        parts.append(times + shift)
    return parts


def _missing_between_ns(before: VideoFile, video: VideoFile, duration_ns: int) -> int:
    """Return the time that is missing between two chapters, according to their creation times.

    The result is 0 if the creation times are unknown, or if the missing time is not longer than the error of
    the creation times.
    """
    if before.created_s is None or video.created_s is None:
        return 0
    gap = round((video.created_s - before.created_s) * NS) - duration_ns
    return gap if gap > _CLOCK_RESOLUTION_NS else 0


def _join_parts(videos: tuple[VideoFile, ...], parts: list[IntArray], notes: list[str]) -> Timeline:
    """Join the frame times of all chapters, and find the usable frames, gaps and overlaps."""
    times = np.concatenate(parts)
    latest = np.maximum.accumulate(times)
    usable = np.ones(len(times), dtype=bool)
    usable[1:] = times[1:] > latest[:-1]
    for (before, start), (video, part) in itertools.pairwise(zip(videos, parts, strict=True)):
        frame_ns = float(np.median(np.diff(start))) if len(start) > 1 else before.duration_ns
        gap_ns = int(part[0]) - (int(start[-1]) + frame_ns)
        if abs(gap_ns) > 1.5 * frame_ns:
            kind = "a gap of" if gap_ns > 0 else "an overlap of"
            notes.append(
                f"there is {kind} {abs(gap_ns) / NS:.2f} s between {before.path.name} and {video.path.name}"
            )
    return Timeline(times_ns=times, usable=usable, notes=tuple(notes))
