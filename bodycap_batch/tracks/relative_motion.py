"""Measure the relative rotation of two frames, and the direction between them, from matched rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.geometry import nearest_rotation

_MAX_SIGMA_DEG = 5.0
"""Maximum standard deviation (degrees) of a measured rotation about any axis. A less exact measurement could
not show a fold of 15 degrees with `SIGMAS`."""
INLIER_PX = 2.5
"""Maximum residual of an inlier, px at the pyramid level of the feature. Origin: two and a half times the
accuracy of an ORB corner."""
_UNKNOWN_VARIANCE = 1e9
"""Variance (rad²) of a direction that the matches do not determine."""
_MIN_NOISE_PX = 0.3
"""Minimum standard deviation (px) of a feature, so that exact synthetic matches do not claim certainty."""
_MIN_MATCHES = 12
"""Minimum number of inliers of a measurement."""
_MIN_CELLS = 8
"""Minimum number of grid cells with an inlier: a twelfth of the picture."""
_MOST = 0.6
"""Share of the matches that shows a motion without a search for others: a majority, with a margin for matches
that follow two motions. Evidence: docs/decisions/tracks.md."""
_TRIALS = 200
"""Number of random samples of each search."""
_REFINEMENTS = 8
"""Maximum number of iterations of reweighted least squares."""
_CONVERGED_RAD = 1e-4
"""Length (radians) of a step after which the iterations end: a hundredth of the noise of usual matches."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RayMatches:
    """M matches between two frames, as unit viewing rays.

    Attributes:
        first: (M,3) rays in the first frame.
        second: (M,3) rays in the second frame.
        cells: (M,) grid cell of each match in the first frame.
        noise_rad: (M,) angle (radians) of one px at the coarser pyramid level of the two features.
    """

    first: FloatArray
    second: FloatArray
    cells: IntArray
    noise_rad: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """The motion between two frames that was measured from their matches. Its length is not known.

    Attributes:
        rotation: (3,3) rotation second_from_first.
        direction: (3,) unit translation second_from_first.
        covariance: (5,5) covariance of the left rotation vector, rad², and of the direction in its
            `tangents`.
        inliers: (M,) True for the matches that follow this motion.
        support: Number of grid cells with an inlier.
    """

    rotation: FloatArray
    direction: FloatArray
    covariance: FloatArray
    inliers: BoolArray
    support: int

    @property
    def rotation_covariance(self) -> FloatArray:
        """(3,3) covariance of the left rotation vector, rad²."""
        return self.covariance[:3, :3]

    @property
    def sigma_deg(self) -> float:
        """Largest standard deviation of the rotation about any axis, degrees."""
        return float(np.rad2deg(np.sqrt(np.linalg.eigvalsh(self.rotation_covariance)[-1])))


def measure_rotation(matches: RayMatches, expected: FloatArray | None = None) -> Motion | None:
    """Measure the relative rotation of two frames; None if the matches do not determine it.

    If most matches follow the motion that a refinement finds from the `expected` rotation (3,3), no other
    motion can have more, so none is looked for.

    The rotation with the support of most grid cells is taken, so that a textured hand does not outvote a
    plain room by its number of features.

    Source: D. Nistér, "An efficient solution to the five-point relative pose problem", PAMI 2004.
    """
    if len(matches.first) < _MIN_MATCHES:
        return None
    if expected is not None and np.isfinite(expected).all():
        near = refine_motion(matches, expected)
        if np.count_nonzero(near.inliers) >= _MOST * len(matches.first):
            return usable(near)
    starts = [_turn_hypothesis(matches), *_essential_hypotheses(matches)]
    found = [refine_motion(matches, start) for start in starts]
    return usable(max(found, key=lambda each: (each.support, np.count_nonzero(each.inliers))))


def residuals(matches: RayMatches, motion: Motion) -> tuple[FloatArray, BoolArray]:
    """Return the distances (M,) of matches from their epipolar lines, px, and which lie in front (M,)."""
    residual, _ = _epipolar(matches, motion.rotation, motion.direction)
    return residual, _may_lie_in_front(matches, motion.rotation, motion.direction)


def usable(found: Motion) -> Motion | None:
    """Return a measurement if its matches are enough, lie in enough cells and determine the rotation."""
    enough = found.support >= _MIN_CELLS and np.count_nonzero(found.inliers) >= _MIN_MATCHES
    return found if enough and found.sigma_deg <= _MAX_SIGMA_DEG else None


def _turn_hypothesis(matches: RayMatches) -> FloatArray:
    """Return the rotation without translation that most matches follow, from samples of two matches."""
    rng = np.random.default_rng(0)
    chosen = rng.integers(0, len(matches.first), (_TRIALS, 2))
    first, second = _triads(matches.first[chosen]), _triads(matches.second[chosen])
    rotations = second @ np.swapaxes(first, 1, 2)
    products = np.einsum("mi,mj->mij", matches.second, matches.first).reshape(-1, 9)
    cosine = rotations.reshape(-1, 9) @ products.T
    near = 2.0 - 2.0 * cosine < (2 * INLIER_PX * matches.noise_rad) ** 2
    return np.asarray(rotations[np.argmax(_support_of(near, matches.cells))])


def _triads(pairs: FloatArray) -> FloatArray:
    """Return a right-handed orthonormal basis (K,3,3) from each pair (K,2,3) of rays, as columns."""
    x = pairs[:, 0]
    z = cross(x, pairs[:, 1])
    z /= np.maximum(np.linalg.norm(z, axis=1, keepdims=True), 1e-12)
    return np.stack([x, cross(z, x), z], axis=2)


def _essential_hypotheses(matches: RayMatches) -> list[FloatArray]:
    """Return the rotations of the essential matrix that most matches follow."""
    import cv2

    first, second = matches.first[:, :2] / matches.first[:, 2:], matches.second[:, :2] / matches.second[:, 2:]
    threshold = INLIER_PX * float(np.median(matches.noise_rad))
    essential, _ = cv2.findEssentialMat(
        first, second, np.eye(3), method=cv2.USAC_ACCURATE, prob=0.999, threshold=threshold, maxIters=1000
    )
    if essential is None or essential.shape != (3, 3) or not np.isfinite(essential).all():
        return []
    one, two, _ = cv2.decomposeEssentialMat(essential)
    # Of the two, the wrong one is a half turn about the baseline; its support in front of the cameras is nil.
    return [min((one, two), key=lambda each: _turn_residual(matches, each))]


def _turn_residual(matches: RayMatches, rotation: FloatArray) -> float:
    return float(np.median(np.linalg.norm(matches.first @ rotation.T - matches.second, axis=1)))


def refine_motion(matches: RayMatches, rotation: FloatArray, *, turn: bool = True) -> Motion:
    """Refine a rotation (if `turn`) and the direction of the translation by reweighted least squares."""
    import cv2

    direction = _translation_direction(matches, rotation)
    for _ in range(_REFINEMENTS):
        residual, jacobian = _epipolar(matches, rotation, direction)
        if not turn:
            jacobian[:, :3] = 0.0
        weights = 1.0 / (1.0 + (residual / INLIER_PX) ** 2) ** 2
        weighted = (jacobian * weights[:, None]).T
        normal = weighted @ jacobian
        # A direction that pictures of a mere turn do not determine stays where it is.
        normal += (1e-9 + 1e-6 * np.trace(normal)) * np.eye(5)
        step = -np.linalg.solve(normal, weighted @ residual)
        rotation = cv2.Rodrigues(step[:3])[0] @ rotation
        direction = direction + tangents(direction) @ step[3:]
        direction /= np.linalg.norm(direction)
        if np.linalg.norm(step) < _CONVERGED_RAD:
            break
    rotation = nearest_rotation(rotation)
    residual, jacobian = _epipolar(matches, rotation, direction)
    inliers = (np.abs(residual) < INLIER_PX) & _may_lie_in_front(matches, rotation, direction)
    noise_px = (
        max(_MIN_NOISE_PX, 1.48 * float(np.median(np.abs(residual[inliers])))) if inliers.any() else 1.0
    )
    values, vectors = np.linalg.eigh(jacobian[inliers].T @ jacobian[inliers])
    # Directions that the matches do not determine, for example through a lens with an absurd focal length,
    # get the variance of nothing known.
    is_known = values > max(1.0 / _UNKNOWN_VARIANCE, 1e-12 * values[-1])
    variance = np.where(is_known, noise_px**2 / np.where(is_known, values, 1.0), _UNKNOWN_VARIANCE)
    return Motion(
        rotation=rotation,
        direction=direction,
        covariance=np.asarray((vectors * variance) @ vectors.T),
        inliers=inliers,
        support=int(_support_of(inliers[None], matches.cells)[0]),
    )


def _translation_direction(matches: RayMatches, rotation: FloatArray) -> FloatArray:
    """Return the direction of the translation that most matches follow under a given rotation."""
    turned = matches.first @ rotation.T
    normals = cross(turned, matches.second)
    lengths = np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    rng = np.random.default_rng(1)
    chosen = rng.integers(0, len(normals), (_TRIALS, 2))
    directions = cross(normals[chosen[:, 0]], normals[chosen[:, 1]])
    norms = np.linalg.norm(directions, axis=1, keepdims=True)
    directions = np.where(norms > 0, directions / np.maximum(norms, 1e-30), [0.0, 0.0, 1.0])
    # Distance of the second ray from the epipolar plane: normal·direction over the normal's own length.
    across = np.sqrt(np.maximum(1.0 - (directions @ turned.T) ** 2, 1e-12))
    off = np.abs(directions @ normals.T) / across
    near = (off < INLIER_PX * matches.noise_rad) | (lengths < INLIER_PX * matches.noise_rad)
    index = int(np.argmax(_support_of(near, matches.cells)))
    best = directions[index]
    # The sign with which most points lie in front of both cameras.
    sign = np.sign(_parallax(turned, matches.second, best)[near[index]]).sum()
    return np.asarray(best if sign >= 0 else -best)


def _parallax(turned: FloatArray, second: FloatArray, direction: FloatArray) -> FloatArray:
    """Return how far (M,) each ray moved along the translation: positive in front of both cameras."""
    along = direction - turned * (turned @ direction)[:, None]
    return np.asarray(np.einsum("mi,mi->m", second - turned, along))


def cross(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return cross products of vectors (...,3). numpy's own function takes five times as long."""
    out = np.empty(np.broadcast_shapes(first.shape, second.shape))
    for axis, (one, two) in enumerate(((1, 2), (2, 0), (0, 1))):
        np.multiply(first[..., one], second[..., two], out=out[..., axis])
        out[..., axis] -= first[..., two] * second[..., one]
    return out


def tangents(direction: FloatArray) -> FloatArray:
    """Return two unit vectors (3,2) perpendicular to a unit vector.

    Source: T. Duff et al., "Building an orthonormal basis, revisited", JCGT 2017.
    """
    x, y, z = direction.tolist()
    sign = 1.0 if z >= 0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    return np.array([[1.0 + sign * x * x * a, b], [sign * b, sign + y * y * a], [-sign * x, -y]])


def _epipolar(
    matches: RayMatches, rotation: FloatArray, direction: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return Sampson's residuals (M,) in px and their Jacobian (M,5).

    With the turned first ray t, the second ray s and the direction d, the residual is s · (d × t) over the
    length of its gradient in the tangent planes of both rays. The squares of the two parts of the gradient
    are 1 - (t · d)² and 1 - (s · d)², each minus the square of the numerator.
    """
    turned, second = matches.first @ rotation.T, matches.second
    normal = cross(turned, second)
    value, along_first, along_second = normal @ direction, turned @ direction, second @ direction
    squared = 2.0 * (1.0 - value**2) - along_first**2 - along_second**2
    scale = np.maximum(np.sqrt(np.maximum(squared, 0.0)), 1e-3) * matches.noise_rad
    jacobian = np.empty((len(turned), 5))
    cosine = np.einsum("mi,mi->m", turned, second)
    jacobian[:, :3] = second * along_first[:, None] - cosine[:, None] * direction
    jacobian[:, 3:] = normal @ tangents(direction)
    jacobian /= scale[:, None]
    return value / scale, jacobian


def _may_lie_in_front(matches: RayMatches, rotation: FloatArray, direction: FloatArray) -> BoolArray:
    """Return True for the matches (M,) whose points may lie in front of both cameras."""
    turned = matches.first @ rotation.T
    parallax = _parallax(turned, matches.second, direction)
    across = np.linalg.norm(cross(turned, direction), axis=1)
    return np.asarray(parallax > -INLIER_PX * matches.noise_rad * across)


def _support_of(near: BoolArray, cells: IntArray) -> IntArray:
    """Return the number of grid cells in which any match is near, for each of K hypotheses (K,M)."""
    in_cell = (np.unique(cells)[None] == cells[:, None]).astype(np.float32)
    return np.asarray(np.count_nonzero(near.astype(np.float32) @ in_cell, axis=1))
