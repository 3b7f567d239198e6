"""Frames kept at the work size, so that a video need not be decoded again for them."""

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
"""Of the bundle in a keyframe artefact, and of the video beside it."""
_FPS = 30
"""Nominal: frames are known by their number."""
_FRAME_TICKS = TIME_BASE_HZ // _FPS
_LARGE_RATIO = 2.0
"""Times the pixels worked at, from which on decoding the video again costs more than writing and reading all
of its frames at the work size (4K: 66 ms of a core a frame against 9)."""
_GROUP_FRAMES = 12
_IDENTITY_ORIENTATION = ((1, 0), (0, 1))


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptFrames:
    """Frames of a camera in a video of their own.

    Attributes:
        path: The video.
        frames: (K,) their indices in the camera, increasing.
        width_px: Width at which they are kept, the camera's work size.
        height_px: Height.
        group: Frames from one that decodes alone to the next one.
    """

    path: Path
    frames: IntArray
    width_px: int
    height_px: int
    group: int

    def __post_init__(self) -> None:
        set_array(self, "frames", (len(self.frames),), np.int64)

    def holds(self, indices: IntArray) -> BoolArray:
        """Which frames of a camera are here."""
        return np.isin(indices, self.frames)

    def read(
        self, indices: IntArray, size: tuple[int, int], *, colour: bool, threads: int = 0
    ) -> Generator[Image, None, None]:
        """Grey (H,W) or RGB (H,W,3) images of kept frames, increasing, at (width, height).

        Raises:
            CaptureError: One cannot be decoded.
        """
        own = (self.width_px, self.height_px)
        for _, frame in decode_frames(self._video(), np.searchsorted(self.frames, indices), threads):
            yield work_image(frame, _IDENTITY_ORIENTATION, size, colour=colour, shown=own)

    def _video(self) -> VideoFile:
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
        index: In its camera.
        grey: (H,W) at the work size.
        planes: Makes its luma and chroma, and tells their range and matrix.
    """

    index: int
    grey: Image
    planes: Callable[[], tuple[Planes, Colours]]


def should_keep_all(stored_size: tuple[int, int], work_size: tuple[int, int]) -> bool:
    """True for videos so large that all of their frames are kept, very nearly as they are.

    Of others the keyframes are, without any loss where they have 8 bits and 4:2:0 chroma, else within a level
    of grey: these alone are read more than twice.
    """
    return stored_size[0] * stored_size[1] >= _LARGE_RATIO * work_size[0] * work_size[1]


@dataclass(slots=True)
class FrameKeeper:
    """Writes the frames of one camera that are kept; a context manager.

    Attributes:
        folder: An existing folder.
        width_px: Of the frames.
        height_px: Of the frames.
        everything: Whether all frames are kept, else those that were chosen.
    """

    folder: Path
    width_px: int
    height_px: int
    keep_all: bool
    _frames: list[int] = field(default_factory=list)
    _colours: Colours = (0, 0)
    _writer: VideoWriter | None = None

    def add_frame(self, shot: FrameCandidate) -> None:
        """A frame comes by."""
        if self.keep_all:
            self._add(shot)

    def add_keyframe(self, shot: FrameCandidate) -> None:
        """A frame becomes a keyframe."""
        if not self.keep_all:
            self._add(shot)

    def kept_frames(self) -> KeptFrames | None:
        """What was written, once the keeper is closed; None where that is nothing."""
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
        if colours == self._colours:  # a chapter of another kind is read where it is
            self._writer.add_planes(planes)
            self._frames.append(shot.index)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._writer is not None:
            self._writer.__exit__(kind, error, trace)
