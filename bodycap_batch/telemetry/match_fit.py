"""Fit a gyroscope and the readout time to matches between adjacent frames of a camera that also translates.

A match of two frames is turned to one orientation with the gyroscope, each point from the instant of its own
row. The two directions and the translation between the frames then lie in one plane, at any depth. So the
translation of the camera, which looks like a rotation, does not bias the result: rotation, bias and delay of
the gyroscope and the readout time are those for which all matches of all pairs lie nearest to such planes.

Source: Kneip and Lynen, "Direct optimization of frame-to-frame rotation", ICCV 2013, for the elimination of
the translation; Li and Mourikis, "Vision-aided inertial navigation with rolling-shutter cameras", IJRR 2014,
for delay and readout time in one problem.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import rotation_angle_rad, so3_exp
from bodycap_batch.model.gyro_rates import GyroOrientation
from bodycap_batch.model.optical_flow import pixel_scale
from bodycap_batch.model.rotation_fit import MatchedRays
from bodycap_batch.telemetry.gyro_fit import AXES_SIGMA_RAD, BIAS_SIGMA_RAD_S, GyroFit
from bodycap_batch.telemetry.streams import Stream

_SCALE_PX = 1.0
"""Scale of the robust weights, px of an image with a long side of 640 px. It is wider than the noise of a
track: the translation adapts to the matches, so that a narrow scale would prefer the matches that agree with
the present solution. Evidence: docs/decisions/telemetry.md."""
_MIN_MATCHES = 20
"""Minimum number of matches of a pair. Origin: a pair has two unknowns of its own, and wrong matches."""
_MIN_PAIRS, _MAX_PAIRS = 45, 400
"""Minimum number of pairs of frames, and maximum: those in which the camera turns most. They bound the time.
Origin of the first: 1.5 s at 30 frames per second. Evidence: none."""
_WEIGHT_ROUNDS = 5
"""Number of times that the weights are computed in each round. Evidence: none."""
_ROUNDS = 15
"""Maximum number of rounds. Evidence: none."""
_STEP = 1e-4
"""Step of the unknowns for derivatives: radians, rad/s and seconds."""
_CONVERGED = 1e-5
"""Largest change of an unknown at which the rounds end: radians, rad/s and seconds."""
_BLOCKS = 8
"""Number of blocks of successive pairs that are left out one after another for the standard deviations."""
_MODEL_SIGMA = (0.01, 0.01, 0.01, 0.01, 0.01, 0.01, 0.0003, 0.0003)
"""Standard deviations (radians, rad/s, seconds) that are added to those of turn, bias, delay and readout
time: errors of matches that last for long, as on the wearer's arms. Evidence: docs/decisions/telemetry.md."""
_READOUT_SIGMA_RATIO = 0.04
"""Standard deviation that is added to that of the readout time, as a ratio of it. Evidence:
docs/decisions/telemetry.md."""
_MAX_TURN_RAD, _MAX_DELAY_S, _MAX_READOUT_S = math.radians(8.0), 0.012, 0.04
"""Maximum change of the rotation, maximum change of the delay, and maximum readout time. Beyond them, the
result is not believed. Evidence: none."""
_TURN, _BIAS, _DELAY, _READOUT = slice(0, 3), slice(3, 6), 6, 7
"""Places of turn, bias, delay and readout time among the unknowns."""


def fit_to_matches(
    rays: MatchedRays,
    times_s: FloatArray,
    gyro: Stream,
    lens: Camera,
    start: GyroFit,
    readout_s: float | None,
) -> tuple[GyroFit, float, float] | None:
    """Improve the relation of a gyroscope to its camera with matches, and estimate the readout time.

    Args:
        rays: Matches between adjacent frames of N frames.
        times_s: (N,) times of the frames, seconds.
        gyro: The gyroscope.
        lens: Intrinsics of the camera. They must be calibrated.
        start: A fit to rotations of the pictures.
        readout_s: The readout time, seconds; None to estimate it.

    Returns:
        The relation of the gyroscope to the camera with better values, the readout time in seconds and its
        standard deviation, 0 if it was given. None if there are too few matches, or if the result contradicts
        the start.
    """
    chosen = _chosen_pairs(rays, times_s, gyro, start)
    if chosen.sum() < _MIN_PAIRS:
        return None
    problem = _MatchProblem(rays, times_s, gyro, lens, start, np.flatnonzero(chosen))
    first = np.zeros(8)
    first[_DELAY], first[_READOUT] = start.delay_s, readout_s or 0.0
    first[_BIAS] = start.bias_rad_s
    free = np.arange(8 if readout_s is None else 7)
    x, sigma = problem.solve(first, free)
    turned = so3_exp(x[_TURN]).reshape(3, 3)
    believed = rotation_angle_rad(turned @ start.cam_from_sensor.T) < _MAX_TURN_RAD
    believed &= abs(x[_DELAY] - start.delay_s) < _MAX_DELAY_S and abs(x[_READOUT]) < _MAX_READOUT_S
    if not believed or not np.isfinite(sigma).all():
        return None
    fit = replace(
        start,
        cam_from_sensor=turned,
        rotation_sigma_rad=sigma[_TURN],
        bias_rad_s=x[_BIAS],
        bias_sigma_rad_s=sigma[_BIAS],
        delay_s=float(x[_DELAY]),
        delay_sigma_s=float(sigma[_DELAY]),
    )
    readout_sigma_s = float(np.hypot(sigma[_READOUT], _READOUT_SIGMA_RATIO * x[_READOUT]))
    return fit, float(x[_READOUT]), readout_sigma_s if readout_s is None else 0.0


def _chosen_pairs(rays: MatchedRays, times_s: FloatArray, gyro: Stream, start: GyroFit) -> BoolArray:
    """Return a mask (N-1,) of the pairs with matches and samples in which the camera turns most."""
    early_s, late_s = (times_s[part] + start.delay_s for part in (slice(None, -1), slice(1, None)))
    margin_s = late_s - early_s
    usable = (rays.used.sum(axis=1) >= _MIN_MATCHES) & (margin_s > 0.0)
    usable &= (early_s - margin_s > gyro.times_s[0]) & (late_s + margin_s < gyro.times_s[-1])
    for first_s, last_s in gyro.gaps_s:
        usable &= (late_s + margin_s < first_s) | (early_s - margin_s > last_s)
    turn = np.linalg.norm(np.einsum("pki,pk->pi", rays.second - rays.first, rays.used), axis=1)
    turn = np.where(usable, turn / np.maximum(rays.used.sum(axis=1), 1), -1.0)
    least = np.sort(turn)[-_MAX_PAIRS] if len(turn) > _MAX_PAIRS else -1.0
    return np.asarray(usable & (turn >= least))


class _MatchProblem:
    """The distances of matches from the planes of their pairs, for rotation, bias, delay and readout time."""

    def __init__(
        self,
        rays: MatchedRays,
        times_s: FloatArray,
        gyro: Stream,
        lens: Camera,
        start: GyroFit,
        pairs: IntArray,
    ) -> None:
        self._first, self._second = rays.first[pairs], rays.second[pairs]
        self._delays = rays.first_delay[pairs], rays.second_delay[pairs]
        self._used = rays.used[pairs].astype(np.float64)
        sensor_s = times_s + start.drift * (times_s - start.middle_s)
        self._times_s = sensor_s[pairs, None], sensor_s[pairs + 1, None]
        self._gyro = gyro
        scale_px = _SCALE_PX * pixel_scale(lens.width_px, lens.height_px)
        self._scale_rad = scale_px / lens.focal_px

    def _normals(self, x: FloatArray) -> FloatArray:
        """Return the products (P,K,3) of the turned directions of each match."""
        rate = (self._gyro.values - x[_BIAS]) @ so3_exp(x[_TURN]).reshape(3, 3).T
        oriented = GyroOrientation(self._gyro.times_s, rate)
        turned = []
        for rays, seconds, delay in zip(
            (self._first, self._second), self._times_s, self._delays, strict=True
        ):
            rotation = oriented.at((seconds + delay * x[_READOUT] + x[_DELAY]).ravel())
            turned.append(np.einsum("mij,mj->mi", rotation, rays.reshape(-1, 3)).reshape(rays.shape))
        return np.cross(*turned)

    def solve(self, x: FloatArray, free: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the unknowns (8,) and their standard deviations (8,); those that are not free stay.

        Turn and bias have a prior at 0.
        """
        prior = np.zeros(8)
        prior[_TURN], prior[_BIAS] = 1.0 / AXES_SIGMA_RAD**2, 1.0 / BIAS_SIGMA_RAD_S**2
        x, information, gradient = x.copy(), np.zeros((1, 8, 8)), np.zeros((1, 8))
        for _ in range(_ROUNDS):
            information, gradient = self._normal_equations(x, free)
            total = information.sum(axis=0) + np.diag(prior[free])
            change = -np.linalg.solve(total, gradient.sum(axis=0) + prior[free] * x[free])
            x[free] += change
            if np.abs(change).max() < _CONVERGED:
                break
        parts = np.array_split(np.arange(len(gradient)), _BLOCKS)
        total = information.sum(axis=0) + np.diag(prior[free])
        steps = np.array(
            [
                np.linalg.solve(total - information[part].sum(axis=0), gradient[part].sum(axis=0))
                for part in parts
            ]
        )
        sigma = np.zeros(8)
        spread = ((steps - steps.mean(axis=0)) ** 2).sum(axis=0) * (_BLOCKS - 1) / _BLOCKS
        sigma[free] = np.sqrt(spread + np.array(_MODEL_SIGMA)[free] ** 2)
        return x, sigma

    def _normal_equations(self, x: FloatArray, free: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return information (P,F,F) and gradient (P,F) of each pair, without its translation."""
        normal = self._normals(x)
        weight = self._used
        for _ in range(_WEIGHT_ROUNDS):
            _, axes = np.linalg.eigh(np.einsum("pk,pki,pkj->pij", weight, normal, normal))
            distance = np.einsum("pi,pki->pk", axes[:, :, 0], normal)
            weight = self._used / (1.0 + (distance / self._scale_rad) ** 2) ** 2
        slope = np.empty((*distance.shape, len(free)))
        for column, unknown in enumerate(free.tolist()):
            moved = x.copy()
            moved[unknown] += _STEP
            slope[..., column] = np.einsum("pi,pki->pk", axes[:, :, 0], self._normals(moved) - normal) / _STEP
        other = np.einsum("pki,pij->pkj", normal, axes[:, :, 1:])
        weighted, weighted_other = slope * weight[..., None], other * weight[..., None]
        mixed = np.swapaxes(weighted, 1, 2) @ other
        own = np.swapaxes(weighted_other, 1, 2) @ other + 1e-12 * np.eye(2)
        gradient = np.einsum("pka,pk->pa", weighted, distance)
        other_gradient = np.einsum("pka,pk->pa", weighted_other, distance)
        solved = np.linalg.solve(
            own, np.concatenate([np.swapaxes(mixed, 1, 2), other_gradient[..., None]], 2)
        )
        information = np.swapaxes(weighted, 1, 2) @ slope - mixed @ solved[..., :-1]
        gradient = gradient - (mixed @ solved[..., -1:])[..., 0]
        return information / self._scale_rad**2, gradient / self._scale_rad**2
