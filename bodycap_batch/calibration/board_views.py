"""Find a marker board in the images of keyframes. The board stands in the room."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bodycap_batch.calibration.board_detection import CalibrationBoard
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
    cameras: Mapping[str, Camera],
    marker_board: MarkerBoard,
    context: StageContext,
) -> tuple[BoardView, ...]:
    """Search for a board in selected frames and estimate its poses.

    Args:
        capture: All cameras with their videos.
        frames: (K,) increasing indices of the frames to search, by camera name.
        cameras: Intrinsics from the map, by camera name, for images of the work size (the image size that all
            stages work at).
        marker_board: The board to search for.
        context: Cancellation.

    Returns:
        One view for each frame in which the board was found and the board's pose could be estimated.

    Raises:
        JobError: The board is not valid.
        CaptureError: A frame cannot be decoded.
    """
    board = CalibrationBoard(**marker_board.model_dump(exclude={"square_m", "placed"}))
    out = []
    for camera, indices in sorted(frames.items()):
        for frame, image in capture.camera(camera).read(indices):
            context.check_cancelled()
            seen = board.find(image)
            if seen is None:
                continue
            corners = marker_board.square_m * seen.board_m
            rays = cameras[camera].unproject(seen.px + CV2_PIXEL_OFFSET_PX)
            valid = np.isfinite(rays).all(axis=1)
            pose = _estimate_board_pose(corners[valid], rays[valid]) if valid.sum() >= 4 else None
            if pose is not None:
                out.append(
                    BoardView(
                        camera=camera,
                        frame=frame,
                        board_m=corners[valid],
                        rays=rays[valid],
                        cam_from_board=pose,
                    )
                )
    return tuple(out)


def _estimate_board_pose(board_m: FloatArray, rays: FloatArray) -> FloatArray | None:
    """Estimate the pose cam_from_board (4,4) of a flat board; return None if OpenCV finds no pose.

    Args:
        board_m: (N,3) positions of the corners on the board, metres, z = 0.
        rays: (N,2) positions of the corners in normalised image coordinates.
    """
    import cv2

    found, rotation, translation = cv2.solvePnP(board_m, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    if not found:
        return None
    return make_transform(cv2.Rodrigues(rotation)[0], translation[:, 0])
