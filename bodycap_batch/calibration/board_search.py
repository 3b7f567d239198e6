"""Measure which calibration board a clip shows: its kind, and its numbers of columns and rows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from bodycap_batch.calibration.board_detection import CalibrationBoard, GreyImage
from bodycap_batch.calibration.intrinsics_fit import fit_intrinsics
from bodycap_batch.capture import CaptureCamera, open_camera
from bodycap_batch.config.calibration import max_rms_px
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.core.arrays import FloatArray, IntArray, evenly_spaced
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import CaptureError

_PICTURES = 16
"""Number of pictures in which boards are searched. Evidence: none."""
_MIN_FOUND = 3
"""Minimum number of these pictures in which a board must be found. One picture can match a wrong board by
chance. Evidence: none."""
_MAX_SIDE_PX = 1280
"""Maximum long side (pixels) of the pictures in which squares are counted. Larger pictures are reduced."""
_MAX_CLIP_PX = 8192
"""Maximum long side (pixels) of the pictures in which corners are found: that of 8K videos."""
_MIN_MARKERS = 4
"""Minimum number of markers in a picture that are used. Fewer can agree with a wrong numbering."""
_MARKER_CORNERS = 0.35 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
"""Corners of a marker around its middle, in squares. Markers are 0.5 to 0.8 squares wide."""
_MAX_COLUMNS = 24
"""Maximum number of columns of squares of a ChArUco board that is recognised. Evidence: none."""
_DICTIONARIES = ("4X4", "5X5", "6X6", "7X7")
"""Families of markers. Each of OpenCV's sizes of a family is the beginning of the next larger size."""
_FAMILY_SIZES = (50, 100, 250)
"""Numbers of markers of the families that are searched. A board of 500 squares has 250 markers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundBoard:
    """A board that pictures show.

    Attributes:
        board: The board.
        corners: Number of its corners in all pictures together.
        rms_px: Reprojection error of the lens that fits the board best, px; infinite if no lens fits.
        is_usable: True if this error is small enough for a calibration.
    """

    board: CalibrationBoard
    corners: int
    rms_px: float
    is_usable: bool


def find_board(video: Path, context: StageContext) -> CalibrationBoard:
    """Return the board that a clip shows.

    The board with the most corners is taken, among those that a lens fits if there are any.

    Args:
        video: Path of the clip.
        context: Progress and cancellation.

    Raises:
        CaptureError: The video cannot be used, or shows no board.
    """
    found = boards_in(video, context)
    if not found:
        raise CaptureError(
            f"no calibration board was found in {_PICTURES} pictures of the clip",
            path=video,
            hint="name the board, for example --charuco 7x5 or --chessboard 9x6; `bodycap calibrate --print "
            "board.pdf` writes a board to print",
        )
    return found[0].board


def boards_in(video: Path, context: StageContext) -> list[FoundBoard]:
    """Return the boards that a clip shows: those that a lens fits first, then by their number of corners.

    Args:
        video: Path of the clip.
        context: Progress and cancellation.

    Raises:
        CaptureError: The video cannot be used.
    """
    camera = open_clip(video)
    size = (camera.camera.width_px, camera.camera.height_px)
    frames = [int(frame) for frame in evenly_spaced(len(camera.times_ns), _PICTURES)]
    pictures = [image for _, image in camera.read(frames)]
    limit = max_rms_px(size)
    small = [_reduced(picture) for picture in pictures]
    candidates = list(_charuco_boards(small) or _chessboards(small))
    found = []
    for number, board in enumerate(candidates):
        context.check_cancelled()
        context.progress(number, len(candidates), "kinds of boards")
        views = [view for picture in pictures if (view := board.find(picture)) is not None]
        if len(views) >= _MIN_FOUND:
            rms_px = np.inf
            for model in ("OPENCV", "OPENCV_FISHEYE"):
                fit = fit_intrinsics(model, views, size) if rms_px > limit else None
                rms_px = rms_px if fit is None else min(rms_px, fit.rms_px)
            corners = sum(len(view.px) for view in views)
            found.append(FoundBoard(board=board, corners=corners, rms_px=rms_px, is_usable=rms_px <= limit))
    return sorted(found, key=lambda each: (not each.is_usable, -each.corners))


def open_clip(video: Path) -> CaptureCamera:
    """Open the clip of a board at its full size. Raises `CaptureError` if it cannot be used."""
    config = CameraConfig(name="camera", video=(video,))
    return open_camera(CaptureConfig(cameras=(config,), work_px=_MAX_CLIP_PX), config)


def _reduced(picture: GreyImage) -> GreyImage:
    scale = min(1.0, _MAX_SIDE_PX / max(picture.shape))
    return np.asarray(cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


def _chessboards(pictures: Sequence[GreyImage]) -> Iterator[CalibrationBoard]:
    """Yield a chessboard for each size of a grid of corners that several pictures show."""
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER  # any grid of at least the size 3x3
    sizes: Counter[tuple[int, int]] = Counter()
    for picture in pictures:
        is_found, _, grid = cv2.findChessboardCornersSBWithMeta(picture, (3, 3), flags=flags)
        if is_found:
            sizes[max(grid.shape), min(grid.shape)] += 1
    for (columns, rows), count in sizes.items():
        if count >= _MIN_FOUND:
            yield CalibrationBoard(kind="chessboard", columns=columns, rows=rows)


def _charuco_boards(pictures: Sequence[GreyImage]) -> list[CalibrationBoard]:
    """Return the ChArUco board whose numbering agrees best with the markers; empty without markers."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.detectInvertedMarker = True

    def markers(name: str, shown: Sequence[GreyImage]) -> list[tuple[IntArray, FloatArray]]:
        family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}_{_FAMILY_SIZES[-1]}"))
        detector = cv2.aruco.ArucoDetector(family, parameters)
        views = [detector.detectMarkers(picture)[:2] for picture in shown]
        return [
            (ids.ravel(), np.reshape(corners, (-1, 4, 2)))
            for corners, ids in views
            if ids is not None and len(ids) >= _MIN_MARKERS
        ]

    seen = {name: sum(len(ids) for ids, _ in markers(name, pictures[::4])) for name in _DICTIONARIES}
    dictionary = max(seen, key=lambda name: seen[name])
    views = markers(dictionary, pictures[::2]) if seen[dictionary] else []
    if not views:
        return []
    layouts = [(columns, legacy) for columns in range(4, _MAX_COLUMNS + 1) for legacy in (False, True)]
    misfits = [np.concatenate([_misfits(*view, *layout) for view in views]) for layout in layouts]
    best = int(np.argmin([misfit.mean() for misfit in misfits]))
    columns, legacy = layouts[best]
    last = int(np.concatenate([ids for ids, _ in views])[misfits[best] < 1.0].max(initial=0))
    rows = int(_squares(np.array([last]), columns, legacy=legacy)[0, 1]) + 1
    return [
        CalibrationBoard(
            kind="charuco",
            columns=columns,
            # Only boards with an even number of rows were drawn in another way by earlier versions of OpenCV.
            rows=max(4, rows + rows % 2 if legacy else rows),
            dictionary=f"{dictionary}_{next(size for size in _FAMILY_SIZES if size > last)}",
            legacy=legacy,
        )
    ]


def _squares(ids: IntArray, columns: int, *, legacy: bool) -> FloatArray:
    """Return the column and the row (N,2) of the square of each marker: every second square of a row."""
    grid = np.indices((2 * int(ids.max()) // columns + 3, columns))
    rows, places = np.nonzero((grid.sum(axis=0) + legacy) % 2)
    return np.stack([places, rows], axis=1)[ids].astype(np.float64)


def _misfits(ids: IntArray, corners: FloatArray, columns: int, legacy: bool) -> FloatArray:
    """Return how well the markers in a picture agree with the numbering of a board.

    Args:
        ids: (N,) numbers of the markers.
        corners: (N,4,2) their corners, px.
        columns: Number of columns of squares of the board.
        legacy: True if the first square of the board is white.

    Returns:
        (N,) distance of each marker's corners from their places, as a ratio to the side of a square; 1 for
        larger distances.
    """
    on_board = _squares(ids, columns, legacy=legacy)[:, None] + _MARKER_CORNERS
    board_from_px, _ = cv2.findHomography(corners.reshape(-1, 2), on_board.reshape(-1, 2), cv2.LMEDS)
    if board_from_px is None:
        return np.ones(len(ids))
    places = cv2.perspectiveTransform(corners.reshape(-1, 1, 2).astype(np.float64), board_from_px)
    distance = np.linalg.norm(places.reshape(-1, 4, 2) - on_board, axis=-1).mean(axis=1)
    return np.asarray(np.minimum(distance, 1.0))
