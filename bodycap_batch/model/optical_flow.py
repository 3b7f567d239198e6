"""Track points between two frames, with a check forwards and backwards. Pixels have COLMAP's origin."""

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
"""Pixel thresholds are stated for images with this long side and scale with it."""

BLUR_SHARPNESS_RATIO = 0.6
"""A frame is blurred if its sharpness is below this fraction of the sharpness of the frames around it.
Evidence: none."""

_WINDOW_PX = 21
"""Pixels: side of the compared square. Evidence: none."""
_LEVELS = 4
"""Coarse pyramid levels without a guess."""
_GUIDED_LEVELS = 2
"""Coarse pyramid levels with a guess."""
_UNCHECKED_LEVELS = 0
"""Coarse pyramid levels with a guess and without the check: they would only add cost and wrong matches."""
_ITERATIONS = 20
"""Most iterations of Lucas–Kanade on a level. Evidence: none."""
_EPSILON_PX = 0.02
"""Pixels: an iteration that moves a point by less is the last one. Evidence: none."""
_MAX_ROUND_TRIP_PX = 1.0
"""Pixels: largest distance after tracking there and back. Evidence: none."""
_COARSE_WIDTH_PX = 320.0
"""Pixels: long side of the reduced images for the motion of the whole image. Evidence: none."""
_COARSE_WINDOW_PX = 15
"""Pixels of the reduced image: side of the compared square. Evidence: none."""
_COARSE_LEVELS = 3
"""Coarse pyramid levels of the reduced image."""
_COARSE_POINTS = 48
"""Most points that are followed for it. Evidence: none."""
_MIN_COARSE_POINTS = 12
"""Least points for a homography. Evidence: none."""
_COARSE_ERROR_PX = 2.5
"""Pixels of the reduced image: inlier limit of the homography. Evidence: none."""
_COARSE_MAX_TRIALS = 300
"""RANSAC iterations. Evidence: none."""
_MIN_INLIERS = 7
"""Least inliers of a homography. Origin: three more than the four points that determine it."""
_RELIABLE_RATIO = 0.5
"""Least ratio of inliers to points for a reliable motion. Origin: the majority."""
_PIECE_SIDE_RATIO = 0.35
"""Side of an image piece, as a fraction of the image's long side. Evidence: none."""
_PIECE_ROWS, _PIECE_COLUMNS = 2, 3
"""Rows and columns of image pieces. Evidence: none."""
_MAX_PIECES = 2
"""Best pieces whose shift is used as a guess. Evidence: none."""
_MIN_CONTRAST = 4.0
"""Least standard deviation of the grey values of a piece. Evidence: none."""


@dataclass(frozen=True, slots=True)
class TrackedPoints:
    """Tracked points.

    Attributes:
        px: (N,2) position in the second image, COLMAP origin.
        ok: (N,) True if the point was found inside the image and passed the check.
        round_trip_px: (N,) distance between a point and its image after tracking there and back.
    """

    px: Pixels
    ok: BoolArray
    round_trip_px: Pixels


def pixel_scale(width_px: int, height_px: int) -> float:
    """Return the factor on pixel thresholds for an image of this size."""
    return max(width_px, height_px) / REFERENCE_WIDTH_PX


def track_points(
    first: GreyImage,
    second: GreyImage,
    px: Pixels,
    guess_px: Pixels | None = None,
    *,
    with_check: bool = True,
    window_px: int = _WINDOW_PX,
) -> TrackedPoints:
    """Track points from one image to the next by pyramidal Lucas–Kanade, with a check backwards.

    Args:
        first: (H,W) uint8 image.
        second: (H,W) uint8 image.
        px: (N,2) float32 points in the first image.
        guess_px: (N,2) expected positions in the second image.
        with_check: Search far around the guess, track the points back too, and reject those that do not
            return. Otherwise only the surroundings of the guess are searched, at a quarter of the cost.
        window_px: Side of the compared square.

    Source: Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker", 2000; the check is Kalal,
        Mikolajczyk, Matas, "Forward-backward error", ICPR 2010.
    """
    if len(px) == 0:
        return TrackedPoints(np.zeros((0, 2), np.float32), np.zeros(0, bool), np.zeros(0, np.float32))
    start = np.ascontiguousarray(px - CV2_PIXEL_OFFSET_PX, dtype=np.float32)
    guess = None if guess_px is None else np.asarray(guess_px - CV2_PIXEL_OFFSET_PX, dtype=np.float32)
    levels = _LEVELS if guess is None else (_GUIDED_LEVELS if with_check else _UNCHECKED_LEVELS)
    tracked, is_found = _lucas_kanade(first, second, start, guess, (window_px, levels))
    height, width = second.shape
    is_found &= ((tracked >= 0) & (tracked <= (width - 1, height - 1))).all(axis=1)
    found_px = (tracked + CV2_PIXEL_OFFSET_PX).astype(np.float32)
    if not with_check:
        return TrackedPoints(found_px, is_found, np.zeros(len(px), np.float32))
    returned_px = np.full_like(tracked, np.inf)
    if is_found.any():
        # Tracking back starts with the opposite of the guess, so that it does not start at the answer.
        return_guess = None if guess is None else tracked[is_found] - (guess - start)[is_found]
        returned, refound = _lucas_kanade(second, first, tracked[is_found], return_guess, (window_px, levels))
        returned[~refound] = np.inf
        returned_px[is_found] = returned
    round_trip = np.linalg.norm(returned_px - start, axis=1).astype(np.float32)
    limit = _MAX_ROUND_TRIP_PX * pixel_scale(width, height)
    return TrackedPoints(found_px, is_found & (round_trip < limit), round_trip)


def _lucas_kanade(
    first: GreyImage, second: GreyImage, start: Pixels, guess: Pixels | None, size: tuple[int, int]
) -> tuple[Pixels, BoolArray]:
    """Call OpenCV's tracker, in OpenCV's pixels.

    Args:
        first: (H,W) image.
        second: (H,W) image.
        start: (N,2) points in the first image.
        guess: (N,2) expected positions in the second image, if there are any.
        size: Side of the compared square, and the number of coarse levels.

    Returns:
        Positions (N,2) in the second image, and which points (N,) were found.
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
    """Reduce an image to the size that `estimate_coarse_motion` works at."""
    import cv2

    scale = min(1.0, _COARSE_WIDTH_PX / max(grey.shape))
    return np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)


@dataclass(frozen=True, slots=True)
class ImageMotion:
    """The motion of the whole image.

    Attributes:
        homography: (3,3) second from first, in full-size pixels with COLMAP's origin.
        is_reliable: True if most points agree with it.
    """

    homography: FloatArray
    is_reliable: bool

    def inverse(self) -> ImageMotion:
        """Return the motion from the second image to the first."""
        return ImageMotion(np.asarray(np.linalg.inv(self.homography)), self.is_reliable)


def estimate_coarse_motion(
    first: GreyImage, second: GreyImage, px: Pixels, width_px: int
) -> ImageMotion | None:
    """Estimate the homography from one image to the next, as a start for tracking.

    Some points are followed from their own position. If few of them agree on a motion, they are followed
    again from the shift of image pieces that are found in the second image. The camera on a hand rotates by
    up to 35 degrees between two frames.

    Args:
        first: Reduced first image, from `make_coarse_image`.
        second: Reduced second image.
        px: (N,2) points of the first image at full size; some of them are followed.
        width_px: Width of the full-size images.

    Returns:
        The motion, or None if too few points agree.
    """
    scale = first.shape[1] / width_px
    chosen = px[np.linspace(0, len(px) - 1, min(len(px), _COARSE_POINTS)).astype(int)] if len(px) else px
    start = np.ascontiguousarray(chosen * scale - CV2_PIXEL_OFFSET_PX, dtype=np.float32)
    best, inliers = _fit_homography(first, second, start, None)
    if inliers < _RELIABLE_RATIO * len(start):
        for shift in _match_image_pieces(first, second):
            homography, count = _fit_homography(first, second, start, start + shift)
            if count > inliers:
                best, inliers = homography, count
    if best is None or inliers < _MIN_INLIERS:
        return None
    # From OpenCV's pixels of the reduced images to COLMAP's pixels of the full-size images.
    full_from_coarse = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, scale]])
    return ImageMotion(
        np.asarray(full_from_coarse @ best @ np.linalg.inv(full_from_coarse)),
        inliers >= _RELIABLE_RATIO * len(start),
    )


def _fit_homography(
    first: GreyImage, second: GreyImage, start: Pixels, guess: Pixels | None
) -> tuple[FloatArray | None, int]:
    """Follow points and return the homography with the most inliers, and their number."""
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
    """Find pieces of the first image in the second, and return the shifts (2,) of the best matches.

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
    """Detect corners (N,2), strongest first, at least `spacing_px` apart, where the mask is True.

    Source: Shi, Tomasi, "Good features to track", CVPR 1994.
    """
    import cv2

    allowed = None if mask is None else mask.astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(grey, count, 0.005, spacing_px, mask=allowed)
    if corners is None:
        return np.zeros((0, 2), np.float32)
    return np.asarray(corners.reshape(-1, 2) + CV2_PIXEL_OFFSET_PX, dtype=np.float32)


def sharpness(grey: GreyImage) -> float:
    """Return the standard deviation of the image's second derivative.

    It falls with blur and is comparable between neighbouring frames.

    Source: Pech-Pacheco et al., "Diatom autofocusing in brightfield microscopy", ICPR 2000.
    """
    import cv2

    small = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return float(cv2.meanStdDev(cv2.Laplacian(small, cv2.CV_16S, ksize=1))[1][0, 0])


def unit_directions(rays: FloatArray) -> FloatArray:
    """Return the unit directions (N,3) of rays (N,2) at depth 1."""
    full = np.column_stack([rays, np.ones(len(rays))])
    return np.asarray(full / np.linalg.norm(full, axis=1, keepdims=True))


def fit_rotation(first: FloatArray, second: FloatArray, iterations: int = 4) -> FloatArray:
    """Fit the rotation (3,3) from unit directions `first` (N,3) to `second` (N,3), robustly.

    Source: Kabsch, "A solution for the best rotation to relate two sets of vectors", 1976, reweighted with
        Cauchy weights at the median residual.
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
