"""Calibrate a camera from a clip of a board: select sharp and diverse views, and fit the intrinsics."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from bodycap_batch.calibration.boards import BoardCorners, CalibrationBoard, GreyImage
from bodycap_batch.calibration.intrinsics_fit import ImageSize, IntrinsicsFit, fit_intrinsics
from bodycap_batch.capture import CaptureCamera, open_camera
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import CaptureError, EstimationError

CameraModelChoice = Literal["auto", "pinhole", "opencv", "fisheye"]
_MODELS: dict[str, tuple[str, ...]] = {
    "auto": ("OPENCV", "OPENCV_FISHEYE"),
    "pinhole": ("PINHOLE",),
    "opencv": ("OPENCV",),
    "fisheye": ("OPENCV_FISHEYE",),
}
_MAX_PICTURES = 160
"""Number of pictures in which the board is searched. They take some seconds of computation. Evidence:
none."""
_PICTURES_PER_S = 5.0
"""Pictures per second of a shorter clip. Evidence: none."""
_MAX_VIEWS = 40
"""Number of views that are used for the fit. Evidence: none."""
MIN_VIEWS = 8
"""Least number of views with the board. Evidence: none."""
_MAX_FISHEYE_ERROR_RATIO = 0.9
"""The fisheye model is used if its error is less than this fraction of the other model's error. Evidence:
none."""
_COVERAGE_CELLS = (8, 6)
"""Columns and rows of the grid that measures coverage. Evidence: none."""
_MIN_COVERAGE = 0.5
"""Fraction of the cells; with fewer, the distortion is extrapolated in much of the picture. Evidence:
none."""
_MAX_FOCAL_SIGMA_RATIO = 0.005
"""Standard deviation of the focal length over the focal length. Evidence: none."""
_MAX_RMS_PX = 1.0
"""Reprojection error in pixels of a picture that is 640 pixels wide. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationResult:
    """Estimated intrinsics with their error.

    Attributes:
        board: The board in the clip.
        fit: The intrinsics.
        size: Width and height of the upright pictures.
        inspected: Number of pictures in which the board was searched.
        found: Number of pictures in which it was found.
        coverage: Fraction of the picture's cells (8x6) with a corner.
        notes: Reasons to doubt the result, with remedies.
        preview: Picture (H,W) of the view with most corners, for `write_preview`.
    """

    board: CalibrationBoard
    fit: IntrinsicsFit
    size: ImageSize
    inspected: int
    found: int
    coverage: float
    notes: tuple[str, ...]
    preview: GreyImage

    def lines(self) -> list[str]:
        """Return the result as text for the user."""
        fit, (width, height) = self.fit, self.size
        sigma = ", ".join(f"{value:.2f}" for value in fit.focal_sigma_px)
        worst = max(fit.view_rms_px)
        return [
            f"{self.board}: found in {self.found} of {self.inspected} pictures, {len(fit.kept)} views used",
            f"{fit.model} at {width}×{height}: focal length {fit.matrix[0, 0]:.2f}, "
            f"{fit.matrix[1, 1]:.2f} px (±{sigma})",
            f"reprojection error {fit.rms_px:.3f} px, worst view {worst:.3f} px; corners seen in "
            f"{100 * self.coverage:.0f} % of the picture",
            *(f"note: {note}" for note in self.notes),
        ]


def calibrate_clip(
    video: Path, board: CalibrationBoard, lens: CameraModelChoice, context: StageContext
) -> CalibrationResult:
    """Calibrate a camera from a clip of a board.

    Args:
        video: The clip, filmed with the settings of the captures (size, zoom, lens mode, stabilisation off).
        board: The board in the clip.
        lens: Camera model to fit; ``auto`` selects OPENCV unless OPENCV_FISHEYE fits better.
        context: Progress and cancellation.

    Returns:
        The intrinsics and their error.

    Raises:
        CaptureError: The video cannot be used, or the board was found in too few pictures.
        EstimationError: No camera model fits the views.
    """
    camera = open_camera(
        CaptureConfig(cameras=(CameraConfig(name="camera", video=(video,)),), work_px=8192),
        CameraConfig(name="camera", video=(video,)),
    )
    size = (camera.camera.width_px, camera.camera.height_px)
    found: list[tuple[int, BoardCorners]] = []
    inspected = 0
    blocks = _frame_blocks(camera)
    for frame, image in _sharpest_pictures(camera, blocks):
        context.check_cancelled()
        inspected += 1
        context.progress(inspected, len(blocks), "pictures")
        view = board.find(image)
        if view is not None:
            found.append((frame, view))
    if len(found) < MIN_VIEWS:
        raise _too_few_views(video, board, len(found), inspected)
    kept = select_diverse_views([view for _, view in found], size, _MAX_VIEWS)
    fit = _best_fit([found[index][1] for index in kept], size, lens, video)
    frames = [found[kept[index]][0] for index in fit.kept]
    views = [found[kept[index]][1] for index in fit.kept]
    shown = frames[int(np.argmax([len(view.px) for view in views]))]
    _, preview = next(iter(camera.read([shown])))
    coverage = corner_coverage([view.px for view in views], size)
    return CalibrationResult(
        board=board,
        fit=fit,
        size=size,
        inspected=inspected,
        found=len(found),
        coverage=coverage,
        notes=tuple(_notes(fit, size, coverage)),
        preview=preview,
    )


def _frame_blocks(camera: CaptureCamera) -> list[tuple[int, int]]:
    """Return blocks of frames as (first, one past the last); the sharpest picture of each is inspected."""
    count = len(camera.times_ns)
    seconds = (int(camera.times_ns[-1]) - int(camera.times_ns[0])) / 1e9 * count / max(count - 1, 1)
    looks = int(np.clip(round(seconds * _PICTURES_PER_S), 1, min(_MAX_PICTURES, count)))
    edges = np.linspace(0, count, looks + 1).round().astype(int).tolist()
    return list(itertools.pairwise(edges))


def _sharpest_pictures(
    camera: CaptureCamera, stretches: Sequence[tuple[int, int]]
) -> Iterator[tuple[int, GreyImage]]:
    """Yield the sharpest picture of each block, because a board in the hand is still for moments only."""
    ends = iter(stretches)
    end = next(ends)[1]
    best: tuple[float, int, GreyImage] | None = None
    for frame, image in camera.grey_frames():
        if frame >= end and best is not None:
            yield best[1], best[2]
            best, end = None, next(ends)[1]
        small = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        sharpness = float(cv2.Laplacian(small, cv2.CV_32F).var())
        if best is None or sharpness > best[0]:
            best = sharpness, frame, image
    if best is not None:
        yield best[1], best[2]


def _best_fit(
    views: Sequence[BoardCorners], size: ImageSize, lens: CameraModelChoice, video: Path
) -> IntrinsicsFit:
    """Return the best fit. OPENCV is preferred if the fisheye model is hardly better."""
    fits = [fit for model in _MODELS[lens] if (fit := fit_intrinsics(model, views, size)) is not None]
    if not fits:
        raise EstimationError(
            f"no lens fits the {len(views)} views of the board",
            path=video,
            hint="film the board tilted to all sides and in all corners of the picture, and keep it flat",
        )
    best = fits[0]
    for other in fits[1:]:
        if other.rms_px < _MAX_FISHEYE_ERROR_RATIO * best.rms_px:
            best = other
    return best


def select_diverse_views(views: Sequence[BoardCorners], size: ImageSize, count: int) -> list[int]:
    """Select diverse views: first the one with most corners, then always the one farthest from all selected.

    The distance compares the position, size and tilt of the board in the picture.

    Args:
        views: Views of the board.
        size: Width and height of the pictures.
        count: Number of views wanted.

    Returns:
        Increasing indices of the selected views.

    Source: T. Gonzalez, "Clustering to minimize the maximum intercluster distance", 1985.
    """
    described = np.array([_view_descriptor(view, size) for view in views])
    chosen = [int(np.argmax([len(view.px) for view in views]))]
    distance = np.linalg.norm(described - described[chosen[0]], axis=1)
    while len(chosen) < min(count, len(views)):
        farthest = int(np.argmax(distance))
        if distance[farthest] == 0.0:
            break
        chosen.append(farthest)
        distance = np.minimum(distance, np.linalg.norm(described - described[farthest], axis=1))
    return sorted(chosen)


def _view_descriptor(view: BoardCorners, size: ImageSize) -> FloatArray:
    """Return the centre, size and perspective of the board in the picture, each scaled to about 0 to 1."""
    homography, _ = cv2.findHomography(view.board_m[:, :2], view.px / max(size))
    centre = view.px.mean(axis=0) / max(size)
    scale = np.log(np.sqrt(np.linalg.det(np.cov((view.px / max(size)).T))) + 1e-6)
    tilt = np.zeros(2) if homography is None else homography[2, :2] / homography[2, 2]
    extent = np.ptp(view.board_m[:, :2], axis=0).max()
    return np.concatenate([centre, [0.3 * scale], np.clip(2.0 * extent * tilt, -1, 1)])


def corner_coverage(pixels: Sequence[FloatArray], size: ImageSize) -> float:
    """Return the fraction of the picture's cells that hold a corner."""
    cells = np.zeros(_COVERAGE_CELLS, dtype=bool)
    for px in pixels:
        cell = np.floor((px + 0.5) / np.array(size) * np.array(_COVERAGE_CELLS)).astype(int)
        column, row = np.clip(cell, 0, np.array(_COVERAGE_CELLS) - 1).T
        cells[column, row] = True
    return float(cells.mean())


def _notes(fit: IntrinsicsFit, size: ImageSize, coverage: float) -> list[str]:
    notes = []
    if coverage < _MIN_COVERAGE:
        notes.append(
            f"corners were found in {100 * coverage:.0f} % of the picture: the lens is a guess elsewhere; "
            "film the board in all corners of the picture, too"
        )
    sigma = max(fit.focal_sigma_px) / fit.matrix[0, 0]
    if sigma > _MAX_FOCAL_SIGMA_RATIO:
        notes.append(
            f"the focal length has an uncertainty of {100 * sigma:.1f} %: tilt the board more, to all sides, "
            "and film it from a shorter distance"
        )
    if fit.rms_px > _MAX_RMS_PX * max(size) / 640.0:
        notes.append(
            f"an error of {fit.rms_px:.1f} px is large: is the board flat, its size correct, the focus fixed "
            "and stabilisation off?"
        )
    return notes


def _too_few_views(video: Path, board: CalibrationBoard, found: int, inspected: int) -> CaptureError:
    size = "count squares, not corners"
    if board.kind == "chessboard":
        size = "count inner corners, not squares; the whole board must be in the picture, with a white border"
    return CaptureError(
        f"the {board} was found in {found} of {inspected} inspected pictures; {MIN_VIEWS} are needed",
        path=video,
        hint=f"check the board's size ({size}) and kind, light it evenly, let it fill a third of the "
        "picture, and hold it still for a moment in each of twenty positions",
    )
