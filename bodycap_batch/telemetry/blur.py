"""Predict the motion blur of each frame from its exposure time and the turn rate of the camera."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.telemetry.streams import CameraTelemetry

_MAX_DISTANCE = 0.6
"""Maximum distance of an exposure from its frame, in intervals of its stream: half, and some rounding."""
_ROLL_RATIO = 0.5
"""Effect of a turn about the optical axis, as a ratio of that of a turn about another axis: the mean distance
of pixels from the centre, as a ratio of a usual focal length. Evidence: none."""
_MAX_EXPOSURE_S = 1.0
"""Maximum exposure time of a frame of a video, seconds. A longer one is an error of the file."""


def predicted_blur_px(times_s: FloatArray, lens: Camera, telemetry: CameraTelemetry) -> FloatArray | None:
    """Return the length (N,) of the motion blur near the centre of each frame, pixels.

    The translation of the camera is ignored. The delay of the gyroscope is not known yet; it is short
    compared with a turn of a body.

    Args:
        times_s: (N,) times of the frames, seconds.
        lens: Intrinsics of the camera.
        telemetry: The telemetry of the camera.

    Returns:
        The lengths; NaN for a frame without samples. None if the file states no exposure times, or if there
        is no gyroscope.
    """
    gyro, exposure = telemetry.gyro, telemetry.exposure
    if gyro is None or exposure is None or len(gyro.times_s) < 2 or not len(exposure.times_s):
        return None
    after = np.clip(np.searchsorted(exposure.times_s, times_s), 0, len(exposure.times_s) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(exposure.times_s[before] - times_s) < np.abs(exposure.times_s[after] - times_s)
    row = np.where(nearer, before, after)
    seconds = exposure.values[row, 0]
    known = np.abs(exposure.times_s[row] - times_s) <= _MAX_DISTANCE / exposure.rate_hz
    known &= (seconds > 0.0) & (seconds < _MAX_EXPOSURE_S)
    known &= (times_s >= gyro.times_s[0]) & (times_s <= gyro.times_s[-1])
    for start_s, end_s in gyro.gaps_s:
        known &= (times_s < start_s) | (times_s > end_s)
    steps = 0.5 * (gyro.values[1:] + gyro.values[:-1]) * np.diff(gyro.times_s)[:, None]
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    turn = np.stack(
        [
            np.interp(times_s + 0.5 * seconds, gyro.times_s, column)
            - np.interp(times_s - 0.5 * seconds, gyro.times_s, column)
            for column in total.T
        ],
        axis=1,
    )
    if telemetry.axes_known:
        turn = turn * [1.0, 1.0, _ROLL_RATIO]
    return np.where(known, lens.focal_px * np.linalg.norm(turn, axis=1), np.nan)
