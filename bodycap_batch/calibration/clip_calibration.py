"""Calibrate a camera from a clip of a board: select sharp and diverse views, and fit the intrinsics."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from bodycap_batch.calibration.board_detection import BoardCorners, CalibrationBoard, GreyImage
from bodycap_batch.calibration.board_search import boards_in, open_clip
from bodycap_batch.calibration.intrinsics_fit import ImageSize, IntrinsicsFit, fit_intrinsics
from bodycap_batch.capture import CaptureCamera
from bodycap_batch.capture.lens_choice import VideoMode, video_mode
from bodycap_batch.config.calibration import NOTED_RMS_RATIO, max_rms_px
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import BodycapError, CaptureError, EstimationError
from bodycap_batch.model.sharpness import sharpness

CameraModelChoice = Literal["auto", "pinhole", "opencv", "fisheye"]
_MODELS: dict[str, tuple[str, ...]] = {
    "auto": ("OPENCV", "OPENCV_FISHEYE"),
    "pinhole": ("PINHOLE",),
    "opencv": ("OPENCV",),
    "fisheye": ("OPENCV_FISHEYE",),
}
_MAX_PICTURES = 160
"""Maximum number of pictures in which the board is searched. The search in this number of pictures takes some
seconds. Evidence: none."""
_PICTURES_PER_S = 5.0
"""Number of pictures that are searched for the board in each second of a clip. In a long clip, fewer pictures
are searched, because their total is limited to `_MAX_PICTURES`. Evidence: none."""
_MAX_VIEWS = 40
"""Maximum number of views in the fit. Evidence: none."""
MIN_VIEWS = 8
"""Minimum number of pictures in which the board must be found. Evidence: none."""
_MAX_FISHEYE_ERROR_RATIO = 0.9
"""Maximum ratio of the fisheye model's error to the error of the model OPENCV. With a larger ratio, the model
OPENCV is selected. Evidence: none."""
_COVERAGE_CELLS = (8, 6)
"""Number of columns and number of rows of the grid that measures coverage. Evidence: none."""
_MIN_COVERAGE = 0.5
"""Minimum fraction of the grid cells that contain a corner. With a smaller fraction, a large part of the
picture has no corners and its distortion is extrapolated. The result then has a note. Evidence: none."""
_MAX_FOCAL_SIGMA_RATIO = 0.005
"""Maximum ratio of the focal length's standard deviation to the focal length. With a larger ratio, the result
has a note. Evidence: none."""
_MAX_FOCAL_DIFFERENCE = 0.05
"""Maximum relative difference of the focal lengths from two halves of the views, and maximum ratio of two
standard deviations of the focal length to the focal length. With larger values, the calibration is refused.
Evidence: docs/decisions/calibration.md."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationResult:
    """The result of a calibration from a clip: intrinsics, their errors, and notes for the user.

    Attributes:
        board: The board in the clip.
        fit: The estimated intrinsics and their errors.
        size: Width and height of the upright pictures, px.
        inspected: Number of pictures in which the board was searched.
        found: Number of pictures in which the board was found.
        coverage: Fraction of the cells of an 8x6 grid in the picture that contain a corner.
        notes: Notes for the user: reasons why the result may be wrong, with remedies.
        halves_px: Focal lengths from every second view and from the others, px; None without a fit.
        mode: What the video states about the camera.
        preview: (H,W) grey picture of the view with the most corners, for `write_preview`.
    """

    board: CalibrationBoard
    fit: IntrinsicsFit
    size: ImageSize
    inspected: int
    found: int
    coverage: float
    notes: tuple[str, ...]
    halves_px: tuple[float, float] | None
    mode: VideoMode
    preview: GreyImage

    def lines(self) -> list[str]:
        """Return the result as lines of text for the user."""
        fit, (width, height) = self.fit, self.size
        sigma = ", ".join(f"{value:.2f}" for value in fit.focal_sigma_px)
        worst = max(fit.view_rms_px)
        halves = self.halves_px and " and ".join(f"{value:.2f}" for value in self.halves_px)
        return [
            f"{self.board}: the board was found in {self.found} of {self.inspected} pictures, and "
            f"{len(fit.kept)} of these views were used",
            f"{fit.model} at {width}×{height}: focal length {fit.matrix[0, 0]:.2f}, "
            f"{fit.matrix[1, 1]:.2f} px (±{sigma})"
            f"{f', from the two halves of the views {halves} px' if halves else ''}",
            f"reprojection error {fit.rms_px:.3f} px, in the worst view {worst:.3f} px; corners of the "
            f"board were found in {100 * self.coverage:.0f} % of the picture",
            *(f"note: {note}" for note in self.notes),
        ]


def calibrate_clip(
    video: Path, board: CalibrationBoard, lens: CameraModelChoice, context: StageContext
) -> CalibrationResult:
    """Calibrate a camera from a clip of a board.

    Args:
        video: Path of the clip. It must be filmed with the same settings as the captures: size, zoom and lens
            mode, with stabilisation off.
        board: The board in the clip.
        lens: Camera model to fit. ``auto`` selects OPENCV_FISHEYE if it fits clearly better, else OPENCV.
        context: Progress and cancellation.

    Returns:
        The intrinsics and their errors.

    Raises:
        CaptureError: The video cannot be used, or the board was found in too few pictures.
        EstimationError: No camera model fits the views, or the fit is not usable: the error is too large, or
            the views do not agree on the focal length. If the clip shows another board, the error names it.
    """
    camera = open_clip(video)
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
        raise _with_shown_board(_too_few_views(video, board, len(found), inspected), video, board, context)
    kept = select_diverse_views([view for _, view in found], size, _MAX_VIEWS)
    fit = _best_fit([found[index][1] for index in kept], size, lens)
    if fit is None or fit.rms_px > max_rms_px(size):
        raise _with_shown_board(_no_lens_fits(video, board, fit, len(kept)), video, board, context)
    frames = [found[kept[index]][0] for index in fit.kept]
    views = [found[kept[index]][1] for index in fit.kept]
    shown = frames[int(np.argmax([len(view.px) for view in views]))]
    _, preview = next(iter(camera.read([shown])))
    coverage = corner_coverage([view.px for view in views], size)
    mode = video_mode(video)
    halves_px = _focal_lengths_of_halves(fit.model, views, size)
    _require_known_focal_length(fit, halves_px, video)
    return CalibrationResult(
        board=board,
        fit=fit,
        size=size,
        inspected=inspected,
        found=len(found),
        coverage=coverage,
        notes=tuple(_notes(fit, size, coverage, mode)),
        halves_px=halves_px,
        mode=mode,
        preview=preview,
    )


def _frame_blocks(camera: CaptureCamera) -> list[tuple[int, int]]:
    """Divide the frames of a clip into blocks. One picture of each block is searched for the board.

    Returns:
        First frame index and end index (last frame index plus one) of each block.
    """
    count = len(camera.times_ns)
    seconds = (int(camera.times_ns[-1]) - int(camera.times_ns[0])) / 1e9 * count / max(count - 1, 1)
    looks = int(np.clip(round(seconds * _PICTURES_PER_S), 1, min(_MAX_PICTURES, count)))
    edges = np.linspace(0, count, looks + 1).round().astype(int).tolist()
    return list(itertools.pairwise(edges))


def _sharpest_pictures(
    camera: CaptureCamera, stretches: Sequence[tuple[int, int]]
) -> Iterator[tuple[int, GreyImage]]:
    """Yield the frame index and the grey picture of the sharpest frame in each block.

    Many pictures are blurred, because a person who holds the board in the hand moves it most of the time.
    """
    ends = iter(stretches)
    end = next(ends)[1]
    best: tuple[float, int, GreyImage] | None = None
    for frame, image in camera.grey_frames():
        if frame >= end and best is not None:
            yield best[1], best[2]
            best, end = None, next(ends)[1]
        score = sharpness(image)
        if best is None or score > best[0]:
            best = score, frame, image
    if best is not None:
        yield best[1], best[2]


def _best_fit(
    views: Sequence[BoardCorners], size: ImageSize, lens: CameraModelChoice
) -> IntrinsicsFit | None:
    """Fit each camera model that `lens` permits to the views, and return the best fit; None if none fits.

    If `lens` is ``auto``, the fisheye model is the best fit only if its error is clearly smaller.
    """
    fits = [fit for model in _MODELS[lens] if (fit := fit_intrinsics(model, views, size)) is not None]

    def weighed(fit: IntrinsicsFit) -> float:
        return fit.rms_px * (1.0 if fit.model == "OPENCV_FISHEYE" else _MAX_FISHEYE_ERROR_RATIO)

    return min(fits, key=weighed, default=None)


def select_diverse_views(views: Sequence[BoardCorners], size: ImageSize, count: int) -> list[int]:
    """Select views in which the board has different positions, sizes and tilts.

    The first selected view is the view with the most corners. Each further step adds one view: the view that
    is farthest from its nearest selected view. The distance between two views compares the position, size and
    tilt of the board in the pictures.

    Args:
        views: Views of the board.
        size: Width and height of the pictures, px.
        count: Maximum number of views to select.

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
    """Return a vector (5,) that describes a view: the centre, size and tilt of the board in the picture.

    All components are scaled to a similar range.
    """
    homography, _ = cv2.findHomography(view.board_m[:, :2], view.px / max(size))
    centre = view.px.mean(axis=0) / max(size)
    scale = np.log(np.sqrt(np.linalg.det(np.cov((view.px / max(size)).T))) + 1e-6)
    tilt = np.zeros(2) if homography is None else homography[2, :2] / homography[2, 2]
    extent = np.ptp(view.board_m[:, :2], axis=0).max()
    return np.concatenate([centre, [0.3 * scale], np.clip(2.0 * extent * tilt, -1, 1)])


def corner_coverage(pixels: Sequence[FloatArray], size: ImageSize) -> float:
    """Return the fraction of the picture's grid cells that contain at least one corner.

    Args:
        pixels: (N,2) corners in each picture, px, OpenCV's pixel origin.
        size: Width and height of the pictures, px.
    """
    cells = np.array(_COVERAGE_CELLS)
    cell = np.floor((np.concatenate(pixels) + 0.5) / np.array(size) * cells).astype(int)
    return len(np.unique(np.clip(cell, 0, cells - 1), axis=0)) / float(cells.prod())


def _notes(fit: IntrinsicsFit, size: ImageSize, coverage: float, mode: VideoMode) -> list[str]:
    notes = []
    if mode.stabilisation not in ("", "off"):
        notes.append(
            f"the camera stabilised the video ({mode.stabilisation}), so the picture moved relative to the "
            "lens: film the board again with stabilisation off"
        )
    if coverage < _MIN_COVERAGE:
        notes.append(
            f"corners of the board were found in only {100 * coverage:.0f} % of the picture, so the "
            "distortion of the rest is uncertain: film the board in all parts of the picture, also at the "
            "edges"
        )
    sigma = max(fit.focal_sigma_px) / fit.matrix[0, 0]
    if sigma > _MAX_FOCAL_SIGMA_RATIO:
        notes.append(
            f"the focal length has an uncertainty of {100 * sigma:.1f} %: tilt the board more to all "
            "sides, and film the board from a shorter distance"
        )
    if fit.rms_px > NOTED_RMS_RATIO * max_rms_px(size):
        notes.append(
            f"a reprojection error of {fit.rms_px:.1f} px is large: check that the board is flat, that its "
            "numbers of columns and rows are correct, that the focus is fixed, and that stabilisation is "
            "off"
        )
    return notes


def _focal_lengths_of_halves(
    model: str, views: Sequence[BoardCorners], size: ImageSize
) -> tuple[float, float] | None:
    """Return the focal lengths (px) from every second view and from the others; None if a half has no fit."""
    fits = [fit_intrinsics(model, views[start::2], size) for start in (0, 1)]
    found = [float(fit.matrix[[0, 1], [0, 1]].mean()) for fit in fits if fit is not None]
    return (found[0], found[1]) if len(found) == 2 else None


def _require_known_focal_length(
    fit: IntrinsicsFit, halves_px: tuple[float, float] | None, video: Path
) -> None:
    """Raise `EstimationError` if the views do not determine the focal length, or do not agree on it."""
    focal = float(fit.matrix[[0, 1], [0, 1]].mean())
    parts = []
    if 2.0 * max(fit.focal_sigma_px) > _MAX_FOCAL_DIFFERENCE * focal:
        parts.append(f"it is {focal:.0f} ± {max(fit.focal_sigma_px):.0f} px")
    if halves_px is not None and abs(halves_px[0] - halves_px[1]) > _MAX_FOCAL_DIFFERENCE * focal:
        parts.append(f"half of the views give {halves_px[0]:.0f} px, the others {halves_px[1]:.0f} px")
    if parts:
        raise EstimationError(
            f"the views of the board do not determine the focal length: {'; '.join(parts)}",
            path=video,
            hint="tilt the board more to all sides, film it near and far, keep it flat, fix focus and "
            "zoom, and switch off stabilisation",
        )


def _no_lens_fits(
    video: Path, board: CalibrationBoard, fit: IntrinsicsFit | None, views: int
) -> EstimationError:
    error = "" if fit is None else f" (the best has a reprojection error of {fit.rms_px:.1f} px)"
    return EstimationError(
        f"no lens fits the {views} views of the {board}{error}",
        path=video,
        hint="check the numbers of columns and rows; keep the board flat, fix the focus, switch off "
        "stabilisation, and film the board in all corners of the picture, tilted to all sides",
    )


def _with_shown_board(
    error: BodycapError, video: Path, stated: CalibrationBoard, context: StageContext
) -> BodycapError:
    """Return the error, which names the board that the clip shows if another one was stated."""
    shown = next(iter(boards_in(video, context)), None)
    if shown is not None and shown.is_usable and not shown.board.is_like(stated):
        error.message += (
            f"; the clip shows a {shown.board}, which a lens fits with an error of {shown.rms_px:.2f} px"
        )
        error.hint = f"give the board that the clip shows: {shown.board.options()}"
    return error


def _too_few_views(video: Path, board: CalibrationBoard, found: int, inspected: int) -> CaptureError:
    size = "count squares, not corners"
    if board.kind == "chessboard":
        size = "count inner corners, not squares; the whole board must be in the picture, with a white border"
    return CaptureError(
        f"the {board} was found in {found} of {inspected} inspected pictures, but {MIN_VIEWS} pictures "
        "with the board are needed",
        path=video,
        hint=f"check the numbers of columns and rows ({size}) and the kind of the board, light the board "
        "evenly, let the board fill a third of the picture, and hold the board still for a moment in each "
        "of twenty positions",
    )
