"""Find out which calibration board a clip shows, if the user does not say it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bodycap_batch.calibration.board_detection import CalibrationBoard, GreyImage
from bodycap_batch.capture import open_camera
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.core.arrays import evenly_spaced
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import CaptureError

_PICTURES = 6
"""Number of pictures in which each kind of board is searched. Evidence: none."""
_MIN_FOUND = 3
"""Minimum number of these pictures in which a board must be found. One picture can match a wrong board by
chance. Evidence: none."""
_MIN_SHARE = 0.5
"""Minimum fraction of a board's corners that its views must show, on average. A board with more corners than
this is taken at once. Evidence: none."""
_MIN_MARKERS = 4
"""Minimum number of markers of a family in all pictures together. Fewer are found by chance.

Evidence: none.
"""
_CHARUCO_SIZES = (
    (7, 5),
    (5, 7),
    (8, 6),
    (6, 8),
    (9, 6),
    (6, 9),
    (8, 5),
    (5, 8),
    (11, 8),
    (8, 11),
    (10, 7),
)
"""Numbers of columns and rows of usual ChArUco boards. That of `bodycap calibrate --print` is the first."""
_DICTIONARIES = ("4X4_1000", "5X5_1000", "6X6_1000")
"""Families of markers of usual boards. The smaller families of OpenCV are the beginnings of these."""
_CHESSBOARD_SIZES = ((9, 6), (8, 6), (7, 6), (8, 5), (7, 5), (10, 7), (11, 8), (6, 4), (7, 4), (8, 7), (9, 7))
"""Numbers of inner corners of usual chessboards."""


def find_board(video: Path, context: StageContext) -> CalibrationBoard:
    """Return the board that a clip shows. Usual ChArUco boards and chessboards are tried.

    The board with the most corners in all pictures together is taken.

    Args:
        video: Path of the clip.
        context: Progress and cancellation.

    Raises:
        CaptureError: The video cannot be used, or shows no usual board.
    """
    pictures = _pictures(video)
    candidates = _charuco_candidates(pictures) or [
        CalibrationBoard(kind="chessboard", columns=columns, rows=rows) for columns, rows in _CHESSBOARD_SIZES
    ]
    best: tuple[int, CalibrationBoard] | None = None
    for number, board in enumerate(candidates):
        context.check_cancelled()
        context.progress(number, len(candidates), "kinds of boards")
        corners = _count_corners(board, pictures)
        if corners > (0 if best is None else best[0]):
            best = corners, board
        if corners > _MIN_SHARE * len(pictures) * _inner_corners(board):
            break
    if best is None:
        raise CaptureError(
            f"no usual calibration board was found in {len(pictures)} pictures of the clip",
            path=video,
            hint="name the board, for example --charuco 7x5 or --chessboard 9x6; `bodycap calibrate --print "
            "board.pdf` writes a board to print",
        )
    return best[1]


def _pictures(video: Path) -> list[GreyImage]:
    config = CameraConfig(name="camera", video=(video,))
    camera = open_camera(CaptureConfig(cameras=(config,), work_px=8192), config)
    frames = [int(frame) for frame in evenly_spaced(len(camera.times_ns), _PICTURES)]
    return [image for _, image in camera.read(frames)]


def _charuco_candidates(pictures: Sequence[GreyImage]) -> list[CalibrationBoard]:
    """Return the usual ChArUco boards that have the markers in the pictures; empty if there are no markers.

    A board of C x R squares has C·R/2 markers, numbered from 0. Boards with too few markers are left out.
    """
    import cv2

    parameters = cv2.aruco.DetectorParameters()
    parameters.detectInvertedMarker = True
    found: dict[str, list[int]] = {}
    for name in _DICTIONARIES:
        family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))
        detector = cv2.aruco.ArucoDetector(family, parameters)
        seen = [detector.detectMarkers(picture)[1] for picture in pictures]
        found[name] = [int(number) for ids in seen if ids is not None for number in ids.ravel()]
    dictionary, numbers = max(found.items(), key=lambda item: len(item[1]))
    if len(numbers) < _MIN_MARKERS:
        return []
    fitting = [size for size in _CHARUCO_SIZES if size[0] * size[1] // 2 > max(numbers)]
    return [
        CalibrationBoard(kind="charuco", columns=columns, rows=rows, dictionary=dictionary)
        for columns, rows in sorted(fitting, key=lambda size: size[0] * size[1])
    ]


def _inner_corners(board: CalibrationBoard) -> int:
    one_less = board.kind == "charuco"  # its size counts squares
    return (board.columns - one_less) * (board.rows - one_less)


def _count_corners(board: CalibrationBoard, pictures: Sequence[GreyImage]) -> int:
    """Return the number of corners in all pictures; 0 if the board is found in too few of them."""
    found: list[int] = []
    for number, picture in enumerate(pictures):
        if number == len(pictures) // 2 and not found:
            return 0  # a board that half of the pictures do not show is another one
        view = board.find(picture)
        if view is not None:
            found.append(len(view.px))
    return sum(found) if len(found) >= _MIN_FOUND else 0
