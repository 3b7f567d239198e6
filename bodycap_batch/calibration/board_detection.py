"""Find the corners of calibration boards in pictures.

Pixels have OpenCV's origin: the centre of the first pixel is (0, 0).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import JobError

GreyImage = npt.NDArray[np.uint8]
MIN_CORNERS = 8
"""Minimum number of corners of a ChArUco board in a view. A view with fewer corners is not used. Eight
corners give 16 coordinates. The board's pose needs six of these coordinates, and the other ten coordinates
help to determine the intrinsics. Evidence: none."""
_WINDOW_RATIO = 0.3
"""Half the side of the window for sub-pixel refinement, as a fraction of the smallest distance between
corners. With this fraction, the window does not contain a second corner."""
_MAX_WINDOW_PX = 15
"""Maximum of half the side of the window for sub-pixel refinement. Unit: px. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardCorners:
    """The visible corners of a board in one picture.

    Attributes:
        board_m: (N,3) positions of the corners on the board, z = 0, in units of a square's side.
        px: (N,2) positions of the corners in the picture, px, OpenCV's pixel origin.
    """

    board_m: FloatArray
    px: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationBoard:
    """A flat calibration board.

    Attributes:
        kind: Kind of the board: a plain chessboard, or a ChArUco board (a chessboard with markers in its
            white squares).
        columns: Number of inner corners in a row of a chessboard, or of squares in a row of a ChArUco board.
        rows: Number of inner corners in a column of a chessboard, or of squares in a column of a ChArUco
            board.
        dictionary: OpenCV's name, without ``DICT_``, of the dictionary of a ChArUco board's markers.
        marker: Ratio of the side of a marker to the side of a square, for a ChArUco board.
        legacy: True for a ChArUco board that was drawn by an OpenCV version before 4.6. Boards with an even
            number of rows have another pattern in these versions.
    """

    kind: Literal["chessboard", "charuco"]
    columns: int
    rows: int
    dictionary: str = "4X4_50"
    marker: float = 0.75
    legacy: bool = False
    _inverted: list[bool] = field(default_factory=lambda: [False], init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        min_size = 3 if self.kind == "chessboard" else 4
        if min(self.columns, self.rows) < min_size:
            raise JobError(
                f"a {self.kind} board of {self.columns}x{self.rows} is too small",
                field=f"--{self.kind}",
                hint="for a chessboard, give the number of inner corners, for example 9x6; for a ChArUco "
                "board, give the number of squares, for example 7x5",
            )
        if self.kind == "charuco" and not 0.1 < self.marker < 1.0:
            raise JobError(
                f"a marker cannot be {self.marker:g} times as wide as a square",
                field="--marker",
                hint="give the side of a marker divided by the side of a square, for example 0.75",
            )

    def __str__(self) -> str:
        if self.kind == "chessboard":
            return f"chessboard of {self.columns}x{self.rows} inner corners"
        return f"ChArUco board of {self.columns}x{self.rows} squares ({self.dictionary})"

    def options(self) -> str:
        """Return the options of `bodycap calibrate` that name the board."""
        size = f"--{self.kind} {self.columns}x{self.rows}"
        if self.kind == "chessboard":
            return size
        return f"{size} --dictionary {self.dictionary}{' --legacy' if self.legacy else ''}"

    def is_like(self, other: CalibrationBoard) -> bool:
        """Return True if both boards have the same corners; a chessboard has them in any orientation."""
        if self.kind != other.kind or self.legacy != other.legacy:
            return False
        if self.kind == "chessboard":
            return {self.columns, self.rows} == {other.columns, other.rows}
        family, other_family = (board.dictionary.upper().split("_")[-2] for board in (self, other))
        return (self.columns, self.rows, family) == (other.columns, other.rows, other_family)

    def find(self, image: GreyImage) -> BoardCorners | None:
        """Find the board's corners in a grey picture (H,W); return None if too few corners are visible.

        A ChArUco board may be printed black on white or white on black.
        """
        if self.kind == "chessboard":
            return self._find_chessboard(image)
        # Some programs print boards white on black. The detector finds no inverted board.
        for is_inverted in (self._inverted[-1], not self._inverted[-1]):
            found = self._find_charuco(255 - image if is_inverted else image)
            if found is not None:
                self._inverted[:] = [is_inverted]
                return found
        return None

    def _find_charuco(self, image: GreyImage) -> BoardCorners | None:
        """Find the corners of a ChArUco board that is printed black on white; None if there are too few."""
        detector, board = _detector(self)
        corners, ids, _, _ = detector.detectBoard(image)
        if ids is None or len(ids) < MIN_CORNERS or board.checkCharucoCornersCollinear(ids):
            return None
        on_board, px = board.matchImagePoints(corners, ids)
        return BoardCorners(
            board_m=np.asarray(on_board, dtype=np.float64).reshape(-1, 3),
            px=np.asarray(px, dtype=np.float64).reshape(-1, 2),
        )

    def picture(self, square_px: int) -> GreyImage:
        """Return a picture of the ChArUco board for printing, without a margin.

        Args:
            square_px: Side of a square, px.
        """
        _, board = _detector(self)
        size = (self.columns * square_px, self.rows * square_px)
        return np.asarray(board.generateImage(size), dtype=np.uint8)

    def _find_chessboard(self, image: GreyImage) -> BoardCorners | None:
        import cv2

        size = (self.columns, self.rows)
        found, corners = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if not found:
            return None
        corners = _refine_corners(image, corners.reshape(self.rows, self.columns, 2))
        x, y = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        on_board = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)
        return BoardCorners(
            board_m=on_board.astype(np.float64), px=np.asarray(corners, dtype=np.float64).reshape(-1, 2)
        )


@functools.cache
def _detector(board: CalibrationBoard) -> tuple[Any, Any]:
    """Return OpenCV's ChArUco detector and board."""
    import cv2

    name = f"DICT_{board.dictionary.upper().removeprefix('DICT_')}"
    if not hasattr(cv2.aruco, name):
        known = sorted(item[5:] for item in dir(cv2.aruco) if item.startswith("DICT_"))
        raise JobError(
            f"there is no family of markers {board.dictionary!r}",
            field="--dictionary",
            hint=f"choose one of {', '.join(known)}",
        )
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    charuco = cv2.aruco.CharucoBoard((board.columns, board.rows), 1.0, board.marker, markers)
    charuco.setLegacyPattern(board.legacy)
    return cv2.aruco.CharucoDetector(charuco), charuco


def _refine_corners(image: GreyImage, corners: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Refine corners (R,C,2) to sub-pixel accuracy, in windows that contain no second corner.

    All corners of OpenCV's detector are displaced by about 0.1 px in the same direction. Without refinement,
    this error moves the estimated principal point by 1 px. Evidence: docs/decisions/calibration.md.
    """
    import cv2

    distance_px = min(float(np.linalg.norm(np.diff(corners, axis=axis), axis=-1).min()) for axis in (0, 1))
    half = int(np.clip(_WINDOW_RATIO * distance_px, 2, _MAX_WINDOW_PX))
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 40, 1e-3)
    initial = np.ascontiguousarray(corners.reshape(-1, 1, 2), dtype=np.float32)
    return np.asarray(cv2.cornerSubPix(image, initial, (half, half), (-1, -1), criteria), dtype=np.float32)
