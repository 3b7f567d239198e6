"""Follow points from frame to frame, with new points wherever a cell of the picture has none."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import BoolArray, IntArray
from bodycap_batch.model.camera import CV2_PIXEL_OFFSET_PX
from bodycap_batch.model.optical_flow import (
    REFERENCE_WIDTH_PX,
    GreyImage,
    Pixels,
    apply_homography,
    estimate_coarse_motion,
    make_coarse_image,
)
from bodycap_batch.model.point_tracks import PointTracks

_CELLS = 300
"""Number of cells of the picture. Each cell holds one point at least, if it has texture. Evidence:
none."""
_WINDOW_PX = 11
"""Side length of the window around a point, px of the tracked image. Evidence: none."""
_LEVELS = 3
"""Number of pyramid levels above the tracked image. The smallest level has a width of 80 px, so that a point
can move by about 50 px from frame to frame."""
_MAX_ROUND_TRIP_PX = 0.7
"""Maximum distance, px of the tracked image, between a point and its position after tracking forward and
back. Evidence: none."""
_MIN_SURVIVAL = 0.5
"""Share of the tracks of the last frame below which the motion of the whole picture is searched, and the
tracks start from it. Origin: a hand turns by up to 35 degrees between two frames."""
_NOISE_FACTOR = 4.0
"""Minimum eigenvalue of a corner, as a multiple of the eigenvalue at the noisy, plain parts of the picture.
Evidence: none."""
_PLAIN_PERCENTILE = 10.0
"""Percentile of the eigenvalues of a picture that stands for its plain parts."""
_MIN_EIGENVALUE = 1e-5
"""Minimum eigenvalue of a corner in a picture without noise, (grey level / 255 px)². Evidence: none."""
_MIN_DISTANCE_PX = 4.0
"""Two tracks that come nearer than this, px of the tracked image, are one point: the shorter track ends."""
_BORDER_PX = 4
"""Distance from the border, px of the tracked image, at which a track ends: half of the window."""
_DETECTION_PERIOD = 3
"""Number of frames between two searches for new points. After a loss of many tracks, it is searched at once.
A search takes as long as the tracking of 150 points."""


@dataclass(slots=True, kw_only=True)
class PointTracker:
    """Follows points from frame to frame.

    Attributes:
        camera: Camera name.
        width_px: Width of the frames, pixels.
        height_px: Height of the frames, pixels.
        mask: (H,W) True for each pixel of a frame that shows the room; None: every pixel shows the room.
        image: (h,w) tracked image of the newest frame: the frame with a long side of 640 px at most.
        px: (K,2) positions of the tracks in the newest frame, px of the tracked image (OpenCV's pixels).
        track: (K,) numbers of these tracks, increasing.

    Source: Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker", 2000; Shi, Tomasi, "Good
        features to track", CVPR 1994; Kalal, Mikolajczyk, Matas, "Forward-backward error", ICPR 2010.
    """

    camera: str
    width_px: int
    height_px: int
    mask: BoolArray | None = None
    image: GreyImage | None = None
    px: Pixels = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    track: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    _next: int = 0
    _since_detection: int = 0
    _frames: dict[int, tuple[IntArray, Pixels]] = field(default_factory=dict)
    _allowed: npt.NDArray[np.uint8] | None = None

    def add(self, index: int, grey: GreyImage) -> None:
        """Follow the points into the next frame, and add points where there are none.

        Args:
            index: Frame index, larger than that of the frame before.
            grey: (H,W) grey frame.
        """
        image = self._reduced(grey)
        before, self.image = self.image, image
        started = len(self.px)
        if before is not None and started:
            self._follow(before, image)
        self._since_detection += 1
        if (
            self._since_detection >= _DETECTION_PERIOD
            or len(self.px) < _MIN_SURVIVAL * started
            or not started
        ):
            self._detect(image)
        self._frames[index] = self.track, self._frame_px()

    def _frame_px(self) -> Pixels:
        """Return the positions (K,2) of the tracks in the newest frame, px of the frame (COLMAP's origin)."""
        return (self.px + np.float32(CV2_PIXEL_OFFSET_PX)) * np.float32(self._scale())

    def tracks(self, frame_count: int) -> PointTracks:
        """Return the tracks of all frames.

        Args:
            frame_count: Number of frames of the video. Frames that were not added have no observations.
        """
        empty = np.zeros(0, np.int64), np.zeros((0, 2), np.float32)
        found = [self._frames.get(index, empty) for index in range(frame_count)]
        return PointTracks(
            camera=self.camera,
            width_px=self.width_px,
            height_px=self.height_px,
            first=np.concatenate([[0], np.cumsum([len(track) for track, _ in found])]),
            track=np.concatenate([empty[0], *(track for track, _ in found)]),
            px=np.concatenate([empty[1], *(px for _, px in found)]),
        )

    def _scale(self) -> float:
        """Return the ratio of the width of a frame to that of the tracked image."""
        return 1.0 if self.image is None else self.width_px / self.image.shape[1]

    def _reduced(self, grey: GreyImage) -> GreyImage:
        import cv2

        scale = REFERENCE_WIDTH_PX / max(grey.shape)
        if scale >= 1.0:
            return grey
        return np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)

    def _follow(self, before: GreyImage, image: GreyImage) -> None:
        """Move the tracks into the newest image; tracks that are not found end."""
        found, ok = self._track(before, image, None)
        if ok.sum() < _MIN_SURVIVAL * len(ok):
            motion = estimate_coarse_motion(
                make_coarse_image(before),
                make_coarse_image(image),
                self.px + np.float32(CV2_PIXEL_OFFSET_PX),
                image.shape[1],
            )
            if motion is not None:
                guess = apply_homography(self.px + np.float32(CV2_PIXEL_OFFSET_PX), motion.homography)
                again = self._track(before, image, guess - np.float32(CV2_PIXEL_OFFSET_PX))
                if again[1].sum() > ok.sum():
                    found, ok = again
        self.px, self.track = found[ok], self.track[ok]
        distinct = _distinct(self.px)
        self.px, self.track = self.px[distinct], self.track[distinct]

    def _track(self, before: GreyImage, image: GreyImage, guess: Pixels | None) -> tuple[Pixels, BoolArray]:
        """Return the positions (K,2) in the newest image, and whether they are found (K,)."""
        import cv2

        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.03)
        window, start = (_WINDOW_PX, _WINDOW_PX), np.ascontiguousarray(self.px, np.float32)
        flags = 0 if guess is None else cv2.OPTFLOW_USE_INITIAL_FLOW
        guess = None if guess is None else np.ascontiguousarray(guess, np.float32)
        found, state, _ = cv2.calcOpticalFlowPyrLK(
            before, image, start, guess, None, None, window, _LEVELS, criteria, flags
        )
        back = None if guess is None else found - (guess - start)
        flags = 0 if back is None else cv2.OPTFLOW_USE_INITIAL_FLOW
        returned, returned_state, _ = cv2.calcOpticalFlowPyrLK(
            image, before, found, back, None, None, window, _LEVELS, criteria, flags
        )
        error = np.linalg.norm(returned - start, axis=1).astype(np.float32)
        height, width = image.shape
        last = np.array([width - 1 - _BORDER_PX, height - 1 - _BORDER_PX])
        ok = (state.ravel() > 0) & (returned_state.ravel() > 0) & (error < _MAX_ROUND_TRIP_PX)
        ok &= (found >= _BORDER_PX).all(axis=1) & (found <= last).all(axis=1)
        return found, np.asarray(ok)

    def _detect(self, image: GreyImage) -> None:
        """Add the best corner of each cell that has no track."""
        import cv2

        self._since_detection = 0
        strength = cv2.cornerMinEigenVal(image, 5, ksize=3)
        limit = max(
            _MIN_EIGENVALUE, _NOISE_FACTOR * float(np.percentile(strength[::4, ::4], _PLAIN_PERCENTILE))
        )
        border = np.ones(image.shape, np.uint8)
        border[_BORDER_PX:-_BORDER_PX, _BORDER_PX:-_BORDER_PX] = 0
        strength[border > 0] = 0.0
        if self.mask is not None:
            if self._allowed is None:
                size = (image.shape[1], image.shape[0])
                self._allowed = cv2.resize(self.mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
            strength *= self._allowed
        side = max(_WINDOW_PX, round(float(np.sqrt(image.size / _CELLS))))
        rows, columns = -(-image.shape[0] // side), -(-image.shape[1] // side)
        padded = np.zeros((rows * side, columns * side), np.float32)
        padded[: image.shape[0], : image.shape[1]] = strength
        cells = padded.reshape(rows, side, columns, side).swapaxes(1, 2).reshape(rows * columns, side * side)
        best = cells.argmax(axis=1)
        is_free = np.ones(rows * columns, dtype=bool)
        own = (self.px // side).astype(np.int64)
        is_free[own[:, 1] * columns + own[:, 0]] = False
        chosen = np.flatnonzero(is_free & (cells[np.arange(len(cells)), best] > limit))
        row, column = np.divmod(best[chosen], side)
        new = np.column_stack([(chosen % columns) * side + column, (chosen // columns) * side + row])
        self.px = np.concatenate([self.px, new.astype(np.float32)])
        self.track = np.concatenate([self.track, np.arange(self._next, self._next + len(new))])
        self._next += len(new)


def _distinct(px: Pixels) -> BoolArray:
    """Return a mask (K,) of the points that are not near an earlier point: of two, the older track stays."""
    places = (px // _MIN_DISTANCE_PX).astype(np.int64)
    _, first = np.unique(places[:, 1] * 2**20 + places[:, 0], return_index=True)
    out = np.zeros(len(px), dtype=bool)
    out[first] = True
    return out
