"""Keep frames at the work size, so that their video need not be decoded again."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from bodycap_batch.capture.decoding import decode_frames
from bodycap_batch.capture.images import Colours, Image, Planes, work_image
from bodycap_batch.capture.video import VideoFile
from bodycap_batch.core.arrays import BoolArray, IntArray, set_array
from bodycap_batch.formats.mp4 import TIME_BASE_HZ, Quality, VideoWriter

KEPT_NAME = "kept"
"""Name of the bundle in a keyframe artefact, and of the video beside it."""
_FPS = 30
"""Nominal frame rate; frames are identified by their number."""
_FRAME_TICKS = TIME_BASE_HZ // _FPS
"""Time between two frames, in units of the video's time base."""
_LARGE_RATIO = 2.0
"""Ratio of the video's pixels to those at the work size, from which on all frames are kept. Decoding the
video again then costs more than writing and reading the copies. Evidence: docs/decisions/capture.md."""
_GROUP_FRAMES = 12
"""Frames from one key frame of the copy to the next, if all frames are kept. Evidence: none."""
_IDENTITY_ORIENTATION = ((1, 0), (0, 1))
"""Display matrix of an image that is stored upright."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptFrames:
    """Frames of a camera in a video of their own.

    Attributes:
        path: The video.
        frames: (K,) their indices in the camera, increasing.
        width_px: Width of the frames, the camera's work size.
        height_px: Height of the frames.
        group: Frames from one key frame to the next.
    """

    path: Path
    frames: IntArray
    width_px: int
    height_px: int
    group: int

    def __post_init__(self) -> None:
        set_array(self, "frames", (len(self.frames),), np.int64)

    def holds(self, indices: IntArray) -> BoolArray:
        """Return which frames of the camera (N,) are kept."""
        return np.isin(indices, self.frames)

    def read(
        self, indices: IntArray, size: tuple[int, int], *, colour: bool, threads: int = 0
    ) -> Generator[Image, None, None]:
        """Decode kept frames, grey (H,W) or RGB (H,W,3), at (width, height).

        Args:
            indices: Increasing indices in the camera.
            size: Width and height of the result.
            colour: RGB instead of grey.
            threads: Threads of the decoder, as in `open_stream`.

        Raises:
            CaptureError: A frame cannot be decoded.
        """
        stored_size = (self.width_px, self.height_px)
        for _, frame in decode_frames(self._video(), np.searchsorted(self.frames, indices), threads):
            yield work_image(frame, _IDENTITY_ORIENTATION, size, colour=colour, shown=stored_size)

    def _video(self) -> VideoFile:
        """Return the frame index of the copy."""
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
    """A frame that may be kept.

    Attributes:
        index: Its index in the camera.
        grey: (H,W) at the work size.
        planes: Makes its luma and chroma, with their range and matrix.
    """

    index: int
    grey: Image
    planes: Callable[[], tuple[Planes, Colours]]


def should_keep_all(stored_size: tuple[int, int], work_size: tuple[int, int]) -> bool:
    """Return True if a video is so large that all of its frames are kept, with a small loss.

    Of other videos only the keyframes are kept, because only these are read more than twice. The copy is
    lossless for 8 bits and 4:2:0 chroma, and correct to one grey level otherwise.
    """
    return stored_size[0] * stored_size[1] >= _LARGE_RATIO * work_size[0] * work_size[1]


@dataclass(slots=True)
class FrameKeeper:
    """Writes the kept frames of one camera; a context manager.

    Attributes:
        folder: An existing folder.
        width_px: Width of the frames.
        height_px: Height of the frames.
        keep_all: True if all frames are kept, not only keyframes.
    """

    folder: Path
    width_px: int
    height_px: int
    keep_all: bool
    _frames: list[int] = field(default_factory=list)
    _colours: Colours = (0, 0)
    _writer: VideoWriter | None = None

    def add_frame(self, shot: FrameCandidate) -> None:
        """Keep a frame if all frames are kept."""
        if self.keep_all:
            self._add(shot)

    def add_keyframe(self, shot: FrameCandidate) -> None:
        """Keep a keyframe, unless all frames are kept in any case."""
        if not self.keep_all:
            self._add(shot)

    def kept_frames(self) -> KeptFrames | None:
        """Return the kept frames once the keeper is closed; None if there are none."""
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
        if colours == self._colours:  # frames of a chapter with another colour range are read from the video
            self._writer.add_planes(planes)
            self._frames.append(shot.index)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._writer is not None:
            self._writer.__exit__(kind, error, trace)
