"""Estimate the lens of a camera from the tracks of its video, before there is a map.

Two pictures of a rigid room determine the lens together with the relative pose, if the camera turned between
them: a wrong lens bends the lines of sight, and no pose makes them meet. One picture pair says little; all
pairs of a video have the same lens. Evidence: docs/decisions/tracks.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.lens_estimate import LensEstimate
from bodycap_batch.model.optical_flow import pixel_scale, unit_directions
from bodycap_batch.model.point_tracks import PointTracks

_PAIRS = 36
"""Number of pairs of frames. Evidence: docs/decisions/tracks.md."""
_POINTS = 100
"""Maximum number of points of a pair. Evidence: docs/decisions/tracks.md."""
_MIN_POINTS = 40
"""Minimum number of points of a pair. Origin: eight for each of its five unknowns."""
_SHIFT_PX = (25.0, 120.0)
"""Minimum and maximum median displacement between the frames of a pair, px of an image with a long side of
640 px. A smaller one does not determine a pose; after a larger one, few tracks are left."""
_MAX_SPAN_S = 1.0
"""Maximum time between the frames of a pair, seconds. Tracks drift. Evidence: docs/decisions/tracks.md."""
_ERROR_PX = 0.5
"""Scale of the robust loss, px of an image with a long side of 640 px: the error of a track after a second.
Evidence: docs/decisions/tracks.md."""
_ANCHORS = (0.4, 0.7, 1.2)
"""Focal lengths, as a share of the long side, at which RANSAC searches the poses to start from. A start that
suits a lens which is a third longer or shorter is improved by the steps."""
_TRIALS = 60
"""Maximum number of trials of RANSAC for a pair. Each takes 0.1 ms."""
_MIN_PAIRS = 6
"""Minimum number of pairs. Evidence: none."""
_STEPS = 6
"""Number of Gauss–Newton steps for each lens. Evidence: docs/decisions/tracks.md."""
_MIN_AHEAD = 0.2
"""Minimum cosine between a line of sight and the axis of the lens for the five-point algorithm: it knows no
points beside the camera."""
_FOCAL_RATIOS = np.geomspace(0.25, 2.0, 13)
"""Focal lengths that are tried, as a share of the long side. Origin: a fisheye lens of 200 degrees, and a
field of view of 28 degrees."""
_DISTORTIONS = {"SIMPLE_RADIAL": (-0.25, -0.1), "SIMPLE_RADIAL_FISHEYE": (-0.1, -0.03, 0.03)}
"""By lens model, the radial distortions that are tried besides 0."""
_BEST_FOCAL = 3
"""Number of focal lengths for which they are tried: those with the least cost without distortion."""
_FINE_FOCAL = np.geomspace(0.88, 1.14, 7)
"""Factors of the best focal length that are tried next."""
_LEAST_SIGMA = float(np.log(_FINE_FOCAL[1] / _FINE_FOCAL[0])) / 12**0.5
"""Least standard deviation of the logarithm of a focal length: that of even errors within a step. At the end
of its range, a distortion holds the focal length of all samples at the same value."""
_FINE_DISTORTION = np.array([-0.06, -0.03, 0.0])
"""Differences from the best distortion that are tried next. None is positive: a longer focal length with
pincushion distortion fits turns of a few degrees as well, but lenses of cameras have barrel distortion."""
_WRONG = 10.0
"""Residual of a wrong point, as a multiple of the scale of the loss: larger ones cost no more."""
_MAX_TURN_RAD = 0.2
"""Maximum rotation of one step, radians."""
_MAX_TILT_RAD = 0.7
"""Maximum change of the direction of a translation in one step, radians."""
_RESAMPLES = 100
"""Number of draws of pairs with replacement, for the standard deviation (bootstrap)."""
_SIGMA_FACTOR = 3.0
"""Factor of the standard deviation. Neighbouring pairs have tracks and the rolling shutter in common. It is
not enough: on nine cameras with known lenses (`python -m tests.bench lens`), the errors are 1.5 of the stated
standard deviations (root mean square)."""
_SEED = 0
"""Seed of these draws."""


_Poses = tuple[FloatArray, FloatArray]
"""Rotations (P,3,3) and unit translations (P,3) of the second frames of the pairs from the first frames."""


def estimate_lens(tracks: PointTracks, times_ns: IntArray) -> LensEstimate | None:
    """Estimate focal length and radial distortion of a camera.

    Args:
        tracks: Tracks in the room.
        times_ns: (N,) times of the frames, nanoseconds.

    Returns:
        The lens; None if there are too few pairs of frames with motion.

    Source: Kneip, Lynen, "Direct optimization of frame-to-frame rotation", ICCV 2013, for the relative pose
        with an eliminated translation; Brückner and others, "Active self-calibration of multi-camera
        systems", DAGM 2010, for a lens scored on two-view geometry.
    """
    pairs = _choose_pairs(tracks, times_ns)
    if len(pairs) < _MIN_PAIRS:
        return None
    problem = _Problem.create(tracks, pairs)
    long_side = max(tracks.width_px, tracks.height_px)
    tried = dict[tuple[str, float, float], tuple[float, _Poses]]()
    for model, distortions in _DISTORTIONS.items():
        anchors = [
            problem.start_by_ransac(_lens(model, ratio * long_side, 0.0, tracks)) for ratio in _ANCHORS
        ]
        before: list[_Poses] = []
        for ratio in _FOCAL_RATIOS.tolist():
            lens = _lens(model, ratio * long_side, 0.0, tracks)
            cost, poses = problem.cost(lens, [problem.start_by_rotation(lens), *anchors, *before])
            before = [poses]
            tried[model, ratio, 0.0] = float(cost.sum()), poses
        own = sorted((key for key in tried if key[0] == model), key=lambda key: tried[key][0])
        for _, ratio, _ in own[:_BEST_FOCAL]:
            for distortion in distortions:
                lens = _lens(model, ratio * long_side, distortion, tracks)
                cost, poses = problem.cost(lens, [tried[model, ratio, 0.0][1], *anchors])
                tried[model, ratio, distortion] = float(cost.sum()), poses
    model, ratio, distortion = min(tried, key=lambda key: tried[key][0])
    poses = tried[model, ratio, distortion][1]
    best = _lens(model, ratio * long_side, distortion, tracks)
    _, poses = problem.cost(best, [poses, problem.start_by_ransac(best)])
    fine = np.full((len(_FINE_FOCAL), len(_FINE_DISTORTION), len(pairs)), np.inf)
    for row, factor in enumerate(_FINE_FOCAL):
        for column, change in enumerate(_FINE_DISTORTION):
            lens = _lens(model, ratio * factor * long_side, distortion + change, tracks)
            fine[row, column], _ = problem.cost(lens, [poses])
    rng = np.random.default_rng(_SEED)
    focal, change = _minimum(fine.sum(axis=2))
    drawn = [
        _minimum(fine[:, :, rng.integers(0, len(pairs), len(pairs))].sum(axis=2))[0]
        for _ in range(_RESAMPLES)
    ]
    lens = _lens(model, ratio * float(np.exp(focal)) * long_side, distortion + change, tracks)
    _, poses = problem.cost(lens, [poses])
    return LensEstimate(
        lens=lens,
        focal_sigma=max(_SIGMA_FACTOR * float(np.std(drawn)), _LEAST_SIGMA),
        pairs=len(pairs),
        error_px=float(np.median(np.abs(problem.residuals_px(lens, poses)[problem.valid]))),
    )


def _lens(model: str, focal_px: float, distortion: float, tracks: PointTracks) -> Camera:
    params = np.array([focal_px, 0.5 * tracks.width_px, 0.5 * tracks.height_px, distortion])
    return Camera(
        model=model, width_px=tracks.width_px, height_px=tracks.height_px, params=params, refine=True
    )


def _minimum(cost: FloatArray) -> tuple[float, float]:
    """Return log focal factor and distortion change at the minimum of a paraboloid on a grid of costs."""
    focal, change = np.meshgrid(np.log(_FINE_FOCAL), _FINE_DISTORTION, indexing="ij")
    row, column = np.unravel_index(int(np.argmin(cost)), cost.shape)
    rows = slice(max(0, min(row - 1, len(_FINE_FOCAL) - 3)), None)
    columns = slice(max(0, min(column - 1, len(_FINE_DISTORTION) - 3)), None)
    x, y, z = (item[rows, columns][:3, :3].ravel() for item in (focal, change, cost))
    terms = np.column_stack([np.ones(9), x, y, x * x, x * y, y * y])
    _, a, b, aa, ab, bb = np.linalg.lstsq(terms, z, rcond=None)[0]
    hessian = np.array([[2 * aa, ab], [ab, 2 * bb]])
    best = np.array([focal[row, column], change[row, column]])
    if np.linalg.eigvalsh(hessian)[0] <= 0.0:
        return float(best[0]), float(best[1])
    found = -np.linalg.solve(hessian, np.array([a, b]))
    step = np.array([np.log(_FINE_FOCAL[1] / _FINE_FOCAL[0]), _FINE_DISTORTION[1] - _FINE_DISTORTION[0]])
    found = np.clip(found, best - step, best + step)
    return float(found[0]), float(found[1])


def _choose_pairs(tracks: PointTracks, times_ns: IntArray) -> list[tuple[int, int]]:
    """Return pairs of frames with enough motion and points, evenly in time."""
    low, high = np.array(_SHIFT_PX) * pixel_scale(tracks.width_px, tracks.height_px)
    starts = np.unique(np.linspace(0, tracks.frame_count - 2, 4 * _PAIRS).astype(int))
    found = list[tuple[int, int]]()
    for start in starts.tolist():
        last = int(np.searchsorted(times_ns, times_ns[start] + int(_MAX_SPAN_S * 1e9)))
        gaps = np.unique(np.geomspace(1, max(1, last - start), 8).astype(int))
        for gap in gaps[::-1].tolist():
            if start + gap >= tracks.frame_count:
                continue
            _, one, other = tracks.between(start, start + gap)
            if len(one) < _MIN_POINTS:
                continue
            if low <= float(np.median(np.linalg.norm(other - one, axis=1))) <= high:
                found.append((start, start + gap))
                break
    chosen = np.unique(np.linspace(0, len(found) - 1, min(len(found), _PAIRS)).astype(int))
    return [found[number] for number in chosen.tolist()] if found else []


@dataclass(frozen=True, slots=True)
class _Problem:
    """Points of all pairs of frames.

    Attributes:
        first_px: (P,K,2) points in the first frame of each pair, px.
        second_px: (P,K,2) points in the second frame, px.
        valid: (P,K) False where a pair has fewer than K points.
        error_px: Scale of the robust loss, px.
    """

    first_px: FloatArray
    second_px: FloatArray
    valid: BoolArray
    error_px: float

    @staticmethod
    def create(tracks: PointTracks, pairs: list[tuple[int, int]]) -> _Problem:
        shape = (len(pairs), _POINTS)
        first, second = np.zeros((*shape, 2)), np.zeros((*shape, 2))
        valid = np.zeros(shape, dtype=bool)
        for number, pair in enumerate(pairs):
            _, one, other = tracks.between(*pair)
            rows = np.unique(np.linspace(0, len(one) - 1, min(len(one), _POINTS)).astype(int))
            first[number, : len(rows)], second[number, : len(rows)] = one[rows], other[rows]
            valid[number, : len(rows)] = True
        scale = pixel_scale(tracks.width_px, tracks.height_px)
        return _Problem(first, second, valid, _ERROR_PX * scale)

    def start_by_rotation(self, lens: Camera) -> _Poses:
        """Return the rotations that fit best, and translations that fit them."""
        rays = _Rays.create(self, lens)
        rotation = _fit_rotations(rays)
        return rotation, _translations(rotation, rays)

    def start_by_ransac(self, lens: Camera) -> _Poses:
        """Return the poses of essential matrices by RANSAC; the best rotations where there is none."""
        import cv2

        rays = _Rays.create(self, lens)
        rotation = _fit_rotations(rays)
        translation = _translations(rotation, rays)
        by_ransac = rotation.copy(), translation.copy()
        for pair, valid in enumerate(
            rays.valid & (rays.first[:, :, 2] > _MIN_AHEAD) & (rays.second[:, :, 2] > _MIN_AHEAD)
        ):
            if valid.sum() < _MIN_POINTS // 2:
                continue
            first, second = (
                item[pair, valid, :2] / item[pair, valid, 2:] for item in (rays.first, rays.second)
            )
            essential, _ = cv2.findEssentialMat(
                first, second, np.eye(3), cv2.RANSAC, 0.99, 2.0 * self.error_px / lens.focal_px, _TRIALS
            )
            if essential is None or essential.shape != (3, 3):
                continue
            one, other, direction = cv2.decomposeEssentialMat(essential)
            turns = [np.trace(found @ rotation[pair].T) for found in (one, other)]
            by_ransac[0][pair] = (one, other)[int(np.argmax(turns))]
            by_ransac[1][pair] = direction.ravel()
        return by_ransac

    def cost(self, lens: Camera, starts: list[_Poses]) -> tuple[FloatArray, _Poses]:
        """Return the robust cost (P,) of each pair for a lens, and the relative poses that minimise it.

        Args:
            lens: The lens.
            starts: Rotations (P,3,3) and unit translations (P,3) to start from. For each pair, the result of
                the best start counts.
        """
        rays = _Rays.create(self, lens)
        best: tuple[FloatArray, _Poses] | None = None
        for start in starts:
            poses = start
            for _ in range(_STEPS):
                poses = _step(poses, rays, self.error_px)
            residual = _residuals_px(poses, rays)[0] / self.error_px
            # A point without a line of sight through this lens costs as much as a wrong one.
            loss = np.where(rays.valid, np.log1p(np.minimum(residual**2, _WRONG**2)), np.log1p(_WRONG**2))
            cost = (loss * self.valid).sum(axis=1)
            if best is None:
                best = cost, poses
            else:
                better = cost < best[0]
                rotation = np.where(better[:, None, None], poses[0], best[1][0])
                translation = np.where(better[:, None], poses[1], best[1][1])
                best = np.minimum(cost, best[0]), (rotation, translation)
        assert best is not None
        return best

    def residuals_px(self, lens: Camera, poses: _Poses) -> FloatArray:
        """Return the distances (P,K) of the points from their epipolar lines, px."""
        return _residuals_px(poses, _Rays.create(self, lens))[0]


@dataclass(frozen=True, slots=True)
class _Rays:
    """The lines of sight of all points through a lens.

    Attributes:
        first: (P,K,3) unit directions in the first frames.
        second: (P,K,3) unit directions in the second frames.
        by_first_px: (P,K,3,2) derivatives of `first` by the pixels.
        by_second_px: (P,K,3,2) derivatives of `second` by the pixels.
        valid: (P,K) False without a line of sight.
    """

    first: FloatArray
    second: FloatArray
    by_first_px: FloatArray
    by_second_px: FloatArray
    valid: BoolArray

    @staticmethod
    def create(problem: _Problem, lens: Camera) -> _Rays:
        shape = problem.valid.shape

        def rays(px: FloatArray) -> FloatArray:
            return unit_directions(lens.unproject(px.reshape(-1, 2))).reshape(*shape, 3)

        pair = []
        for px in (problem.first_px, problem.second_px):
            centre = rays(px)
            sides = [(rays(px + np.eye(2)[axis]) - centre) for axis in range(2)]
            pair.append((centre, np.stack(sides, axis=3)))
        (first, by_first), (second, by_second) = pair
        finite: BoolArray = np.asarray(
            np.isfinite(by_first).all(axis=(2, 3)) & np.isfinite(by_second).all(axis=(2, 3))
        )
        ahead = np.array([0.0, 0.0, 1.0])
        return _Rays(
            first=np.where(finite[:, :, None], first, ahead),
            second=np.where(finite[:, :, None], second, ahead),
            by_first_px=np.where(finite[:, :, None, None], by_first, 0.0),
            by_second_px=np.where(finite[:, :, None, None], by_second, 0.0),
            valid=problem.valid & finite,
        )


def _fit_rotations(rays: _Rays) -> FloatArray:
    """Return the rotations (P,3,3) that fit the rays best, robustly."""
    weight = rays.valid.astype(float)
    rotation = np.broadcast_to(np.eye(3), (len(weight), 3, 3))
    for _ in range(4):
        u, _, vt = np.linalg.svd(np.einsum("pk,pki,pkj->pij", weight, rays.second, rays.first))
        u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
        rotation = u @ vt
        squared = ((rays.second - np.einsum("pij,pkj->pki", rotation, rays.first)) ** 2).sum(axis=2)
        median = np.nanmedian(np.where(rays.valid, squared, np.nan), axis=1)
        weight = rays.valid / (1.0 + squared / (np.nan_to_num(median, nan=1.0)[:, None] + 1e-18))
    return np.asarray(rotation)


def _translations(rotation: FloatArray, rays: _Rays) -> FloatArray:
    """Return the unit translations (P,3) that fit given rotations."""
    normal = np.cross(np.einsum("pij,pkj->pki", rotation, rays.first), rays.second)
    size = np.linalg.norm(normal, axis=2)
    weight = rays.valid / (size**2 + np.median(size[rays.valid]) ** 2 + 1e-18)
    return np.asarray(np.linalg.eigh(np.einsum("pk,pki,pkj->pij", weight, normal, normal))[1][:, :, 0])


def _residuals_px(poses: _Poses, rays: _Rays) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the distances (P,K) of the points from their epipolar lines, px (Sampson's approximation).

    Returns:
        The distances; the turned rays (P,K,3); the sizes (P,K) of the derivatives by the pixels.
    """
    rotation, translation = poses
    turned = np.einsum("pij,pkj->pki", rotation, rays.first)
    plane = np.cross(translation[:, None], turned)
    other = np.einsum("pji,pkj->pki", rotation, np.cross(rays.second, translation[:, None]))
    squared = (np.einsum("pki,pkij->pkj", plane, rays.by_second_px) ** 2).sum(axis=2)
    squared += (np.einsum("pki,pkij->pkj", other, rays.by_first_px) ** 2).sum(axis=2)
    size = np.sqrt(squared) + 1e-9
    return np.einsum("pki,pki->pk", plane, rays.second) / size, turned, size


def _step(poses: _Poses, rays: _Rays, error_px: float) -> _Poses:
    """Return the poses after one robust Gauss–Newton step.

    Args:
        poses: Rotations (P,3,3) and unit translations (P,3).
        rays: Lines of sight.
        error_px: Scale of the robust loss, px.
    """
    rotation, translation = poses
    residual, turned, size = _residuals_px(poses, rays)
    weight = rays.valid / (1.0 + (residual / error_px) ** 2)
    # t · ((ω × a) × b) = ω · (a × (b × t))
    by_rotation = np.cross(turned, np.cross(rays.second, translation[:, None]))
    tangent = np.linalg.svd(translation[:, :, None])[0][:, :, 1:]
    by_translation = np.einsum("pki,pij->pkj", np.cross(turned, rays.second), tangent)
    jacobian = np.concatenate([by_rotation, by_translation], axis=2) / size[:, :, None]
    hessian = np.einsum("pk,pki,pkj->pij", weight, jacobian, jacobian)
    gradient = np.einsum("pk,pki,pk->pi", weight, jacobian, residual)
    damping = 1e-3 * np.einsum("pii->p", hessian)[:, None, None] / 5.0 + 1e-9
    change = -np.linalg.solve(hessian + damping * np.eye(5), gradient[:, :, None])[:, :, 0]
    for part, limit in ((slice(0, 3), _MAX_TURN_RAD), (slice(3, 5), _MAX_TILT_RAD)):
        length = np.linalg.norm(change[:, part], axis=1, keepdims=True)
        change[:, part] *= np.minimum(1.0, limit / (length + 1e-12))
    moved = translation + np.einsum("pij,pj->pi", tangent, change[:, 3:])
    moved /= np.linalg.norm(moved, axis=1, keepdims=True)
    return np.asarray(so3_exp(change[:, :3]) @ rotation), np.asarray(moved)
