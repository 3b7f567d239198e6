"""Write the samples of inertial sensors that ride on the cameras of a synthetic capture.

The samples follow from the continuous motion, not from the frames.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.formats.atomic_files import write_text
from bodycap_batch.model.geometry import so3_exp, so3_log
from bodycap_batch.model.gravity import GRAVITY_M_S2, STANDARD_GRAVITY_M_S2
from bodycap_batch.synthetic.options import ImuOptions

_NOISE_RATE_HZ = 100.0
"""Samples per second to which the noise in the options refers."""
_STEP_S = 0.01
"""Step (seconds) of the second difference that gives accelerations, or one sample if that is longer. It acts
as a low-pass filter of 50 Hz, as consumer's sensors have one. A recorded motion moves straight from frame to
frame; a shorter step would turn each frame into a blow. Evidence: none."""


def write_imu(
    folder: Path,
    camera: str,
    options: ImuOptions,
    seconds: float,
    world_from_cam_at: Callable[[FloatArray], FloatArray],
    rng: np.random.Generator,
) -> None:
    """Write ``<camera>.imu.csv`` and the truth about the sensor, ``gt/<camera>.imu.json``.

    Args:
        folder: Folder of the capture.
        camera: Name of the camera.
        options: The options of the sensor.
        seconds: Length of the recording on the clock of the camera, seconds.
        world_from_cam_at: Function that returns the poses (T,4,4) of the camera at times (T,) on its clock,
            seconds.
        rng: Source of randomness for bias, rotation and noise.
    """
    axis = rng.normal(size=3)
    cam_from_sensor = so3_exp(np.radians(options.turned_deg) * axis / np.linalg.norm(axis))
    biases = [
        rng.normal(0.0, 1.0, 3) * sigma
        for sigma in (options.gyro_bias_rad_s, options.accelerometer_bias_m_s2)
    ]
    times_s = np.arange(int(seconds * options.rate_hz) + 1) / options.rate_hz
    rate, force = true_samples(times_s, 1.0 / options.rate_hz, world_from_cam_at)
    grown = np.sqrt(options.rate_hz / _NOISE_RATE_HZ)
    columns = []
    for values, bias, noise, limit in (
        (rate, biases[0], options.gyro_noise_rad_s, np.radians(options.gyro_range_deg_s)),
        (
            force,
            biases[1],
            options.accelerometer_noise_m_s2,
            options.accelerometer_range_g * STANDARD_GRAVITY_M_S2,
        ),
    ):
        measured = values @ cam_from_sensor + bias + rng.normal(0.0, 1.0, values.shape) * noise * grown
        columns.append(np.clip(measured, -limit, limit))
    rows = np.column_stack([times_s + options.late_s, *columns])
    lines = [",".join(f"{value:.6f}" for value in row) for row in rows.tolist()]
    write_text(folder / f"{camera}.imu.csv", "t_s,gx,gy,gz,ax,ay,az\n" + "\n".join(lines) + "\n")
    truth = {
        "cam_from_sensor": cam_from_sensor.tolist(),
        "gyro_bias_rad_s": biases[0].tolist(),
        "accelerometer_bias_m_s2": biases[1].tolist(),
        "late_s": options.late_s,
    }
    write_text(folder / "gt" / f"{camera}.imu.json", json.dumps(truth, indent=1) + "\n")


def true_samples(
    times_s: FloatArray, interval_s: float, world_from_cam_at: Callable[[FloatArray], FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return angular rates and specific forces in the frame of the camera, without errors.

    Args:
        times_s: (N,) times on the clock of the camera, seconds.
        interval_s: Interval of the samples, seconds. A rate is the mean over it.
        world_from_cam_at: As in `write_imu`.

    Returns:
        (N,3) angular rates, rad/s, and (N,3) specific forces, m/s²: at rest, 9.81 upwards.
    """
    before, after = (world_from_cam_at(times_s + sign * 0.5 * interval_s) for sign in (-1.0, 1.0))
    turned = np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]
    rate = so3_log(turned) / interval_s
    step_s = max(interval_s, _STEP_S)
    early, now, late = (world_from_cam_at(times_s + shift) for shift in (-step_s, 0.0, step_s))
    acceleration = (early[:, :3, 3] - 2.0 * now[:, :3, 3] + late[:, :3, 3]) / step_s**2
    force_in_world = acceleration + np.array([0.0, 0.0, GRAVITY_M_S2])
    force = np.einsum("nij,ni->nj", now[:, :3, :3], force_in_world)
    return np.asarray(rate, dtype=np.float64), np.asarray(force, dtype=np.float64)
