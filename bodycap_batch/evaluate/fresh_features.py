"""Detect and match features that neither the tracks nor the map use, to measure poses independently.

The features are ORB. The map uses SIFT, and the tracks follow corners by optical flow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.camera import CV2_PIXEL_OFFSET_PX, Camera
from bodycap_batch.model.optical_flow import unit_directions
from bodycap_batch.model.rolling_shutter import row_delay

_LONG_SIDE_PX = 800
"""Maximum long side (px) of the image in which features are detected. Origin: above it, detection takes
longer than decoding, and 0.1 degree of rotation is still more than a pixel of a usual lens."""
_CANDIDATES = 6000
"""Number of ORB corners before the selection per cell."""
_CORNER_CONTRAST = 7
"""Minimum contrast of a corner, grey levels. Origin: a third of OpenCV's default, for plain walls; the limit
for each cell keeps strong texture from taking all features."""
CELLS = (12, 9)
"""Number of columns and rows of the grid in which features are selected, and in which support is counted."""
_FEATURES_PER_CELL = 16
"""Maximum number of features in one cell."""
_MAX_RATIO = 0.85
"""Maximum ratio of the Hamming distance of a match to that of the second nearest descriptor."""
_MAX_AXIS_ANGLE_DEG = 80.0
"""Maximum angle (degrees) between the optical axis and a viewing ray. Beyond it few lens models hold."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameFeatures:
    """The features of one frame.

    Attributes:
        rays: (N,3) unit viewing rays in the camera frame.
        cells: (N,) index of the grid cell of each feature.
        descriptors: (N,32) uint8 ORB descriptors; for points of tracks, the (N,) numbers of the tracks.
        pixel_rad: (N,) angle (radians) that corresponds to one px of the detection image at each feature's
            pyramid level.
        row: (N,) time at which each feature's row is exposed, relative to the middle row, in units of the
            readout time: −0.5 to 0.5.
    """

    rays: FloatArray
    cells: IntArray
    descriptors: npt.NDArray[np.integer]
    pixel_rad: FloatArray
    row: FloatArray


def detect_features(
    image: npt.NDArray[np.uint8], camera: Camera, shows_room: Callable[[FloatArray], BoolArray]
) -> FrameFeatures:
    """Detect ORB features that are spread over the room in a grey image.

    Args:
        image: (H,W) image of the size of `camera`.
        camera: Intrinsics.
        shows_room: Returns which pixels (N,2) show the room (N,).
    """
    import cv2

    height, width = image.shape
    factor = min(1.0, _LONG_SIDE_PX / max(width, height))
    if factor < 1.0:
        size = (round(width * factor), round(height * factor))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    orb = cv2.ORB.create(_CANDIDATES, fastThreshold=_CORNER_CONTRAST)
    corners = orb.detect(image, None)
    px = np.array([corner.pt for corner in corners], dtype=np.float64).reshape(-1, 2)
    inside = shows_room((px + CV2_PIXEL_OFFSET_PX) / factor)
    corners, px = [corners[index] for index in np.flatnonzero(inside).tolist()], px[inside]
    cells = cells_of(px, (image.shape[1], image.shape[0]))
    response = np.array([corner.response for corner in corners])
    kept = [corners[index] for index in _best_per_cell(cells, response, _FEATURES_PER_CELL)]
    described, descriptors = orb.compute(image, kept)
    px = np.array([corner.pt for corner in described]).reshape(-1, 2)
    level = np.array([corner.octave for corner in described], dtype=np.int64)
    return features_at(
        camera,
        (px + CV2_PIXEL_OFFSET_PX) / factor,
        np.zeros((0, 32), np.uint8) if descriptors is None else descriptors,
        1.2**level / (factor * camera.focal_px),
    )


def features_at(
    camera: Camera, px: FloatArray, descriptors: npt.NDArray[np.integer], pixel_rad: FloatArray
) -> FrameFeatures:
    """Return the features of a frame at pixels (N,2). Those far from the optical axis are left out."""
    rays = unit_directions(camera.unproject(px))
    near = rays[:, 2] > np.cos(np.deg2rad(_MAX_AXIS_ANGLE_DEG))
    usable = np.isfinite(rays).all(axis=1) & near
    return FrameFeatures(
        rays=rays[usable],
        cells=cells_of(px[usable], (camera.width_px, camera.height_px)),
        descriptors=descriptors[usable],
        pixel_rad=pixel_rad[usable],
        row=row_delay(camera, px[usable]),
    )


def cells_of(px: FloatArray, size: tuple[int, int]) -> IntArray:
    """Return the index (N,) of the grid cell of each pixel (N,2) in a picture of a size (width, height)."""
    column = np.clip((px[:, 0] * CELLS[0] / size[0]).astype(np.int64), 0, CELLS[0] - 1)
    row = np.clip((px[:, 1] * CELLS[1] / size[1]).astype(np.int64), 0, CELLS[1] - 1)
    return np.asarray(row * CELLS[0] + column)


def _best_per_cell(cells: IntArray, score: FloatArray, count: int) -> IntArray:
    """Return the indices of the `count` elements of each cell that have the highest score."""
    order = np.lexsort((-score, cells))
    first_of_cell = np.searchsorted(cells[order], cells[order])
    return np.asarray(order[np.arange(len(order)) - first_of_cell < count], dtype=np.int64)


def match_features(first: FrameFeatures, second: FrameFeatures) -> IntArray:
    """Return the mutual nearest descriptors (M,2) of two frames that pass the ratio test, as indices."""
    import cv2

    if min(len(first.rays), len(second.rays)) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    forward = matcher.knnMatch(first.descriptors, second.descriptors, k=2)
    pairs = np.array(
        [(a.queryIdx, a.trainIdx) for a, b in forward if a.distance < _MAX_RATIO * b.distance], dtype=np.int64
    ).reshape(-1, 2)
    backward = matcher.match(second.descriptors, first.descriptors)
    nearest = np.array([match.trainIdx for match in backward], dtype=np.int64)
    return np.asarray(pairs[nearest[pairs[:, 1]] == pairs[:, 0]])
