"""One video file: an index of its frames by exact timestamps, and decoding by index."""

from __future__ import annotations

import contextlib
import itertools
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from bodycap_batch.arrays import IntArray
from bodycap_batch.errors import CaptureError

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.frame import VideoFrame

COPY_AGAIN = "copy it again from the camera's card, or leave this camera out"


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoFile:
    """One container's video stream, demuxed once.

    Attributes:
        path: The file.
        pts: (N,) presentation timestamps in `time_base` units, increasing: one a frame.
        key_pts: (K,) timestamps of the frames decoding can start from.
        time_base: Seconds per unit.
        fps: The container's nominal rate.
        duration_ns: From the first frame to the end of the last.
        stored_size: Width and height as coded, before the display rotation.
        orientation: (2,2) integers, display matrix: shown = orientation · stored (y down).
        created_s: Creation time of the metadata, Unix seconds.
        focal_35mm: 35 mm equivalent focal length of the metadata.
    """

    path: Path
    pts: IntArray
    key_pts: IntArray
    time_base: Fraction
    fps: float
    duration_ns: int
    stored_size: tuple[int, int]
    orientation: tuple[tuple[int, int], tuple[int, int]]
    created_s: float | None = None
    focal_35mm: float | None = None

    @property
    def shown_size(self) -> tuple[int, int]:
        """Width and height after the display rotation."""
        width, height = self.stored_size
        return (width, height) if self.orientation[0][0] else (height, width)

    def times_ns(self) -> IntArray:
        """(N,) timestamps in nanoseconds, exact to half of one."""
        scale = self.time_base * 1_000_000_000
        exact = [round(int(value) * scale) for value in self.pts]
        return np.array(exact, dtype=np.int64)

    def decode(self, indices: IntArray) -> Iterator[tuple[int, VideoFrame]]:
        """Decode the frames with these increasing indices, seeking over what is not needed.

        Raises:
            CaptureError: A frame cannot be decoded.
        """
        with open_container(self.path) as container:
            yield from _decode(self, container, indices)


def open_container(path: Path) -> InputContainer:
    """Open a media file.

    Raises:
        CaptureError: It is missing, empty or not a video.
    """
    import av

    if not path.is_file():
        raise CaptureError(
            "no such video", path=path, hint="check the path in the job, relative to the job file"
        )
    if path.stat().st_size == 0:
        raise CaptureError("the video is empty (0 bytes)", path=path, hint=COPY_AGAIN)
    try:
        container: InputContainer = av.open(str(path))
    except av.error.EOFError as error:
        raise CaptureError("the video holds no frame", path=path, hint=COPY_AGAIN) from error
    except (av.error.FFmpegError, OSError) as error:
        raise CaptureError(
            f"not a readable video ({_reason(error)}); recordings cut short have no index",
            path=path,
            hint=COPY_AGAIN,
        ) from error
    return container


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", "") or error)


def index_video(path: Path) -> VideoFile:
    """List a video's frames without decoding them (one frame is decoded, for its orientation).

    Raises:
        CaptureError: No video stream, no frames, or the file ends before its index says.
    """
    with open_container(path) as container:
        if not container.streams.video:
            what = "no video in it, sound only" if container.streams.audio else "the video holds no frame"
            raise CaptureError(what, path=path, hint="give the file that holds the camera's pictures")
        stream = container.streams.video[0]
        pts, key_pts, end = _scan_packets(path, container, stream)
        if len(pts) == 0:
            raise CaptureError("the video holds no frame", path=path, hint=COPY_AGAIN)
        if stream.frames > 0 and len(pts) < stream.frames - _CONTAINER_SLACK:
            raise CaptureError(
                f"the video is cut short: {len(pts)} of the {stream.frames} frames its index lists",
                path=path,
                hint=COPY_AGAIN,
            )
        metadata = {**container.metadata, **stream.metadata}
        time_base, rate = Fraction(stream.time_base or 0), stream.average_rate or stream.guessed_rate
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
    )
    return _with_first_frame(video)


# Fragments and edit lists make a container count a few frames it does not show.
_CONTAINER_SLACK = 2


def _scan_packets(path: Path, container: InputContainer, stream: Any) -> tuple[IntArray, IntArray, int]:
    """Timestamps of all frames, of those decoding can start from, and the end of the last one."""
    import av

    pts: list[int] = []
    key: list[int] = []
    end = 0
    try:
        for packet in container.demux(stream):
            if packet.pts is None or packet.is_discard or packet.size == 0:
                continue
            pts.append(packet.pts)
            end = max(end, packet.pts + (packet.duration or 0))
            if packet.is_keyframe:
                key.append(packet.pts)
    except av.error.FFmpegError as error:
        raise CaptureError(
            f"the video breaks off after {len(pts)} frames ({_reason(error)})", path=path, hint=COPY_AGAIN
        ) from error
    shown = np.unique(np.array(pts, dtype=np.int64))
    if len(shown) > 1 and end <= int(shown[-1]):
        end = int(shown[-1]) + int(np.median(np.diff(shown)))
    return shown, np.unique(np.array(key, dtype=np.int64)), end


def _nominal_fps(pts: IntArray, time_base: Fraction, rate: Fraction | None) -> float:
    """The container's rate, or the median frame distance where it states none."""
    if rate:
        return float(rate)
    steps = np.diff(pts)
    return float(1 / (int(np.median(steps)) * time_base)) if len(steps) else 0.0


def _creation_time(metadata: dict[str, str]) -> float | None:
    """Creation time as Unix seconds, None where absent or the epoch of an unset clock."""
    text = metadata.get("creation_time", "")
    try:
        stamp = datetime.fromisoformat(text.replace("Z", "+00:00"))
    except ValueError:
        return None
    if stamp.tzinfo is None:
        stamp = stamp.replace(tzinfo=UTC)
    return stamp.timestamp() if stamp.year > 1980 else None


def _focal_35mm(metadata: dict[str, str]) -> float | None:
    """35 mm equivalent focal length that phones write, None where absent."""
    for key, text in metadata.items():
        if key.lower().endswith("focal_length.35mm_equivalent"):
            with contextlib.suppress(ValueError):
                value = float(text)
                return value if 5.0 < value < 300.0 else None
    return None


def _with_first_frame(video: VideoFile) -> VideoFile:
    """Decode one frame: the size and display matrix a decoder delivers are the ones that count."""
    for _, frame in video.decode(np.zeros(1, dtype=np.int64)):
        return replace(video, stored_size=(frame.width, frame.height), orientation=_orientation(frame))
    raise CaptureError("not one frame of the video can be decoded", path=video.path, hint=COPY_AGAIN)


def _orientation(frame: VideoFrame) -> tuple[tuple[int, int], tuple[int, int]]:
    """Round the display matrix to a quarter turn or mirror: shown = matrix · stored, y down."""
    side_data: Any = frame.side_data.get("DISPLAYMATRIX")
    if side_data is None:
        return (1, 0), (0, 1)
    a, b, _, c, d, *_ = struct.unpack("=9i", bytes(side_data)[:36])
    if abs(a) + abs(d) >= abs(b) + abs(c):
        return (_sign(a), 0), (0, _sign(d))
    return (0, _sign(c)), (_sign(b), 0)


def _sign(value: int) -> int:
    return -1 if value < 0 else 1


def turn_upright(
    image: npt.NDArray[np.uint8], orientation: tuple[tuple[int, int], tuple[int, int]]
) -> npt.NDArray[np.uint8]:
    """Turn a stored image (H,W) or (H,W,3) the way a player shows it."""
    (m00, m01), (m10, m11) = orientation
    if m00:
        sign_x, sign_y = m00, m11
    else:
        image, sign_x, sign_y = image.swapaxes(0, 1), m01, m10
    return image[::sign_y, ::sign_x]


def _decode(
    video: VideoFile, container: InputContainer, indices: IntArray
) -> Iterator[tuple[int, VideoFrame]]:
    """Decode wanted frames in order; jump to a later key frame only where that skips decoding."""
    import av

    stream = container.streams.video[0]
    stream.thread_type = "AUTO"
    stream.codec_context.thread_count = int(os.environ.get("OMP_NUM_THREADS", "0") or 0)
    frames: Iterator[VideoFrame] = iter(())
    position = -1  # index of the last decoded frame, −1 before the first
    started = False
    key_index = np.searchsorted(video.pts, video.key_pts)
    try:
        for wanted in map(int, indices):
            start = int(key_index[max(0, int(np.searchsorted(key_index, wanted, side="right")) - 1)])
            if not started or start > position + 1:
                frames, started = _frames_from(video, container, start), True
            for frame in frames:
                position = int(np.searchsorted(video.pts, frame.pts or 0))
                if position >= wanted:
                    break
            else:
                raise _lost(video, wanted)
            if position != wanted or frame.pts != video.pts[wanted]:
                raise _lost(video, wanted)
            yield wanted, frame
    except av.error.FFmpegError as error:
        raise CaptureError(
            f"decoding fails after frame {position} ({_reason(error)})", path=video.path, hint=COPY_AGAIN
        ) from error


def _frames_from(video: VideoFile, container: InputContainer, index: int) -> Iterator[VideoFrame]:
    """Decode from a key frame on; step back while the container seeks past it."""
    stream = container.streams.video[0]
    target = int(video.pts[index])
    step = 0
    while True:
        container.seek(target - step, stream=stream, backward=True)
        frames = container.decode(stream)
        first = next(frames, None)
        if first is not None and first.pts is not None and first.pts <= video.pts[index]:
            return itertools.chain((first,), frames)
        if target - step < int(video.pts[0]):
            return iter(()) if first is None else itertools.chain((first,), frames)
        step = max(2 * step, round(1 / video.time_base))


def _lost(video: VideoFile, index: int) -> CaptureError:
    seconds = float((int(video.pts[index]) - int(video.pts[0])) * video.time_base)
    return CaptureError(
        f"frame {index} (at {seconds:.2f} s) cannot be decoded",
        path=video.path,
        hint="re-encode it (ffmpeg -i in.mp4 -fps_mode passthrough out.mp4), or cut before it with end_s",
    )
