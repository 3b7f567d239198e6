"""A board that stands in the room: where keyframes see it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bodycap_batch.calibration.boards import CalibrationBoard
from bodycap_batch.capture import Capture
from bodycap_batch.config.options import MarkerBoard
from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.camera import CV2_PIXEL_OFFSET_PX, Camera
from bodycap_batch.model.geometry import make_transform
from bodycap_batch.model.merge_data import BoardView


def find_board_views(
    capture: Capture,
    frames: Mapping[str, IntArray],
    lenses: Mapping[str, Camera],
    wanted: MarkerBoard,
    context: StageContext,
) -> tuple[BoardView, ...]:
    """Look for a board in chosen frames.

    Args:
        capture: The videos.
        frames: By camera, increasing indices of the frames to look at.
        lenses: By camera, the lens at the work size, as the map has it.
        wanted: The board.
        context: Cancellation.

    Raises:
        JobError: There is no such board.
        CaptureError: A frame cannot be decoded.
    """
    board = CalibrationBoard(
        kind=wanted.kind,
        columns=wanted.columns,
        rows=wanted.rows,
        dictionary=wanted.dictionary,
        marker=wanted.marker,
        legacy=wanted.legacy,
    )
    out = []
    for camera, indices in sorted(frames.items()):
        for frame, image in capture.camera(camera).read(indices):
            context.check_cancelled()
            seen = board.find(image)
            if seen is None:
                continue
            corners = wanted.square_m * seen.board_m
            rays = lenses[camera].unproject(seen.px + CV2_PIXEL_OFFSET_PX)
            known = np.isfinite(rays).all(axis=1)
            pose = _estimate_board_pose(corners[known], rays[known]) if known.sum() >= 4 else None
            if pose is not None:
                out.append(
                    BoardView(
                        camera=camera,
                        frame=frame,
                        board_m=corners[known],
                        rays=rays[known],
                        cam_from_board=pose,
                    )
                )
    return tuple(out)


def _estimate_board_pose(board_m: FloatArray, rays: FloatArray) -> FloatArray | None:
    """cam_from_board (4,4) of a flat board, None where OpenCV finds none."""
    import cv2

    found, turn, shift = cv2.solvePnP(board_m, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    if not found:
        return None
    return make_transform(cv2.Rodrigues(turn)[0], shift[:, 0])
