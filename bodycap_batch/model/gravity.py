"""The vertical, the metric scale and the biases that inertial sensors and solved paths give together.

For each window: force − rotation · bias − turned_force · turn = scale · acceleration + lever · distance +
gravity · up. Up (with the magnitude of gravity) and scale are common to all cameras of a map; bias, turn and
distance of the sensor belong to a camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray, set_array
from bodycap_batch.model.inertial_camera import ForceWindows

GRAVITY_M_S2 = 9.81
"""Magnitude of gravity, m/s². It varies by 0.3 % on Earth."""
STANDARD_GRAVITY_M_S2 = 9.80665
"""Standard acceleration of gravity, m/s²: the unit g of accelerometers."""
_GRAVITY_SIGMA_M_S2 = 0.1
"""Standard deviation (m/s²) of the measured magnitude of gravity: the place on Earth, and the scale error of
consumer's accelerometers, 1 %."""
_BIAS_SIGMA_M_S2 = 0.15
"""Standard deviation (m/s²) of an accelerometer's bias, per axis. Origin: consumer sensors state up to 60 mg
without and 10 to 20 mg with a calibration."""
_LEVER_SIGMA_M = 0.03
"""Standard deviation (metres) of the distance between sensor and lens, per axis: half of a small camera."""
_MIN_ROTATION_SIGMA_RAD = 0.002
"""Minimum standard deviation (radians) of the rotation between sensor and camera. Evidence: none."""
_MIN_WINDOWS = 5
"""Minimum number of windows for a fit: 2.4 s. Evidence: none."""
_ROUNDS = 8
"""Number of times that robust weights are computed. Evidence: none."""
_MIN_NOISE_M_S2 = 0.01
"""Minimum standard deviation (m/s²) of a window's residual, per axis. Evidence: none."""
_MAX_AUTOCORRELATION = 0.95
"""Largest autocorrelation of the residuals of successive windows that is believed. Evidence: none."""
_PRIOR_SCALE_WEIGHT = 1e-6
"""Weight that keeps the equations regular if nothing moves, so that the scale is unknown."""
_SENSITIVITY_SIGMA = 0.01
"""Standard deviation of the sensitivity of an axis of an accelerometer, as a share. The axes of all cameras
are independent. Origin: as in `_GRAVITY_SIGMA_M_S2`. Evidence: docs/decisions/telemetry.md."""
_MAX_LEVERAGE = 0.9
"""Maximum leverage of a window that is believed. Beyond it, the residual says nothing. Evidence: none."""
_MAX_NOISE_SHARE = 0.5
"""Largest share of the information about the scale that is believed to be noise. Evidence: none."""
_SMALLEST = 1e-18
"""Smallest divisor. It prevents a division by zero."""
_OWN = 9
"""Number of unknowns of a camera: bias, distance, turn."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GravityFit:
    """What the windows of the cameras of one map determine.

    Attributes:
        up: (3,) unit vector upwards in the axes of the gauge.
        sigma_deg: Standard deviation of its direction, degrees: the larger one of two axes.
        gravity_m_s2: Magnitude of the measured gravity.
        metres_per_unit: Metric scale of the gauge.
        scale_sigma: Standard deviation of its logarithm; infinity if it is unknown.
        windows: Number of windows.
        solution: (4+9C,) up · gravity, scale, and per camera bias, distance, turn.
        covariance: (4+9C,4+9C) covariance of the solution.
    """

    up: FloatArray
    sigma_deg: float
    gravity_m_s2: float
    metres_per_unit: float
    scale_sigma: float
    windows: int
    solution: FloatArray
    covariance: FloatArray

    def __post_init__(self) -> None:
        set_array(self, "up", (3,))
        set_array(self, "solution", (None,))
        set_array(self, "covariance", (len(self.solution), len(self.solution)))


def fit_gravity(cameras: Sequence[ForceWindows]) -> GravityFit | None:
    """Estimate the vertical, the metric scale and the biases of the sensors.

    Args:
        cameras: The windows of each camera, in one gauge.

    Returns:
        The fit; None if there are too few windows.
    """
    cameras = [camera for camera in cameras if len(camera.times_s)]
    if sum(len(camera.times_s) for camera in cameras) < _MIN_WINDOWS:
        return None
    rows, values = _equations(cameras)
    prior = _prior_information(cameras)
    weight, noise = np.ones(len(values)), 1.0
    gravity_row = np.zeros(rows.shape[2])
    solution = np.zeros(rows.shape[2])
    for number in range(_ROUNDS):
        information = prior + np.einsum("nki,n,nkj->ij", rows, weight / noise**2, rows)
        vector = np.einsum("nki,n,nk->i", rows, weight / noise**2, values)
        if number:
            gravity_row[:3] = solution[:3] / np.linalg.norm(solution[:3]) / _GRAVITY_SIGMA_M_S2
            information += np.outer(gravity_row, gravity_row)
            vector += gravity_row * (GRAVITY_M_S2 / _GRAVITY_SIGMA_M_S2)
            of_scale = 1.0 / np.linalg.inv(information)[3, 3]
            of_noise = _path_noise(values - rows @ solution, weight, solution[3]) / noise**2
            information[3, 3] -= min(of_noise, _MAX_NOISE_SHARE * of_scale)
        solution = np.linalg.solve(information, vector)
        size = np.linalg.norm(values - rows @ solution, axis=1)
        size /= np.sqrt(1.0 - _leverage(rows, weight / noise**2, information))
        noise = max(1.2 * float(np.median(size)) / np.sqrt(3.0), _MIN_NOISE_M_S2)
        weight = 1.0 / (1.0 + (size / (2.5 * noise)) ** 2) ** 2
    covariance = np.linalg.inv(information) * _growth(cameras, values - rows @ solution, weight)
    covariance[3, 3] += (_SENSITIVITY_SIGMA * solution[3]) ** 2 / (3.0 * len(cameras))
    return _fit_of(solution, covariance, len(values))


def _path_noise(error: FloatArray, weight: FloatArray, scale: float) -> float:
    """Return by how much the noise of the solved paths raises the weighted sum of squared accelerations.

    The residuals (N,3) of a solution are the noise of the path times its scale, but for the noise that
    windows with exact poses have. Uncorrected, this sum makes the scale too small.

    Source: Fuller, "Measurement error models", 1987, section 1.2.
    """
    squared = (error**2).sum(axis=1) - 3.0 * _MIN_NOISE_M_S2**2
    return max(float(weight @ squared), 0.0) / max(scale**2, _SMALLEST)


def _leverage(rows: FloatArray, weight: FloatArray, information: FloatArray) -> FloatArray:
    """Return the share (N,) of its own residual that each window takes up by its influence on the solution.

    With few windows for each camera, the residuals are much smaller than the noise.
    """
    covariance = np.linalg.inv(information)
    taken = weight / 3.0 * np.einsum("nki,ij,nkj->n", rows, covariance, rows)
    return np.asarray(np.clip(taken, 0.0, _MAX_LEVERAGE))


def _fit_of(solution: FloatArray, covariance: FloatArray, windows: int) -> GravityFit:
    gravity = float(np.linalg.norm(solution[:3]))
    up = solution[:3] / gravity
    across = np.eye(3) - np.outer(up, up)
    spread = np.linalg.eigvalsh(across @ covariance[:3, :3] @ across)
    scale = float(solution[3])
    scale_sigma = float(np.sqrt(covariance[3, 3])) / scale if scale > 0.0 else np.inf
    return GravityFit(
        up=up,
        sigma_deg=float(np.degrees(np.sqrt(max(spread[-1], 0.0)) / gravity)),
        gravity_m_s2=gravity,
        metres_per_unit=scale,
        scale_sigma=scale_sigma,
        windows=windows,
        solution=solution,
        covariance=covariance,
    )


def _equations(cameras: Sequence[ForceWindows]) -> tuple[FloatArray, FloatArray]:
    """Return the rows (N,3,U) and the values (N,3) of all windows."""
    rows, unknowns = [], 4 + _OWN * len(cameras)
    for index, camera in enumerate(cameras):
        own = np.zeros((len(camera.times_s), 3, unknowns))
        own[:, :, :3] = np.eye(3)
        own[:, :, 3] = camera.acceleration
        first = 4 + _OWN * index
        own[:, :, first : first + 3] = camera.rotation
        own[:, :, first + 3 : first + 6] = camera.lever
        own[:, :, first + 6 : first + 9] = camera.turned_force
        rows.append(own)
    return np.concatenate(rows), np.concatenate([camera.force for camera in cameras])


def _prior_information(cameras: Sequence[ForceWindows]) -> FloatArray:
    """Return the information (U,U) of what is known beforehand; the means are zero."""
    parts = [np.full(3, 1e-9), np.array([_PRIOR_SCALE_WEIGHT])]
    for camera in cameras:
        parts += [sigma**-2.0 for sigma in prior_sigmas(camera.rotation_sigma_rad)]
    return np.diag(np.concatenate(parts))


def prior_sigmas(rotation_sigma_rad: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what is known of a sensor beforehand: standard deviations (3,) of bias, distance and turn.

    Args:
        rotation_sigma_rad: (3,) standard deviations of its rotation against the camera, radians.

    Returns:
        The standard deviations, m/s², metres and radians. The means are zero.
    """
    turn = np.maximum(rotation_sigma_rad, _MIN_ROTATION_SIGMA_RAD)
    return np.full(3, _BIAS_SIGMA_M_S2), np.full(3, _LEVER_SIGMA_M), turn


def _growth(cameras: Sequence[ForceWindows], error: FloatArray, weight: FloatArray) -> float:
    """Return the factor by which residuals (N,3) that last for several windows raise variances."""
    product, energy, first = 0.0, 0.0, 0
    root = np.sqrt(weight)[:, None] * error
    for camera in cameras:
        own = root[first : first + len(camera.times_s)]
        first += len(camera.times_s)
        product += float((own[1:] * own[:-1]).sum())
        energy += float((own**2).sum())
    correlation = min(max(product / max(energy, _SMALLEST), 0.0), _MAX_AUTOCORRELATION)
    return (1.0 + correlation) / (1.0 - correlation)
