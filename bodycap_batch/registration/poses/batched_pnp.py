"""Refine the poses of many frames at once from observed map points: robust Gauss–Newton, batched in numpy."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import make_transform, so3_exp, transform_points
from bodycap_batch.model.reprojection_derivatives import (
    common_error_ratio,
    picture_cells,
    pose_derivatives,
    projection_jacobian,
    weighted_hessians,
)

_CHUNK_FRAMES = 48
"""Number of frames solved together. More frames reduce numpy's overhead per frame; fewer frames fit into the
processor's cache."""
_BATCH_ROWS = 1 << 14
"""Maximum number of observations that are undistorted in one call. Undistortion temporarily needs ten times
the memory of its result."""
_MAX_ITERATIONS = 20
"""Maximum number of Gauss–Newton iterations. Evidence: none."""
_CONVERGED_PX = 1e-2
"""Maximum movement of the projected points in the last iteration. Unit: pixels. The iterations of a pose end
if the points move by a smaller distance. Origin: a third of the standard error of the mean of 200 points with
0.5 px of noise. Evidence: docs/decisions/registration.md."""
_MAX_STEP_RAD = 0.5
"""Radians: maximum rotation in one iteration. Origin: the linearisation is not valid for larger rotations.
Evidence: none."""
_CUTOFF_MEDIANS = 3.0
"""Cut-off of residuals, as a multiple of the frame's median residual. An observation with a larger residual
has no weight. If this cut-off is smaller than the inlier limit, the inlier limit is used instead. In early
iterations the pose is inaccurate and the median is large, so the cut-off exceeds the inlier limit.
Evidence: none."""
MIN_COUNTED_WEIGHT = 0.05
"""Minimum weight of an observation that is used for the noise estimate and for RANSAC. If too few
observations have this weight, RANSAC uses all observations. Evidence: none."""
_LOSS_SCALE = 0.25
"""Scale of the Cauchy loss, as a fraction of the cut-off. Evidence: docs/decisions/registration.md."""
_DAMPING = 1e-10
"""Damping, as a fraction of the trace of the normal equations. It only prevents a singular matrix."""
_TINY = 1e-300
"""Smallest divisor. It prevents a division by zero."""
_SMALLEST_VARIANCE = 1e-12
"""Smallest variance of an angular velocity, rad²/s². It prevents a division by zero."""
_SMALLEST_NOISE_PX2 = 1e-12
"""Smallest variance of an observation, px². It prevents singular equations for a frame without inliers."""
_UNUSABLE = 1e5
"""Residual in pixels, or depth, that stands for "no usable value". It exceeds every limit."""
_MIN_OBSERVATIONS = 3
"""Minimum number of observations for a pose. Each observation gives two residuals, and a pose has six
unknowns."""


@dataclass(frozen=True, slots=True)
class RateErrors:
    """The unknown angular velocities of the frames of a rolling shutter.

    The observations are moved to the instant of the middle row with an angular velocity that has an error.

    Attributes:
        leverage_s: (M,) seconds by which the angular velocity turns the ray of each observation.
        sigma: (M,) standard deviation of the angular velocity about an axis before the observations are
            used, rad/s, for the frame of each observation.
    """

    leverage_s: FloatArray
    sigma: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Observations:
    """Map points observed in F frames, ordered by frame.

    Attributes:
        bounds: (F+1,) row bounds: the rows of frame f are [bounds[f], bounds[f+1]).
        points: (M,3) observed points in the gauge.
        rays: (M,2) undistorted observed pixels at depth 1: x/z, y/z.
        px_from_ray: (M,2,2) derivative of the pixel with respect to the ray.
        weight: (M,) inverse variance of each observation, relative to the inverse variance of the best
            observations.
        rates: How the angular velocities of a rolling shutter's frames move the observations; None if all
            observations are from one instant.
    """

    bounds: IntArray
    points: FloatArray
    rays: FloatArray
    px_from_ray: FloatArray
    weight: FloatArray
    rates: RateErrors | None = None

    def rows(self, frame: int) -> slice:
        """Return the range of rows of one frame."""
        return slice(int(self.bounds[frame]), int(self.bounds[frame + 1]))

    def select_frame(self, frame: int) -> Observations:
        """Return the observations of one frame."""
        rows = self.rows(frame)
        return Observations(
            bounds=np.array([0, rows.stop - rows.start]),
            points=self.points[rows],
            rays=self.rays[rows],
            px_from_ray=self.px_from_ray[rows],
            weight=self.weight[rows],
            rates=None
            if self.rates is None
            else RateErrors(self.rates.leverage_s[rows], self.rates.sigma[rows]),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseQuality:
    """How well each pose explains the observations of its frame.

    Attributes:
        inliers: (F,) number of observations whose residual is below the inlier limit.
        error_px: (F,) mean residual of the inliers, pixels.
        inlier_weight_ratio: (F,) ratio of the inliers' weight to the weight of all observations.
        noise_px: (F,) noise of the observations, pixels. Each residual has an x and a y component. The noise
            is the median of the absolute components, each multiplied by the root of its observation's weight.
            Only inliers with a weight of at least `MIN_COUNTED_WEIGHT` are used.
        variance_px2: (F,) variance of a residual's component, pixels squared: the reduced chi-squared of the
            inliers. It contains large errors, which the median in `noise_px` does not.
        common_px2: (F,) the same variance as it follows from the common errors of neighbouring points; see
            `common_error_ratio`. NaN if it is unknown.
        depth: (F,) median depth of the inliers, in the unit of the gauge.
        information: (F,6,6) Gauss–Newton information matrix of each pose, for 1 px of noise. It refers to a
            left perturbation of cam_from_gauge.
    """

    inliers: IntArray
    error_px: FloatArray
    inlier_weight_ratio: FloatArray
    noise_px: FloatArray
    variance_px2: FloatArray
    common_px2: FloatArray
    depth: FloatArray
    information: FloatArray


def make_observations(
    camera: Camera, bounds: IntArray, points: FloatArray, px: FloatArray, weight: FloatArray | None = None
) -> Observations:
    """Return observations with undistorted pixels, so that the iterations need no camera model.

    Args:
        camera: The camera model.
        bounds: (F+1,) row bounds of the frames, as in `Observations`.
        points: (M,3) observed points in the gauge.
        px: (M,2) observed pixels.
        weight: (M,) weights of the observations; 1 by default.
    """
    rays = np.empty((len(px), 2))
    for start in range(0, len(px), _BATCH_ROWS):
        rays[start : start + _BATCH_ROWS] = camera.unproject(px[start : start + _BATCH_ROWS])
    return Observations(
        bounds=bounds,
        points=points,
        rays=rays,
        px_from_ray=projection_jacobian(camera, rays),
        weight=np.ones(len(px)) if weight is None else weight,
    )


def refine_poses(
    observations: Observations, cam_from_gauge: FloatArray, limit_px: float, threads: int = 1
) -> FloatArray:
    """Minimise the reprojection error of each frame under a Cauchy loss, cut off at `limit_px`.

    The loss is wide while the residuals are large, and becomes narrower as the residuals decrease. The poses
    therefore converge even if the first residuals exceed the limit. Frames are independent of each other.

    Args:
        observations: Observations of F frames.
        cam_from_gauge: (F,4,4) initial poses.
        limit_px: Inlier limit, pixels.
        threads: Number of threads that solve chunks of frames. The result does not depend on it.

    Returns:
        Refined poses cam_from_gauge (F,4,4).

    Source: Holland, Welsch, "Robust regression using iteratively reweighted least-squares", 1977.
    """
    poses = cam_from_gauge.copy()

    def refine_chunk(active: IntArray) -> None:
        for _ in range(_MAX_ITERATIONS):
            poses[active], done = _gauss_newton_step(observations, active, poses[active], limit_px)
            active = active[~done]
            if len(active) == 0:
                break

    _for_each_chunk(observations, refine_chunk, threads)
    return poses


def evaluate_poses(
    observations: Observations, cam_from_gauge: FloatArray, limit_px: float, threads: int = 1
) -> PoseQuality:
    """Evaluate how well poses (F,4,4) explain the observations of their frames."""
    frame_count = len(cam_from_gauge)
    quality = PoseQuality(
        inliers=np.zeros(frame_count, np.int64),
        error_px=np.full(frame_count, np.nan),
        inlier_weight_ratio=np.zeros(frame_count),
        noise_px=np.full(frame_count, np.nan),
        variance_px2=np.full(frame_count, np.nan),
        common_px2=np.full(frame_count, np.nan),
        depth=np.full(frame_count, np.nan),
        information=np.zeros((frame_count, 6, 6)),
    )

    def evaluate_chunk(chosen: IntArray) -> None:
        rows, starts, owner = _rows_of_frames(observations, chosen)
        residual, jacobian, depth = linearise(observations, rows, cam_from_gauge[chosen][owner])
        error_px = np.hypot(residual[0], residual[1])
        inlier = error_px < limit_px
        count = np.add.reduceat(inlier, starts, dtype=np.int64)
        quality.inliers[chosen] = count
        quality.error_px[chosen] = np.add.reduceat(np.where(inlier, error_px, 0.0), starts) / np.maximum(
            count, 1
        )
        weight = observations.weight[rows]
        total = np.maximum(np.add.reduceat(weight, starts), _TINY)
        quality.inlier_weight_ratio[chosen] = np.add.reduceat(inlier * weight, starts) / total
        is_counted = inlier & (weight >= MIN_COUNTED_WEIGHT)
        scaled_px = np.abs(np.where(is_counted, residual * np.sqrt(weight), _UNUSABLE)).T.ravel()
        counted = np.add.reduceat(is_counted, starts, dtype=np.int64)
        quality.noise_px[chosen] = _segment_medians(scaled_px, np.repeat(owner, 2), 2 * starts, 2 * counted)
        quality.depth[chosen] = _segment_medians(np.where(inlier, depth, np.inf), owner, starts, count)
        used = inlier * weight
        information = weighted_hessians(jacobian, used, starts)
        redundancy = np.maximum(2 * counted - 6, 1)
        quality.variance_px2[chosen] = np.add.reduceat(used * error_px**2, starts) / redundancy
        cell = picture_cells(observations.rays[rows])
        quality.common_px2[chosen] = common_error_ratio(
            residual, jacobian, used, cell, owner, _inverse_or_nan(information)
        )
        if observations.rates is not None:
            noise_px2 = np.fmax(quality.variance_px2[chosen], np.nan_to_num(quality.common_px2[chosen]))
            taken = _information_of_rates(observations.rates, rows, jacobian, used, starts, noise_px2)
            information = information - taken
        quality.information[chosen] = information

    _for_each_chunk(observations, evaluate_chunk, threads)
    return quality


def _information_of_rates(
    rates: RateErrors,
    rows: IntArray,
    jacobian: FloatArray,
    weight: FloatArray,
    starts: IntArray,
    noise_px2: FloatArray,
) -> FloatArray:
    """Return the information (F,6,6) about poses that the unknown angular velocities take away.

    The observations of a frame determine its pose and its angular velocity together, with the sigma of the
    angular velocity as prior. What is left belongs to the pose alone.

    Args:
        rates: The angular velocities.
        rows: (N,) row indices of the observations.
        jacobian: (2,6,N) derivatives with respect to the pose, rotation first.
        weight: (N,) weights.
        starts: (F,) first row of each frame.
        noise_px2: (F,) variance of an observation with the weight 1, pixels squared.

    Source: the Schur complement, as in Triggs et al., "Bundle adjustment: a modern synthesis", 2000,
        section 6.
    """
    lag = rates.leverage_s[rows]
    weighted = jacobian * (weight * lag)
    cross = np.empty((len(starts), 6, 3))
    own = np.empty((len(starts), 3, 3))
    for j in range(3):
        for i in range(6):
            entry = weighted[0, i] * jacobian[0, j] + weighted[1, i] * jacobian[1, j]
            cross[:, i, j] = np.add.reduceat(entry, starts)
            if i < 3:
                own[:, i, j] = np.add.reduceat(entry * lag, starts)
    variance = np.maximum.reduceat(rates.sigma[rows], starts) ** 2
    prior = np.maximum(noise_px2, _SMALLEST_NOISE_PX2) / np.maximum(variance, _SMALLEST_VARIANCE)
    # Rates on which no observation of a frame depends take nothing away, however little is known of them.
    known = np.maximum(prior, np.finfo(np.float64).eps * np.maximum(np.trace(own, axis1=1, axis2=2), 1.0))
    own += known[:, None, None] * np.eye(3)
    return np.asarray(cross @ np.linalg.solve(own, np.swapaxes(cross, 1, 2)))


def _inverse_or_nan(information: FloatArray) -> FloatArray:
    """Return the inverses of information matrices (F,6,6); NaN for a singular matrix."""
    solvable = np.linalg.matrix_rank(information) == 6
    inverse = np.linalg.inv(np.where(solvable[:, None, None], information, np.eye(6)))
    return np.asarray(np.where(solvable[:, None, None], inverse, np.nan))


def find_inliers(
    observations: Observations, cam_from_gauge: FloatArray, limit_px: float, threads: int
) -> BoolArray:
    """Return a mask (M,) of the observations that agree with poses (F,4,4) within a limit.

    The mask is False for all observations of a frame whose pose is NaN.
    """
    out = np.zeros(len(observations.rays), dtype=bool)

    def mark_chunk(chosen: IntArray) -> None:
        rows, _, owner = _rows_of_frames(observations, chosen)
        residual, _, _ = _residuals(observations, rows, cam_from_gauge[chosen][owner])
        out[rows] = np.hypot(residual[0], residual[1]) < limit_px

    _for_each_chunk(observations, mark_chunk, threads)
    return out


def _for_each_chunk(observations: Observations, work: Callable[[IntArray], None], threads: int) -> None:
    """Call `work` for each chunk of frames, on several threads. Frames are independent of each other."""
    chunks = list(_chunks(observations))
    if threads <= 1 or len(chunks) < 2:
        for frames in chunks:
            work(frames)
        return
    with ThreadPoolExecutor(threads, thread_name_prefix="poses") as pool:
        for _ in pool.map(work, chunks):
            pass


def _chunks(observations: Observations) -> Iterator[IntArray]:
    """Yield chunks of frame indices. Frames with too few observations for a pose are omitted."""
    counts = np.diff(observations.bounds)
    usable = np.flatnonzero(counts >= _MIN_OBSERVATIONS)
    for start in range(0, len(usable), _CHUNK_FRAMES):
        yield usable[start : start + _CHUNK_FRAMES]


def _gauss_newton_step(
    observations: Observations, frames: IntArray, poses: FloatArray, limit_px: float
) -> tuple[FloatArray, BoolArray]:
    """Perform one Gauss–Newton iteration.

    Returns:
        The new poses (N,4,4), and a mask (N,) of the poses that have converged.
    """
    rows, starts, owner = _rows_of_frames(observations, frames)
    residual, jacobian, _ = linearise(observations, rows, poses[owner])
    error_px = np.hypot(residual[0], residual[1])
    median = _segment_medians(
        error_px, owner, starts, observations.bounds[frames + 1] - observations.bounds[frames]
    )
    cutoff = np.maximum(limit_px, _CUTOFF_MEDIANS * median)[owner]
    robust = np.where(error_px < cutoff, 1.0 / (1.0 + (error_px / (_LOSS_SCALE * cutoff)) ** 2), 0.0)
    weight = robust * observations.weight[rows]
    hessian, gradient = _normal_equations(residual, jacobian, weight, starts)
    damped = hessian + np.eye(6) * (_DAMPING * np.einsum("fii->f", hessian) + _TINY)[:, None, None]
    step = -np.linalg.solve(damped, gradient[:, :, None])[:, :, 0]
    total = np.maximum(np.add.reduceat(weight, starts), 1e-3)
    moved_px = np.sqrt(np.einsum("fi,fij,fj->f", step, hessian, step) / total)
    return _retract(poses, step), moved_px < _CONVERGED_PX


def _segment_medians(value: FloatArray, owner: IntArray, starts: IntArray, counts: IntArray) -> FloatArray:
    """Return, for each frame, the lower median of its `counts` smallest values.

    The values of all frames are sorted together. Before sorting, an offset is added to each value. All values
    of one frame have the same offset, and later frames have larger offsets. Sorting therefore does not mix
    the values of different frames.

    Args:
        value: (M,) values, ordered by frame.
        owner: (M,) number of the frame of each value.
        starts: (F,) position of each frame's first value.
        counts: (F,) number of smallest values to use in each frame.
    """
    capped = np.minimum(value, _UNUSABLE)
    base = owner * (2.0 * _UNUSABLE)
    middle = starts + np.maximum(counts - 1, 0) // 2
    return np.asarray(np.sort(base + capped)[middle] - base[starts])


def _rows_of_frames(observations: Observations, frames: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Return the rows of the selected frames.

    Returns:
        Row indices (M,); the position (F,) of each frame's first row in these indices; for each row, the
        number (M,) of its frame.
    """
    counts = observations.bounds[frames + 1] - observations.bounds[frames]
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    owner = np.repeat(np.arange(len(frames)), counts)
    rows = np.arange(counts.sum()) + (observations.bounds[frames] - starts)[owner]
    return rows, starts, owner


def linearise(
    observations: Observations, rows: IntArray, cam_from_gauge: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return residuals, their derivatives with respect to a left perturbation of cam_from_gauge, and depths.

    A point behind the camera gets a residual beyond any limit. Its derivatives are zero.

    Args:
        observations: The observations.
        rows: (N,) row indices of the observations to use.
        cam_from_gauge: (N,4,4) pose of the frame of each row.

    Returns:
        Residuals (2,N) in pixels; derivatives (2,6,N), rotation first; depths (N,).
    """
    residual, (a, b, inverse, z), px_from_ray = _residuals(observations, rows, cam_from_gauge)
    return residual, pose_derivatives(a, b, inverse, px_from_ray), z


def _residuals(
    observations: Observations, rows: IntArray, cam_from_gauge: FloatArray
) -> tuple[FloatArray, tuple[FloatArray, FloatArray, FloatArray, FloatArray], FloatArray]:
    """Return the residuals, the projected points and the derivative of the pixel with respect to the ray.

    Returns:
        Residuals (2,N) as in `linearise`; a tuple of four arrays (N,): x/z, y/z, 1/z and z; px_from_ray
        (2,2,N). For unusable observations px_from_ray is 0.
    """
    x, y, z = transform_points(cam_from_gauge, observations.points[rows]).T
    in_front = z > 1e-9
    inverse = 1.0 / np.where(in_front, z, 1.0)
    a, b = x * inverse, y * inverse
    px_from_ray = np.ascontiguousarray(observations.px_from_ray[rows].transpose(1, 2, 0))
    off_a, off_b = a - observations.rays[rows, 0], b - observations.rays[rows, 1]
    residual = np.stack([by_a * off_a + by_b * off_b for by_a, by_b in px_from_ray])
    usable = in_front & np.isfinite(residual).all(axis=0)
    if not usable.all():
        residual, px_from_ray = np.where(usable, residual, _UNUSABLE), np.where(usable, px_from_ray, 0.0)
    return residual, (a, b, inverse, z), px_from_ray


def _normal_equations(
    residual: FloatArray, jacobian: FloatArray, weight: FloatArray, starts: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return the weighted Hessians (F,6,6) and gradients (F,6) of the frames."""
    gradient = np.empty((len(starts), 6))
    weighted = jacobian * weight
    for i in range(6):
        gradient[:, i] = np.add.reduceat(weighted[0, i] * residual[0] + weighted[1, i] * residual[1], starts)
    return weighted_hessians(jacobian, weight, starts), gradient


def _retract(cam_from_gauge: FloatArray, step: FloatArray) -> FloatArray:
    """Apply left perturbations (N,6), rotation first, to poses (N,4,4).

    A perturbation with a rotation above `_MAX_STEP_RAD` is shortened.
    """
    rotvec = step[:, :3]
    angle = np.linalg.norm(rotvec, axis=1, keepdims=True)
    scale = np.minimum(1.0, _MAX_STEP_RAD / np.maximum(angle, 1e-12))
    return make_transform(so3_exp(rotvec * scale), step[:, 3:] * scale) @ cam_from_gauge
