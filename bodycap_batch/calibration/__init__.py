"""Calibrate cameras: estimate intrinsics from a clip of a calibration board."""

from bodycap_batch.calibration.board_detection import CalibrationBoard
from bodycap_batch.calibration.calibration_files import write_calibration, write_preview
from bodycap_batch.calibration.clip_calibration import CalibrationResult, CameraModelChoice, calibrate_clip

__all__ = [
    "CalibrationBoard",
    "CalibrationResult",
    "CameraModelChoice",
    "calibrate_clip",
    "write_calibration",
    "write_preview",
]
