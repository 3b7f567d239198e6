"""The options of the inertial sensors of a synthetic capture."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from bodycap_batch.config.bounds import MAX_ANGLE_DEG
from bodycap_batch.config.options import Options

_MAX_RATE_HZ = 2000.0
"""Maximum samples per second of an inertial sensor. Sensors of cameras have 100 to 1,600. Evidence: none."""
_MAX_DELAY_S = 1.0
"""Maximum delay of an inertial sensor, seconds. Evidence: none."""
_PERFECT = {
    "gyro_noise_rad_s": 0.0,
    "accelerometer_noise_m_s2": 0.0,
    "gyro_bias_rad_s": 0.0,
    "accelerometer_bias_m_s2": 0.0,
    "turned_deg": 0.0,
    "late_s": 0.0,
}
"""Options of a sensor without errors."""


class ImuOptions(Options):
    """Inertial sensors that are written beside the videos, by default those of a consumer's camera."""

    rate_hz: float = Field(200.0, ge=10.0, le=_MAX_RATE_HZ, description="samples per second")
    gyro_noise_rad_s: float = Field(
        0.004,
        ge=0,
        le=10,
        description="white noise of each sample of the gyroscope at 100 samples per second, in rad/s; at "
        "another rate it grows with the root of the rate",
    )
    accelerometer_noise_m_s2: float = Field(
        0.03, ge=0, le=100, description="the same of the accelerometer, in m/s²"
    )
    gyro_bias_rad_s: float = Field(
        0.01, ge=0, le=1, description="standard deviation of the gyroscope's bias, per axis, in rad/s"
    )
    accelerometer_bias_m_s2: float = Field(
        0.1, ge=0, le=10, description="standard deviation of the accelerometer's bias, per axis, in m/s²"
    )
    gyro_range_deg_s: float = Field(
        2000.0, gt=0, le=100_000, description="largest angular rate that the sensor measures, in degrees/s"
    )
    accelerometer_range_g: float = Field(
        16.0, gt=0, le=1000, description="largest acceleration that the sensor measures, in multiples of g"
    )
    turned_deg: float = Field(
        2.0, ge=0, le=MAX_ANGLE_DEG, description="angle between the sensor and the camera, in degrees"
    )
    late_s: float = Field(
        0.008,
        ge=-_MAX_DELAY_S,
        le=_MAX_DELAY_S,
        description="the sensor's time stamp of an instant is later than the camera's by this, in seconds",
    )


def imu_from_word(value: Any) -> Any:
    """Return the options for a word: ``true`` or ``consumer``, ``perfect``, ``false``."""
    if value is True or value == "consumer":
        return {}
    if value == "perfect":
        return _PERFECT
    return None if value is False else value
