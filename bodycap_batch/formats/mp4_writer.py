"""Write H.264 video as MP4 files. Browsers and video editors can play these files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.errors import StoreError
from bodycap_batch.formats.atomic_files import store_error_from_os_error
from bodycap_batch.formats.file_url import file_url

if TYPE_CHECKING:
    from av.audio.frame import AudioFrame
    from av.video.frame import VideoFrame

_FRAME_SAMPLES = 1024
"""Number of samples of a frame. Origin: the frames of AAC have this size."""

TIME_BASE_HZ = 15360
"""Number of timestamp units per second. Derivation: the number is a multiple of the usual frame rates 24, 30,
60 and 120 Hz. It is also FFmpeg's default for 30 Hz."""

_DATA_HZ = 1000
"""Number of timestamp units per second of a data track, as in GoPro's files."""

_FAST_X264_PARAMS = "bframes=0:rc-lookahead=0:weightp=0:8x8dct=0"
"""Options of x264 for fast encoding: no look-ahead, no weighted prediction, no large transforms. Evidence:
docs/decisions/formats.md."""

_ENCODER_OPTIONS = {
    "high": {"crf": "16", "preset": "superfast"},
    "lossless": {"crf": "0", "preset": "ultrafast"},
    # With g = 1 (GOP length 1), every frame is a key frame, which can be decoded without other frames.
    "exact": {"qp": "0", "preset": "ultrafast", "g": "1"},
    "near": {"crf": "12", "preset": "ultrafast", "g": "12"},
    "small": {"crf": "27", "preset": "superfast", "x264-params": _FAST_X264_PARAMS},
}
"""Options of the encoder for each quality of `VideoWriter`."""

_CONTAINER_OPTIONS = {"small": {"movflags": "+faststart"}}
"""Options of the MP4 container, by quality of `VideoWriter`. The option ``+faststart`` puts the index at the
start of the file, so that a web page can play the video while the file loads."""

Quality = Literal["high", "lossless", "exact", "near", "small"]
_STUDIO_RANGE_CHROMA = np.round((np.arange(256) - 128.0) * (224.0 / 255.0) + 128.0).astype(np.uint8)
"""Look-up table from chroma in full range to chroma in studio range. Source: ITU-R BT.601."""


@dataclass(frozen=True, slots=True)
class Sound:
    """Mono sound.

    Attributes:
        samples: (N,) samples, full scale −1 to 1.
        rate_hz: Samples per second.
    """

    samples: npt.NDArray[np.float32]
    rate_hz: int


@dataclass(frozen=True, slots=True)
class DataTrack:
    """A track of data, such as the telemetry of a camera.

    Attributes:
        handler: Name of the track's handler.
        payloads: Content, time in the file (seconds) and duration (seconds) of each payload.
    """

    handler: str
    payloads: tuple[tuple[bytes, float, float], ...]


class VideoWriter:
    """Writer of an MP4 file with H.264 video.

    The encoder uses one thread, so that equal frames give equal bytes.

    Args:
        path: Path of the file.
        fps: Frames per second.
        size: Width and height of the images, pixels.
        quality: Quality of the video. "high": good quality. "lossless": no losses, except that the chroma has
            half the resolution. "exact": like "lossless", and every frame can be decoded without other
            frames. "near": hardly visible losses. "small": small file.
        colours: Colour range and colour matrix of the images given to `add_planes`, as FFmpeg's numbers, to
            be stored in the file. None to store neither.
        sound: Mono sound that starts with the first image, to be stored as AAC. None for no sound.
        bit_rate_mbps: Mean bit rate, megabits per second, instead of a constant quality. None: `quality`
            decides.
        timecode: Timecode of the first image, for a timecode track; "" for none.
        data: Track of data. None for none.

    Raises:
        StoreError: The file cannot be written.
    """

    def __init__(  # noqa: PLR0913, PLR0917 - what a video consists of
        self,
        path: Path,
        fps: float,
        size: tuple[int, int],
        quality: Quality,
        colours: tuple[int, int] | None = None,
        sound: Sound | None = None,
        bit_rate_mbps: float | None = None,
        timecode: str = "",
        data: DataTrack | None = None,
    ) -> None:
        import av

        self._av = av
        self._path = path
        self._quality = quality
        rate = Fraction(fps).limit_denominator(100_000)
        with self._reported():
            self._container = av.open(file_url(path), "w", options=_CONTAINER_OPTIONS.get(quality, {}))
            self._stream = self._container.add_stream("libx264", rate=rate)
            self._sound_stream = sound and self._container.add_stream(
                "aac", rate=sound.rate_hz, layout="mono"
            )
            if data is not None:
                self._data_stream = self._container.add_data_stream("bin_data")
                self._data_stream.metadata["handler_name"] = data.handler
                self._data_stream.time_base = Fraction(1, _DATA_HZ)
        self._payloads = () if data is None else data.payloads
        self._sound = iter(()) if sound is None else sound_frames(sound.samples, sound.rate_hz)
        self._stream.width, self._stream.height = size
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = _ENCODER_OPTIONS[quality]
        if bit_rate_mbps is not None:
            self._stream.bit_rate = round(1e6 * bit_rate_mbps)
            rate_kbps = f"{1e3 * bit_rate_mbps:.0f}k"
            # An interval of one second between complete frames, and a buffer of one second, as phones have.
            self._stream.options = {
                "preset": "veryfast",
                "maxrate": rate_kbps,
                "bufsize": rate_kbps,
                "g": f"{max(1, round(fps))}",
            }
        if timecode:
            self._stream.metadata["timecode"] = timecode
        self._stream.codec_context.thread_count = 1
        if colours is not None:
            self._stream.codec_context.color_range, self._stream.codec_context.colorspace = colours
        self._frame_duration = Fraction(1) / rate
        self._count = 0
        self._sound_s = 0.0

    def add(self, image: npt.NDArray[np.uint8]) -> None:
        """Append an RGB image (H,W,3) to the video."""
        if self._quality == "small":
            self.add_planes(yuv420_from_rgb(image))
        else:
            self._add(self._av.VideoFrame.from_ndarray(image, format="rgb24"))

    def add_planes(self, planes: npt.NDArray[np.uint8]) -> None:
        """Append an image, given as planes, to the video.

        Args:
            planes: (1.5·H,W) luma, then both chroma planes at half resolution. The values must be in the
                colour range that is stored in the file.
        """
        self._add(self._av.VideoFrame.from_ndarray(planes, format="yuv420p"))

    def _add(self, frame: VideoFrame) -> None:
        frame.pts = round(self._count * self._frame_duration * TIME_BASE_HZ)
        frame.time_base = Fraction(1, TIME_BASE_HZ)
        self._count += 1
        self._send(self._stream, frame)
        self._send_sound(float(self._count * self._frame_duration))

    def _send_sound(self, until_s: float) -> None:
        """Encode the sound up to a time in the file, seconds, so that the file holds it beside the images."""
        while self._sound_s < until_s and (frame := next(self._sound, None)) is not None:
            self._sound_s += frame.samples / frame.sample_rate
            self._send(self._sound_stream, frame)

    def _send_data(self) -> None:
        """Write the payloads of the data track."""
        for content, time_s, duration_s in self._payloads:
            packet = self._av.Packet(content)
            packet.stream, packet.time_base = self._data_stream, Fraction(1, _DATA_HZ)
            packet.pts = packet.dts = round(_DATA_HZ * time_s)
            packet.duration = round(_DATA_HZ * duration_s)
            with self._reported():
                self._container.mux(packet)

    def _send(self, stream: Any, frame: object) -> None:
        with self._reported():
            for packet in stream.encode(frame):
                self._container.mux(packet)

    @contextmanager
    def _reported(self) -> Iterator[None]:
        """Convert an error of the encoder or of the disk to a `StoreError`."""
        try:
            yield
        except OSError as error:
            raise store_error_from_os_error(error, self._path) from error
        except self._av.error.FFmpegError as error:
            raise StoreError(
                f"the video cannot be written: {error}", path=self._path, hint="check the disk for errors"
            ) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self._send(self._stream, None)
            self._send_sound(float("inf"))
            if self._sound_stream is not None:
                self._send(self._sound_stream, None)
            self._send_data()
        with self._reported() if kind is None else suppress(OSError, self._av.error.FFmpegError):
            self._container.close()


def yuv420_from_rgb(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Convert an RGB image to YUV 4:2:0 planes in studio range.

    This conversion is faster than FFmpeg's conversion. Evidence: docs/decisions/formats.md.

    Args:
        image: (H,W,3) RGB image. Width and height must be even.

    Returns:
        The planes (1.5·H,W): luma, then both chroma planes at half resolution.

    Source: ITU-R BT.601.
    """
    import cv2

    height, width = image.shape[:2]
    planes = cv2.cvtColor(image, cv2.COLOR_RGB2YUV_I420)
    half = cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    # For the chroma of four pixels, cvtColor uses only one of the pixels. Then thin coloured lines flicker.
    # Therefore the chroma is computed from the mean of the four pixels.
    _, red, blue = cv2.split(cv2.cvtColor(half, cv2.COLOR_RGB2YCrCb))
    for plane, chroma in zip(planes[height:].reshape(2, -1), (blue, red), strict=True):
        plane[:] = cv2.LUT(chroma, _STUDIO_RANGE_CHROMA).ravel()
    return np.asarray(planes)


def sound_frames(
    samples: npt.NDArray[np.float32], rate_hz: int, layout: str = "mono", start: int = 0
) -> Iterator[AudioFrame]:
    """Yield the frames of PyAV for samples (N,) or (channels,N); the first has the timestamp `start`."""
    import av

    planes = np.atleast_2d(samples)
    for first in range(0, planes.shape[1], _FRAME_SAMPLES):
        part = np.ascontiguousarray(planes[:, first : first + _FRAME_SAMPLES], np.float32)
        frame = av.AudioFrame.from_ndarray(part, format="fltp", layout=layout)
        frame.sample_rate, frame.pts, frame.time_base = rate_hz, start + first, Fraction(1, rate_hz)
        yield frame
