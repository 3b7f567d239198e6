"""Telemetry that cameras record: inertial sensors, exposure, gravity, GPS and settings."""

from bodycap_batch.telemetry.reading import read_telemetry
from bodycap_batch.telemetry.streams import CameraTelemetry, GpsTrack, Stream

__all__ = ["CameraTelemetry", "GpsTrack", "Stream", "read_telemetry"]
