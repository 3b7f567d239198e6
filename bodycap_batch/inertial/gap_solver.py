"""Poses through a gap between solved poses, from inertial samples: least squares over a short stretch.

Unknowns are orientation, position and velocity of the sensor at every frame of the stretch, and what is
constant in it: biases, gravity, scale, and delay, distance and rotation of the sensor against the camera. The
constants have the prior that the whole clip gives.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, interpolated, set_array
from bodycap_batch.inertial.preintegration import (
    Preintegrated,
    SensorNoise,
    Steps,
    preintegrate,
    steps_between,
)
from bodycap_batch.inertial.samples import InertialSamples
from bodycap_batch.model.geometry import make_transform, skew, so3_exp, so3_log

_NODE = 9
"""Number of unknowns of a frame: orientation, position, velocity."""
GYRO_BIAS, FORCE_BIAS, GRAVITY = slice(0, 3), slice(3, 6), slice(6, 9)
"""Places in the vector of constants: biases (rad/s, m/s²), gravity upwards (m/s²)."""
LOG_SCALE, LEVER, DELAY, TURN = slice(9, 10), slice(10, 13), slice(13, 14), slice(14, 17)
"""Places of the logarithm of the metres per gauge unit, the position of the sensor relative to the lens
(metres), the delay of its samples (seconds), and its rotation against the camera (radians)."""
CONSTANTS = 17
"""Number of the constants."""
_MAX_ITERATIONS = 12
"""Maximum number of Gauss-Newton steps. Evidence: none."""
_CONVERGED = 1e-5
"""Largest change of the normalised unknowns at which the solution has converged. Evidence: none."""
_HUBER_SIGMAS = 2.5
"""Residual of a solved pose, in sigmas per axis, above which its weight decreases. Evidence: none."""
_WITHOUT_SAMPLES = 1e-8
"""Factor of the weight of an interval without samples, or with a sensor at the end of its range. It only
keeps the equations regular: a deviation of a metre counts as one of 0.1 mm."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Constants:
    """What is constant in a stretch, with its uncertainty.

    Attributes:
        mean: (17,) values in the order of the slices of this module.
        covariance: (17,17) covariance.
    """

    mean: FloatArray
    covariance: FloatArray

    def __post_init__(self) -> None:
        set_array(self, "mean", (CONSTANTS,))
        set_array(self, "covariance", (CONSTANTS, CONSTANTS))


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretch:
    """The frames of a stretch, before it is solved.

    Attributes:
        times_s: (N,) times of the frames, increasing, seconds.
        gauge_from_cam: (N,4,4) solved poses; any values at frames without a pose.
        covariance: (N,6,6) covariance of the poses in the axes of the camera, rotation before translation.
        known: (N,) True for frames with a solved pose. The first two and the last two must be known.
    """

    times_s: FloatArray
    gauge_from_cam: FloatArray
    covariance: FloatArray
    known: BoolArray


@dataclass(frozen=True, slots=True, kw_only=True)
class SolvedStretch:
    """The solution of a stretch.

    Attributes:
        gauge_from_cam: (N,4,4) poses of all frames in the gauge.
        covariance: (N,6,6) covariance in the axes of the camera, rotation before translation (gauge units).
        worst_fix: Largest residual of a solved pose, in sigmas of six axes together.
        worst_frame: Index of the frame with this residual.
        fix_sigmas: (F,) residuals of all solved poses, in the same unit.
        constants: (17,) the constants of the stretch.
    """

    gauge_from_cam: FloatArray
    covariance: FloatArray
    worst_fix: float
    worst_frame: int
    fix_sigmas: FloatArray
    constants: FloatArray


@dataclass(frozen=True, slots=True)
class _State:
    """The unknowns: rotation (N,3,3) and position (N,3) (metres) of the sensor, velocity (N,3), constants."""

    rotation: FloatArray
    position: FloatArray
    velocity: FloatArray
    constants: FloatArray

    def moved(self, step: FloatArray) -> _State:
        nodes = step[: _NODE * len(self.rotation)].reshape(-1, _NODE)
        return _State(
            self.rotation @ so3_exp(nodes[:, :3]),
            self.position + nodes[:, 3:6],
            self.velocity + nodes[:, 6:],
            self.constants + step[_NODE * len(self.rotation) :],
        )


def solve_stretch(
    stretch: Stretch, samples: InertialSamples, constants: Constants, noise: SensorNoise
) -> SolvedStretch:
    """Solve all poses of a stretch.

    Args:
        stretch: The frames with and without poses.
        samples: The samples, which must cover the stretch.
        constants: What the whole clip gives.
        noise: Noise of the sensor.

    Returns:
        The solution. The caller decides from `worst_fix` and the covariance whether it is used.
    """
    problem = _Problem(stretch, samples, constants, noise)
    state = problem.initial()
    for _ in range(_MAX_ITERATIONS):
        information, vector, _ = problem.linearise(state)
        scale = np.sqrt(np.diag(information))
        step = np.linalg.solve(information / np.outer(scale, scale), vector / scale)
        state = state.moved(step / scale)
        if float(np.abs(step).max()) < _CONVERGED * max(float(scale.max()), 1.0):
            break
    information, _, sizes = problem.linearise(state)
    return problem.result(state, information, sizes)


class _Problem:
    """The residuals of a stretch. Positions are relative to the mean of the known ones."""

    def __init__(
        self, stretch: Stretch, samples: InertialSamples, constants: Constants, noise: SensorNoise
    ) -> None:
        self._stretch, self._prior, self._noise = stretch, constants, noise
        self._fixes = np.flatnonzero(stretch.known)
        self._origin = stretch.gauge_from_cam[self._fixes, :3, 3].mean(axis=0)
        self._poses = stretch.gauge_from_cam[self._fixes].copy()
        self._poses[:, :3, 3] -= self._origin
        self._weights = np.linalg.inv(stretch.covariance[self._fixes])
        self._prior_information = np.linalg.inv(constants.covariance)
        self._steps: Steps = steps_between(samples, stretch.times_s)
        measured = samples.covers(stretch.times_s[:-1], stretch.times_s[1:])
        self._trust = np.where(measured, 1.0, _WITHOUT_SAMPLES)
        self._rate = interpolated(stretch.times_s, samples.times_s, samples.rate_rad_s)
        self._nodes = len(stretch.times_s)

    def initial(self) -> _State:
        """Return a start: orientations from the gyroscope, positions from a spline through the known ones."""
        from scipy.interpolate import CubicSpline

        times_s, mean = self._stretch.times_s, self._prior.mean
        spans = preintegrate(self._steps, mean[GYRO_BIAS], mean[FORCE_BIAS], self._noise)
        rotation = np.empty((self._nodes, 3, 3))
        by_frame = dict(zip(self._fixes.tolist(), self._poses[:, :3, :3], strict=True))
        for node in range(self._nodes):
            known = by_frame.get(node)
            rotation[node] = rotation[node - 1] @ spans.rotation[node - 1] if known is None else known
        scale = float(np.exp(mean[LOG_SCALE][0]))
        path = CubicSpline(times_s[self._fixes], scale * self._poses[:, :3, 3])
        position = path(times_s) + rotation @ mean[LEVER]
        return _State(rotation, position, np.asarray(path(times_s, 1)), mean.copy())

    def linearise(self, state: _State) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return information, vector, and the residuals (F,) of the solved poses in sigmas."""
        size = _NODE * self._nodes + CONSTANTS
        information, vector = np.zeros((size, size)), np.zeros(size)
        tail = slice(size - CONSTANTS, size)
        off = state.constants - self._prior.mean
        information[tail, tail] = self._prior_information
        vector[tail] = -self._prior_information @ off
        spans = preintegrate(
            self._steps, state.constants[GYRO_BIAS], state.constants[FORCE_BIAS], self._noise
        )
        residual, first, second, common = self._span_rows(state, spans)
        weight = np.linalg.inv(spans.covariance + 1e-14 * np.eye(_NODE)) * self._trust[:, None, None]
        for node in range(self._nodes - 1):
            start = _NODE * node
            jacobian = np.concatenate([first[node], second[node], common[node]], axis=1)
            columns = np.r_[start : start + 2 * _NODE, size - CONSTANTS : size]
            weighted = jacobian.T @ weight[node]
            information[np.ix_(columns, columns)] += weighted @ jacobian
            vector[columns] -= weighted @ residual[node]
        residual, first, common = self._fix_rows(state)
        sizes = np.zeros(len(self._fixes))
        for index, node in enumerate(self._fixes.tolist()):
            start, weights = _NODE * node, self._weights[index]
            size2 = float(residual[index] @ weights @ residual[index])
            sizes[index] = np.sqrt(size2)
            limit = _HUBER_SIGMAS * np.sqrt(6.0)
            share = min(1.0, limit / max(np.sqrt(size2), 1e-12))
            jacobian = np.concatenate([first[index], common[index]], axis=1)
            columns = np.r_[start : start + _NODE, size - CONSTANTS : size]
            weighted = share * jacobian.T @ weights
            information[np.ix_(columns, columns)] += weighted @ jacobian
            vector[columns] -= weighted @ residual[index]
        return information, vector, sizes

    def _span_rows(
        self, state: _State, spans: Preintegrated
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return residuals (N-1,9) between nodes and derivatives by first node, second node, constants."""
        seconds = spans.seconds[:, None]
        start, end = state.rotation[:-1], state.rotation[1:]
        start_t = np.swapaxes(start, 1, 2)
        up = state.constants[GRAVITY]
        turn = so3_log(np.swapaxes(spans.rotation, 1, 2) @ start_t @ end)
        gained = np.einsum("nij,nj->ni", start_t, np.diff(state.velocity, axis=0) + up * seconds)
        moved = np.diff(state.position, axis=0) - state.velocity[:-1] * seconds + 0.5 * up * seconds**2
        moved = np.einsum("nij,nj->ni", start_t, moved)
        residual = np.concatenate([turn, gained - spans.velocity, moved - spans.position], axis=1)
        count = self._nodes - 1
        first, second = np.zeros((count, 9, 9)), np.zeros((count, 9, 9))
        common = np.zeros((count, 9, CONSTANTS))
        right = np.eye(3) + 0.5 * skew(turn)
        wide = seconds[..., None]
        first[:, :3, :3] = -right @ np.swapaxes(end, 1, 2) @ start
        second[:, :3, :3] = right
        first[:, 3:6, :3], first[:, 6:, :3] = skew(gained), skew(moved)
        first[:, 3:6, 6:], second[:, 3:6, 6:] = -start_t, start_t
        first[:, 6:, 3:6], second[:, 6:, 3:6] = -start_t, start_t
        first[:, 6:, 6:] = -start_t * wide
        common[:, :, GYRO_BIAS], common[:, :, FORCE_BIAS] = -spans.by_gyro_bias, -spans.by_force_bias
        common[:, 3:6, GRAVITY], common[:, 6:, GRAVITY] = start_t * wide, 0.5 * start_t * wide**2
        return residual, first, second, common

    def _camera(self, state: _State, nodes: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return rotation (M,3,3) and position (M,3) (gauge units) of the camera at nodes."""
        values = state.constants
        rate = self._rate[nodes] - values[GYRO_BIAS]
        rotation = state.rotation[nodes] @ so3_exp(values[TURN] + rate * values[DELAY])
        position = state.position[nodes] + state.velocity[nodes] * values[DELAY]
        position = position - state.rotation[nodes] @ values[LEVER]
        return rotation, position * np.exp(-values[LOG_SCALE])

    def _camera_rows(self, state: _State, nodes: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return derivatives (M,6,9) and (M,6,17) of camera poses, in the axes of the camera."""
        values = state.constants
        inverse = float(np.exp(-values[LOG_SCALE][0]))
        rotation, position = self._camera(state, nodes)
        rotation_t = np.swapaxes(rotation, 1, 2)
        own = state.rotation[nodes]
        rate = self._rate[nodes] - values[GYRO_BIAS]
        relative_t = rotation_t @ own
        count = len(rotation)
        first, common = np.zeros((count, 6, _NODE)), np.zeros((count, 6, CONSTANTS))
        first[:, :3, :3] = relative_t
        first[:, 3:, :3] = inverse * relative_t @ skew(values[LEVER])
        first[:, 3:, 3:6] = inverse * rotation_t
        first[:, 3:, 6:] = inverse * values[DELAY] * rotation_t
        common[:, :3, DELAY] = rate[..., None]
        common[:, :3, TURN] = np.eye(3)
        common[:, 3:, DELAY] = inverse * rotation_t @ state.velocity[nodes][..., None]
        common[:, 3:, LOG_SCALE] = -rotation_t @ position[..., None]
        common[:, 3:, LEVER] = -inverse * relative_t
        return first, common

    def _fix_rows(self, state: _State) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return residuals (F,6) of the solved poses, and their derivatives by node and constants."""
        rotation, position = self._camera(state, self._fixes)
        first, common = self._camera_rows(state, self._fixes)
        measured_t = np.swapaxes(self._poses[:, :3, :3], 1, 2)
        turn = so3_log(measured_t @ rotation)
        shift = np.einsum("nij,nj->ni", measured_t, position - self._poses[:, :3, 3])
        right = np.eye(3) + 0.5 * skew(turn)
        back = measured_t @ rotation
        for rows in (first, common):
            rows[:, :3], rows[:, 3:] = right @ rows[:, :3], back @ rows[:, 3:]
        return np.concatenate([turn, shift], axis=1), first, common

    def result(self, state: _State, information: FloatArray, sizes: FloatArray) -> SolvedStretch:
        """Return the poses of the camera with their covariances."""
        nodes = np.arange(self._nodes)
        rotation, position = self._camera(state, nodes)
        first, common = self._camera_rows(state, nodes)
        scale = np.sqrt(np.diag(information))
        covariance = np.linalg.inv(information / np.outer(scale, scale)) / np.outer(scale, scale)
        size = len(information)
        out = np.empty((self._nodes, 6, 6))
        for node in nodes.tolist():
            columns = np.r_[_NODE * node : _NODE * (node + 1), size - CONSTANTS : size]
            jacobian = np.concatenate([first[node], common[node]], axis=1)
            out[node] = jacobian @ covariance[np.ix_(columns, columns)] @ jacobian.T
        return SolvedStretch(
            gauge_from_cam=make_transform(rotation, position + self._origin),
            covariance=0.5 * (out + np.swapaxes(out, 1, 2)),
            worst_fix=float(sizes.max()),
            worst_frame=int(self._fixes[int(np.argmax(sizes))]),
            fix_sigmas=sizes,
            constants=state.constants,
        )
