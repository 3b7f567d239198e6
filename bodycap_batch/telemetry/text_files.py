"""Files of text with the samples of an inertial sensor, beside the videos of a camera.

``<camera>.imu.csv`` has a header and the columns ``t_s,gx,gy,gz,ax,ay,az``: seconds on the clock of the
camera, rad/s and m/s², in OpenCV's axes (x right, y down, z forward). ``<camera>.gcsv`` is Gyroflow's text
format.

A line that is no sample is left out and counted in a note. Times are compared with those of the video.
"""

from __future__ import annotations

import bisect
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.core.text_encoding import decode_text
from bodycap_batch.model.gravity import STANDARD_GRAVITY_M_S2
from bodycap_batch.telemetry.streams import (
    ACCELEROMETER,
    GYROSCOPE,
    CameraTelemetry,
    Stream,
    TelemetrySource,
    gaps_of,
)

_TIME_UNITS_S = {"t": 1.0, "time": 1.0, "t_s": 1.0, "t_ms": 1e-3, "t_us": 1e-6, "t_ns": 1e-9}
"""Unit, seconds, of the first column, by its name. In a Gyroflow file, ``tscale`` gives it."""
_GYROSCOPE_NAMES = (("gx", "gy", "gz"), ("rx", "ry", "rz"))
_ACCELEROMETER_NAMES = ("ax", "ay", "az")
_GYROFLOW_TITLES = ("GYROFLOW IMU LOG", "CAMERA IMU LOG")
_DEFAULT_SCALES = {"tscale": 0.001, "gscale": 1.0, "ascale": 1.0}
"""Scales of a Gyroflow file that does not state them. Source: Gyroflow's own reader."""
_ENTRY = re.compile(r'[\s"]*(\w+)[\s"]*[,;:\t](.*)')
"""Name and value of an entry of a Gyroflow header."""
_MAX_BYTES = 512 << 20
"""Maximum size (bytes) of a file. An hour at 1,000 samples per second has 300 MB. Evidence: none."""
_MAX_HEADER_LINES = 200
"""Maximum number of lines of a Gyroflow file before its table. Real files have some ten."""
_MAX_ABS_TIME_S = 4e9
"""Maximum absolute time, seconds: later than the Unix time of any recording."""
_MAX_ABS_VALUE = 1e6
"""Maximum absolute rate (rad/s) or acceleration (m/s²) that is read; sensors end near 70 and 160."""
_LONELY_RATIO = 1000.0
"""Distance of a sample from both neighbours, as a multiple of the median interval, above which its time is
wrong. Origin: 5 s at 200 samples per second; no logger pauses before and after a single sample."""
_PLAUSIBLE_HZ = (10.0, 10_000.0)
"""Least and greatest plausible number of samples per second. Derivation: sensors of cameras and phones give
16 to 8,000; as the ends are a factor of 1,000 apart, only one of two units is plausible."""
_SHOWN = 40
"""Maximum number of characters of a faulty line in an error."""


def read_imu_file(path: Path, video_s: tuple[float, float] | None = None) -> CameraTelemetry:
    """Read a file with inertial samples. Its times are on the clock of the camera.

    Args:
        path: Path of the file.
        video_s: Time of the first and of the last frame on the clock of the camera, seconds; None if it is
            unknown. It shows whether the times of the file are in the unit that the file states.

    Raises:
        CaptureError: The file cannot be read, most of its lines are no samples, or its times and those of the
            video have nothing in common.
    """
    lines = _lines_of(path)
    header = _header(path, lines)
    table, notes = _table(path, lines, header)
    if video_s is not None:
        factor = _time_factor(table[:, 0], video_s[1] - video_s[0])
        if factor != 1.0:
            notes.append(
                f"{path.name}: the times are multiplied by {factor:g}: as the file states them, they last "
                f"{np.ptp(table[:, 0]):.4g} s, and the video lasts {video_s[1] - video_s[0]:.4g} s"
            )
        table[:, 0] *= factor
    first_s, last_s = float(table[0, 0]), float(table[-1, 0])
    if max(abs(first_s), abs(last_s)) > _MAX_ABS_TIME_S:
        raise CaptureError("the times are not plausible", path=path, hint="write the times in seconds")
    if video_s is not None and (last_s < video_s[0] or video_s[1] < first_s):
        raise CaptureError(
            f"the samples are from {first_s:.3f} to {last_s:.3f} s, but the video is from "
            f"{video_s[0]:.3f} to {video_s[1]:.3f} s on the camera's clock",
            path=path,
            hint="give the times on the clock of the video: 0 is the start of the video",
        )
    if header.is_gyroflow:
        return _with_header(_telemetry(_in_stated_axes(table, header), "gcsv file", notes), header)
    return replace(_telemetry(table, "imu.csv file", notes), axes_known=True)


def _lines_of(path: Path) -> list[str]:
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise CaptureError(
                f"the file is larger than {_MAX_BYTES >> 20} MB",
                path=path,
                hint="write at most 1,000 samples per second, for the recording only",
            )
        return decode_text(path.read_bytes(), "replace").splitlines()
    except OSError as error:
        raise CaptureError(
            f"the inertial samples cannot be read ({error.strerror or error})",
            path=path,
            hint="correct the permissions, or remove the file",
        ) from error


@dataclass(frozen=True, slots=True)
class _Header:
    """What the lines before the table state.

    Attributes:
        values: The entries of a Gyroflow header, by name.
        table: Index of the first line of the table.
        separator: Character between two cells. If it is not the comma, numbers may have a decimal comma.
        columns: Index of the cell of the time, of the rates, and of the accelerations if there are any.
        factors: (C,) factor of each of these columns to seconds, rad/s and m/s².
        is_gyroflow: True for Gyroflow's format.
    """

    values: dict[str, str]
    table: int
    separator: str
    columns: tuple[int, ...]
    factors: FloatArray
    is_gyroflow: bool

    def cells(self, line: str) -> list[str]:
        """Return the cells of a line of the table."""
        if self.separator != ",":
            line = line.replace(",", ".")
        return line.replace('"', "").rstrip(self.separator + " \t").split(self.separator)


def _header(path: Path, lines: Sequence[str]) -> _Header:
    start = next((index for index, line in enumerate(lines) if line.strip(',; \t"')), 0)
    title = lines[start].strip(' \t"').upper() if lines else ""
    is_gyroflow = title.startswith(_GYROFLOW_TITLES)
    if not is_gyroflow and path.suffix.lower() == ".gcsv":
        raise CaptureError(
            f"the file does not start with {_GYROFLOW_TITLES[0]}" if title else "the file is empty",
            path=path,
            line=1,
            hint="export the samples in Gyroflow's format, or write a file <camera>.imu.csv",
        )
    values: dict[str, str] = {}
    for index, line in enumerate(lines[start : start + _MAX_HEADER_LINES], start=start):
        separator = next((mark for mark in ";\t" if mark in line), ",")
        names = [cell.strip(' "').lower() for cell in line.split(separator)]
        gyroscope = next((names_ for names_ in _GYROSCOPE_NAMES if set(names_) <= set(names)), None)
        if names[0] in _TIME_UNITS_S and gyroscope is not None:
            force = _ACCELEROMETER_NAMES if set(_ACCELEROMETER_NAMES) <= set(names) else ()
            columns = (0, *(names.index(name) for name in (*gyroscope, *force)))
            factors = [_TIME_UNITS_S[names[0]], 1.0, 1.0]
            if is_gyroflow:
                factors = [_scale(path, values, name) for name in _DEFAULT_SCALES]
                factors[2] *= STANDARD_GRAVITY_M_S2  # accelerations of Gyroflow files are in multiples of g
            each = np.repeat(factors, (1, 3, 3))[: len(columns)]
            return _Header(values, index + 1, separator, columns, each, is_gyroflow)
        if (entry := _ENTRY.match(line)) is not None:
            values[entry[1].lower()] = entry[2].strip(' \t",;')
        if not is_gyroflow and line.strip() and not line.startswith("#"):
            break
    raise CaptureError(
        "no line names the columns of inertial samples" if title else "the file is empty",
        path=path,
        line=None if is_gyroflow else start + 1,
        hint="write the columns t_s,gx,gy,gz,ax,ay,az: seconds on the camera's clock, rad/s, m/s²; in "
        "Gyroflow's format t,gx,gy,gz,ax,ay,az",
    )


def _scale(path: Path, values: dict[str, str], name: str) -> float:
    """Return a scale of a Gyroflow header as a positive number."""
    if name not in values:
        return _DEFAULT_SCALES[name]
    text = values[name]
    try:
        value = float(text.replace(",", "."))
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


def _table(path: Path, lines: Sequence[str], header: _Header) -> tuple[FloatArray, list[str]]:
    """Return the samples (N,C) in seconds, rad/s and m/s², in the order of time, and notes about wrong lines.

    Raises:
        CaptureError: Fewer than two lines are samples, or fewer than the lines that are none.
    """
    wrong: dict[int, str] = {}
    numbers: list[int] = []
    rows: list[list[float]] = []
    counts: list[int] = []
    for number, line in enumerate(lines[header.table :], start=header.table + 1):
        if not line.strip() or line.startswith("#"):
            continue
        cells = header.cells(line)
        try:
            rows.append([float(cells[column]) for column in header.columns])
        except (ValueError, IndexError):
            wrong[number] = f"does not have {len(header.columns)} numbers"
            continue
        numbers.append(number)
        counts.append(len(cells))
    table = np.array(rows).reshape(-1, len(header.columns)) * header.factors
    used = np.arange(len(table))

    def leave_out(is_right: BoolArray, what: str) -> None:
        nonlocal used
        wrong.update((numbers[index], what) for index in used[~is_right].tolist())
        used = used[is_right]

    leave_out(np.array(counts) <= np.median(counts or [0]), "has more numbers than other lines")
    limits = np.array([1e9 * _MAX_ABS_TIME_S, *[_MAX_ABS_VALUE] * 6])[: table.shape[1]]
    leave_out(np.all(np.abs(table[used]) <= limits, axis=1), "is not a plausible inertial sample")
    leave_out(_in_order(table[used, 0]), "is not later than the sample before it")
    leave_out(~_is_lonely(table[used, 0]), "has a time far from those of other lines")
    if not wrong and len(used) < 2:
        raise CaptureError(
            "the file has fewer than two inertial samples", path=path, hint="record again, or remove the file"
        )
    if not wrong:
        return table, []
    first = min(wrong)
    text = f"{lines[first - 1].strip()[:_SHOWN]!r} {wrong[first]}"
    if len(used) < max(2, len(wrong)):
        raise CaptureError(
            f"{text}; {len(wrong)} of {len(used) + len(wrong)} lines are no samples",
            path=path,
            line=first,
            hint="write one sample on each line, in the order of time, with commas between the numbers",
        )
    what = "line is" if len(wrong) == 1 else "lines are"
    return table[used], [f"{path.name}: {len(wrong)} {what} not used: line {first}, {text}"]


def _in_order(times_s: FloatArray) -> BoolArray:
    """Return a mask (N,) of the longest series of samples whose times increase."""
    mask = np.ones(len(times_s), dtype=bool)
    if (np.diff(times_s) > 0).all():
        return mask
    mask[:] = False
    # `ends` holds the least time with which a series of each length can end; `last` holds its last sample.
    ends: list[float] = []
    last: list[int] = []
    before: list[int] = []
    for index, time_s in enumerate(times_s.tolist()):
        length = bisect.bisect_left(ends, time_s)
        before.append(last[length - 1] if length else -1)
        if length == len(ends) or time_s < ends[length]:
            ends[length : length + 1] = [time_s]
            last[length : length + 1] = [index]
    at = last[-1]
    while at >= 0:
        mask[at], at = True, before[at]
    return mask


def _is_lonely(times_s: FloatArray) -> BoolArray:
    """Return a mask (N,) of the samples that are far from the samples before and after them."""
    if len(times_s) < 2:
        return np.zeros(len(times_s), dtype=bool)
    steps_s = np.diff(times_s)
    is_far = np.concatenate([[True], steps_s > _LONELY_RATIO * np.median(steps_s), [True]])
    return np.asarray(is_far[:-1] & is_far[1:])


def _time_factor(times_s: FloatArray, video_s: float) -> float:
    """Return the power of 1,000 by which times must be multiplied to be seconds; usually 1.

    Milliseconds that are read as seconds give a rate that no sensor has, and a duration that is not that of
    the video. Only if both say so, the stated unit is not believed.

    Args:
        times_s: (N,) times in the unit that the file states, seconds.
        video_s: Duration of the video, seconds.
    """
    least_hz, most_hz = _PLAUSIBLE_HZ
    rate_hz = 1.0 / float(np.median(np.diff(times_s)))
    if least_hz <= rate_hz < most_hz or video_s <= 0.0:
        return 1.0
    factor = float(1000.0 ** -round(math.log(float(np.ptp(times_s)) / video_s, 1000.0)))
    return factor if least_hz <= rate_hz / factor < most_hz else 1.0


def _with_header(telemetry: CameraTelemetry, header: _Header) -> CameraTelemetry:
    """Return the telemetry with the camera that a Gyroflow header names."""
    values = header.values
    return replace(
        telemetry,
        model=" ".join(part for part in (values.get("vendor", ""), values.get("id", "")) if part)[:100],
        firmware=values.get("fwversion", "")[:100],
        settings={name[:40]: value[:200] for name, value in values.items()},
    )


def _in_stated_axes(table: FloatArray, header: _Header) -> FloatArray:
    """Return the samples (N,C) with their axes in the stated order: letter i is the axis of value i."""
    axes = header.values.get("orientation", "")
    if sorted(axes.upper()) != ["X", "Y", "Z"]:
        return table
    out = table.copy()
    for start in range(1, table.shape[1], 3):
        for index, letter in enumerate(axes):
            sign = 1.0 if letter.isupper() else -1.0
            out[:, start + index] = sign * table[:, start + "XYZ".index(letter.upper())]
    return out


def _telemetry(table: FloatArray, source: TelemetrySource, notes: Sequence[str]) -> CameraTelemetry:
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
                gaps_s=gaps_of(key, times_s, table[:, start : start + 3], rate_hz),
            )
    return CameraTelemetry(source=source, streams=streams, notes=tuple(notes))
