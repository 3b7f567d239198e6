"""A lens from a clip of a calibration board."""

from bodycap_batch.calibration.boards import Board
from bodycap_batch.calibration.clip import CalibrationResult, LensChoice, calibrate_clip
from bodycap_batch.calibration.files import write_calibration, write_preview

__all__ = [
    "Board",
    "CalibrationResult",
    "LensChoice",
    "calibrate_clip",
    "write_calibration",
    "write_preview",
]
