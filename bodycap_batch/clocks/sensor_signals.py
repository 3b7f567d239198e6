"""What the inertial sensor of a camera measures that other places of the body measure, too.

The vertical acceleration and the turn rate about the vertical do not depend on how a camera is mounted. A
step shakes the whole body along the vertical, and a person who turns takes all limbs along.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.telemetry.streams import CameraTelemetry, Stream

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

RATE_HZ = 100.0
"""Samples per second of the signals. Origin: 25 times the highest frequency that is compared."""
_VERTICAL_S = 2.0
"""Standard deviation, seconds, of the window in which the mean specific force is the vertical. Origin: the
mean acceleration of a person over some seconds is small, and a gyroscope turns by less than 2 degrees in them
due to its bias. Evidence: none."""
_MIN_SECONDS = 4.0
"""Minimum duration of a recording that is compared, seconds. Evidence: docs/decisions/clocks.md."""
_MAX_MISSING = 0.2
"""Maximum share of a recording in which the sensor has no samples or is at the end of its range. The signals
are straight lines there. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorTrack:
    """The signals of the inertial sensor of one camera.

    Attributes:
        camera: Name of the camera.
        start_s: Time of the first sample on the clock of the camera, seconds.
        vertical: (N,) specific force along the vertical at `RATE_HZ`, m/s².
        turn: (N,) turn rate about the vertical, rad/s.
        model: What the file says about the camera; "" if it says nothing.
        problem: Reason why the sensor cannot be used; empty if it can be used.
    """

    camera: str
    start_s: float = 0.0
    vertical: FloatArray = field(default_factory=lambda: np.zeros(0), repr=False)
    turn: FloatArray = field(default_factory=lambda: np.zeros(0), repr=False)
    model: str = ""
    problem: str = ""


def sensor_track(camera: str, telemetry: CameraTelemetry) -> SensorTrack:
    """Return the signals of the inertial sensor of a camera.

    Args:
        camera: Name of the camera.
        telemetry: The telemetry of the camera.
    """
    from scipy.ndimage import gaussian_filter1d

    problem = _problem_of(telemetry)
    force, rate = telemetry.accelerometer, telemetry.gyro
    if problem or force is None or rate is None:
        return SensorTrack(camera=camera, problem=problem)
    start_s, end_s = _common_s(force, rate)
    edges_s = start_s + np.arange(int((end_s - start_s) * RATE_HZ) + 1) / RATE_HZ
    forces, rates = _means(force, edges_s), _means(rate, edges_s)
    turns = _orientations(rates / RATE_HZ)
    forces, rates = turns.apply(forces), turns.apply(rates)
    up = gaussian_filter1d(forces, _VERTICAL_S * RATE_HZ, axis=0, mode="nearest")
    up /= np.maximum(np.linalg.norm(up, axis=1, keepdims=True), 1e-9)
    return SensorTrack(
        camera=camera,
        start_s=start_s + 0.5 / RATE_HZ,
        vertical=np.einsum("ni,ni->n", forces, up),
        turn=np.einsum("ni,ni->n", rates, up),
        model=telemetry.model,
    )


def _problem_of(telemetry: CameraTelemetry) -> str:
    """Return why the inertial sensor cannot be used; "" if it can be used."""
    force, rate = telemetry.accelerometer, telemetry.gyro
    if force is None or rate is None:
        missing = "accelerometer" if force is None else "gyroscope"
        return f"there are no samples of {'an' if force is None else 'a'} {missing}"
    if not telemetry.axes_known:
        return "the axes of the inertial sensor are unknown"
    start_s, end_s = _common_s(force, rate)
    if end_s - start_s < _MIN_SECONDS:
        return f"the inertial samples last less than {_MIN_SECONDS:g} s"
    for stream in (force, rate):
        missing_s = sum(max(0.0, min(end, end_s) - max(start, start_s)) for start, end in stream.gaps_s)
        if missing_s > _MAX_MISSING * (end_s - start_s):
            return f"{missing_s:.1f} s of the inertial samples are missing or at the end of the range"
    return ""


def _common_s(force: Stream, rate: Stream) -> tuple[float, float]:
    """Return start and end of the time in which both streams have samples, seconds."""
    start_s = max(float(force.times_s[0]), float(rate.times_s[0]))
    return start_s, min(float(force.times_s[-1]), float(rate.times_s[-1]))


def _means(stream: Stream, edges_s: FloatArray) -> FloatArray:
    """Return the mean (N,3) of a stream in each interval between N + 1 edges."""
    steps = 0.5 * np.diff(stream.times_s)[:, None] * (stream.values[1:] + stream.values[:-1])
    summed = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    at_edges = np.column_stack([np.interp(edges_s, stream.times_s, column) for column in summed.T])
    return np.asarray(np.diff(at_edges, axis=0) / np.diff(edges_s)[:, None])


def _orientations(turns_rad: FloatArray) -> Rotation:
    """Return the orientation after each of N turns (N,3), in the axes before the first one."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = 0.0, 0.0, 0.0, 1.0
    quats = []
    for a, b, c, d in Rotation.from_rotvec(turns_rad).as_quat().tolist():
        x, y, z, w = (
            w * a + x * d + y * c - z * b,
            w * b - x * c + y * d + z * a,
            w * c + x * b - y * a + z * d,
            w * d - x * a - y * b - z * c,
        )
        quats.append((x, y, z, w))
    return Rotation.from_quat(quats)
