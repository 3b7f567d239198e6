"""Telemetry that cameras record: inertial sensors, exposure, gravity, GPS and settings."""

from bodycap_batch.telemetry.comparison import (
    PictureGyroComparison,
    compare_picture_and_gyro,
    telemetry_notes,
)
from bodycap_batch.telemetry.reading import read_telemetry
from bodycap_batch.telemetry.streams import CameraTelemetry, GpsTrack, Stream

__all__ = [
    "CameraTelemetry",
    "GpsTrack",
    "PictureGyroComparison",
    "Stream",
    "compare_picture_and_gyro",
    "read_telemetry",
    "telemetry_notes",
]
