"""Measure the shape of the path through three frames, and compare it with delivered positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.evaluate.two_view import Outcome
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.tracks.relative_motion import INLIER_PX, Motion, cross

_MIN_POINTS = 10
"""Minimum number of points that are seen in all three frames. Evidence: none."""
_MIN_CELLS = 6
"""Minimum number of grid cells with such a point. Evidence: none."""
_MIN_PARALLAX_DEG = 1.0
"""Minimum error of parallax (degrees) that is wrong: 3.5 cm at a depth of 2 m, 5 px of a usual lens. Less is
noise of delivered positions."""
_MIN_ERROR = 0.2
"""Minimum error of a leg that is wrong, relative to the measured leg. Less is a slow change of scale."""
_MAX_SIGMA = 0.2
"""Maximum standard deviation of the measured legs, relative to the length of both. A leg that
is twice as long as its neighbour is then found."""
_MIN_NOISE_PX = 0.3
"""Minimum standard deviation (px) of a ray, so that exact synthetic matches do not claim certainty."""
_MIN_SIGMA = 0.02
"""Standard deviation of the measured legs, relative to the length of both, that the errors of lens and
shutter leave. Evidence: none."""
_EQUAL_SUPPORT = 0.8
"""Minimum support of legs like the delivered ones, relative to the best legs, with which the pictures confirm
them as well: a hand or a second wall moves otherwise."""
_NOT_EXCLUDED = 0.6
"""Minimum support of the delivered poses themselves, relative to the best legs, with which the pictures
do not exclude them."""
_CORRELATION = 2.0
"""Factor of the standard deviations for what neighbouring corners have in common. Evidence: without it, the
errors of measured ratios have a median of 1.3 to 1.7 standard deviations, on captures with truth."""
_MAX_DISTANCE2 = 18.2
"""Square of the normalised distance (5 degrees of freedom) that is as likely as `SIGMAS` of one value."""
_ITERATIONS = 8
"""Maximum number of iterations of reweighted least squares."""
_CONVERGED = 1e-4
"""Length of a step after which the iterations end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CommonRays:
    """M points that are seen in three frames, as unit viewing rays.

    Attributes:
        rays: (3,M,3) rays in the first, the middle and the last frame.
        noise_rad: (M,) angle (radians) of one px.
        cells: (M,) grid cell of each point in the middle frame.
        elapsed: (2,M) time between the exposures of a point's rows in the middle frame and in the first and
            last one, relative to the time between the frames. It is 1 without a rolling shutter.
    """

    rays: FloatArray
    noise_rad: FloatArray
    cells: IntArray
    elapsed: FloatArray

    @property
    def is_enough(self) -> bool:
        """True if the points are enough for a measurement."""
        return len(self.noise_rad) >= _MIN_POINTS and len(np.unique(self.cells)) >= _MIN_CELLS


@dataclass(frozen=True, slots=True, kw_only=True)
class Legs:
    """The two legs of the path through three frames. The length of both together is 1.

    Attributes:
        rotations: (2,3,3) rotations first_from_middle and last_from_middle.
        translations: (2,3) translations first_from_middle and last_from_middle.
        covariance: (6,6) covariance of the translations.
        parallax: Angle (radians) by which a usual point moves with a translation of length 1.
        inliers: (M,) True for the points that follow these legs.
        support: Number of grid cells with an inlier.
    """

    rotations: FloatArray
    translations: FloatArray
    covariance: FloatArray
    parallax: float
    inliers: BoolArray
    support: int

    @property
    def sigma(self) -> float:
        """Largest standard deviation of the translations in any direction but that of their length."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))

    @property
    def log_ratio(self) -> tuple[float, float]:
        """Logarithm of the ratio last leg / first leg, and its standard deviation."""
        lengths = np.maximum(np.linalg.norm(self.translations, axis=1), 1e-9)
        gradient = (self.translations * np.array([[-1.0], [1.0]]) / lengths[:, None] ** 2).ravel()
        sigma = np.sqrt(gradient @ self.covariance @ gradient)
        return float(np.log(lengths[1] / lengths[0])), float(sigma)


def measure_legs(common: CommonRays, motions: tuple[Motion, Motion]) -> Legs | None:
    """Measure the two legs of three frames; None if the pictures do not determine them.

    Args:
        common: Points in the three frames.
        motions: Measured motions of the second and the third frame, each from the frame before it.
    """
    if not common.is_enough:
        return None
    rotations = np.stack([motions[0].rotation.T, motions[1].rotation])
    directions = np.stack([-rotations[0] @ motions[0].direction, motions[1].direction])
    along = [
        _along(common.rays[view], common.rays[1] @ rotation.T, direction)
        for view, rotation, direction in zip((0, 2), rotations, directions, strict=True)
    ]
    # A point's inverse depth is its parallax along a leg over the length of this leg.
    lengths = np.array([max(float(np.median(each)), 1e-9) for each in along])
    if max(lengths) < np.deg2rad(_MIN_PARALLAX_DEG):
        return None
    return _usable(_refined(common, rotations, directions * lengths[:, None]))


def judge_legs(
    common: CommonRays, measured: Legs | None, rotations: FloatArray, legs: FloatArray
) -> tuple[Outcome, Legs | None]:
    """Compare delivered positions of three frames with the legs that the pictures show.

    A leap, or an error of the path's scale, changes one leg against the other. Only the pictures give
    rotations here, so an inexact delivered rotation is not taken for an error of positions.

    Args:
        common: Points in the three frames.
        measured: The legs that `measure_legs` found in them.
        rotations: (2,3,3) delivered rotations first_from_middle and last_from_middle.
        legs: (2,3) delivered legs in the frame of the middle camera: middle − first, last − middle.

    Returns:
        The outcome, and the legs that the pictures confirm: of several with nearly equal support, as a camera
        that moves towards a wall has them, those next to the delivered ones.
    """
    if measured is None:
        return Outcome.UNMEASURABLE, None
    outcome = _compare(measured, legs)
    delivered = _translations(rotations, legs)
    nearest = _usable(_refined(common, rotations, delivered))
    if nearest is not None and nearest.support < _EQUAL_SUPPORT * measured.support:
        nearest = None
    if outcome is not Outcome.WRONG:
        return outcome, nearest or measured
    if _support(common, rotations, delivered) >= _NOT_EXCLUDED * measured.support:
        return Outcome.UNMEASURABLE, nearest or measured
    return (_compare(nearest, legs), nearest) if nearest is not None else (Outcome.WRONG, measured)


def _support(common: CommonRays, rotations: FloatArray, translations: FloatArray) -> int:
    """Return the number of grid cells with a point that follows given rotations and translations."""
    unit = translations / np.linalg.norm(translations)
    values, _, depth = _linearised(common, _tangents(common), rotations, unit)
    return len(np.unique(common.cells[_follows(values, depth, common)]))


def _follows(values: FloatArray, depth: FloatArray, common: CommonRays) -> BoolArray:
    near = np.linalg.norm(values, axis=1) < INLIER_PX
    return np.asarray(near & (depth > -INLIER_PX * common.noise_rad))


def _usable(found: Legs) -> Legs | None:
    enough = np.count_nonzero(found.inliers) >= _MIN_POINTS and found.support >= _MIN_CELLS
    return found if enough and found.sigma <= _MAX_SIGMA else None


def _translations(rotations: FloatArray, legs: FloatArray) -> FloatArray:
    """Return the translations first_from_middle and last_from_middle (2,3) of legs in the middle frame."""
    return np.stack([rotations[0] @ legs[0], -rotations[1] @ legs[1]])


def _compare(measured: Legs, legs: FloatArray) -> Outcome:
    limit = np.deg2rad(_MIN_PARALLAX_DEG)
    true = measured.translations
    parallax = measured.parallax * np.linalg.norm(true, axis=1)
    if max(parallax) < limit:
        return Outcome.UNMEASURABLE
    given = _translations(measured.rotations, legs)
    lengths = np.linalg.norm(given, axis=1)
    if max(lengths) <= 0:
        return Outcome.WRONG
    # A leg that is seen well gives the scale of the delivered path; the other one is compared with it.
    error = 0.0
    for one, other in ((0, 1), (1, 0)):
        if parallax[one] > limit / 2:
            scale = np.linalg.norm(true[one]) / max(lengths[one], 1e-6 * lengths[other])
            moved = float(np.linalg.norm(scale * given - true, axis=1).max())
            if moved > _MIN_ERROR * np.linalg.norm(true[other]):
                error = max(error, measured.parallax * moved)
    if error <= limit:
        return Outcome.RIGHT
    axis, unit = true.ravel(), given.ravel() / np.linalg.norm(given)
    across = unit - axis * (axis @ unit)
    angle = np.arctan2(np.linalg.norm(across), axis @ unit)
    across *= angle / max(float(np.linalg.norm(across)), 1e-12)
    covariance = measured.covariance + _MIN_SIGMA**2 * np.eye(6)
    distance2 = across @ np.linalg.solve(covariance, across)
    return Outcome.WRONG if distance2 > _MAX_DISTANCE2 else Outcome.RIGHT


def _along(seen: FloatArray, turned: FloatArray, translation: FloatArray) -> FloatArray:
    """Return the inverse depths (M,) in units of a translation: seen ~ turned + depth · translation."""
    moved = cross(seen, translation)
    length2 = np.maximum(np.sum(moved**2, axis=1), 1e-12)
    return np.asarray(-np.einsum("mi,mi->m", cross(seen, turned), moved) / length2)


def _refined(common: CommonRays, rotations: FloatArray, translations: FloatArray) -> Legs:
    """Refine rotations and translations by reweighted least squares, with all inverse depths eliminated.

    Source: the elimination is variable projection in L. Kaufman's form, BIT 1975.
    """
    axis = translations.ravel() / np.linalg.norm(translations)
    tangents = _tangents(common)
    for _ in range(_ITERATIONS):
        values, jacobian, _ = _linearised(common, tangents, rotations, axis.reshape(2, 3))
        weights = 1.0 / (1.0 + np.sum(values**2, axis=1) / INLIER_PX**2)
        rows = (jacobian * weights[:, None, None]).reshape(-1, 12)
        normal = rows.T @ rows
        # Neither the length of both legs nor, in pictures of a mere turn, their direction is determined.
        normal[6:, 6:] += np.trace(normal) * np.outer(axis, axis)
        normal += 1e-7 * (1.0 + np.trace(normal)) * np.eye(12)
        step = -np.linalg.solve(normal, rows.T @ (values * weights[:, None]).ravel())
        rotations = so3_exp(step[:6].reshape(2, 3)) @ rotations
        axis = axis + step[6:]
        axis /= np.linalg.norm(axis)
        if np.linalg.norm(step) < _CONVERGED:
            break
    values, jacobian, depth = _linearised(common, tangents, rotations, axis.reshape(2, 3))
    inliers = _follows(values, depth, common)
    noise_px = max(_MIN_NOISE_PX, 1.48 * float(np.median(np.abs(values[inliers])))) if inliers.any() else 1.0
    rows = jacobian[inliers].reshape(-1, 12)
    normal = rows.T @ rows + 1e-6 * np.eye(12)
    normal[6:, 6:] += (1.0 + np.trace(normal)) * np.outer(axis, axis)
    return Legs(
        rotations=rotations,
        translations=axis.reshape(2, 3),
        covariance=np.asarray((_CORRELATION * noise_px) ** 2 * np.linalg.inv(normal)[6:, 6:]),
        parallax=float(np.median(depth[inliers])) if inliers.any() else 0.0,
        inliers=inliers,
        support=len(np.unique(common.cells[inliers])),
    )


def _linearised(
    common: CommonRays, tangents: FloatArray, rotations: FloatArray, translations: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return residuals (M,4) in px, their Jacobian (M,4,12) and the inverse depths (M,).

    The parameters are both left rotation vectors and both translations. The derivative with the inverse
    depth, which has its best value, is projected out of the Jacobian. The tangents are those of `_tangents`.
    """
    seen, count = common.rays[[0, 2]], len(common.noise_rad)
    turned = common.rays[1] @ np.swapaxes(rotations, 1, 2)
    shift = translations[:, None] * common.elapsed[..., None]
    moved = cross(seen, shift)
    depth = -np.einsum("kmi,kmi->m", cross(seen, turned), moved)
    depth = depth / np.maximum(np.einsum("kmi,kmi->m", moved, moved), 1e-12)
    point = turned + depth[None, :, None] * shift
    length = np.maximum(np.linalg.norm(point, axis=2), 1e-9)[..., None, None]
    ray = point[..., None, :] / length
    value = np.sum(tangents * ray, axis=-1, keepdims=True)
    slope = (tangents - value * ray) / length
    jacobian = np.zeros((count, 2, 2, 12))
    by_turn, by_shift = cross(turned[:, :, None], slope), slope * (depth * common.elapsed)[..., None, None]
    for view in range(2):
        jacobian[:, view, :, 3 * view : 3 * view + 3] = by_turn[view]
        jacobian[:, view, :, 6 + 3 * view : 9 + 3 * view] = by_shift[view]
    by_depth = np.einsum("kmai,kmi->mka", slope, shift).reshape(count, 4, 1)
    by_depth /= np.maximum(np.linalg.norm(by_depth, axis=1, keepdims=True), 1e-12)
    flat = jacobian.reshape(count, 4, 12)
    flat -= by_depth * (np.swapaxes(by_depth, 1, 2) @ flat)
    return np.swapaxes(value[..., 0], 0, 1).reshape(count, 4), flat, depth


def _tangents(common: CommonRays) -> FloatArray:
    """Return two vectors (2,M,2,3) perpendicular to each ray of the first and the last picture.

    Their length is 1 / noise_rad, so that their products with other rays are errors in px.
    """
    rays = common.rays[[0, 2]]
    helper = np.where(np.abs(rays[..., :1]) < 0.6, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    one = cross(rays, helper)
    one /= np.linalg.norm(one, axis=-1, keepdims=True)
    return np.asarray(np.stack([one, cross(rays, one)], axis=-2) / common.noise_rad[:, None, None])
