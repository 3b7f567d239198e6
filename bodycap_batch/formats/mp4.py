"""MP4 with H.264, written one frame after the other; what browsers and editors play."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Literal, Self

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.errors import StoreError
from bodycap_batch.formats.atomic_files import store_error_from_os_error

if TYPE_CHECKING:
    from av.video.frame import VideoFrame

TIME_BASE_HZ = 15360
_FAST_X264_PARAMS = "bframes=0:rc-lookahead=0:weightp=0:8x8dct=0"
"""Without looking ahead a picture takes 16 ms instead of 22, and a file a tenth more; without weights and
large transforms a tenth less time, and it is no larger and no worse."""
_ENCODER_OPTIONS = {
    "high": {"crf": "16", "preset": "superfast"},
    "lossless": {"crf": "0", "preset": "ultrafast"},
    # Every frame decodes alone.
    "exact": {"qp": "0", "preset": "ultrafast", "g": "1"},
    "near": {"crf": "12", "preset": "ultrafast", "g": "12"},
    "small": {"crf": "27", "preset": "superfast", "x264-params": _FAST_X264_PARAMS},
}
_CONTAINER_OPTIONS = {"small": {"movflags": "+faststart"}}
"""The index first, so that a page plays the file while it is still loading."""
Quality = Literal["high", "lossless", "exact", "near", "small"]
_STUDIO_RANGE_CHROMA = np.round((np.arange(256) - 128.0) * (224.0 / 255.0) + 128.0).astype(np.uint8)
"""Chroma of full range in studio range (ITU-R BT.601)."""


class VideoWriter:
    """H.264 in an MP4 file. One encoder thread, so that the same frames give the same bytes.

    Args:
        path: The file.
        fps: Frames per second.
        size: Width and height.
        quality: "high", "lossless" (but for the chroma, which has half the resolution), "exact" (the same,
            every frame by itself), "near" (hardly a difference to be seen), or "small".
        colours: Range and matrix of what `add_planes` is given, as FFmpeg numbers them; told in the file.

    Raises:
        StoreError: The file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        fps: float,
        size: tuple[int, int],
        quality: Quality,
        colours: tuple[int, int] | None = None,
    ) -> None:
        import av

        self._av = av
        self._path = path
        self._quality = quality
        rate = Fraction(fps).limit_denominator(100_000)
        try:
            self._container = av.open(str(path), "w", options=_CONTAINER_OPTIONS.get(quality, {}))
            self._stream = self._container.add_stream("libx264", rate=rate)
        except (OSError, av.error.FFmpegError) as error:
            raise self._failure(error) from error
        self._stream.width, self._stream.height = size
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = _ENCODER_OPTIONS[quality]
        self._stream.codec_context.thread_count = 1
        if colours is not None:
            self._stream.codec_context.color_range, self._stream.codec_context.colorspace = colours
        self._frame_duration = Fraction(1) / rate
        self._count = 0

    def add(self, image: npt.NDArray[np.uint8]) -> None:
        """Append an RGB image (H,W,3)."""
        if self._quality == "small":
            self.add_planes(yuv420_from_rgb(image))
        else:
            self._add(self._av.VideoFrame.from_ndarray(image, format="rgb24"))

    def add_planes(self, planes: npt.NDArray[np.uint8]) -> None:
        """Append luma and halved chroma (1.5·H,W), in the range that the file tells."""
        self._add(self._av.VideoFrame.from_ndarray(planes, format="yuv420p"))

    def _add(self, frame: VideoFrame) -> None:
        frame.pts = round(self._count * self._frame_duration * TIME_BASE_HZ)
        frame.time_base = Fraction(1, TIME_BASE_HZ)
        self._count += 1
        self._send(frame)

    def _send(self, frame: object) -> None:
        try:
            for packet in self._stream.encode(frame):
                self._container.mux(packet)
        except (OSError, self._av.error.FFmpegError) as error:
            raise self._failure(error) from error

    def _failure(self, error: Exception) -> StoreError:
        if isinstance(error, OSError):
            return store_error_from_os_error(error, self._path)
        return StoreError(f"cannot write the video: {error}", path=self._path, hint="check the disk")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self._send(None)
        try:
            self._container.close()
        except (OSError, self._av.error.FFmpegError) as problem:
            if kind is None:
                raise self._failure(problem) from problem


def yuv420_from_rgb(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Luma and halved chroma (1.5·H,W) of an RGB image (H,W,3) whose sides are even, in studio range.

    FFmpeg's conversion takes 3.5 ms for 1280×720, this 1.0, and a picture's encoding 8.

    Source: ITU-R BT.601.
    """
    import cv2

    height, width = image.shape[:2]
    planes = cv2.cvtColor(image, cv2.COLOR_RGB2YUV_I420)
    half = cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    # OpenCV takes the chroma of one pixel in four, where thin coloured lines flicker: the mean of them.
    _, red, blue = cv2.split(cv2.cvtColor(half, cv2.COLOR_RGB2YCrCb))
    for plane, chroma in zip(planes[height:].reshape(2, -1), (blue, red), strict=True):
        plane[:] = cv2.LUT(chroma, _STUDIO_RANGE_CHROMA).ravel()
    return np.asarray(planes)
