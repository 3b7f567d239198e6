"""Read the telemetry of all chapters of a camera, from the videos or from a file beside them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bodycap_batch.capture.timeline import ChapterClock, clock_of_chapter
from bodycap_batch.capture.video import VideoFile
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.telemetry.gopro import read_gopro_file
from bodycap_batch.telemetry.streams import (
    ACCELEROMETER,
    CAMERA_ORIENTATION,
    GRAVITY,
    GYROSCOPE,
    IMAGE_ORIENTATION,
    CameraTelemetry,
    GpsTrack,
    Stream,
    gaps_of,
)
from bodycap_batch.telemetry.text_files import read_imu_file

_TURNED = (GYROSCOPE, ACCELEROMETER, GRAVITY)
_ORIENTATIONS = (CAMERA_ORIENTATION, IMAGE_ORIENTATION)


def read_telemetry(
    videos: Sequence[VideoFile], times_ns: IntArray, samples: Path | None = None
) -> CameraTelemetry:
    """Read the telemetry of all chapters of a camera.

    A file of samples (``.imu.csv`` or ``.gcsv``) replaces the inertial samples of the videos.

    Args:
        videos: The chapters in the order of the recording.
        times_ns: (N,) time of every frame of the chapters on the clock of the camera, nanoseconds: see
            `join_chapters`.
        samples: The file with inertial samples; None if there is none.

    Raises:
        CaptureError: A video cannot be opened, or the file of samples is wrong.
    """
    chapters: list[CameraTelemetry] = []
    first = 0
    for video in videos:
        clock = clock_of_chapter(video.times_ns(), times_ns[first : first + len(video.pts)])
        first += len(video.pts)
        if video.part is None or video.part[0] == 0:
            chapter = _on_camera_clock(read_gopro_file(video.path, video.fps), clock)
        else:
            note = f"{video.path.name}: only the telemetry of the first of the joined recordings is used"
            chapter = CameraTelemetry(notes=(note,) if chapters[-1].streams else ())
        chapters.append(_turned(chapter, video))
    joined = _joined(chapters)
    if samples is None:
        return joined
    span_s = (1e-9 * float(times_ns[0]), 1e-9 * float(times_ns[-1]))
    return _with_samples(joined, read_imu_file(samples, span_s), samples)


def _with_samples(video: CameraTelemetry, samples: CameraTelemetry, path: Path) -> CameraTelemetry:
    """Return the telemetry of the videos with the inertial samples of a file."""
    others = {key: stream for key, stream in video.streams.items() if key not in (GYROSCOPE, ACCELEROMETER)}
    replaced = [key for key in (GYROSCOPE, ACCELEROMETER) if key in video.streams]
    note = f"{path.name} replaces the inertial samples of the video"
    return replace(
        video,
        source=samples.source,
        model=video.model or samples.model,
        firmware=video.firmware or samples.firmware,
        settings={**samples.settings, **video.settings},
        streams={**samples.streams, **others},
        axes_known=samples.axes_known,
        is_timelapse=False,
        notes=(*video.notes, *samples.notes, *([note] if replaced else [])),
    )


def _on_camera_clock(telemetry: CameraTelemetry, clock: ChapterClock) -> CameraTelemetry:
    """Return the telemetry of a chapter with times on the clock of the camera."""
    streams = {
        key: replace(
            stream,
            times_s=stream.times_s * clock.rate + clock.shift_s,
            rate_hz=stream.rate_hz / clock.rate,
            gaps_s=tuple((clock.camera_s(start), clock.camera_s(end)) for start, end in stream.gaps_s),
        )
        for key, stream in telemetry.streams.items()
    }
    gps = telemetry.gps
    if gps is not None:
        gps = replace(gps, times_s=gps.times_s * clock.rate + clock.shift_s)
    return replace(telemetry, streams=streams, gps=gps)


def _turned(telemetry: CameraTelemetry, video: VideoFile) -> CameraTelemetry:
    """Return the telemetry in the axes of the shown image, for a video that a player rotates."""
    (a, b), (c, d) = video.orientation
    if (a, b, c, d) == (1, 0, 0, 1) or a * d - b * c != 1:
        return telemetry
    rotation = np.array([[a, b, 0.0], [c, d, 0.0], [0.0, 0.0, 1.0]])

    def turned(stream: Stream) -> Stream:
        if stream.key in _TURNED:
            return replace(stream, values=stream.values @ rotation.T)
        if stream.key in _ORIENTATIONS:
            axis = stream.values[:, 1:] @ rotation.T
            return replace(stream, values=np.column_stack([stream.values[:, 0], axis]))
        return stream

    streams = {key: turned(stream) for key, stream in telemetry.streams.items()}
    return replace(telemetry, streams=streams)


def _joined(chapters: Sequence[CameraTelemetry]) -> CameraTelemetry:
    """Return the telemetry of all chapters. What a later chapter repeats of an earlier one is left out."""
    if len(chapters) == 1:
        return chapters[0]
    keys = dict.fromkeys(key for chapter in chapters for key in chapter.streams)
    is_timelapse = any(chapter.is_timelapse for chapter in chapters)
    other = Counter[str]()
    for chapter in chapters:
        other.update(chapter.other_streams)
    found = next((chapter for chapter in chapters if chapter.source != "none"), chapters[0])
    return replace(
        found,
        streams={
            key: _joined_stream([each.streams[key] for each in chapters if key in each.streams])
            for key in keys
            if not is_timelapse or key not in (*_TURNED, "MAGN")
        },
        gps=_joined_gps([chapter.gps for chapter in chapters if chapter.gps is not None]),
        other_streams=dict(other),
        axes_known=all(chapter.axes_known for chapter in chapters if chapter.source != "none"),
        is_timelapse=is_timelapse,
        notes=tuple(dict.fromkeys(note for chapter in chapters for note in chapter.notes)),
    )


def _joined_stream(parts: Sequence[Stream]) -> Stream:
    times, values, end_s = [], [], -np.inf
    for part in parts:
        later = part.times_s > end_s
        times.append(part.times_s[later])
        values.append(part.values[later])
        end_s = max(end_s, float(part.times_s[-1]))
    times_s = np.concatenate(times)
    counts = np.array([len(part.times_s) for part in parts])
    rate_hz = float(counts.sum() / (counts / np.array([part.rate_hz for part in parts])).sum())
    joined = np.concatenate(values)
    return replace(
        parts[0],
        times_s=times_s,
        values=joined,
        rate_hz=rate_hz,
        gaps_s=gaps_of(parts[0].key, times_s, joined, rate_hz),
    )


def _joined_gps(parts: Sequence[GpsTrack]) -> GpsTrack | None:
    if not parts:
        return None
    names = ("times_s", "latitude_longitude_deg", "altitude_m", "speed_m_s", "fix", "dilution")
    values = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    order = np.argsort(values["times_s"], kind="stable")
    return GpsTrack(start_utc=parts[0].start_utc, **{name: value[order] for name, value in values.items()})
