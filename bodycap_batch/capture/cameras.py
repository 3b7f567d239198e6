"""The cameras of a capture: frames with common times, decoded at the work size."""

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
from bodycap_batch.core.arrays import BoolArray, IntArray, set_array
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.model.camera import Camera

if TYPE_CHECKING:
    from av.video.frame import VideoFrame

logger = logging.getLogger(__name__)

_MIN_KEPT_RATIO = 0.75
"""Least ratio of requested frames with a stored copy for these copies to be read. With many other frames in
between, the video is decoded from end to end in any case. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptureCamera:
    """One camera of a capture.

    Attributes:
        name: Name of the camera in every result.
        chapters: Its video files in order.
        camera: Camera model at the work size, COLMAP's pixel origin.
        calibrated: False if the intrinsics are a guess that mapping refines.
        frame_numbers: (N,) numbers of the used frames in the joined video, from 0.
        times_ns: (N,) their times on the camera's own clock, increasing.
        nominal_fps: Frame rate stated by the container.
        offset_s: Common time = camera time + offset_s.
        rolling_shutter_s: Readout time, from the exposure of the first row to that of the last.
        rolling_shutter_known: False if the job does not state it: mapping then estimates it.
        may_be_sideways: True if the sensor's rows may run along the image columns. If the readout time is
            known, `camera.sideways` says whether they do; otherwise mapping finds out.
        notes: Findings for the user: gaps and overlaps of chapters, dropped frames.
        videos: Frame index of each chapter.
        mask: (H,W) at the work size, True where the room is visible; None if it is visible everywhere.
        kept: Frames that are read from a copy at the work size instead of the video.
        threads: Threads of the decoder. 0: those of the environment's OMP_NUM_THREADS, or all processors.
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
        """Return the frame times (N,) on the common clock."""
        return np.asarray(self.times_ns + round(self.offset_s * 1e9), dtype=np.int64)

    def is_unmasked(self, px: npt.NDArray[Any]) -> BoolArray:
        """Return which pixels (N,2), COLMAP origin, the mask leaves visible."""
        if self.mask is None:
            return np.ones(len(px), dtype=bool)
        column = np.clip(px[:, 0].astype(int), 0, self.mask.shape[1] - 1)
        row = np.clip(px[:, 1].astype(int), 0, self.mask.shape[0] - 1)
        return np.asarray(self.mask[row, column])

    def key_indices(self) -> IntArray:
        """Return the indices into `frame_numbers` of frames that decode without their neighbours."""
        numbers: list[IntArray] = []
        first = 0
        for video in self.videos:
            numbers.append(first + np.searchsorted(video.pts, video.key_pts))
            first += len(video.pts)
        keys = np.isin(self.frame_numbers, np.concatenate(numbers)) if numbers else np.zeros(0, dtype=bool)
        return np.asarray(np.flatnonzero(keys), dtype=np.int64)

    def grey_frames(self, start: int = 0, stop: int | None = None) -> Iterator[tuple[int, Image]]:
        """Yield grey frames (H,W) uint8 at the work size, decoded ahead in a thread.

        Args:
            start: First index into `frame_numbers`.
            stop: One past the last index; all frames by default.

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
        """Decode some frames, grey (H,W) or RGB (H,W,3) uint8, at the work size.

        Args:
            indices: Increasing indices into `frame_numbers`.
            colour: RGB instead of grey.

        Yields:
            The index and the image.

        Raises:
            CaptureError: A frame cannot be decoded.
            ValueError: The indices do not increase or are outside the video.
        """
        chosen = np.asarray(indices, dtype=np.int64)
        if len(chosen) and (
            chosen[0] < 0 or chosen[-1] >= len(self.frame_numbers) or (np.diff(chosen) <= 0).any()
        ):
            raise ValueError("indices must increase and lie inside the video")
        return prefetch(self._decode(chosen, colour=colour), self.threads)

    def frame_candidates(self) -> Generator[FrameCandidate, None, None]:
        """Yield all frames in a form in which they can be kept, decoded ahead in a thread.

        Raises:
            CaptureError: A frame cannot be decoded.
        """
        return prefetch(self._frame_candidates(), self.threads)

    @property
    def should_keep_all(self) -> bool:
        """True if the videos are so large that keeping all frames at the work size saves time."""
        size = (self.camera.width_px, self.camera.height_px)
        return any(should_keep_all(video.stored_size, size) for video in self.videos)

    def _frame_candidates(self) -> Generator[FrameCandidate, None, None]:
        size = (self.camera.width_px, self.camera.height_px)
        keep_all = self.should_keep_all
        indices = np.arange(len(self.frame_numbers), dtype=np.int64)
        for index, frame, video in self._frames(indices):
            if keep_all:
                # Only the reduced planes are held: they are far smaller than the frame.
                planes = work_planes(frame, video.orientation, size)
                yield FrameCandidate(index, grey_from_planes(planes, size), partial(_identity, planes))
            else:
                grey = work_image(frame, video.orientation, size, colour=False)
                yield FrameCandidate(index, grey, partial(work_planes, frame, video.orientation, size))

    def _decode(self, indices: IntArray, *, colour: bool) -> Generator[tuple[int, Image], None, None]:
        """Yield frames from their kept copy or from the video."""
        size = (self.camera.width_px, self.camera.height_px)
        is_kept = np.zeros(len(indices), dtype=bool) if self.kept is None else self.kept.holds(indices)
        kept_images: Iterator[Image] = iter(())
        if self.kept is not None and is_kept.sum() >= _MIN_KEPT_RATIO * len(is_kept):
            kept_images = self.kept.read(indices[is_kept], size, colour=colour, threads=self.threads)
        else:
            is_kept[:] = False
        others = self._frames(indices[~is_kept])
        for position, (index, from_copy) in enumerate(zip(indices.tolist(), is_kept.tolist(), strict=True)):
            if from_copy:
                try:
                    image = next(kept_images)
                except CaptureError as error:  # the video still has the frame
                    logger.warning("%s: read from the video, since its kept copy fails: %s", self.name, error)
                    yield from replace(self, kept=None)._decode(indices[position:], colour=colour)
                    return
                yield index, image
            else:
                _, frame, video = next(others)
                yield index, work_image(frame, video.orientation, size, colour=colour)

    def _frames(self, indices: IntArray) -> Generator[tuple[int, VideoFrame, VideoFile], None, None]:
        """Yield the index, the decoded frame and the video of each requested frame."""
        first = 0
        for video in self.videos:
            numbers = self.frame_numbers[indices] - first
            inside = (numbers >= 0) & (numbers < len(video.pts))
            own = indices[inside]
            for index, (_, frame) in zip(
                own, decode_frames(video, numbers[inside], self.threads), strict=True
            ):
                yield int(index), frame, video
            first += len(video.pts)


@dataclass(frozen=True, slots=True, kw_only=True)
class Capture:
    """The cameras of one recording, on one common clock."""

    cameras: tuple[CaptureCamera, ...]

    def camera(self, name: str) -> CaptureCamera:
        """Return the camera with a name; raise KeyError if there is none."""
        for camera in self.cameras:
            if camera.name == name:
                return camera
        raise KeyError(name)


def _identity(planes: tuple[Planes, Colours]) -> tuple[Planes, Colours]:
    """Return the planes: the counterpart of `work_planes` for planes that exist already."""
    return planes
