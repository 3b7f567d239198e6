"""Files of text with the samples of an inertial sensor, beside the videos of a camera.

``<camera>.imu.csv`` has a header and the columns ``t_s,gx,gy,gz,ax,ay,az``: seconds on the clock of the
camera, rad/s and m/s², in OpenCV's axes (x right, y down, z forward). ``<camera>.gcsv`` is Gyroflow's text
format.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bodycap_batch.config.sample_files import GYROFLOW_SUFFIX
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.telemetry.gopro import gaps_of
from bodycap_batch.telemetry.saturation import saturated_stretches
from bodycap_batch.telemetry.streams import ACCELEROMETER, GYROSCOPE, CameraTelemetry, Stream

IMU_COLUMNS = ("t_s", "gx", "gy", "gz", "ax", "ay", "az")
"""Columns of a file ``.imu.csv``: time, angular rate along three axes, specific force along three axes."""
_GYROFLOW_TITLES = ("GYROFLOW IMU LOG", "CAMERA IMU LOG")
_MAX_BYTES = 512 << 20
"""Maximum size (bytes) of a file. An hour at 1,000 samples per second has 300 MB. Evidence: none."""
_MAX_HEADER_LINES = 200
"""Maximum number of lines of a Gyroflow file before its table. Real files have some ten."""
_STANDARD_GRAVITY = 9.80665
"""Standard acceleration of gravity, m/s². Accelerations of Gyroflow files are in multiples of it."""
_MAX_ABS_TIME_S = 4e9
"""Maximum absolute time, seconds: later than the Unix time of any recording."""
_MAX_ABS_VALUE = 1e6
"""Maximum absolute rate (rad/s) or acceleration (m/s²) that is read; sensors end near 70 and 160."""
_SHOWN = 40
"""Maximum number of characters of a faulty line in an error."""


def read_imu_file(path: Path) -> CameraTelemetry:
    """Read a file with inertial samples. Its times are on the clock of the camera.

    Raises:
        CaptureError: The file cannot be read, or a line is wrong. The error names the line.
    """
    lines = _lines_of(path)
    if path.name.lower().endswith(GYROFLOW_SUFFIX):
        return _gyroflow(path, lines)
    header = lines[0].strip().lower().replace(" ", "") if lines else ""
    if tuple(header.split(",")) != IMU_COLUMNS:
        raise CaptureError(
            "the first line does not name the columns of inertial samples",
            path=path,
            line=1,
            hint=f"write the columns {','.join(IMU_COLUMNS)}: seconds on the camera's clock, rad/s, m/s²",
        )
    table = _table(path, lines, 1, len(IMU_COLUMNS), 1.0)
    return replace(_telemetry(table, "imu.csv file"), axes_known=True)


def _lines_of(path: Path) -> list[str]:
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise CaptureError(
                f"the file is larger than {_MAX_BYTES >> 20} MB",
                path=path,
                hint="write at most 1,000 samples per second, for the recording only",
            )
        return path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    except OSError as error:
        raise CaptureError(
            f"the inertial samples cannot be read ({error.strerror or error})",
            path=path,
            hint="correct the permissions, or remove the file",
        ) from error


def _table(path: Path, lines: Sequence[str], first: int, columns: int, time_unit_s: float) -> FloatArray:
    """Return the lines from a line on as numbers (N,C), with the time in seconds.

    Args:
        path: Path of the file, for errors.
        lines: All lines of the file.
        first: Index of the first line of the table.
        columns: Number of columns that are read.
        time_unit_s: Unit of the first column, seconds.
    """
    rows = list(_rows(path, lines, first, columns))
    if len(rows) < 2:
        raise CaptureError(
            "the file has fewer than two inertial samples", path=path, hint="record again, or remove the file"
        )
    numbers = np.array([line for line, _ in rows])
    table = np.array([values for _, values in rows])
    table[:, 0] *= time_unit_s
    wrong = ~np.isfinite(table).all(axis=1)
    wrong |= np.abs(table[:, 0]) > _MAX_ABS_TIME_S
    wrong |= (np.abs(table[:, 1:]) > _MAX_ABS_VALUE).any(axis=1)
    if wrong.any():
        line = int(numbers[np.argmax(wrong)])
        raise _wrong_line(path, line, lines[line - 1], "is not a plausible inertial sample")
    steps = np.diff(table[:, 0]) <= 0
    if steps.any():
        line = int(numbers[int(np.argmax(steps)) + 1])
        raise _wrong_line(path, line, lines[line - 1], "is not later than the sample before it")
    return table


def _rows(
    path: Path, lines: Sequence[str], first: int, columns: int
) -> Iterator[tuple[int, tuple[float, ...]]]:
    for index in range(first, len(lines)):
        text = lines[index].strip()
        if not text or text.startswith("#"):
            continue
        try:
            values = tuple(map(float, text.split(",")[:columns]))
        except ValueError:
            values = ()
        if len(values) < columns:
            raise _wrong_line(path, index + 1, text, f"does not have {columns} numbers")
        yield index + 1, values


def _wrong_line(path: Path, line: int, text: str, what: str) -> CaptureError:
    return CaptureError(
        f"{text.strip()[:_SHOWN]!r} {what}",
        path=path,
        line=line,
        hint="write one sample on each line, in the order of time, with commas between the numbers",
    )


@dataclass(frozen=True, slots=True)
class _GyroflowHeader:
    """What the header of a Gyroflow file states.

    Attributes:
        values: The other entries, by name.
        table: Index of the first line of the table.
        columns: Number of columns that are read: four, or seven with accelerations.
    """

    values: dict[str, str]
    table: int
    columns: int

    def number(self, name: str, path: Path) -> float:
        """Return an entry as a positive number; 1 if the header does not have it."""
        text = self.values.get(name, "1")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and value > 0):
            raise CaptureError(
                f"{name} is {text[:_SHOWN]!r}, not a positive number",
                path=path,
                field=name,
                hint="export the file again from the program that wrote it",
            )
        return value


def _gyroflow_header(path: Path, lines: Sequence[str]) -> _GyroflowHeader:
    values: dict[str, str] = {}
    if not lines or not lines[0].strip().upper().startswith(_GYROFLOW_TITLES):
        raise CaptureError(
            f"the file does not start with {_GYROFLOW_TITLES[0]}",
            path=path,
            line=1,
            hint="export the samples in Gyroflow's format, or write a file <camera>.imu.csv",
        )
    for index, line in enumerate(lines[1:_MAX_HEADER_LINES], start=1):
        name, _, value = line.strip().replace(":", ",", 1).partition(",")
        if name.strip().lower() in ("t", "time"):
            columns = [part.strip().lower() for part in line.split(",")]
            if columns[1:4] != ["gx", "gy", "gz"] and columns[1:4] != ["rx", "ry", "rz"]:
                break
            return _GyroflowHeader(values, index + 1, 7 if columns[4:7] == ["ax", "ay", "az"] else 4)
        values[name.strip().lower()] = value.strip()
    raise CaptureError(
        "the file has no line that names the columns t,gx,gy,gz",
        path=path,
        hint="export the samples again in Gyroflow's format",
    )


def _gyroflow(path: Path, lines: Sequence[str]) -> CameraTelemetry:
    header = _gyroflow_header(path, lines)
    table = _table(path, lines, header.table, header.columns, header.number("tscale", path))
    table[:, 1:4] *= header.number("gscale", path)
    table[:, 4:] *= header.number("ascale", path) * _STANDARD_GRAVITY
    telemetry = _telemetry(_in_stated_axes(table, header.values.get("orientation", "")), "gcsv file")
    parts = (header.values.get("vendor", ""), header.values.get("id", ""))
    return replace(
        telemetry,
        model=" ".join(part for part in parts if part)[:100],
        firmware=header.values.get("fwversion", "")[:100],
        settings={name[:40]: value[:200] for name, value in header.values.items()},
    )


def _in_stated_axes(table: FloatArray, axes: str) -> FloatArray:
    """Return the samples (N,C) with their axes in the stated order: letter i is the axis of value i."""
    if sorted(axes.upper()) != ["X", "Y", "Z"]:
        return table
    out = table.copy()
    for start in range(1, table.shape[1], 3):
        for index, letter in enumerate(axes):
            sign = 1.0 if letter.isupper() else -1.0
            out[:, start + index] = sign * table[:, start + "XYZ".index(letter.upper())]
    return out


def _telemetry(table: FloatArray, source: str) -> CameraTelemetry:
    """Return the telemetry of samples (N,4) or (N,7)."""
    times_s = table[:, 0]
    rate_hz = float(1.0 / np.median(np.diff(times_s)))
    kept = np.diff(times_s) <= 1.5 / rate_hz
    if kept.any():
        rate_hz = float(1.0 / np.diff(times_s)[kept].mean())
    streams = {}
    for key, name, unit, start in (
        (GYROSCOPE, "Gyroscope", "rad/s", 1),
        (ACCELEROMETER, "Accelerometer", "m/s²", 4),
    ):
        if table.shape[1] > start:
            streams[key] = Stream(
                key=key,
                name=name,
                unit=unit,
                times_s=times_s,
                values=table[:, start : start + 3],
                rate_hz=rate_hz,
                gaps_s=(
                    *gaps_of(times_s, rate_hz),
                    *saturated_stretches(key, times_s, table[:, start : start + 3]),
                ),
            )
    return CameraTelemetry(source=source, streams=streams)  # type: ignore[arg-type]
