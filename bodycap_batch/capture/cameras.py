"""Cameras of a capture: their frames on the clock, decoded at the work size."""

from __future__ import annotations

import logging
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from bodycap_batch.capture.decoding import decode_frames
from bodycap_batch.capture.images import Colours, Image, Planes, grey_from_planes, work_image, work_planes
from bodycap_batch.capture.kept import FrameCandidate, KeptFrames, should_keep_all
from bodycap_batch.capture.prefetch import prefetch
from bodycap_batch.capture.video import VideoFile
from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, set_array
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.model.camera import Camera

if TYPE_CHECKING:
    from av.video.frame import VideoFrame

logger = logging.getLogger(__name__)

_MIN_KEPT_RATIO = 0.75
"""Share of the frames asked for that must be kept: with many others between them the video is decoded from
end to end anyway."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptureCamera:
    """One camera of a capture.

    Attributes:
        name: Names the camera in every result.
        chapters: Its video files in order.
        camera: Intrinsics at the work size, COLMAP's pixel origin.
        calibrated: False where the intrinsics are a guess that mapping refines.
        frame_numbers: (N,) numbers of the used frames in the joined video, from 0.
        times_ns: (N,) their times on the camera's own clock, increasing.
        nominal_fps: Frame rate the container states.
        offset_s: Common time = camera time + offset_s.
        rolling_shutter_s: Time from the first row's exposure to the last's.
        rolling_shutter_known: False where the job does not state it: mapping looks for it in the data.
        turned: True where the sensor's rows may run along the picture's columns: `camera.sideways` says
            whether they do where the rolling shutter is known, else the data tell.
        notes: What opening found worth telling: gaps and overlaps of chapters, dropped frames.
        videos: Frame index of each chapter.
        mask: (H,W) at the work size, True where the room is seen; None where that is everywhere.
        kept: Frames that are read from a copy at the work size instead.
    """

    name: str
    chapters: tuple[Path, ...]
    camera: Camera
    calibrated: bool
    frame_numbers: IntArray
    times_ns: IntArray
    nominal_fps: float
    offset_s: float
    rolling_shutter_s: float
    rolling_shutter_known: bool = True
    may_be_sideways: bool = False
    notes: tuple[str, ...] = ()
    videos: tuple[VideoFile, ...] = field(default=(), repr=False)
    mask: BoolArray | None = field(default=None, repr=False)
    kept: KeptFrames | None = field(default=None, repr=False)
    threads: int = 0

    def __post_init__(self) -> None:
        count = len(self.frame_numbers)
        set_array(self, "frame_numbers", (count,), np.int64)
        set_array(self, "times_ns", (count,), np.int64)
        if count and ((np.diff(self.frame_numbers) <= 0).any() or (np.diff(self.times_ns) <= 0).any()):
            raise ValueError("frame numbers and times must increase")

    def common_times_ns(self) -> IntArray:
        """(N,) frame times on the common clock."""
        return np.asarray(self.times_ns + round(self.offset_s * 1e9), dtype=np.int64)

    def is_unmasked(self, px: npt.NDArray[Any]) -> BoolArray:
        """Which pixels (N,2), COLMAP origin, lie where the mask lets the room be seen."""
        if self.mask is None:
            return np.ones(len(px), dtype=bool)
        column = np.clip(px[:, 0].astype(int), 0, self.mask.shape[1] - 1)
        row = np.clip(px[:, 1].astype(int), 0, self.mask.shape[0] - 1)
        return np.asarray(self.mask[row, column])

    def key_indices(self) -> IntArray:
        """Indices into `frame_numbers` of frames that decode without their neighbours."""
        numbers: list[IntArray] = []
        first = 0
        for video in self.videos:
            numbers.append(first + np.searchsorted(video.pts, video.key_pts))
            first += len(video.pts)
        keys = np.isin(self.frame_numbers, np.concatenate(numbers)) if numbers else np.zeros(0, dtype=bool)
        return np.asarray(np.flatnonzero(keys), dtype=np.int64)

    def row_times_ns(self, index: int, rows_px: npt.ArrayLike) -> IntArray:
        """Common times at which pixel rows (M,) of one frame were exposed (rolling shutter).

        Columns, where the sensor's rows run along them.
        """
        extent_px = self.camera.width_px if self.camera.sideways else self.camera.height_px
        delay_ns = rolling_shutter_delay_s(rows_px, extent_px, self.rolling_shutter_s) * 1e9
        return np.asarray(self.common_times_ns()[index] + np.round(delay_ns), dtype=np.int64)

    def grey_frames(self, start: int = 0, stop: int | None = None) -> Iterator[tuple[int, Image]]:
        """Stream grey frames (H,W) uint8 at the work size, decoded ahead in a thread.

        Args:
            start: First index into `frame_numbers`.
            stop: One past the last; default all.

        Yields:
            The index and the image.

        Raises:
            CaptureError: A frame cannot be decoded.
        """
        indices = range(*slice(start, stop).indices(len(self.frame_numbers)))
        return self.read(np.array(indices, dtype=np.int64))

    def read(
        self, indices: Sequence[int] | IntArray, *, colour: bool = False
    ) -> Generator[tuple[int, Image], None, None]:
        """Decode chosen frames, grey (H,W) or RGB (H,W,3) uint8 at the work size.

        Args:
            indices: Increasing indices into `frame_numbers`.
            colour: RGB instead of grey.

        Raises:
            CaptureError: A frame cannot be decoded.
            ValueError: The indices do not increase or lie outside.
        """
        wanted = np.asarray(indices, dtype=np.int64)
        if len(wanted) and (
            wanted[0] < 0 or wanted[-1] >= len(self.frame_numbers) or (np.diff(wanted) <= 0).any()
        ):
            raise ValueError("indices must increase and lie inside the video")
        return prefetch(self._decode(wanted, colour=colour), self.threads)

    def frame_candidates(self) -> Generator[FrameCandidate, None, None]:
        """Stream all frames as they may be kept, decoded ahead in a thread.

        Raises:
            CaptureError: A frame cannot be decoded.
        """
        return prefetch(self._shots(), self.threads)

    @property
    def should_keep_all(self) -> bool:
        """True where the videos are so large that all of their frames are worth keeping at the work size."""
        size = (self.camera.width_px, self.camera.height_px)
        return any(should_keep_all(video.stored_size, size) for video in self.videos)

    def _shots(self) -> Generator[FrameCandidate, None, None]:
        size = (self.camera.width_px, self.camera.height_px)
        everything = self.should_keep_all
        indices = np.arange(len(self.frame_numbers), dtype=np.int64)
        for index, frame, video in self._frames(indices):
            if everything:
                # A large frame is let go of at once.
                planes = work_planes(frame, video.orientation, size)
                yield FrameCandidate(index, grey_from_planes(planes, size), partial(_same, planes))
            else:
                grey = work_image(frame, video.orientation, size, colour=False)
                yield FrameCandidate(index, grey, partial(work_planes, frame, video.orientation, size))

    def _decode(self, indices: IntArray, *, colour: bool) -> Generator[tuple[int, Image], None, None]:
        size = (self.camera.width_px, self.camera.height_px)
        held = np.zeros(len(indices), dtype=bool) if self.kept is None else self.kept.holds(indices)
        copies: Iterator[Image] = iter(())
        if self.kept is not None and held.sum() >= _MIN_KEPT_RATIO * len(held):
            copies = self.kept.read(indices[held], size, colour=colour, threads=self.threads)
        else:
            held[:] = False
        others = self._frames(indices[~held])
        for position, (index, is_held) in enumerate(zip(indices.tolist(), held.tolist(), strict=True)):
            if is_held:
                try:
                    image = next(copies)
                except CaptureError as error:  # the video has all there is
                    logger.warning("%s: read from the video, since its kept copy fails: %s", self.name, error)
                    yield from replace(self, kept=None)._decode(indices[position:], colour=colour)
                    return
                yield index, image
            else:
                _, frame, video = next(others)
                yield index, work_image(frame, video.orientation, size, colour=colour)

    def _frames(self, indices: IntArray) -> Generator[tuple[int, VideoFrame, VideoFile], None, None]:
        first = 0
        for video in self.videos:
            numbers = self.frame_numbers[indices] - first
            inside = (numbers >= 0) & (numbers < len(video.pts))
            mine = indices[inside]
            for index, (_, frame) in zip(
                mine, decode_frames(video, numbers[inside], self.threads), strict=True
            ):
                yield int(index), frame, video
            first += len(video.pts)


@dataclass(frozen=True, slots=True, kw_only=True)
class Capture:
    """The cameras of one recording, on one common clock."""

    cameras: tuple[CaptureCamera, ...]

    def camera(self, name: str) -> CaptureCamera:
        """Find a camera by name (KeyError if there is none)."""
        for camera in self.cameras:
            if camera.name == name:
                return camera
        raise KeyError(name)


def _same(planes: tuple[Planes, Colours]) -> tuple[Planes, Colours]:
    return planes


def rolling_shutter_delay_s(rows_px: npt.ArrayLike, height_px: int, rolling_shutter_s: float) -> FloatArray:
    """Exposure of pixel rows relative to the frame's time: (row/height − ½) · rolling_shutter_s."""
    rows = np.asarray(rows_px, dtype=np.float64)
    return np.asarray((rows / height_px - 0.5) * rolling_shutter_s)
