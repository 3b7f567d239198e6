"""A video file: the list of its frames and their times, and functions to open the file."""

from __future__ import annotations

import contextlib
import struct
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.formats.file_completeness import missing_part
from bodycap_batch.formats.file_url import file_url

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.packet import Packet
    from av.video.frame import VideoFrame
    from av.video.stream import VideoStream

Orientation = tuple[tuple[int, int], tuple[int, int]]
"""Matrix (2,2) that converts the coordinates of a stored image to the coordinates of the shown image: shown =
orientation · stored. x points to the right and y down. The matrix is a signed permutation."""

COPY_AGAIN = "copy the video again from the memory card of the camera, or leave this camera out"
"""Hint of the error about a damaged file."""
_SPHERICAL_PROJECTIONS = {
    0: "equirectangular", 1: "a cube map", 2: "equirectangular, in tiles", 3: "half equirectangular",
    6: "parametric immersive",
}  # fmt: skip
"""FFmpeg's numbers of the projections that no lens has. Rectilinear and fisheye pictures are left out."""
MAY_READ = (
    "give the user who runs this program the permission to read the file and to enter its folders (chmod)"
)
"""Hint of the error about a file that the user has no permission to read."""

_COUNTED_PACKETS = 100
"""Number of pictures of a stream that are counted, if a file has several video streams. Origin: more than the
pictures between two parts of an interleaved file, some seconds."""
_MIN_PREVIEW_SHARE = 0.1
"""Least number of pictures of a video, relative to the stream with most of them. Fewer are a preview."""
_MIN_AREA_SHARE = 0.3
"""Least number of pixels of a video, relative to the largest one. A smaller one is a copy of it. Origin:
copies have at most half the width and the height."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoFile:
    """The video stream of one file, with all that is needed to decode its frames and to compute their times.

    Attributes:
        path: Path of the file.
        pts: (N,) presentation timestamps of the frames in units of `time_base`, increasing.
        key_pts: (K,) presentation timestamps of the codec's key frames, at which decoding can start.
        time_base: Seconds per unit of the timestamps.
        fps: Nominal frame rate of the container, frames per second.
        duration_ns: Nanoseconds from the start of the first frame to the end of the last frame.
        stored_size: Width and height of the stored frames, before the display rotation, in stored pixels.
        orientation: (2,2) display matrix of integers: shown = orientation · stored, with y down.
        created_s: Creation time from the metadata, Unix seconds; None if it is unknown.
        focal_35mm: 35 mm equivalent focal length from the metadata, millimetres; None if it is unknown.
        is_counted: True if the frames must be identified by counting them from the start, because the decoder
            returns no timestamps (AVI with B-frames).
        is_interlaced: True if a frame contains two half pictures of different times.
        missing_end: What is missing at the end of the file; "" if nothing is known to be missing.
        pixel_aspect: Width of a stored pixel over its height. For example, it is 4/3 if 1440 stored columns
            are shown as 1920 columns.
        restarts: The packets at which the times start again, and the number that is added to the timestamps
            from there on: see `PacketTimes`. `pts` contains the sums.
        start_pts: Timestamp of the start of the file. It is not 0 if the time of the first frame comes from
            the format of the file alone, as in MPEG transport streams.
        capture_fps: Frames per second at which the camera took the pictures, from the metadata; None if it is
            unknown.
        sound_s: Duration of the longest sound track, seconds; 0 without sound, or if it is unknown.
        part: First byte, and the byte after the last byte, of the recording in the file, if the file consists
            of several recordings. None if the whole file is one recording.
        notes: Notes for the user about frames without a time of their own.
        projection: Projection of a 360° picture, which no lens has, as the file states it; "" for a picture
            through a lens.
    """

    path: Path
    pts: IntArray
    key_pts: IntArray
    time_base: Fraction
    fps: float
    duration_ns: int
    stored_size: tuple[int, int]
    orientation: Orientation
    created_s: float | None = None
    focal_35mm: float | None = None
    is_counted: bool = False
    is_interlaced: bool = False
    missing_end: str = ""
    pixel_aspect: Fraction = Fraction(1)
    restarts: tuple[tuple[int, int], ...] = ()
    start_pts: int = 0
    capture_fps: float | None = None
    sound_s: float = 0.0
    part: tuple[int, int] | None = None
    notes: tuple[str, ...] = ()
    projection: str = ""

    @property
    def turned_size(self) -> tuple[int, int]:
        """Width and height after the display rotation, in stored pixels."""
        return self._turned(*self.stored_size)

    @property
    def shown_size(self) -> tuple[int, int]:
        """Width and height after the display rotation, in square pixels."""
        width, height = self.stored_size
        wide, high = max(self.pixel_aspect, Fraction(1)), min(self.pixel_aspect, Fraction(1))
        return self._turned(round(width * wide), round(height / high))

    def _turned(self, width: int, height: int) -> tuple[int, int]:
        return (width, height) if self.orientation[0][0] else (height, width)

    @property
    def length_s(self) -> float:
        """Time (seconds) from the first frame to the last frame."""
        return float((int(self.pts[-1]) - int(self.pts[0])) * self.time_base)

    def times_ns(self) -> IntArray:
        """Return the timestamps (N,) in nanoseconds, rounded to the nearest nanosecond."""
        top, bottom = self.time_base.numerator * 1_000_000_000, self.time_base.denominator
        exact = [(2 * value * top + bottom) // (2 * bottom) for value in self.pts.tolist()]
        return np.array(exact, dtype=np.int64)


def open_container(path: Path, part: tuple[int, int] | None = None) -> InputContainer:
    """Open a media file. A file whose end is missing is opened up to the last part that is complete.

    Args:
        path: Path of the file.
        part: First byte, and the byte after the last byte, that are read; None to read the whole file.

    Raises:
        CaptureError: The file is missing, empty or not a video.
    """
    import av

    container: InputContainer
    try:
        if not path.is_file():
            raise CaptureError(
                "there is no such video file",
                path=path,
                hint="correct the path of the video in the job; a relative path starts at the folder "
                "of the job file",
            )
        if path.stat().st_size == 0:
            raise CaptureError("the video is empty (0 bytes)", path=path, hint=COPY_AGAIN)
        try:
            container = av.open(_url(path, part), metadata_errors="replace")
        except (av.error.EOFError, av.error.InvalidDataError):
            # The file may end inside the index of a fragment. FFmpeg then reads no frame at all.
            missing = missing_part(path.resolve())
            if part is not None or missing is None or not 0 < missing.readable_bytes < path.stat().st_size:
                raise
            container = av.open(_url(path, (0, missing.readable_bytes)), metadata_errors="replace")
    except av.error.EOFError as error:
        raise CaptureError("the video contains no frame", path=path, hint=COPY_AGAIN) from error
    except PermissionError as error:
        raise CaptureError(
            "the program has no permission to read the video", path=path, hint=MAY_READ
        ) from error
    except (av.error.FFmpegError, OSError) as error:
        missing = missing_part(path.resolve())
        reason = error_reason(error) if missing is None else missing.text
        raise CaptureError(
            f"the file cannot be read as a video: {reason}", path=path, hint=COPY_AGAIN
        ) from error
    return container


def _url(path: Path, part: tuple[int, int] | None) -> str:
    """Return the URL of a file, or of the bytes from the first to before the second of `part`, for FFmpeg."""
    return file_url(path) if part is None else f"subfile,,start,{part[0]},end,{part[1]},,:{file_url(path)}"


def video_stream(container: InputContainer, path: Path) -> VideoStream:
    """Return the stream with the camera's pictures. Cover pictures and small previews are ignored.

    Raises:
        CaptureError: There is no stream with the camera's pictures, there are several, or there is no decoder
            for the stream.
    """
    import av

    cover = av.stream.Disposition.attached_pic
    streams = [stream for stream in container.streams.video if not stream.disposition & cover]
    if not streams:
        what = (
            "the file contains only sound, no video"
            if container.streams.audio
            else "the video contains no frame"
        )
        raise CaptureError(what, path=path, hint="give the file that contains the pictures of the camera")
    streams = [stream for stream in streams if stream.codec_context is not None]
    if not streams:
        raise CaptureError(
            "the program cannot decode this kind of video", path=path, hint="convert the video to H.264"
        )
    if len(streams) > 1:
        streams = _without_previews(streams, path)
    if len(streams) > 1:
        sizes = ", ".join(f"{each.width}×{each.height}" for each in streams)
        raise CaptureError(
            f"the file contains {len(streams)} video tracks ({sizes}), for example those of two lenses",
            path=path,
            hint="export the video of one lens as a file of its own (ffmpeg -map 0:v:0 -c copy)",
        )
    return streams[0]


def _without_previews(streams: list[VideoStream], path: Path) -> list[VideoStream]:
    """Return the video streams without single pictures and without small copies of another stream."""
    import av

    counts = dict.fromkeys((stream.index for stream in streams), 0)
    with open_container(path) as container, contextlib.suppress(av.error.FFmpegError):
        for packet in container.demux([container.streams[index] for index in counts]):
            counts[packet.stream.index] += packet.size > 0
            if max(counts.values()) >= _COUNTED_PACKETS:
                break
    least = _MIN_PREVIEW_SHARE * max(counts.values())
    moving = [stream for stream in streams if counts[stream.index] >= least]
    area = max(stream.width * stream.height for stream in moving)
    return [stream for stream in moving if stream.width * stream.height >= _MIN_AREA_SHARE * area]


def is_frame(packet: Packet[Any]) -> bool:
    """Return True if a packet of the video stream contains a frame that is shown, and its time."""
    return packet.pts is not None and not packet.is_discard and packet.size > 0


def error_reason(error: Exception) -> str:
    """Return a short description of an error that a library raised."""
    return str(getattr(error, "strerror", "") or error)


def orientation_from_frame(frame: VideoFrame) -> Orientation:
    """Return the orientation that is nearest to the display matrix of a frame.

    Such an orientation is a rotation by a multiple of 90°, with or without mirroring. Without a display
    matrix, it is the identity.
    """
    side_data: Any = frame.side_data.get("DISPLAYMATRIX")
    if side_data is None:
        return (1, 0), (0, 1)
    a, b, _, c, d, *_ = struct.unpack("=9i", bytes(side_data)[:36])
    if abs(a) + abs(d) >= abs(b) + abs(c):
        return (_sign(a), 0), (0, _sign(d))
    return (0, _sign(c)), (_sign(b), 0)


def projection_from_frame(frame: VideoFrame, path: Path) -> str:
    """Return the projection of a 360° picture, as the metadata or the format of the file state it; else "".

    Source: FFmpeg, libavutil/spherical.h, which reads both versions of Google's Spherical Video metadata.
    """
    side_data: Any = frame.side_data.get("SPHERICAL")
    number = None if side_data is None else struct.unpack("=i", bytes(side_data)[:4])[0]
    if number in _SPHERICAL_PROJECTIONS:
        return f"{_SPHERICAL_PROJECTIONS[number]} in its metadata"
    suffix, shape = path.suffix.lower(), Fraction(frame.width, frame.height)
    if suffix == ".360" or (suffix == ".insv" and shape in (1, 2)):
        return f"unstitched pictures of a 360° camera in a file {suffix}"
    return ""


def spherical_error(path: Path, projection: str) -> CaptureError:
    """Return the error for a video of 360° pictures."""
    return CaptureError(
        f"the video shows a 360° picture ({projection}), which no lens model describes",
        path=path,
        hint="export a flat view first: in the program of the camera, reframe the video to a fixed direction "
        "and a fixed field of view, without stabilisation, and use the exported file",
    )


def _sign(value: int) -> int:
    return -1 if value < 0 else 1
