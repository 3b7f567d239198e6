"""Store copies of frames at the work size, so that the video need not be decoded again.

The work size is the image size that all stages work at. A frame with a stored copy is called a kept frame.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from bodycap_batch.capture.decoding import decode_frames
from bodycap_batch.capture.images import Colours, Image, Planes, work_image
from bodycap_batch.capture.video import VideoFile
from bodycap_batch.core.arrays import BoolArray, IntArray, set_array
from bodycap_batch.formats.mp4_writer import TIME_BASE_HZ, Quality, VideoWriter
from bodycap_batch.model.copied_frames import Pictures

KEPT_NAME = "kept"
"""Name of the stored `KeptFrames` in a keyframe artefact, and name of the video file with the copies."""
_FPS = 30
"""Nominal frame rate, Hz, of the video with the copies. Any value is possible, because the frames are
identified by their numbers, not by their times."""
_FRAME_TICKS = TIME_BASE_HZ // _FPS
"""Time between two frames of the video with the copies, in units of its time base."""
_LARGE_RATIO = 2.0
"""Copies of all frames are stored only if the number of pixels of a frame in the video, divided by the number
of pixels at the work size, is at least this ratio. For such a large video, decoding again costs more than
writing and reading the copies. Unit: 1. Evidence: docs/decisions/capture.md."""
_GROUP_FRAMES = 12
"""Number of frames from one codec key frame to the next (GOP length), if all frames are kept. Evidence:
none."""
_IDENTITY_ORIENTATION = ((1, 0), (0, 1))
"""Display matrix of an image that is stored upright."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptFrames:
    """The kept frames of a camera, stored in a separate video that can be decoded quickly.

    Attributes:
        path: Path of the video with the copies.
        frames: (K,) indices of the kept frames among the frames of the camera, not decreasing.
        width_px: Width of the copies at the camera's work size, pixels.
        height_px: Height of the copies at the camera's work size, pixels.
        group: Number of frames from one codec key frame to the next (GOP length).
    """

    path: Path
    frames: IntArray
    width_px: int
    height_px: int
    group: int

    def __post_init__(self) -> None:
        set_array(self, "frames", (len(self.frames),), np.int64)

    def only(self, pictures: Pictures | None) -> KeptFrames:
        """Return the kept frames with indices among the frames that are no copies; unchanged for None.

        A kept copy gets the index of its original.
        """
        if pictures is None:
            return self
        index = np.searchsorted(pictures.frames, self.frames, side="right") - 1
        return replace(self, frames=index)

    def holds(self, indices: IntArray) -> BoolArray:
        """Return a mask (N,) that is True where the frame with the given index (N,) is kept."""
        return np.isin(indices, self.frames)

    def read(
        self, indices: IntArray, size: tuple[int, int], *, colour: bool, threads: int = 0
    ) -> Generator[Image, None, None]:
        """Decode kept frames.

        Args:
            indices: (N,) increasing indices among the frames of the camera. All these frames must be kept.
            size: Width and height of the returned images, pixels.
            colour: True for RGB images, False for grey images.
            threads: Number of threads of the decoder, as in `open_stream`.

        Yields:
            The image of each frame: (H,W,3) for RGB or (H,W) for grey.

        Raises:
            CaptureError: A frame cannot be decoded.
        """
        stored_size = (self.width_px, self.height_px)
        for _, frame in decode_frames(self._video(), np.searchsorted(self.frames, indices), threads):
            yield work_image(frame, _IDENTITY_ORIENTATION, size, colour=colour, shown=stored_size)

    def _video(self) -> VideoFile:
        """Return the video with the copies, with the list of its frames."""
        pts = np.arange(len(self.frames), dtype=np.int64) * _FRAME_TICKS
        return VideoFile(
            path=self.path,
            pts=pts,
            key_pts=pts[:: self.group],
            time_base=Fraction(1, TIME_BASE_HZ),
            fps=float(_FPS),
            duration_ns=len(pts) * 10**9 // _FPS,
            stored_size=(self.width_px, self.height_px),
            orientation=_IDENTITY_ORIENTATION,
        )


@dataclass(frozen=True, slots=True)
class FrameCandidate:
    """A decoded frame that may be kept.

    Attributes:
        index: Index among the frames of the camera.
        grey: (H,W) grey image at the work size.
        planes: Function that returns the luma and chroma planes of the frame, with their colour range and
            colour matrix.
    """

    index: int
    grey: Image
    planes: Callable[[], tuple[Planes, Colours]]


def should_keep_all(stored_size: tuple[int, int], work_size: tuple[int, int]) -> bool:
    """Return True if a video is so large that all its frames are kept.

    If all frames are kept, their compression has small losses. For a smaller video, only the keyframes are
    kept, because only the keyframes are read more than twice. The copies of keyframes are lossless for frames
    with 8 bits and 4:2:0 chroma. For other formats, the luma of these copies is correct to one grey level.

    Args:
        stored_size: Width and height of the frames in the video, pixels.
        work_size: Width and height of the copies, pixels.
    """
    return stored_size[0] * stored_size[1] >= _LARGE_RATIO * work_size[0] * work_size[1]


@dataclass(slots=True)
class FrameKeeper:
    """Context manager that writes the kept frames of one camera.

    Attributes:
        folder: Existing folder for the video with the copies.
        width_px: Width of the frames at the work size, pixels.
        height_px: Height of the frames at the work size, pixels.
        keep_all: True if all frames are kept; False if only the keyframes are kept.
    """

    folder: Path
    width_px: int
    height_px: int
    keep_all: bool
    _frames: list[int] = field(default_factory=list)
    _colours: Colours = (0, 0)
    _writer: VideoWriter | None = None

    def add_frame(self, shot: FrameCandidate) -> None:
        """Write a frame if `keep_all` is True; otherwise do nothing."""
        if self.keep_all:
            self._add(shot)

    def add_keyframe(self, shot: FrameCandidate) -> None:
        """Write a keyframe if `keep_all` is False. Otherwise do nothing: `add_frame` writes all frames."""
        if not self.keep_all:
            self._add(shot)

    def kept_frames(self) -> KeptFrames | None:
        """Return the kept frames; None if no frame was kept. Call this after the context has ended."""
        if not self._frames:
            return None
        return KeptFrames(
            path=self._path,
            frames=np.array(self._frames, dtype=np.int64),
            width_px=self.width_px,
            height_px=self.height_px,
            group=_GROUP_FRAMES if self.keep_all else 1,
        )

    @property
    def _path(self) -> Path:
        return self.folder / f"{KEPT_NAME}.mp4"

    def _add(self, shot: FrameCandidate) -> None:
        planes, colours = shot.planes()
        if self._writer is None:
            self._colours = colours
            size = (planes.shape[1], planes.shape[0] * 2 // 3)
            quality: Quality = "near" if self.keep_all else "exact"
            self._writer = VideoWriter(self._path, _FPS, size, quality, colours)
        if colours == self._colours:  # a frame with another range or matrix is not kept
            self._writer.add_planes(planes)
            self._frames.append(shot.index)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._writer is not None:
            self._writer.__exit__(kind, error, trace)
