"""Calibrate cameras: estimate intrinsics from a clip of a calibration board."""

from bodycap_batch.calibration.board_detection import CalibrationBoard
from bodycap_batch.calibration.board_search import find_board
from bodycap_batch.calibration.calibration_files import write_calibration, write_preview
from bodycap_batch.calibration.clip_calibration import calibrate_clip
from bodycap_batch.calibration.printed_board import write_board

__all__ = [
    "CalibrationBoard",
    "calibrate_clip",
    "find_board",
    "write_board",
    "write_calibration",
    "write_preview",
]
