"""List the frames of a video without decoding them."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bodycap_batch.capture.decoding import first_frame
from bodycap_batch.capture.video import (
    COPY_AGAIN,
    VideoFile,
    error_reason,
    open_container,
    orientation_from_frame,
    video_stream,
)
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.errors import CaptureError

if TYPE_CHECKING:
    from av.container import InputContainer


_MAX_SECONDS = 4e9
"""Seconds: later than any Unix time of a recording, and far from the end of 64-bit nanoseconds."""
_MIN_PIXEL_ASPECT = Fraction(2, 5)
"""Least plausible pixel aspect, and the inverse of the largest. Origin: HDV and AVCHD have 4:3; television
and anamorphic lenses lie between 1:2 and 2:1."""
_SQUARE_TOLERANCE = 0.004
"""Pixel aspects this near to 1 count as square. Origin: sizes are rounded to even numbers, and resampling
would blur each image for less than a pixel."""


def index_video(path: Path, threads: int = 0) -> VideoFile:
    """List a video's frames without decoding them; one frame is decoded for its size and orientation.

    Args:
        path: The video file.
        threads: Threads of the decoder, as in `open_stream`.

    Raises:
        CaptureError: There is no video stream, there are no frames, or the file ends before its index says.
    """
    with open_container(path) as container:
        stream = video_stream(container, path)
        container_format = container.format.name
        # MP4 lists every packet of the file. The list is read first, because demuxing adds to it.
        expected = len(stream.index_entries) if "mp4" in container_format else 0
        pts, key_pts, end = _scan_packets(path, container, stream, expected)
        metadata = {**container.metadata, **stream.metadata}
        time_base, rate = Fraction(stream.time_base or 0), stream.average_rate or stream.guessed_rate
        pixel_aspect = _pixel_aspect(stream.sample_aspect_ratio)
    if max(abs(int(pts[0])), abs(int(pts[-1]))) * time_base > _MAX_SECONDS or time_base <= 0:
        raise CaptureError("its timestamps are implausible", path=path, hint=COPY_AGAIN)
    video = VideoFile(
        path=path,
        pts=pts,
        key_pts=key_pts,
        time_base=time_base,
        fps=_nominal_fps(pts, time_base, rate),
        duration_ns=round((end - int(pts[0])) * time_base * 1_000_000_000),
        stored_size=(0, 0),
        orientation=((1, 0), (0, 1)),
        created_s=_creation_time(metadata),
        focal_35mm=_focal_35mm(metadata),
        pixel_aspect=pixel_aspect,
    )
    return _with_first_frame(video, container_format, threads)


def _scan_packets(
    path: Path, container: InputContainer, stream: Any, expected: int
) -> tuple[IntArray, IntArray, int]:
    """Return the timestamps of all frames, those of the key frames, and the end of the last frame."""
    import av

    pts: list[int] = []
    key: list[int] = []
    read, end = 0, 0
    try:
        for packet in container.demux(stream):
            read += packet.size > 0
            if packet.pts is None or packet.is_discard or packet.size == 0:
                continue
            pts.append(packet.pts)
            end = max(end, packet.pts + (packet.duration or 0))
            if packet.is_keyframe:
                key.append(packet.pts)
    except av.error.FFmpegError as error:
        raise CaptureError(
            f"the video breaks off after {len(pts)} frames ({error_reason(error)})",
            path=path,
            hint=COPY_AGAIN,
        ) from error
    if read < expected:
        message = f"the video is cut short: {read} of the {expected} frames its index lists"
        raise CaptureError(message, path=path, hint=COPY_AGAIN)
    if not pts:
        raise CaptureError("the video holds no frame", path=path, hint=COPY_AGAIN)
    frame_pts = np.unique(np.array(pts, dtype=np.int64))
    if len(frame_pts) > 1 and end <= int(frame_pts[-1]):
        end = int(frame_pts[-1]) + int(np.median(np.diff(frame_pts)))
    return frame_pts, np.unique(np.array(key, dtype=np.int64)), end


def _nominal_fps(pts: IntArray, time_base: Fraction, rate: Fraction | None) -> float:
    """Return the container's frame rate, or that of the median frame interval if it states none."""
    if rate:
        return float(rate)
    steps = np.diff(pts)
    return float(1 / (int(np.median(steps)) * time_base)) if len(steps) else 0.0


def _pixel_aspect(stated: Fraction | None) -> Fraction:
    """Return the width of a stored pixel over its height; 1 if the stated value is missing or implausible."""
    aspect = Fraction(stated or 1)
    is_plausible = _MIN_PIXEL_ASPECT <= aspect <= 1 / _MIN_PIXEL_ASPECT
    return aspect if is_plausible and abs(aspect - 1) > _SQUARE_TOLERANCE else Fraction(1)


def _creation_time(metadata: dict[str, str]) -> float | None:
    """Return the creation time as Unix seconds; None if it is missing or from an unset clock."""
    text = metadata.get("creation_time", "")
    try:
        stamp = datetime.fromisoformat(text.replace("Z", "+00:00"))
    except ValueError:
        return None
    if stamp.tzinfo is None:
        stamp = stamp.replace(tzinfo=UTC)
    return stamp.timestamp() if stamp.year > 1980 else None


def _focal_35mm(metadata: dict[str, str]) -> float | None:
    """Return the 35 mm equivalent focal length that phones write; None if it is missing."""
    for key, text in metadata.items():
        if key.lower().endswith("focal_length.35mm_equivalent"):
            with contextlib.suppress(ValueError):
                value = float(text)
                return value if 5.0 < value < 300.0 else None
    return None


def _with_first_frame(video: VideoFile, container_format: str, threads: int) -> VideoFile:
    """Set the size and orientation from a decoded frame, because the container may state others.

    Frames before the first that decodes are left out (a stream cut inside a group of pictures).
    """
    frame, reordered = first_frame(video, threads)
    video = replace(
        video,
        stored_size=(frame.width, frame.height),
        orientation=orientation_from_frame(frame),
        is_interlaced=bool(frame.interlaced_frame),
    )
    if container_format == "avi" and reordered:
        return replace(video, is_counted=True, key_pts=video.pts[:1])
    first = int(np.searchsorted(video.pts, frame.pts or 0))
    return replace(video, pts=video.pts[first:], key_pts=video.key_pts[video.key_pts >= video.pts[first]])
