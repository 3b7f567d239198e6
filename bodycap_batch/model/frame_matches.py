"""Match points between adjacent frames of a video, to measure how the camera rotates.

All pixel coordinates have COLMAP's origin.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import BoolArray, IntArray, set_array
from bodycap_batch.model.camera import CV2_PIXEL_OFFSET_PX
from bodycap_batch.model.optical_flow import (
    GreyImage,
    Pixels,
    TrackedPoints,
    detect_corners,
    pixel_scale,
    track_points,
)

_CORNERS = 120
"""Maximum number of corners that are tracked from one frame to the next. Evidence: none."""
_CORNER_SPACING_PX = 12.0
"""Minimum distance between two corners, in px of an image with a long side of 640 px. Evidence: none."""
_WINDOW_PX = 11
"""Width of the tracker's window, px of the reduced image. Evidence: none."""
_ENOUGH_TRACKS = 60
"""Minimum number of tracks in a pair of frames. With fewer tracks, SIFT features are matched too. Origin: if
the camera turns by more than 20 degrees from one frame to the next, few tracks are right."""
_FEATURES = 250
"""Maximum number of SIFT features in a reduced image. Evidence: none."""
_CONTRAST_THRESHOLD = 0.02
"""Contrast threshold of the SIFT detector. It is the same threshold as for the features of the map."""
_MAX_RATIO = 0.8
"""Maximum ratio of the angle between the descriptors of a match to the angle of the second nearest
descriptor. Origin: Lowe, IJCV 2004."""
_MIN_FEATURES = 8
"""Minimum number of SIFT features for a search of matches. Evidence: none."""

_Descriptors = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameMatches:
    """Matches between each frame of one camera and the next frame.

    Attributes:
        camera: Camera name.
        frame: (M,) index of the first frame of each match, not decreasing. The second frame has the next
            index.
        first_px: (M,2) float32 pixel in the first frame.
        second_px: (M,2) float32 pixel in the second frame.
    """

    camera: str
    frame: IntArray
    first_px: Pixels
    second_px: Pixels

    def __post_init__(self) -> None:
        set_array(self, "frame", (None,), np.int64)
        set_array(self, "first_px", (len(self.frame), 2), np.float32)
        set_array(self, "second_px", (len(self.frame), 2), np.float32)


@dataclass(slots=True)
class FrameMatcher:
    """Matches each frame of a video with the frame before it, in reduced images.

    Corners are tracked by optical flow. If the camera turns fast, few tracks are right. Then SIFT features of
    both frames are matched too.

    Attributes:
        camera: Camera name.
        width_px: Width of the full image.
        mask: (H,W) True for each pixel of the reduced image that shows the room; None: every pixel shows the
            room.
        enabled: False to match nothing.

    Source: Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004.
    """

    camera: str
    width_px: int
    mask: BoolArray | None = None
    enabled: bool = True
    _image: GreyImage | None = None
    _index: int = -1
    _features: tuple[Pixels, _Descriptors] | None = None
    _detector: Any = None
    _frame: list[IntArray] = field(default_factory=list)
    _first: list[Pixels] = field(default_factory=list)
    _second: list[Pixels] = field(default_factory=list)

    def add(self, index: int, image: GreyImage, tracked: tuple[Pixels, Pixels] | None = None) -> None:
        """Add the next frame, and match it with the frame before it.

        Args:
            index: Frame index. If it does not follow the index of the frame before, nothing is matched.
            image: (H,W) reduced image of the frame.
            tracked: Positions (N,2) in the frame before and in this frame, px of the reduced image, of
                points that were tracked anyway. If they are enough, no other points are tracked.
        """
        if not self.enabled:
            return
        before, features, adjacent = self._image, self._features, index == self._index + 1
        self._image, self._index, self._features = image, index, None
        if before is None or not adjacent:
            return
        first, second = tracked if tracked is not None else (np.zeros((0, 2), np.float32),) * 2
        if len(first) < _ENOUGH_TRACKS:
            first, second = self._track(before, image)
        if len(first) < _ENOUGH_TRACKS:
            earlier = self._detect(before) if features is None else features
            self._features = self._detect(image)
            rows = _mutual_matches(earlier[1], self._features[1])
            first = np.concatenate([first, earlier[0][rows[:, 0]]])
            second = np.concatenate([second, self._features[0][rows[:, 1]]])
        scale = np.float32(self.width_px / image.shape[1])
        self._frame.append(np.full(len(first), index - 1, np.int64))
        self._first.append(first * scale)
        self._second.append(second * scale)

    def matches(self) -> FrameMatches | None:
        """Return the matches of all frames that were added; None if the matcher is not enabled."""
        if not self.enabled:
            return None
        none = np.zeros((0, 2), np.float32)
        return FrameMatches(
            camera=self.camera,
            frame=np.concatenate([np.zeros(0, np.int64), *self._frame]),
            first_px=np.concatenate([none, *self._first]),
            second_px=np.concatenate([none, *self._second]),
        )

    def _track(self, before: GreyImage, image: GreyImage) -> tuple[Pixels, Pixels]:
        """Detect corners in the frame before, and track them into this frame."""
        spacing = _CORNER_SPACING_PX * pixel_scale(image.shape[1], image.shape[0])
        corners = detect_corners(before, _CORNERS, spacing, self.mask)
        flow: TrackedPoints = track_points(before, image, corners, window_px=_WINDOW_PX)
        return corners[flow.ok], flow.px[flow.ok]

    def _detect(self, image: GreyImage) -> tuple[Pixels, _Descriptors]:
        """Return the SIFT features (N,2) of a reduced image and their root-normalised descriptors (N,128)."""
        import cv2

        if self._detector is None:
            self._detector = cv2.SIFT.create(_FEATURES, contrastThreshold=_CONTRAST_THRESHOLD)
        mask = None if self.mask is None else self.mask.astype(np.uint8)
        found, raw = self._detector.detectAndCompute(image, mask)
        if not found:
            return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32)
        px = np.array([keypoint.pt for keypoint in found], np.float32) + np.float32(CV2_PIXEL_OFFSET_PX)
        return px, np.sqrt(raw / np.maximum(raw.sum(axis=1, keepdims=True), 1e-9))


def _mutual_matches(first: _Descriptors, second: _Descriptors) -> IntArray:
    """Return the mutual nearest descriptors (K,2) of two frames that pass the ratio test, as indices."""
    if min(len(first), len(second)) < _MIN_FEATURES:
        return np.zeros((0, 2), dtype=np.int64)
    products = first @ second.T
    row = np.arange(len(first))
    nearest = products.argmax(axis=1)
    best = products[row, nearest]
    mutual = products.argmax(axis=0)[nearest] == row
    products[row, nearest] = -1.0
    angle, second_angle = (np.arccos(np.clip(value, -1.0, 1.0)) for value in (best, products.max(axis=1)))
    kept = np.flatnonzero(mutual & (angle < _MAX_RATIO * second_angle))
    return np.column_stack([kept, nearest[kept]])
