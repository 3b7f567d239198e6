"""Samples of an inertial sensor in the axes and on the clock of its camera, and rotations from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, interpolated, set_array
from bodycap_batch.model.geometry import so3_exp, so3_log
from bodycap_batch.model.gyro_rates import GyroOrientation
from bodycap_batch.telemetry.gyro_fit import GyroFit
from bodycap_batch.telemetry.streams import Stream


@dataclass(frozen=True, slots=True, kw_only=True)
class InertialSamples:
    """Samples of an inertial sensor in the axes and on the clock of its camera.

    Attributes:
        times_s: (N,) time of each sample on the clock of the camera's frames, seconds.
        rate_rad_s: (N,3) angular rate in the axes of the camera, without the estimated bias, rad/s.
        force_m_s2: (N,3) specific force in the axes of the camera, m/s²; at rest, 9.81 upwards. NaN where
            the accelerometer has no sample near.
        gaps_s: Start and end of each stretch without samples, seconds.
    """

    times_s: FloatArray
    rate_rad_s: FloatArray
    force_m_s2: FloatArray
    gaps_s: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        count = len(self.times_s)
        set_array(self, "times_s", (count,))
        set_array(self, "rate_rad_s", (count, 3))
        set_array(self, "force_m_s2", (count, 3), finite=False)

    def covers(self, start_s: FloatArray, end_s: FloatArray) -> BoolArray:
        """Return for each interval (N,) whether samples without a gap cover it."""
        inside = (start_s >= self.times_s[0]) & (end_s <= self.times_s[-1])
        for first_s, last_s in self.gaps_s:
            inside &= (end_s <= first_s) | (start_s >= last_s)
        return np.asarray(inside)


def samples_of_fit(gyro: Stream, accelerometer: Stream | None, fit: GyroFit) -> InertialSamples:
    """Return the samples of a sensor in the axes and on the clock of its camera.

    Args:
        gyro: The gyroscope.
        accelerometer: The accelerometer; None if there is none.
        fit: The relation of the gyroscope to the camera.
    """
    times_s, rate_rad_s = fit.in_camera(gyro)
    gaps_s = gyro.gaps_s
    force = np.full(gyro.values.shape, np.nan)
    if accelerometer is not None and len(accelerometer.times_s) > 1:
        gaps_s += accelerometer.gaps_s
        inside = (gyro.times_s >= accelerometer.times_s[0]) & (gyro.times_s <= accelerometer.times_s[-1])
        force[inside] = interpolated(gyro.times_s[inside], accelerometer.times_s, accelerometer.values)
    return InertialSamples(
        times_s=times_s,
        rate_rad_s=rate_rad_s,
        force_m_s2=force @ fit.cam_from_sensor.T,
        gaps_s=tuple((start_s - fit.delay_s, end_s - fit.delay_s) for start_s, end_s in gaps_s),
    )


def pinned_orientations(
    gyro: GyroOrientation, frame_s: FloatArray, rotation: FloatArray, times_s: FloatArray
) -> FloatArray:
    """Return orientations (T,3,3) that equal solved ones at the frames and follow the gyroscope between them.

    The difference at the next frame is distributed evenly over the time: the most likely course for white
    noise.

    Args:
        gyro: The orientation from the gyroscope alone.
        frame_s: (N,) times of the frames with a pose, increasing, seconds.
        rotation: (N,3,3) solved rotations gauge_from_cam.
        times_s: (T,) requested times, seconds. Outside the frames, the nearest difference holds.
    """
    correction = rotation @ np.swapaxes(gyro.at(frame_s), 1, 2)
    after = np.clip(np.searchsorted(frame_s, times_s), 1, len(frame_s) - 1)
    before = after - 1
    share = np.clip((times_s - frame_s[before]) / (frame_s[after] - frame_s[before]), 0.0, 1.0)
    turn = so3_log(np.swapaxes(correction[before], 1, 2) @ correction[after])
    return np.asarray(correction[before] @ so3_exp(share[:, None] * turn) @ gyro.at(times_s))
