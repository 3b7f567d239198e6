"""List the frames of a video without decoding them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from dataclasses import replace
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bodycap_batch.capture.capture_rate import capture_fps
from bodycap_batch.capture.decoding import first_frame
from bodycap_batch.capture.joined_files import parts_of
from bodycap_batch.capture.packet_order import PacketTimes, sort_packets
from bodycap_batch.capture.video import (
    COPY_AGAIN,
    VideoFile,
    error_reason,
    is_frame,
    open_container,
    orientation_from_frame,
    projection_from_frame,
    video_stream,
)
from bodycap_batch.config.bounds import ASPECT_TOLERANCE, MAX_TIME_S
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.formats.file_completeness import missing_part

if TYPE_CHECKING:
    from av.container import InputContainer


_MIN_PIXEL_ASPECT = Fraction(2, 5)
"""Minimum plausible pixel aspect, width over height. The maximum is the inverse of this value. Origin: HDV
and AVCHD have 4:3; television and anamorphic lenses have pixel aspects between 1:2 and 2:1."""
_NO_ZERO = 0x200
"""Flag of containers whose times start at an arbitrary number: MPEG transport and program streams. Origin:
FFmpeg's AVFMT_TS_DISCONT."""


def index_videos(paths: Iterable[Path]) -> tuple[VideoFile, ...]:
    """List the frames of the chapters of a camera. A file of several recordings gives several chapters.

    Args:
        paths: Paths of the video files.

    Raises:
        CaptureError: A file cannot be used: see `index_video`.
    """
    return tuple(index_video(path, part) for path in paths for part in parts_of(path))


def index_video(path: Path, part: tuple[int, int] | None = None) -> VideoFile:
    """List the frames of a video. Only one frame is decoded, to read its size and orientation.

    Args:
        path: Path of the video file.
        part: First byte, and the byte after the last byte, of the recording in the file; None for all bytes.

    A video whose end is missing is used up to its last whole frame, unless an index of the whole file shows
    that the file was not copied completely.

    Raises:
        CaptureError: There is no video stream, there are no frames, the timestamps are implausible, or the
            file contains fewer frames than its index lists.
    """
    missing = missing_part(path.resolve())
    is_last = part is None or part[1] >= path.stat().st_size
    missing_end = missing.text if missing is not None and missing.readable_bytes and is_last else ""
    with open_container(path, part) as container:
        stream = video_stream(container, path)
        container_format = container.format.name
        # An MP4 file has an index of all packets. The length of the index is read before demuxing, because
        # demuxing adds entries to the index.
        expected = len(stream.index_entries) if "mp4" in container_format and not missing_end else 0
        packets, is_cut = _scan_packets(path, container, stream, expected)
        pts = packets.pts
        metadata = {**container.metadata, **stream.metadata}
        sound_s = max(
            (float((s.duration or 0) * (s.time_base or 0)) for s in container.streams.audio), default=0
        )
        time_base, rate = Fraction(stream.time_base or 0), stream.average_rate or stream.guessed_rate
        pixel_aspect = _pixel_aspect(stream.sample_aspect_ratio)
    if max(abs(int(pts[0])), abs(int(pts[-1]))) * time_base > MAX_TIME_S or time_base <= 0:
        raise CaptureError(
            "the times of the frames in the video file are not plausible", path=path, hint=COPY_AGAIN
        )
    video = VideoFile(
        path=path,
        pts=pts,
        key_pts=packets.key_pts,
        time_base=time_base,
        fps=_nominal_fps(pts, time_base, rate),
        duration_ns=round((packets.end - int(pts[0])) * time_base * 1_000_000_000),
        stored_size=(0, 0),
        orientation=((1, 0), (0, 1)),
        created_s=_creation_time(metadata),
        focal_35mm=_focal_35mm(metadata),
        missing_end=missing_end or ("its last frame is cut" if is_cut else ""),
        pixel_aspect=pixel_aspect,
        restarts=packets.restarts,
        start_pts=packets.start,
        capture_fps=capture_fps(metadata, path),
        sound_s=sound_s,
        part=part,
    )
    return _with_lost_frames(_with_first_frame(video, container_format), packets.lost)


def _scan_packets(
    path: Path, container: InputContainer, stream: Any, expected: int
) -> tuple[PacketTimes, bool]:
    """Read the timestamps of all packets of a video stream. A last packet that is cut is left out.

    Args:
        path: Path of the video file, for error messages.
        container: The opened file.
        stream: The video stream.
        expected: Minimum number of packets; a smaller number means that the file is truncated.

    Returns:
        The times of the frames; whether the last packet is cut.
    """
    import av

    frames: list[tuple[int, int, bool]] = []
    first_dts: int | None = None
    read, untimed, is_cut = 0, 0, False
    try:
        for packet in container.demux(stream):
            read += packet.size > 0
            if is_frame(packet):
                first_dts = first_dts if frames else packet.dts
                frames.append((packet.pts, packet.duration or 0, packet.is_keyframe))
                is_cut = packet.is_corrupt
            elif packet.size > 0 and packet.pts is None:
                untimed += 1
    except av.error.FFmpegError as error:
        raise CaptureError(
            f"the video cannot be read after {len(frames)} frames ({error_reason(error)})",
            path=path,
            hint=COPY_AGAIN,
        ) from error
    if read < expected:
        message = (
            f"the video file is incomplete: its index lists {expected} frames, but the file contains only "
            f"{read} of these frames"
        )
        raise CaptureError(message, path=path, hint=COPY_AGAIN)
    if not frames:
        raise CaptureError("the video contains no frame", path=path, hint=COPY_AGAIN)
    whole = frames[:-1] if is_cut and len(frames) > 1 else frames
    has_zero = not container.format.flags & _NO_ZERO
    packets = sort_packets(np.array(whole, dtype=np.int64), first_dts, untimed, has_zero=has_zero)
    return packets, is_cut


def _nominal_fps(pts: IntArray, time_base: Fraction, rate: Fraction | None) -> float:
    """Return the container's frame rate; if there is none, the inverse of the median frame interval."""
    if rate:
        return float(rate)
    steps = np.diff(pts)
    return float(1 / (int(np.median(steps)) * time_base)) if len(steps) else 0.0


def _pixel_aspect(stated: Fraction | None) -> Fraction:
    """Return the pixel aspect: the width of a stored pixel over its height.

    It is 1 if the value in the file is missing, implausible or nearly 1: resampling would blur every image to
    correct an error of less than one pixel.
    """
    aspect = Fraction(stated or 1)
    is_plausible = _MIN_PIXEL_ASPECT <= aspect <= 1 / _MIN_PIXEL_ASPECT
    return aspect if is_plausible and abs(aspect - 1) > ASPECT_TOLERANCE else Fraction(1)


def _creation_time(metadata: dict[str, str]) -> float | None:
    """Return the creation time, Unix seconds; None if the time is missing or the clock was not set."""
    text = metadata.get("creation_time", "")
    try:
        stamp = datetime.fromisoformat(text.replace("Z", "+00:00"))
    except ValueError:
        return None
    if stamp.tzinfo is None:
        stamp = stamp.replace(tzinfo=UTC)
    return stamp.timestamp() if stamp.year > 1980 else None


def _focal_35mm(metadata: dict[str, str]) -> float | None:
    """Return the 35 mm equivalent focal length, millimetres, from the metadata of a phone.

    Returns None if the metadata do not contain a plausible value.
    """
    for key, text in metadata.items():
        if key.lower().endswith("focal_length.35mm_equivalent"):
            with contextlib.suppress(ValueError):
                value = float(text)
                return value if 5.0 < value < 300.0 else None
    return None


def _with_lost_frames(video: VideoFile, lost: int) -> VideoFile:
    """Return the video with a note about frames without a time of their own.

    The two halves of an interlaced frame may be in two packets, and the second packet needs no time.
    """
    if not lost or video.is_interlaced:
        return video
    text = (
        f"{lost} of {len(video.pts) + lost} frames have no time, or that of another frame: they are left out"
    )
    return replace(video, notes=(*video.notes, text))


def _with_first_frame(video: VideoFile, container_format: str) -> VideoFile:
    """Return the video with size and orientation taken from a decoded frame.

    The values in the container may be wrong. Frames before the first frame that can be decoded are removed
    from the list. Such frames exist if the stream was cut between two key frames. If no decoded frame has a
    timestamp, no frame is removed.
    """
    frame, reordered = first_frame(video)
    video = replace(
        video,
        stored_size=(frame.width, frame.height),
        orientation=orientation_from_frame(frame),
        is_interlaced=bool(frame.interlaced_frame),
        projection=projection_from_frame(frame, video.path),
    )
    if container_format == "avi" and reordered:
        return replace(video, is_counted=True, key_pts=video.pts[:1])
    first = 0 if frame.pts is None else int(np.searchsorted(video.pts, frame.pts))
    return replace(video, pts=video.pts[first:], key_pts=video.key_pts[video.key_pts >= video.pts[first]])
