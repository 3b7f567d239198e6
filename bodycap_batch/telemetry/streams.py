"""Typed telemetry of one camera: streams of samples with units and times on the clock of the camera.

Vectors of the accelerometer, the gyroscope, the magnetometer and the gravity are in the nominal camera frame:
OpenCV's axes (x right, y down, z forward), as the maker states them for the sensor. The true sensor is turned
against the lens by some degrees, and its samples may be late: `compare_picture_and_gyro` estimates both. The
accelerometer measures the specific force: at rest, 9.8 m/s² upwards.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray, runs, set_array
from bodycap_batch.model.picture_turns import stabilisation_note

TelemetrySource = Literal["GPMF", "gcsv file", "imu.csv file", "none"]
"""Where telemetry comes from."""

GYROSCOPE, ACCELEROMETER, MAGNETOMETER, GRAVITY = "GYRO", "ACCL", "MAGN", "GRAV"
CAMERA_ORIENTATION, IMAGE_ORIENTATION = "CORI", "IORI"
EXPOSURE, READOUT = "SHUT", "SROT"
"""Keys of streams, as in GPMF. Files of text have the first two."""
_MAX_GAP_RATIO = 1.5
"""Distance of two samples, as a multiple of the sample interval, above which there is a gap."""
_LEAST_RANGES = {GYROSCOPE: 4.3, ACCELEROMETER: 19.4}
"""Least range of a sensor, by key of its stream: rad/s and m/s². Origin: 250 degrees per second and 2 g are
the smallest ranges that makers offer, less 1 %."""
_RELATIVE_ROUNDING = 1e-4
"""Largest relative difference of two values at the end of a range. Origin: three steps of 16 bits."""
_LEAST_SAMPLES = 2
"""Least number of successive samples at the largest value: a single one is a peak of the motion."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stream:
    """Samples of one sensor or one setting.

    Attributes:
        key: Key of four letters, as in GPMF.
        name: Name of the stream in the file.
        unit: Unit of the values.
        times_s: (N,) time of each sample on the clock of the camera, seconds, increasing.
        values: (N,C) values in the unit.
        rate_hz: Samples per second of the camera's clock, fitted to the recording.
        gaps_s: Start and end of each stretch without samples, or in which the sensor was at the end of its
            range, seconds on the clock of the camera.
    """

    key: str
    name: str
    unit: str
    times_s: FloatArray
    values: FloatArray
    rate_hz: float
    gaps_s: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        set_array(self, "times_s", (None,))
        set_array(self, "values", (len(self.times_s), None))
        if (np.diff(self.times_s) <= 0).any():
            raise ValueError("times_s: must increase")


def gaps_of(
    key: str, times_s: FloatArray, values: FloatArray, rate_hz: float
) -> tuple[tuple[float, float], ...]:
    """Return start and end (seconds) of each stretch without measurements.

    Args:
        key: Key of the stream.
        times_s: (N,) times of the samples, seconds.
        values: (N,C) values along the axes of the sensor.
        rate_hz: Samples per second.
    """
    wide = np.flatnonzero(np.diff(times_s) > _MAX_GAP_RATIO / rate_hz)
    gaps = ((float(times_s[index]), float(times_s[index + 1])) for index in wide)
    return (*gaps, *saturated_stretches(key, times_s, values))


def saturated_stretches(key: str, times_s: FloatArray, values: FloatArray) -> tuple[tuple[float, float], ...]:
    """Return start and end (seconds) of each stretch in which a sensor was at the end of its range.

    A stretch lasts from the last measurement before it to the first one after it.

    Args:
        key: Key of the stream, `GYROSCOPE` or `ACCELEROMETER`; other streams have no such stretches.
        times_s: (N,) times of the samples, seconds.
        values: (N,C) values along the axes of the sensor.
    """
    least = _LEAST_RANGES.get(key)
    if least is None or not len(values):
        return ()
    at_end = np.zeros(len(values), dtype=bool)
    for column in np.abs(values).T:
        largest = float(np.nanmax(column, initial=0.0))
        if largest >= least:
            for start, stop in runs(column >= (1.0 - _RELATIVE_ROUNDING) * largest):
                at_end[start:stop] |= stop - start >= _LEAST_SAMPLES
    last = len(times_s) - 1
    return tuple(
        (float(times_s[max(start - 1, 0)]), float(times_s[min(stop, last)])) for start, stop in runs(at_end)
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class GpsTrack:
    """Positions of a GPS receiver.

    Attributes:
        times_s: (N,) time of each fix on the clock of the camera, seconds.
        latitude_longitude_deg: (N,2) latitude and longitude, degrees.
        altitude_m: (N,) altitude, metres.
        speed_m_s: (N,2) speed over ground and speed in space, m/s.
        fix: (N,) kind of the fix: 0 none, 2 without altitude, 3 with altitude; −1 if it is unknown.
        dilution: (N,) dilution of precision, no unit; NaN if it is unknown.
        start_utc: UTC time of the first fix, as the receiver gives it (ISO 8601); "" if it is unknown.
    """

    times_s: FloatArray
    latitude_longitude_deg: FloatArray
    altitude_m: FloatArray
    speed_m_s: FloatArray
    fix: IntArray
    dilution: FloatArray
    start_utc: str = ""

    def __post_init__(self) -> None:
        count = len(self.times_s)
        set_array(self, "times_s", (count,))
        set_array(self, "latitude_longitude_deg", (count, 2))
        set_array(self, "altitude_m", (count,))
        set_array(self, "speed_m_s", (count, 2))
        set_array(self, "fix", (count,), np.int64)
        set_array(self, "dilution", (count,), finite=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraTelemetry:
    """All telemetry of one camera.

    Attributes:
        source: Where the samples come from.
        model: Name of the camera model; "" if it is unknown.
        firmware: Version of the firmware; "" if it is unknown.
        lens_mode: Name of the lens mode (field of view) that the file gives; "" if it is unknown.
        stabilisation: The stabilisation that the file's settings give: a mode, "off", or "" if it is unknown.
        settings: All settings in the file, by four-letter key.
        streams: The streams that this program understands, by key.
        gps: Positions; None if there are none.
        other_streams: Number of samples of each further stream, by key and name.
        axes_known: True if the file or the model gives the axes of the sensor, so that the vectors are in the
            nominal camera frame. Otherwise they are in the axes of the sensor.
        is_timelapse: True if the recording is a timelapse, whose inertial samples are means over long times.
            They are not in `streams`.
        notes: Notes for the user about what is damaged or missing.
    """

    source: TelemetrySource = "none"
    model: str = ""
    firmware: str = ""
    lens_mode: str = ""
    stabilisation: str = ""
    settings: Mapping[str, str] = field(default_factory=dict)
    streams: Mapping[str, Stream] = field(default_factory=dict)
    gps: GpsTrack | None = None
    other_streams: Mapping[str, int] = field(default_factory=dict)
    axes_known: bool = False
    is_timelapse: bool = False
    notes: tuple[str, ...] = ()

    @property
    def is_stabilised(self) -> bool:
        """Whether the file states that the camera stabilised the video."""
        return self.stabilisation not in {"", "off"}

    def stabilisation_note(self) -> str:
        """Return the note for the user on a stabilisation that the file states; "" if it states none."""
        if not self.is_stabilised:
            return ""
        return stabilisation_note(self.stabilisation, recorded=IMAGE_ORIENTATION in self.streams)

    def with_statement(self, *, stabilised: bool | None) -> CameraTelemetry:
        """Return the telemetry with what the user states about the stabilisation; None: nothing."""
        if stabilised is None or (stabilised and self.is_stabilised):
            return self
        kept = {key: each for key, each in self.streams.items() if stabilised or key != IMAGE_ORIENTATION}
        return replace(self, stabilisation="on" if stabilised else "off", streams=kept)

    @property
    def gyro(self) -> Stream | None:
        """Angular rate (N,3), rad/s; None if there is none."""
        return self.streams.get(GYROSCOPE)

    @property
    def accelerometer(self) -> Stream | None:
        """Specific force (N,3), m/s²; None if there is none."""
        return self.streams.get(ACCELEROMETER)
