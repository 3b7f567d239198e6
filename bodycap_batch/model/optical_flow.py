"""Track points from one frame to another and check the result by tracking back.

All pixel coordinates have COLMAP's origin, unless a docstring says that they are in OpenCV's pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.model.camera import CV2_PIXEL_OFFSET_PX
from bodycap_batch.model.geometry import nearest_rotation

GreyImage = npt.NDArray[np.uint8]
Pixels = npt.NDArray[np.float32]

REFERENCE_WIDTH_PX = 640.0
"""Long side, pixels, of the images that the pixel thresholds refer to. For other images, the thresholds are
scaled with the long side."""

BLUR_SHARPNESS_RATIO = 0.6
"""Minimum sharpness of a frame, divided by the sharpness of the neighbouring frames. A frame below this
minimum is treated as blurred. Evidence: none."""

_WINDOW_PX = 21
"""Side length, pixels, of the square window around a tracked point. The tracker compares the content of this
window in both images. Evidence: none."""
_LEVELS = 4
"""Number of pyramid levels above the full image if no expected positions are given. Evidence: none."""
_GUIDED_LEVELS = 2
"""Number of pyramid levels above the full image if expected positions are given. Evidence: none."""
_UNCHECKED_LEVELS = 0
"""Number of pyramid levels above the full image if expected positions are given and tracks are not checked by
tracking back. More levels would only increase the cost and the number of wrong matches."""
_ITERATIONS = 20
"""Maximum number of Lucas–Kanade iterations on each pyramid level. Evidence: none."""
_EPSILON_PX = 0.02
"""Minimum movement, pixels, of a point from one iteration to the next. The iterations end after a smaller
movement. Evidence: none."""
_MAX_DISTORTION_PX = 0.25
"""Pixels: maximum distance between a corner of a tracker's window and its position if the window only moved
with its centre. If the expected motion distorts windows further, the first image is warped by this motion
before tracking. Evidence: docs/decisions/registration.md."""
_MAX_ROUND_TRIP_PX = 1.0
"""Maximum distance, pixels, between a point and its position after tracking forwards and back. Evidence:
none."""
_COARSE_WIDTH_PX = 320.0
"""Long side, pixels, of the reduced images in which the motion of the whole image is estimated. Evidence:
none."""
_COARSE_WINDOW_PX = 15
"""Side length of the square window around a tracked point, in pixels of the reduced image. Evidence: none."""
_COARSE_LEVELS = 3
"""Number of pyramid levels above the reduced image if no expected positions are given. Evidence: none."""
_COARSE_POINTS = 48
"""Maximum number of points that are tracked for the motion of the whole image. Evidence: none."""
_MIN_COARSE_POINTS = 12
"""Minimum number of tracked points for estimating a homography. Evidence: none."""
_COARSE_ERROR_PX = 2.5
"""Maximum error, pixels of the reduced image, of an inlier of the homography. Evidence: none."""
_COARSE_MAX_TRIALS = 300
"""Maximum number of RANSAC iterations. Evidence: none."""
_MIN_INLIERS = 7
"""Minimum number of inliers of a homography. Origin: three more than the four points that determine a
homography."""
_RELIABLE_RATIO = 0.5
"""An estimated motion is reliable if at least this fraction of the points are inliers: half of them."""
_PIECE_SIDE_RATIO = 0.35
"""Ratio of the side of an image piece to the long side of the image. Evidence: none."""
_PIECE_ROWS, _PIECE_COLUMNS = 2, 3
"""Numbers of rows and columns of image pieces. Evidence: none."""
_MAX_PIECES = 2
"""Maximum number of image pieces whose shifts are tried as expected shift of the tracked points. The pieces
with the best matches are used. Evidence: none."""
_MIN_CONTRAST = 4.0
"""Minimum standard deviation, grey levels, of an image piece. A piece with less contrast is not searched.
Evidence: none."""


@dataclass(frozen=True, slots=True)
class TrackedPoints:
    """The result of tracking points from a first to a second image.

    Attributes:
        px: (N,2) positions in the second image, with COLMAP's origin.
        ok: (N,) True if the point was found inside the image and passed the check.
        round_trip_px: (N,) distance, pixels, in the first image between each point and its position after
            tracking forwards and back; 0 without the check.
    """

    px: Pixels
    ok: BoolArray
    round_trip_px: Pixels


def pixel_scale(width_px: int, height_px: int) -> float:
    """Return the factor that scales pixel thresholds to an image of this size."""
    return max(width_px, height_px) / REFERENCE_WIDTH_PX


def track_points(
    first: GreyImage,
    second: GreyImage,
    px: Pixels,
    motion: ImageMotion | None = None,
    *,
    with_check: bool = True,
    window_px: int = _WINDOW_PX,
) -> TrackedPoints:
    """Track points from one image to another by pyramidal Lucas–Kanade.

    The tracker moves windows, but does not turn or scale them. So the first image is warped by the expected
    motion if this motion is reliable and turns or scales windows.

    Args:
        first: (H,W) uint8 image in which the points are given.
        second: (H,W) uint8 image in which the points are searched.
        px: (N,2) float32 points in the first image.
        motion: Expected motion of the whole image from the first to the second image; None if it is unknown.
        with_check: True to check each point: the point is also tracked back to the first image, and rejected
            if it does not return to its start. False to skip this check. If `motion` is given and the
            check is skipped, only the surroundings of the expected position are searched. This reduces the
            cost to a quarter.
        window_px: Side length, pixels, of the square window around a point. The tracker compares the content
            of this window in both images.

    Source: Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker", 2000; the check is Kalal,
        Mikolajczyk, Matas, "Forward-backward error", ICPR 2010.
    """
    if len(px) == 0:
        return TrackedPoints(np.zeros((0, 2), np.float32), np.zeros(0, bool), np.zeros(0, np.float32))
    start = np.ascontiguousarray(px - CV2_PIXEL_OFFSET_PX, dtype=np.float32)
    guess: Pixels | None = None
    if motion is not None:
        guess = np.asarray(apply_homography(px, motion.homography) - CV2_PIXEL_OFFSET_PX, dtype=np.float32)
        distortion_px = _window_distortion_px(px, motion.homography, window_px)
        if motion.is_reliable and distortion_px > _MAX_DISTORTION_PX:
            first, start = _warp_image(first, motion.homography, second.shape), guess
    levels = _LEVELS if guess is None else (_GUIDED_LEVELS if with_check else _UNCHECKED_LEVELS)
    tracked, is_found = _lucas_kanade(first, second, start, guess, (window_px, levels))
    height, width = second.shape
    is_found &= ((tracked >= 0) & (tracked <= (width - 1, height - 1))).all(axis=1)
    found_px = (tracked + CV2_PIXEL_OFFSET_PX).astype(np.float32)
    if not with_check:
        return TrackedPoints(found_px, is_found, np.zeros(len(px), np.float32))
    returned_px = np.full_like(tracked, np.inf)
    if is_found.any():
        # Tracking back starts at the found position minus the expected shift. If it started at the original
        # point, the check would always succeed.
        return_guess = None if guess is None else tracked[is_found] - (guess - start)[is_found]
        returned, refound = _lucas_kanade(second, first, tracked[is_found], return_guess, (window_px, levels))
        returned[~refound] = np.inf
        returned_px[is_found] = returned
    round_trip = np.linalg.norm(returned_px - start, axis=1).astype(np.float32)
    limit = _MAX_ROUND_TRIP_PX * pixel_scale(width, height)
    return TrackedPoints(found_px, is_found & (round_trip < limit), round_trip)


def _window_distortion_px(px: Pixels, homography: FloatArray, window_px: int) -> float:
    """Return how far (pixels, median of all points) a homography distorts the windows around points (N,2).

    This is the largest distance between the corners of a window that is transformed and those of a window
    that only moves with its centre.
    """
    half = 0.5 * window_px
    corners = np.array([[-half, -half], [half, -half], [-half, half], [half, half]])
    moved = apply_homography((px[:, None] + corners).reshape(-1, 2), homography).reshape(-1, 4, 2)
    only_shifted = apply_homography(px, homography)[:, None] + corners
    return float(np.median(np.linalg.norm(moved - only_shifted, axis=2).max(axis=1)))


def _warp_image(image: GreyImage, homography: FloatArray, shape: tuple[int, ...]) -> GreyImage:
    """Return the image (H,W) of a given shape, transformed by a homography of pixels with COLMAP's origin."""
    import cv2

    colmap_from_cv2 = _colmap_from_cv2(1.0)
    in_cv2 = np.linalg.inv(colmap_from_cv2) @ homography @ colmap_from_cv2
    return np.asarray(
        cv2.warpPerspective(image, in_cv2, (shape[1], shape[0]), borderMode=cv2.BORDER_REPLICATE), np.uint8
    )


def _colmap_from_cv2(scale: float) -> FloatArray:
    """Return the matrix (3,3) from OpenCV's pixels of a reduced image to COLMAP's pixels of the full image.

    Args:
        scale: Width of the reduced image divided by the width of the full image; 1 for the full image.
    """
    offset = CV2_PIXEL_OFFSET_PX
    return np.array([[1.0, 0.0, offset], [0.0, 1.0, offset], [0.0, 0.0, scale]])


def _lucas_kanade(
    first: GreyImage, second: GreyImage, start: Pixels, guess: Pixels | None, size: tuple[int, int]
) -> tuple[Pixels, BoolArray]:
    """Call OpenCV's tracker. All positions are in OpenCV's pixels.

    Args:
        first: (H,W) image in which the points are given.
        second: (H,W) image in which the points are searched.
        start: (N,2) points in the first image.
        guess: (N,2) expected positions in the second image; None if they are unknown.
        size: Side length, pixels, of the square window around a point, and number of pyramid levels above the
            full image.

    Returns:
        Positions (N,2) in the second image, and a mask (N,) that is True for the points that were found.
    """
    import cv2

    window, levels = size
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, _ITERATIONS, _EPSILON_PX)
    flags = 0 if guess is None else cv2.OPTFLOW_USE_INITIAL_FLOW
    guess = None if guess is None else guess.copy()
    tracked, found, _ = cv2.calcOpticalFlowPyrLK(
        first, second, start, guess, None, None, (window, window), levels, criteria, flags
    )
    return tracked, np.asarray(found).ravel().astype(bool)


def make_coarse_image(grey: GreyImage) -> GreyImage:
    """Reduce an image to the size that `estimate_coarse_motion` needs."""
    import cv2

    scale = min(1.0, _COARSE_WIDTH_PX / max(grey.shape))
    return np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)


@dataclass(frozen=True, slots=True)
class ImageMotion:
    """The motion of the whole image from a first to a second image.

    Attributes:
        homography: (3,3) homography from the first to the second image, in pixels of the full-size images
            with COLMAP's origin.
        is_reliable: True if at least half of the tracked points are inliers of the homography.
    """

    homography: FloatArray
    is_reliable: bool

    def inverse(self) -> ImageMotion:
        """Return the motion from the second image to the first."""
        return ImageMotion(np.asarray(np.linalg.inv(self.homography)), self.is_reliable)


def estimate_coarse_motion(
    first: GreyImage, second: GreyImage, px: Pixels, width_px: int, expected: FloatArray | None = None
) -> ImageMotion | None:
    """Estimate the homography from one image to another, as the initial motion for tracking.

    A subset of the points is tracked, starting at their positions in the first image. If too few points agree
    on a motion, large pieces of the first image are searched in the second image. The points are then tracked
    again from positions that are moved by the shifts of these pieces. This is necessary because a camera on a
    hand can rotate by up to 35 degrees between two frames.

    Args:
        first: Reduced first image, from `make_coarse_image`.
        second: Reduced second image, from `make_coarse_image`.
        px: (N,2) points in the first image, in pixels of the full-size image.
        width_px: Width of the full-size images, pixels.
        expected: (3,3) expected homography, in pixels of the full-size images with COLMAP's origin, from
            which the search starts; None if it is unknown.

    Returns:
        The motion, or None if too few points agree on a motion.
    """
    scale = first.shape[1] / width_px
    chosen = px[np.linspace(0, len(px) - 1, min(len(px), _COARSE_POINTS)).astype(int)] if len(px) else px
    start = np.ascontiguousarray(chosen * scale - CV2_PIXEL_OFFSET_PX, dtype=np.float32)
    best, inliers = None, 0
    full_from_coarse = _colmap_from_cv2(scale)
    if expected is not None and len(start):
        arrived = apply_homography(start, np.linalg.inv(full_from_coarse) @ expected @ full_from_coarse)
        best, inliers = _fit_homography(first, second, start, arrived)
    if inliers < _RELIABLE_RATIO * len(start):
        homography, count = _fit_homography(first, second, start, None)
        if count > inliers:
            best, inliers = homography, count
    if inliers < _RELIABLE_RATIO * len(start):
        for shift in _match_image_pieces(first, second):
            homography, count = _fit_homography(first, second, start, start + shift)
            if count > inliers:
                best, inliers = homography, count
    if best is None or inliers < _MIN_INLIERS:
        return None
    return ImageMotion(
        np.asarray(full_from_coarse @ best @ np.linalg.inv(full_from_coarse)),
        inliers >= _RELIABLE_RATIO * len(start),
    )


def _fit_homography(
    first: GreyImage, second: GreyImage, start: Pixels, guess: Pixels | None
) -> tuple[FloatArray | None, int]:
    """Track points and fit a homography to their motion by RANSAC.

    Args:
        first: Reduced first image.
        second: Reduced second image.
        start: (N,2) points in the first image, in OpenCV's pixels.
        guess: (N,2) expected positions in the second image; None if they are unknown.

    Returns:
        The homography (3,3), or None if there is none, and its number of inliers.
    """
    import cv2

    if len(start) < _MIN_COARSE_POINTS:
        return None, 0
    levels = _COARSE_LEVELS if guess is None else _GUIDED_LEVELS
    tracked, found = _lucas_kanade(first, second, start, guess, (_COARSE_WINDOW_PX, levels))
    found &= ((tracked >= 0) & (tracked <= (second.shape[1] - 1, second.shape[0] - 1))).all(axis=1)
    if found.sum() < _MIN_COARSE_POINTS:
        return None, 0
    homography, is_inlier = cv2.findHomography(
        start[found], tracked[found], cv2.RANSAC, _COARSE_ERROR_PX, maxIters=_COARSE_MAX_TRIALS
    )
    return (None, 0) if homography is None else (homography, int(is_inlier.sum()))


def _match_image_pieces(first: GreyImage, second: GreyImage) -> list[Pixels]:
    """Search pieces of the first image in the second image.

    Returns:
        For each of the pieces with the best matches, the shift (2,) of the piece from the first image to the
        second image, in pixels of these images. The best match comes first.

    Source: Lewis, "Fast normalized cross-correlation", 1995.
    """
    import cv2

    reduced = [
        cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for image in (first, second)
    ]
    height, width = reduced[0].shape
    side = round(_PIECE_SIDE_RATIO * max(height, width))
    matches: list[tuple[float, Pixels]] = []
    for top in np.linspace(0, height - side, _PIECE_ROWS).astype(int):
        for left in np.linspace(0, width - side, _PIECE_COLUMNS).astype(int):
            piece = reduced[0][top : top + side, left : left + side]
            if piece.std() < _MIN_CONTRAST:
                continue
            scores = cv2.matchTemplate(reduced[1], piece, cv2.TM_CCOEFF_NORMED)
            _, score, _, (column, row) = cv2.minMaxLoc(scores)
            matches.append((score, np.array([column - left, row - top], np.float32) * np.float32(2.0)))
    matches.sort(key=lambda item: -item[0])
    return [shift for _, shift in matches[:_MAX_PIECES]]


def apply_homography(px: Pixels, homography: FloatArray) -> Pixels:
    """Transform points (N,2) by a homography (3,3)."""
    homogeneous = px @ homography[:, :2].T + homography[:, 2]
    return np.asarray(homogeneous[:, :2] / homogeneous[:, 2:], dtype=np.float32)


def detect_corners(grey: GreyImage, count: int, spacing_px: float, mask: BoolArray | None = None) -> Pixels:
    """Detect corners in an image.

    Args:
        grey: (H,W) uint8 image.
        count: Maximum number of corners.
        spacing_px: Minimum distance between two corners, pixels.
        mask: (H,W) True where corners are allowed; None if they are allowed everywhere.

    Returns:
        The corners (N,2), the strongest first, with COLMAP's origin.

    Source: Shi, Tomasi, "Good features to track", CVPR 1994.
    """
    import cv2

    allowed = None if mask is None else mask.astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(grey, count, 0.005, spacing_px, mask=allowed)
    if corners is None:
        return np.zeros((0, 2), np.float32)
    return np.asarray(corners.reshape(-1, 2) + CV2_PIXEL_OFFSET_PX, dtype=np.float32)


def unit_directions(rays: FloatArray) -> FloatArray:
    """Return the unit directions (N,3) of rays (N,2) at depth 1."""
    full = np.column_stack([rays, np.ones(len(rays))])
    return np.asarray(full / np.linalg.norm(full, axis=1, keepdims=True))


def fit_rotation(first: FloatArray, second: FloatArray, iterations: int = 4) -> FloatArray:
    """Fit a rotation to corresponding unit directions, robustly.

    Args:
        first: (N,3) unit directions before the rotation.
        second: (N,3) unit directions after the rotation.
        iterations: Number of times that the weights are computed again.

    Returns:
        The rotation (3,3) from `first` to `second`.

    Source: Kabsch, "A solution for the best rotation to relate two sets of vectors", 1976. For robustness,
        Cauchy weights are used. Their scale is the median residual.
    """
    weight = np.ones(len(first))
    rotation = np.eye(3)
    for _ in range(iterations):
        rotation = nearest_rotation((second * weight[:, None]).T @ first)
        residual = second - first @ rotation.T
        squared = np.einsum("ni,ni->n", residual, residual)
        median = np.partition(squared, len(squared) // 2)[len(squared) // 2]
        weight = 1.0 / (1.0 + squared / (median + 1e-18))
    return np.asarray(rotation)
