"""Read when a recording started from its file: the creation time, the timecode and the time of GPS.

The clocks of cameras are set by hand, and GPS time is written to some tenths of a second, so these times only
show where to search first, and whether two recordings can belong together.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from bodycap_batch.capture.video import VideoFile, open_container
from bodycap_batch.telemetry.gopro import gps_time_s, has_telemetry_track, read_gopro_file

CLOCK_SIGMA_S = 2.0
"""Standard deviation, seconds, of the difference between the clocks of two cameras that were set alike, and
between the creation of a file and its first frame. Evidence: none."""
_GPS_SIGMA_S = 0.7
"""Standard deviation, seconds, of the difference between the GPS times of two cameras. Origin: receivers
write the time of a fix up to a second late; half a second for each camera. Evidence: none."""
_CREATION_RESOLUTION_S = 1.0
"""Resolution of a creation time, seconds. Origin: the format of the container."""
_RANGE_SIGMAS = 4.0
"""Number of standard deviations of the offset that are searched first. Evidence: none."""
DAY_S = 86_400.0
"""Seconds of a day."""
_APART_S = 6 * 3600.0
"""Difference, seconds, from which two recordings are reported as of different dates. Origin: longer than a
session; shorter differences may be a wrong time zone."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ContainerTime:
    """When a recording started, according to its first file.

    Attributes:
        first_frame_s: Time of the first frame on the clock of the camera, seconds.
        created_s: Creation time, Unix seconds; None if it is unknown.
        timecode_s: Time of day from the timecode, seconds; None if it is unknown or was not set.
        frame_s: Resolution of the timecode, seconds.
        gps_s: Unix time of the first frame according to GPS, seconds; None if it is unknown.
    """

    first_frame_s: float
    created_s: float | None
    timecode_s: float | None
    frame_s: float
    gps_s: float | None = None


@dataclass(frozen=True, slots=True)
class ExpectedOffset:
    """The offset between two cameras according to their containers.

    Attributes:
        offset_s: Time of the first camera − time of the second camera, seconds.
        sigma_s: Standard deviation, seconds, if the clocks of both cameras were set.
    """

    offset_s: float
    sigma_s: float

    def limits(self) -> tuple[float, float]:
        """Return the least and the greatest offset to search first, seconds."""
        reach = _RANGE_SIGMAS * self.sigma_s
        return self.offset_s - reach, self.offset_s + reach

    def are_dates_apart(self) -> bool:
        """Return True if two recordings are of different dates according to their files."""
        return abs(self.offset_s) > _APART_S

    def contradicts(self, offset_s: float) -> bool:
        """Return True if a measured offset is outside the limits."""
        low, high = self.limits()
        return not low <= offset_s <= high


def read_container_time(videos: Sequence[VideoFile], first_frame_s: float) -> ContainerTime:
    """Read the start of a recording from its first file.

    Args:
        videos: The chapters of the camera.
        first_frame_s: Time of the first frame on the clock of the camera, seconds.

    Raises:
        CaptureError: The file cannot be opened.
    """
    video, timecode = videos[0], read_timecode(videos[0])
    fps = video.fps or 30.0
    return ContainerTime(
        first_frame_s=first_frame_s,
        created_s=video.created_s,
        timecode_s=timecode_seconds(timecode, fps),
        frame_s=1.0 / fps,
        gps_s=_gps_start_s(video),
    )


def read_timecode(video: VideoFile) -> str:
    """Return the text of the timecode of the first frame of a file; "" if the file has none.

    Raises:
        CaptureError: The file cannot be opened.
    """
    with open_container(video.path) as container:
        texts = [container.metadata, *(stream.metadata for stream in container.streams)]
        return next((text["timecode"] for text in texts if text.get("timecode")), "")


def _gps_start_s(video: VideoFile) -> float | None:
    """Return the Unix time of the first frame of a file according to GPS; None if it is unknown."""
    if not has_telemetry_track(video.path):
        return None
    return gps_time_s(read_gopro_file(video.path, video.fps), float(video.times_ns()[0]) * 1e-9)


def timecode_seconds(text: str, fps: float) -> float | None:
    """Return the time of day of a timecode ``HH:MM:SS:FF``, seconds; None if it is not one or is zero."""
    match = re.fullmatch(r"(\d\d):(\d\d):(\d\d)[:;.](\d\d)", text.strip())
    if match is None:
        return None
    hours, minutes, seconds, frames = (int(part) for part in match.groups())
    total = 3600.0 * hours + 60.0 * minutes + seconds + frames / fps
    return total if total > 0.0 else None


def expected_offset(first: ContainerTime, second: ContainerTime) -> ExpectedOffset | None:
    """Return the offset between two cameras according to their containers; None if it is unknown.

    GPS time is used if both cameras have it. The timecode is used if it agrees with the creation times, or
    without these: it has no date.
    """
    frames = first.first_frame_s - second.first_frame_s
    if first.gps_s is not None and second.gps_s is not None:
        return ExpectedOffset(second.gps_s - first.gps_s + frames, _GPS_SIGMA_S)
    created = None
    if first.created_s is not None and second.created_s is not None:
        created = ExpectedOffset(
            second.created_s - first.created_s + frames, CLOCK_SIGMA_S + _CREATION_RESOLUTION_S
        )
    if first.timecode_s is None or second.timecode_s is None:
        return created
    between = second.timecode_s - first.timecode_s
    if created is None:
        between = (between + 0.5 * DAY_S) % DAY_S - 0.5 * DAY_S
    coded = ExpectedOffset(between + frames, CLOCK_SIGMA_S + max(first.frame_s, second.frame_s))
    return coded if created is None or not created.contradicts(coded.offset_s) else created
