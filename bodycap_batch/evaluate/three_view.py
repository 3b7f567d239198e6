"""Measure the ratio of two successive legs of a path, and compare it with delivered positions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.evaluate.two_view import SIGMAS, Motion, Outcome, moved_along

_MIN_POINTS = 10
"""Minimum number of points that are seen in all three frames. Evidence: none."""
_MIN_CELLS = 6
"""Minimum number of grid cells with such a point. Evidence: none."""
_MIN_RATIO = 1.3
"""Minimum ratio between the measured and the delivered ratio of the legs that is wrong. Evidence: none."""
_MIN_PARALLAX_DEG = 2.0
"""Minimum error of parallax (degrees) that is wrong: 7 cm at a depth of 2 m. Less is noise of delivered
positions. """
_MAX_SIGMA_RAD = 0.1
"""Maximum standard deviation (radians) of the measured angle atan(first leg / second leg). With `SIGMAS`, a
leg that is twice as long as its neighbour is then found."""
_ITERATIONS = 5
"""Number of iterations of reweighted least squares."""
_ROBUST_SIGMAS = 2.0
"""Residual, in standard deviations, beyond which a point loses weight."""


def judge_positions(
    rays: Sequence[FloatArray],
    motions: tuple[Motion, Motion],
    legs: tuple[float, float],
    noise_rad: FloatArray,
    cells: IntArray,
) -> Outcome:
    """Compare the lengths of two successive legs with what the parallax of common points shows.

    A leap, or an error of the path's scale, changes one leg against the other. Only the pictures give
    rotations and directions here, so an inexact delivered rotation is not taken for an error of positions.

    Args:
        rays: Three arrays (M,3): unit rays of the same M points in the three frames.
        motions: Measured motions of the second and the third frame, each from the frame before it.
        legs: Delivered distances between the camera centres.
        noise_rad: (M,) angle (radians) of one px.
        cells: (M,) grid cell of each point.
    """
    if len(noise_rad) < _MIN_POINTS or len(np.unique(cells)) < _MIN_CELLS:
        return Outcome.UNMEASURABLE
    angle, parallax = _leg_angle(rays, motions, noise_rad)
    variance = 0.0
    for index, motion in enumerate(motions):
        values, axes = np.linalg.eigh(motion.covariance)
        for value, axis in zip(values, axes.T, strict=True):
            moved = list(motions)
            moved[index] = moved_along(motion, np.sqrt(max(value, 0.0)) * axis)
            variance += (_leg_angle(rays, moved, noise_rad)[0] - angle) ** 2
    sigma = float(np.sqrt(variance))
    limit = np.deg2rad(_MIN_PARALLAX_DEG)
    if sigma > _MAX_SIGMA_RAD or max(parallax) < limit:
        return Outcome.UNMEASURABLE
    delivered = float(np.arctan2(legs[0], legs[1]))
    tiny = 1e-6
    ratio = abs(np.log(max(np.tan(angle), tiny)) - np.log(max(np.tan(delivered), tiny)))
    ends = np.maximum(legs, tiny * max(*legs, tiny))
    error = max(
        abs(parallax[1] - parallax[0] * ends[1] / ends[0]), abs(parallax[0] - parallax[1] * ends[0] / ends[1])
    )
    is_wrong = abs(angle - delivered) > SIGMAS * sigma and ratio > np.log(_MIN_RATIO) and error > limit
    return Outcome.WRONG if is_wrong else Outcome.RIGHT


def _leg_angle(
    rays: Sequence[FloatArray], motions: Sequence[Motion], noise_rad: FloatArray
) -> tuple[float, tuple[float, float]]:
    """Return atan(first leg / second leg), and the parallax (radians) of a usual point along each leg.

    The inverse depth of a point in the middle frame is its parallax along a leg over the length of this leg.
    So the parallaxes of all points lie on one line through the origin, and its direction is the angle.
    """
    turn = motions[0].rotation.T
    first = _parallax(rays[1], rays[0], turn, -turn @ motions[0].direction, noise_rad)
    second = _parallax(rays[1], rays[2], motions[1].rotation, motions[1].direction, noise_rad)
    points = np.column_stack([first[0], second[0]])
    variances = np.column_stack([first[1], second[1]]) ** 2
    angle = float(np.median(np.arctan2(np.maximum(points[:, 0], 0.0), np.maximum(points[:, 1], 1e-12))))
    for _ in range(_ITERATIONS):
        across = np.array([np.cos(angle), -np.sin(angle)])
        spread = np.sqrt(variances @ across**2)
        residual = points @ across / spread
        weight = 1.0 / (1.0 + (residual / _ROBUST_SIGMAS) ** 2) ** 2 / spread**2
        along = points @ np.array([np.sin(angle), np.cos(angle)])
        step = np.sum(weight * along * (points @ across)) / max(np.sum(weight * along**2), 1e-30)
        angle = float(np.clip(angle + step, 0.0, np.pi / 2))
    middle = np.median(np.linalg.norm(points, axis=1))
    return angle, (float(middle * np.sin(angle)), float(middle * np.cos(angle)))


def _parallax(
    first: FloatArray, second: FloatArray, rotation: FloatArray, direction: FloatArray, noise_rad: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the parallax (M,) of points along a translation, and its standard deviation (M,).

    Both are inverse depths in units of the translation: second ~ rotation · first + parallax · direction.
    """
    turned = first @ rotation.T
    moved = np.cross(second, direction)
    length2 = np.maximum(np.sum(moved**2, axis=1), 1e-6)
    parallax = -np.einsum("mi,mi->m", np.cross(second, turned), moved) / length2
    return np.asarray(parallax), np.asarray(np.sqrt(2.0) * noise_rad / np.sqrt(length2))
