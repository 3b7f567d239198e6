"""Estimate the lens of a camera from the tracks of its video, before there is a map.

Two pictures of a rigid room determine the lens together with the relative pose, if the camera turned between
them: a wrong lens bends the lines of sight, and no pose makes them meet. One picture pair says little; all
pairs of a video have the same lens. Evidence: docs/decisions/tracks.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import count

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import skew, so3_exp
from bodycap_batch.model.lens_estimate import LensEstimate
from bodycap_batch.model.optical_flow import pixel_scale, unit_directions
from bodycap_batch.model.point_tracks import PointTracks
from bodycap_batch.tracks.relative_motion import cross

_PAIRS = 36
"""Number of pairs of frames. Evidence: none."""
_POINTS = 100
"""Maximum number of points of a pair. Evidence: none."""
_MIN_POINTS = 40
"""Minimum number of points of a pair. Origin: eight for each of its five unknowns."""
_SHIFT_PX = (25.0, 120.0)
"""Minimum and maximum median displacement between the frames of a pair, px of an image with a long side of
640 px. A smaller one does not determine a pose; after a larger one, few tracks are left."""
_MAX_SPAN_S = 1.0
"""Maximum time between the frames of a pair, seconds. Tracks drift. Evidence: docs/decisions/tracks.md."""
_ERROR_PX = 0.5
"""Scale of the robust loss, px of an image with a long side of 640 px: the error of a track after a second.
Evidence: none."""
_ANCHORS = (0.4, 0.7, 1.2)
"""Focal lengths, as a share of the long side, at which RANSAC searches the poses to start from. A start that
suits a lens which is a third longer or shorter is improved by the steps."""
_TRIALS = 60
"""Maximum number of trials of RANSAC for a pair. Each takes 0.1 ms."""
_MIN_PAIRS = 6
"""Minimum number of pairs. Evidence: none."""
_STEPS = 6
"""Number of Gauss–Newton steps for each lens. Evidence: none."""
_MIN_AHEAD = 0.2
"""Minimum cosine between a line of sight and the axis of the lens for the five-point algorithm: it knows no
points beside the camera."""
_FOCAL_RATIOS = np.geomspace(0.25, 2.0, 13)
"""Focal lengths that are tried first, as a share of the long side. Origin: a fisheye lens of 200 degrees, and
a field of view of 28 degrees."""
_DISTORTIONS = {"SIMPLE_RADIAL": (-0.25, -0.1), "SIMPLE_RADIAL_FISHEYE": (-0.1, -0.03, 0.03)}
"""By lens model, the radial distortions that are tried besides 0."""
_BEST_FOCAL = 3
"""Number of focal lengths for which they are tried: those with the least cost without distortion."""
_CANDIDATES = 4
"""Number of lenses from which lens, readout times and poses are fitted together. Evidence:
docs/decisions/tracks.md."""
_ROUNDS, _JOINT_STEPS = 2, 8
"""Number of rounds, each after a search of poses by RANSAC, and of steps of a round. Evidence:
docs/decisions/tracks.md."""
_JOINT_DAMPING = 1e-5
"""Damping of the poses in the first of these steps. With more, the poses hold the readout time where it
began. Evidence: docs/decisions/tracks.md."""
_DIFFERENCES = np.array([1e-3, 1e-3, 5e-4, 5e-4])
"""Differences of log focal length, distortion and readout times (seconds) for derivatives."""
_MAX_CHANGE = np.array([0.1, 0.05, 0.01, 0.01])
"""Maximum changes of these in one step."""
_DISTORTION_SIGMA, _READOUT_SIGMA_S = 0.05, 0.015
"""Usual deviations of the distortion from the start of a fit, and of the readout times from 0 (seconds).
Evidence: none."""
_MAX_PINCUSHION = 0.03
"""Maximum growth of the distortion in a fit. A longer focal length with pincushion distortion fits turns of a
few degrees as well, but lenses of cameras have barrel distortion. Evidence: docs/decisions/tracks.md."""
_PRIOR = np.diag([0.0, 1.0 / _DISTORTION_SIGMA**2, *[1.0 / _READOUT_SIGMA_S**2] * 2])
"""Information matrix of these deviations. It shortens steps where the pairs determine little. Whether a step
is taken depends on the pairs alone."""
_LEAST_SIGMA = 0.01
"""Least standard deviation of the logarithm of a focal length. Evidence: none."""
_DAMPING = 1e-3
"""Damping of the Gauss–Newton steps, as a share of the mean of the diagonal."""
_WRONG = 10.0
"""Residual of a wrong point, as a multiple of the scale of the loss: larger ones cost no more."""
_MAX_TURN_RAD = 0.2
"""Maximum rotation of one step, radians."""
_MAX_TILT_RAD = 0.7
"""Maximum change of the direction of a translation in one step, radians."""
_RESAMPLES = 100
"""Number of draws of pairs with replacement, for the standard deviation (bootstrap)."""
_SIGMA_FACTOR = 2.5
"""Factor of the standard deviation. Neighbouring pairs have tracks in common. Evidence:
docs/decisions/tracks.md."""
_SEED = 0
"""Seed of these draws."""


_Poses = tuple[FloatArray, FloatArray]
"""Rotations (P,3,3) and unit translations (P,3) of the second frames of the pairs from the first frames."""


def estimate_lens(
    tracks: PointTracks, times_ns: IntArray, progress: Callable[[int, int], None] | None = None
) -> LensEstimate | None:
    """Estimate focal length and radial distortion of a camera.

    The readout times along both axes of the picture are estimated with the lens, because a rolling shutter
    bends the lines of sight as a wrong lens does. They are 0 for a global shutter.

    Args:
        tracks: Tracks in the room.
        times_ns: (N,) times of the frames, nanoseconds.
        progress: Receives the number of finished steps and of all steps.

    Returns:
        The lens; None if there are too few pairs of frames with motion.

    Source: Kneip, Lynen, "Direct optimization of frame-to-frame rotation", ICCV 2013, for the relative pose
        with an eliminated translation; Brückner and others, "Active self-calibration of multi-camera
        systems", DAGM 2010, for a lens scored on two-view geometry.
    """
    pairs = _choose_pairs(tracks, times_ns)
    if len(pairs) < _MIN_PAIRS:
        return None
    problem = _Problem.create(tracks, times_ns, pairs)
    steps, total = count(1), len(_DISTORTIONS) * len(_FOCAL_RATIOS) + _CANDIDATES * _ROUNDS * _JOINT_STEPS

    def step() -> None:
        if progress is not None:
            progress(next(steps), total)

    solutions = [_solve(problem, shared, poses, step) for shared, poses in _search(problem, step)]
    best = min(solutions, key=lambda each: each.cost.sum())
    rng = np.random.default_rng(_SEED)
    equations = [each.linearised(problem, _JOINT_DAMPING) for each in solutions]
    log_focal = list[float]()
    for _ in range(_RESAMPLES):
        rows = rng.integers(0, len(pairs), len(pairs))
        number = int(np.argmin([each.cost[rows].sum() for each in solutions]))
        shared = solutions[number].shared
        log_focal.append(float(np.log(shared.lens.focal_px)) + equations[number].change(shared, rows)[0])
    return LensEstimate(
        lens=replace(best.shared.lens, refine=True),
        focal_sigma=max(_SIGMA_FACTOR * float(np.std(log_focal)), _LEAST_SIGMA),
        pairs=len(pairs),
        error_px=float(np.median(np.abs(best.system.residual[problem.valid]))),
    )


def _search(problem: _Problem, step: Callable[[], None]) -> list[tuple[_Shared, _Poses]]:
    """Return the best of a wide range of lenses, and the relative poses of the pairs with each of them."""
    width_px, height_px = problem.size_px
    long_side = max(width_px, height_px)

    def make(model: str, focal_px: float, distortion: float) -> _Shared:
        params = np.array([focal_px, 0.5 * width_px, 0.5 * height_px, distortion])
        lens = Camera(model=model, width_px=width_px, height_px=height_px, params=params)
        return _Shared(lens, distortion)

    tried = list[tuple[float, _Shared, _Poses]]()
    anchors = [
        problem.rays(make("SIMPLE_RADIAL", ratio * long_side, 0.0)).start_by_ransac(problem)
        for ratio in _ANCHORS
    ]
    for model, distortions in _DISTORTIONS.items():
        own = list[tuple[float, _Shared, _Poses]]()
        before: list[_Poses] = []
        for ratio in _FOCAL_RATIOS.tolist():
            shared = make(model, ratio * long_side, 0.0)
            rays = problem.rays(shared)
            cost, poses = problem.cost(rays, [rays.start_by_rotation(), *anchors, *before])
            own.append((float(cost.sum()), shared, poses))
            before = [poses]
            step()
        for _, shared, poses in sorted(own, key=lambda item: item[0])[:_BEST_FOCAL]:
            for distortion in distortions:
                bent = make(model, shared.lens.focal_px, distortion)
                cost, bent_poses = problem.cost(problem.rays(bent), [poses, *anchors])
                tried.append((float(cost.sum()), bent, bent_poses))
        tried += own
    return [(shared, poses) for _, shared, poses in sorted(tried, key=lambda item: item[0])[:_CANDIDATES]]


@dataclass(frozen=True, slots=True)
class _Shared:
    """What all pairs of frames have in common.

    Attributes:
        lens: The lens.
        usual_distortion: The distortion at the start of the fit.
        readout_s: (2,) time from the first to the last column, and from the first to the last row, seconds.
            A sensor reads rows or columns, so one of the two should be 0. Which one depends on how the camera
            was held, which is often unknown.
    """

    lens: Camera
    usual_distortion: float
    readout_s: FloatArray = field(default_factory=lambda: np.zeros(2))

    def changed(self, change: FloatArray) -> _Shared:
        """Return the values after a change (4,) of log focal length, distortion and the readout times."""
        params = self.lens.params.copy()
        params[0] *= np.exp(change[0])
        params[3] += change[1]
        return replace(self, lens=replace(self.lens, params=params), readout_s=self.readout_s + change[2:])

    def prior_gradient(self) -> FloatArray:
        """Return the gradient (4,) of the cost of unusual values."""
        bent = self.lens.params[3] - self.usual_distortion
        return np.asarray(_PRIOR @ np.array([0.0, bent, *self.readout_s]))


@dataclass(frozen=True, slots=True)
class _Solution:
    """Lens, readout times and relative poses, and the robust normal equations around them.

    Attributes:
        shared: What all pairs have in common.
        poses: The relative poses.
        cost: (P,) robust cost of each pair.
        system: The equations of the poses.
        rays: The lines of sight.
    """

    shared: _Shared
    poses: _Poses
    cost: FloatArray
    system: _System
    rays: _Rays

    @staticmethod
    def create(problem: _Problem, shared: _Shared, poses: _Poses) -> _Solution:
        """Set up the equations at given values."""
        rays = problem.rays(shared)
        system = _System.create(poses, rays, problem.error_px)
        return _Solution(shared, poses, problem.robust_cost(system.residual, rays), system, rays)

    def linearised(self, problem: _Problem, damping: float) -> _Linearised:
        """Return the equations of the shared values, without the poses."""
        derivatives = [
            (_residuals_px(self.poses, problem.rays(self.shared.changed(change)))[0] - self.system.residual)
            / change.sum()
            for change in np.diag(_DIFFERENCES)
        ]
        by_shared = np.stack(derivatives, axis=2)
        weighted = (self.system.weight[:, :, None] * by_shared).swapaxes(1, 2)
        mixed = weighted @ self.system.jacobian
        damped = self.system.damped(damping)
        by_poses = np.asarray(np.linalg.solve(damped, mixed.swapaxes(1, 2)))
        offset = np.asarray(np.linalg.solve(damped, self.system.gradient[:, :, None]))
        hessian = weighted @ by_shared - mixed @ by_poses
        gradient = weighted @ self.system.residual[:, :, None] - mixed @ offset
        scale = problem.error_px**2
        return _Linearised(hessian / scale, gradient[:, :, 0] / scale, by_poses, offset[:, :, 0])


@dataclass(frozen=True, slots=True)
class _Linearised:
    """Normal equations of the shared values.

    Attributes:
        hessian: (P,4,4) normal matrix of each pair.
        gradient: (P,4) gradient of each pair.
        by_poses: (P,5,4) negative changes of the poses with those of the shared values.
        offset: (P,5) negative changes of the poses without these.
    """

    hessian: FloatArray
    gradient: FloatArray
    by_poses: FloatArray
    offset: FloatArray

    def change(self, shared: _Shared, rows: IntArray | slice, damping: float = 0.0) -> FloatArray:
        """Return the change (4,) of the shared values that some pairs ask for."""
        hessian = self.hessian[rows].sum(axis=0)
        hessian += _PRIOR + damping * np.diag(np.diag(hessian))
        gradient = self.gradient[rows].sum(axis=0) + shared.prior_gradient()
        change = -np.linalg.solve(hessian, gradient)
        highest = max(0.0, shared.usual_distortion + _MAX_PINCUSHION - shared.lens.params[3])
        if change[1] > highest:
            others = [0, 2, 3]
            change[1] = highest
            right = gradient[others] + hessian[others, 1] * highest
            change[others] = -np.linalg.solve(hessian[np.ix_(others, others)], right)
        return np.asarray(np.clip(change, -_MAX_CHANGE, _MAX_CHANGE))


def _solve(problem: _Problem, shared: _Shared, poses: _Poses, step: Callable[[], None]) -> _Solution:
    """Fit lens, readout times and relative poses together, by steps of Levenberg and Marquardt."""
    best = _Solution.create(problem, shared, poses)
    for _ in range(_ROUNDS):
        _, poses = problem.cost(best.rays, [best.poses, best.rays.start_by_ransac(problem)])
        best = _Solution.create(problem, best.shared, poses)
        damping = _JOINT_DAMPING
        for _ in range(_JOINT_STEPS):
            equations = best.linearised(problem, damping)
            change = equations.change(best.shared, slice(None), damping)
            moved = best.system.moved(best.poses, -equations.offset - equations.by_poses @ change)
            found = _Solution.create(problem, best.shared.changed(change), moved)
            if found.cost.sum() < best.cost.sum():
                best, damping = found, damping / 10.0
            else:
                damping *= 10.0
            step()
    return best


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


def _speeds(tracks: PointTracks, times_ns: IntArray, frame: int, wanted: IntArray) -> FloatArray:
    """Return the speeds (K,2) of some tracks (K,) in a frame, px/s; 0 for a track of one frame."""
    own_track, own_px = tracks.at(frame)
    row = np.searchsorted(own_track, wanted)
    moved, seconds = np.zeros((len(wanted), 2)), np.zeros(len(wanted))
    for neighbour in (frame - 1, frame + 1):
        if not 0 <= neighbour < tracks.frame_count:
            continue
        track, px = tracks.at(neighbour)
        if len(track) == 0:
            continue
        other = np.minimum(np.searchsorted(track, wanted), len(track) - 1)
        has = track[other] == wanted
        moved[has] += (neighbour - frame) * (px[other[has]] - own_px[row[has]])
        seconds[has] += abs(int(times_ns[neighbour] - times_ns[frame])) / 1e9
    return np.asarray(moved / np.maximum(seconds, 1e-9)[:, None])


@dataclass(frozen=True, slots=True)
class _Problem:
    """Points of all pairs of frames.

    Attributes:
        first_px: (P,K,2) points in the first frame of each pair, px.
        second_px: (P,K,2) points in the second frame, px.
        first_px_s: (P,K,2) speeds of the points in the first frame, px/s, if all rows had one time.
        second_px_s: (P,K,2) the same in the second frame.
        valid: (P,K) False where a pair has fewer than K points.
        error_px: Scale of the robust loss, px.
        size_px: Width and height of the pictures, px.
    """

    first_px: FloatArray
    second_px: FloatArray
    first_px_s: FloatArray
    second_px_s: FloatArray
    valid: BoolArray
    error_px: float
    size_px: tuple[int, int]

    @staticmethod
    def create(tracks: PointTracks, times_ns: IntArray, pairs: list[tuple[int, int]]) -> _Problem:
        """Take the points of some pairs of frames (P,2)."""
        px = np.zeros((2, len(pairs), _POINTS, 2))
        px_s = np.zeros_like(px)
        valid = np.zeros(px.shape[1:3], dtype=bool)
        for number, pair in enumerate(pairs):
            track, *both = tracks.between(*pair)
            rows = np.unique(np.linspace(0, len(track) - 1, min(len(track), _POINTS)).astype(int))
            valid[number, : len(rows)] = True
            for side in range(2):
                px[side, number, : len(rows)] = both[side][rows]
                px_s[side, number, : len(rows)] = _speeds(tracks, times_ns, pair[side], track[rows])
        scale = pixel_scale(tracks.width_px, tracks.height_px)
        size_px = tracks.width_px, tracks.height_px
        return _Problem(px[0], px[1], px_s[0], px_s[1], valid, _ERROR_PX * scale, size_px)

    def rays(self, shared: _Shared) -> _Rays:
        """Return the lines of sight of the points where they were when the middle of the picture was read."""

        def moved(px: FloatArray, px_s: FloatArray) -> FloatArray:
            by_px = shared.readout_s / np.array(self.size_px)
            # Two frames see a point that moves to another row with another interval.
            true_px_s = px_s / (1.0 + px_s @ by_px)[:, :, None]
            late_s = px @ by_px - 0.5 * shared.readout_s.sum()
            return np.asarray(px - true_px_s * late_s[:, :, None])

        pixels = moved(self.first_px, self.first_px_s), moved(self.second_px, self.second_px_s)
        return _Rays.create(*pixels, self.valid, shared.lens)

    def cost(self, rays: _Rays, starts: list[_Poses]) -> tuple[FloatArray, _Poses]:
        """Return the robust cost (P,) of each pair, and the relative poses that minimise it.

        Args:
            rays: The lines of sight through a lens.
            starts: Rotations (P,3,3) and unit translations (P,3) to start from. For each pair, the result of
                the best start counts.
        """
        best: tuple[FloatArray, _Poses] | None = None
        for start in starts:
            poses = start
            for _ in range(_STEPS):
                system = _System.create(poses, rays, self.error_px)
                poses = system.moved(poses, system.step())
            cost = self.robust_cost(_residuals_px(poses, rays)[0], rays)
            if best is None:
                best = cost, poses
            else:
                better = cost < best[0]
                rotation = np.where(better[:, None, None], poses[0], best[1][0])
                translation = np.where(better[:, None], poses[1], best[1][1])
                best = np.minimum(cost, best[0]), (rotation, translation)
        assert best is not None
        return best

    def robust_cost(self, residual_px: FloatArray, rays: _Rays) -> FloatArray:
        """Return the robust cost (P,) of each pair with some distances (P,K) from the epipolar lines."""
        residual = residual_px / self.error_px
        # A point without a line of sight through this lens costs as much as a wrong one.
        loss = np.where(rays.valid, np.log1p(np.minimum(residual**2, _WRONG**2)), np.log1p(_WRONG**2))
        return np.asarray((loss * self.valid).sum(axis=1))


@dataclass(frozen=True, slots=True)
class _Rays:
    """The lines of sight of all points through a lens.

    Attributes:
        first: (P,K,3) unit directions in the first frames.
        second: (P,K,3) unit directions in the second frames.
        by_first_px: (P,K,3,2) derivatives of `first` by the pixels.
        by_second_px: (P,K,3,2) derivatives of `second` by the pixels.
        valid: (P,K) False without a line of sight.
        focal_px: Focal length, px.
    """

    first: FloatArray
    second: FloatArray
    by_first_px: FloatArray
    by_second_px: FloatArray
    valid: BoolArray
    focal_px: float

    @staticmethod
    def create(first_px: FloatArray, second_px: FloatArray, given: BoolArray, lens: Camera) -> _Rays:
        """Return the lines of sight of points (P,K,2) through a lens."""
        shape = given.shape

        def rays(px: FloatArray) -> FloatArray:
            return unit_directions(lens.unproject(px.reshape(-1, 2))).reshape(*shape, 3)

        pair = []
        for px in (first_px, second_px):
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
            valid=given & finite,
            focal_px=lens.focal_px,
        )

    def start_by_rotation(self) -> _Poses:
        """Return the rotations that fit best, and translations that fit them."""
        rotation = _fit_rotations(self)
        return rotation, _translations(rotation, self)

    def start_by_ransac(self, problem: _Problem) -> _Poses:
        """Return the poses of essential matrices by RANSAC; the best rotations where there is none."""
        import cv2

        rotation, translation = self.start_by_rotation()
        by_ransac = rotation.copy(), translation.copy()
        for pair, valid in enumerate(
            self.valid & (self.first[:, :, 2] > _MIN_AHEAD) & (self.second[:, :, 2] > _MIN_AHEAD)
        ):
            if valid.sum() < _MIN_POINTS // 2:
                continue
            first, second = (
                item[pair, valid, :2] / item[pair, valid, 2:] for item in (self.first, self.second)
            )
            essential, _ = cv2.findEssentialMat(
                first, second, np.eye(3), cv2.RANSAC, 0.99, 2.0 * problem.error_px / self.focal_px, _TRIALS
            )
            if essential is None or essential.shape != (3, 3):
                continue
            one, other, direction = cv2.decomposeEssentialMat(essential)
            turns = [np.trace(found @ rotation[pair].T) for found in (one, other)]
            by_ransac[0][pair] = (one, other)[int(np.argmax(turns))]
            by_ransac[1][pair] = direction.ravel()
        return by_ransac


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
    turned = rays.first @ rotation.swapaxes(1, 2)
    across = skew(translation)
    plane = turned @ across.swapaxes(1, 2)
    other = rays.second @ across @ rotation
    by_second = np.einsum("pki,pkij->pkj", plane, rays.by_second_px)
    by_first = np.einsum("pki,pkij->pkj", other, rays.by_first_px)
    squared = np.einsum("pkj,pkj->pk", by_second, by_second) + np.einsum("pkj,pkj->pk", by_first, by_first)
    size = np.sqrt(squared) + 1e-9
    return np.einsum("pki,pki->pk", plane, rays.second) / size, turned, size


@dataclass(frozen=True, slots=True)
class _System:
    """The robust normal equations of the relative poses.

    Attributes:
        residual: (P,K) distances of the points from their epipolar lines, px.
        weight: (P,K) weights of the points.
        jacobian: (P,K,5) derivatives of the distances by a turn and by two tilts of the translation.
        hessian: (P,5,5) normal matrices.
        gradient: (P,5) gradients.
        tangent: (P,3,2) directions of the tilts.
    """

    residual: FloatArray
    weight: FloatArray
    jacobian: FloatArray
    hessian: FloatArray
    gradient: FloatArray
    tangent: FloatArray

    @staticmethod
    def create(poses: _Poses, rays: _Rays, error_px: float) -> _System:
        """Set up the equations at some rotations (P,3,3) and unit translations (P,3)."""
        translation = poses[1]
        residual, turned, size = _residuals_px(poses, rays)
        weight = rays.valid / (1.0 + (residual / error_px) ** 2)
        # t · ((ω × a) × b) = ω · (a × (b × t))
        by_rotation = cross(turned, rays.second @ skew(translation))
        tangent = np.linalg.svd(translation[:, :, None])[0][:, :, 1:]
        by_translation = cross(turned, rays.second) @ tangent
        jacobian = np.concatenate([by_rotation, by_translation], axis=2) / size[:, :, None]
        weighted = (weight[:, :, None] * jacobian).swapaxes(1, 2)
        hessian = weighted @ jacobian
        gradient = (weighted @ residual[:, :, None])[:, :, 0]
        return _System(residual, weight, jacobian, hessian, gradient, tangent)

    def damped(self, damping: float) -> FloatArray:
        """Return the normal matrices (P,5,5) with a share of the mean of their diagonals added to these."""
        level = damping * np.einsum("pii->p", self.hessian) / 5.0 + 1e-9
        return np.asarray(self.hessian + level[:, None, None] * np.eye(5))

    def step(self) -> FloatArray:
        """Return the change (P,5) of the poses by a Gauss–Newton step."""
        return np.asarray(-np.linalg.solve(self.damped(_DAMPING), self.gradient[:, :, None])[:, :, 0])

    def moved(self, poses: _Poses, change: FloatArray) -> _Poses:
        """Return the poses after a change (P,5), which is shortened if it is large."""
        change = change.copy()
        for part, limit in ((slice(0, 3), _MAX_TURN_RAD), (slice(3, 5), _MAX_TILT_RAD)):
            length = np.linalg.norm(change[:, part], axis=1, keepdims=True)
            change[:, part] *= np.minimum(1.0, limit / (length + 1e-12))
        direction = poses[1] + np.einsum("pij,pj->pi", self.tangent, change[:, 3:])
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return np.asarray(so3_exp(change[:, :3]) @ poses[0]), np.asarray(direction)
