"""The cameras of a capture: frames with common times, decoded at the work size.

The work size is the image size that all stages work at.
"""

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
from bodycap_batch.model.camera_clock import ClockRelation
from bodycap_batch.model.copied_frames import Pictures
from bodycap_batch.model.rotation_chain import RotationChain

if TYPE_CHECKING:
    from av.video.frame import VideoFrame

logger = logging.getLogger(__name__)

_MIN_KEPT_RATIO = 0.75
"""The stored copies are read only if at least this fraction of the requested frames has a stored copy.
Otherwise, all requested frames are decoded from the video, because the frames without a copy already require
the decoding of nearly the whole video. Unit: 1. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptureCamera:
    """One camera of a capture: its frames, their times and the intrinsics, with methods to decode the frames.

    The chapters are the successive video files of one recording. The joined video contains all chapters.

    Attributes:
        name: Name of the camera in every result.
        chapters: Paths of the chapters, in the order of the recording.
        camera: Intrinsics at the work size, with COLMAP's pixel origin.
        calibrated: False if the intrinsics are an initial guess that mapping refines.
        frame_numbers: (N,) numbers of the frames in use, counted from 0 in the joined video.
        times_ns: (N,) time of each frame in use on the clock of the camera, nanoseconds, increasing.
        nominal_fps: Frame rate given by the container, frames per second.
        rolling_shutter_s: Readout time: seconds from the exposure of the first row to the exposure of the
            last row.
        rolling_shutter_known: False if the readout time is not given in the job. Mapping then estimates the
            readout time.
        may_be_sideways: True if the rows of the sensor may be the columns of the image. If the readout time
            is known, `camera.sideways` is already correct. Otherwise mapping determines the direction.
        clock: Relation of the camera's clock to the common clock. Until the clocks are known, the common time
            is the time of the camera.
        notes: Notes for the user about gaps and overlaps between chapters.
        videos: Video file of each chapter, with the list of its frames.
        mask: (H,W) mask at the work size, True where the room is visible; None if the room is visible
            everywhere.
        moving_regions: (N,R,C) mask of cells that divide the picture of each frame evenly, True where
            something moves by itself, for example a hand; None if nothing does.
        damaged: (D,) indices into `frame_numbers` of frames that are damaged in the video. They are not read.
            Empty if the video was not yet searched for damage.
        kept: Stored copies of frames at the work size. They are read instead of the video. None if there are
            no copies.
        threads: Number of threads of the decoder. For 0, the number is taken from the environment variable
            OMP_NUM_THREADS. If this variable is not set, all processors are used.
        lens_sigma: Relative standard deviation of the focal length, if `camera` was estimated from the tracks
            of the video. The lens is constant until the last adjustment of the map. 0 for another lens.
        rotation_chain: How the camera turns, by the tracks of its video; None if it is unknown.
        given: Intrinsics that were given, if the map contradicted them and `camera` replaces them; else None.
    """

    name: str
    chapters: tuple[Path, ...]
    camera: Camera
    calibrated: bool
    frame_numbers: IntArray
    times_ns: IntArray
    nominal_fps: float
    rolling_shutter_s: float
    rolling_shutter_known: bool = True
    may_be_sideways: bool = False
    clock: ClockRelation = field(default_factory=ClockRelation)
    notes: tuple[str, ...] = ()
    videos: tuple[VideoFile, ...] = field(default=(), repr=False)
    mask: BoolArray | None = field(default=None, repr=False)
    moving_regions: BoolArray | None = field(default=None, repr=False)
    damaged: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64), repr=False)
    kept: KeptFrames | None = field(default=None, repr=False)
    threads: int = 0
    given: Camera | None = None
    lens_sigma: float = 0.0
    rotation_chain: RotationChain | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        count = len(self.frame_numbers)
        set_array(self, "frame_numbers", (count,), np.int64)
        set_array(self, "times_ns", (count,), np.int64)
        set_array(self, "damaged", (None,), np.int64)
        if count and ((np.diff(self.frame_numbers) <= 0).any() or (np.diff(self.times_ns) <= 0).any()):
            raise ValueError("frame numbers and times must increase")

    def common_times_ns(self) -> IntArray:
        """Return the frame times (N,) on the common clock, nanoseconds."""
        return self.clock.common_ns(self.times_ns)

    def only(self, pictures: Pictures | None) -> CaptureCamera:
        """Return the camera without the frames that are copies of the frame before; unchanged for None."""
        if pictures is None:
            return self
        return replace(
            self,
            frame_numbers=self.frame_numbers[pictures.frames],
            times_ns=pictures.times_ns,
            nominal_fps=1e9 / float(np.median(np.diff(pictures.times_ns))),
        )

    @property
    def shows_only_room(self) -> bool:
        """True if no part of any picture is left out."""
        return self.mask is None and self.moving_regions is None

    def is_unmasked(self, px: npt.NDArray[Any], frame: int | None = None) -> BoolArray:
        """Return a mask (K,) of the pixels at which the room is visible.

        Args:
            px: (K,2) pixels at the work size, with COLMAP's origin.
            frame: Index of the frame, to leave out what moves by itself in it. None: only the mask counts.
        """
        out = np.ones(len(px), dtype=bool)
        size = self.camera.width_px, self.camera.height_px
        if self.mask is not None:
            out &= _at(self.mask, px, size)
        if self.moving_regions is not None and frame is not None:
            out &= ~_at(self.moving_regions[frame], px, size)
        return out

    def key_indices(self) -> IntArray:
        """Return the indices into `frame_numbers` of the codec's key frames.

        The decoder can start at a key frame, because a key frame does not depend on earlier frames.
        """
        numbers: list[IntArray] = []
        first = 0
        for video in self.videos:
            numbers.append(first + np.searchsorted(video.pts, video.key_pts))
            first += len(video.pts)
        keys = np.isin(self.frame_numbers, np.concatenate(numbers)) if numbers else np.zeros(0, dtype=bool)
        return np.asarray(np.flatnonzero(keys), dtype=np.int64)

    def grey_frames(self, start: int = 0, stop: int | None = None) -> Iterator[tuple[int, Image]]:
        """Decode successive frames as grey images at the work size. A thread decodes the next frames ahead.

        Args:
            start: First index into `frame_numbers`.
            stop: Index after the last index; None for the end of the video.

        Yields:
            The index into `frame_numbers`, and the image (H,W) uint8. Damaged frames are omitted.

        Raises:
            CaptureError: A frame that is not listed as damaged cannot be decoded.
        """
        indices = np.arange(*slice(start, stop).indices(len(self.frame_numbers)), dtype=np.int64)
        return self.read(np.setdiff1d(indices, self.damaged))

    def read_decodable(self, indices: IntArray) -> Generator[tuple[int, Image], None, None]:
        """Decode selected frames as grey images at the work size. Frames that cannot be decoded are omitted.

        Args:
            indices: (K,) increasing indices into `frame_numbers`.

        Yields:
            The index into `frame_numbers`, and the image (H,W) uint8.
        """
        size = (self.camera.width_px, self.camera.height_px)
        for index, frame, video in self._frames(indices, skip_lost=True):
            yield index, work_image(frame, video.orientation, size, colour=False)

    def read(
        self, indices: Sequence[int] | IntArray, *, colour: bool = False
    ) -> Generator[tuple[int, Image], None, None]:
        """Decode selected frames at the work size. A thread decodes the next frames ahead.

        Args:
            indices: (K,) increasing indices into `frame_numbers`.
            colour: True for RGB images, False for grey images.

        Yields:
            The index into `frame_numbers`, and the image: (H,W,3) for RGB or (H,W) for grey, uint8.

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
        """Decode all frames.

        Each result has the grey image at the work size, and a function that returns the planes from which a
        copy of the frame can be stored.

        Damaged frames are omitted. A thread decodes the next frames ahead.

        Raises:
            CaptureError: A video cannot be read.
        """
        return prefetch(self._frame_candidates(), self.threads)

    @property
    def should_keep_all(self) -> bool:
        """True if the videos are so large that storing copies of all frames saves time."""
        size = (self.camera.width_px, self.camera.height_px)
        return any(should_keep_all(video.stored_size, size) for video in self.videos)

    def _frame_candidates(self) -> Generator[FrameCandidate, None, None]:
        size = (self.camera.width_px, self.camera.height_px)
        keep_all = self.should_keep_all
        for index, frame, video in self._frames(
            np.arange(len(self.frame_numbers), dtype=np.int64), skip_lost=True
        ):
            if frame.is_corrupt:
                continue
            if keep_all:
                # Only the planes at the work size are held in memory. They are far smaller than the frame.
                planes = work_planes(frame, video.orientation, size)
                yield FrameCandidate(index, grey_from_planes(planes, size), partial(_identity, planes))
            else:
                grey = work_image(frame, video.orientation, size, colour=False)
                yield FrameCandidate(index, grey, partial(work_planes, frame, video.orientation, size))

    def _decode(self, indices: IntArray, *, colour: bool) -> Generator[tuple[int, Image], None, None]:
        """Yield the index and the image of each frame, from the stored copy or from the video."""
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
                except CaptureError as error:  # the frame can still be decoded from the video
                    logger.warning(
                        "%s: the stored copy of the frames cannot be read, so the video is decoded again: %s",
                        self.name,
                        error,
                    )
                    yield from replace(self, kept=None)._decode(indices[position:], colour=colour)
                    return
                yield index, image
            else:
                _, frame, video = next(others)
                yield index, work_image(frame, video.orientation, size, colour=colour)

    def _frames(
        self, indices: IntArray, *, skip_lost: bool = False
    ) -> Generator[tuple[int, VideoFrame, VideoFile], None, None]:
        """Decode the requested frames from the videos.

        Args:
            indices: (K,) increasing indices into `frame_numbers`.
            skip_lost: Whether frames that cannot be decoded are omitted, instead of raising an error.

        Yields:
            The index into `frame_numbers`, the decoded frame, and the video file of its chapter.
        """
        first = 0
        for video in self.videos:
            numbers = self.frame_numbers[indices] - first
            inside = (numbers >= 0) & (numbers < len(video.pts))
            own = dict(zip(numbers[inside].tolist(), indices[inside].tolist(), strict=True))
            for number, frame in decode_frames(video, numbers[inside], self.threads, skip_lost=skip_lost):
                yield own[number], frame, video
            first += len(video.pts)


@dataclass(frozen=True, slots=True, kw_only=True)
class Capture:
    """The cameras of one recording. All cameras are related to one common clock."""

    cameras: tuple[CaptureCamera, ...]

    def camera(self, name: str) -> CaptureCamera:
        """Return the camera with this name.

        Raises:
            KeyError: There is no camera with this name.
        """
        return {camera.name: camera for camera in self.cameras}[name]


def _identity(planes: tuple[Planes, Colours]) -> tuple[Planes, Colours]:
    """Return the planes unchanged.

    This function is used for `FrameCandidate.planes` if the planes have already been computed.
    """
    return planes


def _at(cells: BoolArray, px: npt.NDArray[Any], size: tuple[int, int]) -> BoolArray:
    """Return the values (K,) at pixels (K,2) of a mask (R,C) that divides a picture of some size evenly."""
    rows, columns = cells.shape
    column = np.clip((px[:, 0] * columns / size[0]).astype(int), 0, columns - 1)
    row = np.clip((px[:, 1] * rows / size[1]).astype(int), 0, rows - 1)
    return np.asarray(cells[row, column])
