"""Integrals of inertial samples between successive nodes, with the effect of biases and the noise.

Source: Forster, Carlone, Dellaert and Scaramuzza, "On-manifold preintegration for real-time visual-inertial
odometry", IEEE Transactions on Robotics 2017. The integrals are computed again for each estimate of the
biases, so their derivatives are exact to first order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray, interpolated
from bodycap_batch.inertial.samples import InertialSamples
from bodycap_batch.model.geometry import skew, so3_exp


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorNoise:
    """Noise densities of a sensor.

    Attributes:
        gyro: Noise density of the angular rate, rad/s/√Hz.
        force: Noise density of the specific force, m/s²/√Hz.
    """

    gyro: float
    force: float


@dataclass(frozen=True, slots=True)
class Steps:
    """The samples between N+1 nodes, as up to S steps for each of the N intervals.

    A step that an interval does not have has no duration.

    Attributes:
        duration_s: (N,S) duration of each step, seconds.
        rate: (N,S,3) mean angular rate, rad/s.
        force_start: (N,S,3) specific force at the start of each step, m/s².
        force_end: (N,S,3) the same at its end.
    """

    duration_s: FloatArray
    rate: FloatArray
    force_start: FloatArray
    force_end: FloatArray


@dataclass(frozen=True, slots=True)
class Preintegrated:
    """Integrals over N intervals in the axes at the start of each interval.

    Attributes:
        seconds: (N,) durations, seconds.
        rotation: (N,3,3) rotation from the start to the end.
        velocity: (N,3) integral of the specific force, m/s.
        position: (N,3) double integral of the specific force, metres.
        by_gyro_bias: (N,9,3) derivative of rotation (radians, at the end), velocity and position per bias of
            the gyroscope.
        by_force_bias: (N,9,3) the same per bias of the accelerometer.
        covariance: (N,9,9) covariance of rotation, velocity and position.
    """

    seconds: FloatArray
    rotation: FloatArray
    velocity: FloatArray
    position: FloatArray
    by_gyro_bias: FloatArray
    by_force_bias: FloatArray
    covariance: FloatArray


def steps_between(samples: InertialSamples, nodes_s: FloatArray) -> Steps:
    """Split the samples at the nodes.

    Args:
        samples: The samples, which must cover the nodes.
        nodes_s: (N+1,) increasing times of the nodes, seconds.
    """
    inside = samples.times_s[(samples.times_s > nodes_s[0]) & (samples.times_s < nodes_s[-1])]
    knots_s = np.unique(np.concatenate([nodes_s, inside]))
    rate, force = (
        interpolated(knots_s, samples.times_s, values) for values in (samples.rate_rad_s, samples.force_m_s2)
    )
    owner: IntArray = np.searchsorted(nodes_s, knots_s[:-1], side="right") - 1
    place = np.arange(len(owner)) - np.searchsorted(owner, owner)
    count, most = len(nodes_s) - 1, int(place.max()) + 1
    out = [np.zeros((count, most)), *(np.zeros((count, most, 3)) for _ in range(3))]
    for target, values in zip(
        out, (np.diff(knots_s), 0.5 * (rate[1:] + rate[:-1]), force[:-1], force[1:]), strict=True
    ):
        target[owner, place] = values
    return Steps(*out)


def preintegrate(
    steps: Steps, gyro_bias: FloatArray, force_bias: FloatArray, noise: SensorNoise
) -> Preintegrated:
    """Integrate the samples of all intervals.

    Args:
        steps: The samples between the nodes.
        gyro_bias: (3,) bias that is subtracted from the rate, rad/s.
        force_bias: (3,) bias that is subtracted from the specific force, m/s².
        noise: Noise of the sensor.
    """
    count, most = steps.duration_s.shape
    rotation = np.tile(np.eye(3), (count, 1, 1))
    velocity, position = np.zeros((count, 3)), np.zeros((count, 3))
    by_gyro, by_force = np.zeros((count, 9, 3)), np.zeros((count, 9, 3))
    covariance = np.zeros((count, 9, 9))
    for index in range(most):
        dt = steps.duration_s[:, index][:, None]
        turn = so3_exp((steps.rate[:, index] - gyro_bias) * dt)
        after = rotation @ turn
        start = np.einsum("nij,nj->ni", rotation, steps.force_start[:, index] - force_bias)
        end = np.einsum("nij,nj->ni", after, steps.force_end[:, index] - force_bias)
        mean = 0.5 * (start + end)
        # The perturbation multiplies the rotation from the right.
        mean_force = 0.5 * (steps.force_start[:, index] + steps.force_end[:, index]) - force_bias
        wide = dt[..., None]
        transition = np.tile(np.eye(9), (count, 1, 1))
        transition[:, :3, :3] = np.swapaxes(turn, 1, 2)
        transition[:, 3:6, :3] = -rotation @ skew(mean_force) * wide
        transition[:, 6:, :3] = 0.5 * transition[:, 3:6, :3] * wide
        transition[:, 6:, 3:6] = np.eye(3) * wide
        effect = np.zeros((count, 9, 6))
        effect[:, :3, :3] = np.eye(3)
        effect[:, 3:6, 3:] = rotation
        effect[:, 6:, 3:] = 0.5 * rotation * wide
        effect *= wide
        by_gyro = transition @ by_gyro - effect[:, :, :3]
        by_force = transition @ by_force - effect[:, :, 3:]
        density = np.repeat([noise.gyro**2, noise.force**2], 3) / np.maximum(dt, 1e-12)
        covariance = transition @ covariance @ np.swapaxes(transition, 1, 2)
        covariance += (effect * density[:, None, :]) @ np.swapaxes(effect, 1, 2)
        position = position + velocity * dt + 0.5 * mean * dt**2
        velocity = velocity + mean * dt
        rotation = after
    return Preintegrated(
        steps.duration_s.sum(axis=1), rotation, velocity, position, by_gyro, by_force, covariance
    )
