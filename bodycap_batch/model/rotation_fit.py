"""Estimate the rotation of a camera over time from matches between adjacent frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.frame_matches import FrameMatches
from bodycap_batch.model.geometry import nearest_rotation, skew, so3_exp, so3_log
from bodycap_batch.model.optical_flow import pixel_scale, unit_directions
from bodycap_batch.model.rolling_shutter import row_delay
from bodycap_batch.model.rotation_path import RotationPath

_MATCHES = 64
"""Maximum number of matches of a pair of frames that are used. More matches do not improve a rotation of
three degrees of freedom much. Evidence: none."""
_SAMPLES = 64
"""Number of random samples of two matches for the first estimate of a rotation. Origin: if one match in three
is right, 64 samples contain a sample of two right matches with a probability of 99.9 %."""
_SEED = 0
"""Seed of the random samples."""
_MIN_SAMPLE_SINE = 0.02
"""Minimum sine of the angle between the two directions of a random sample: about one degree. Nearer
directions determine no rotation."""
_NOISE_PX = 2.0
"""Expected deviation of a match from a pure rotation, px of an image with a long side of 640 px. It is mostly
the parallax between two frames. Evidence: none."""
_SAMPLE_SCALE = 3.0
"""Limit of the cost of a match for a random sample, as a multiple of `_NOISE_PX`. The rolling shutter is not
yet corrected then, so the limit is wide. Evidence: none."""
_INLIER_SCALE = 4.0
"""Maximum deviation of an inlier, as a multiple of `_NOISE_PX`. Evidence: none."""
_MIN_SCALE = 0.25
"""Minimum scale of the weights of a pair, as a multiple of `_NOISE_PX`. Evidence: none."""
_MIN_INLIERS = 8
"""Minimum number of inliers of a known rotation. Origin: a rotation has three unknowns, and two matches
determine it; six more matches confirm it."""
_MIN_INLIER_RATIO = 0.25
"""Minimum ratio of inliers to matches of a known rotation. Evidence: none."""
_WEIGHT_ROUNDS = 4
"""Number of times that the weights of a rotation are computed again in one round. Evidence: none."""
_RATE_ROUNDS = 4
"""Number of rounds in which the angular velocities are estimated with the rotations. Evidence: none."""
_SPLINE_ROUNDS = 4
"""Maximum number of rounds. In each round, the rays are corrected with the spline of the round before, and
all rotations are estimated again. Evidence: none."""
_INDEPENDENT_RATIO = 0.25
"""Ratio of the number of independent deviations of a pair to the number of its matches. The deviations are
mostly parallax, which is similar for neighbouring points. Evidence: none."""
_RATE_SIGMA_RATIO = 0.05
"""Expected error of an angular velocity from the spline, as a ratio of the change of the mean angular
velocity from the interval before the frame to the interval after it. Evidence: none."""
_MIN_RATE_SIGMA = 0.1
"""Minimum expected error of an angular velocity from the spline, rad/s. Evidence: none."""
_END_RATE_SIGMA_RATIO = 0.3
"""Expected error of an angular velocity at the end of a segment, as a ratio of this velocity. Evidence:
none."""
_END_RATE_SIGMA = 2.0
"""Expected error of an angular velocity at the end of a segment, rad/s, added to the ratio. An arm reaches
20 rad/s. Evidence: none."""
_CONVERGED_RAD = 1e-4
"""Largest change of a rotation between two rounds at which the rounds end, radians. It moves a pixel by less
than a tenth of a pixel."""
_BATCH_FRAMES = 256
"""Number of pairs of frames whose rotations are estimated together. It bounds the memory."""


@dataclass(frozen=True, slots=True)
class MatchedRays:
    """Matches between adjacent frames as rays, in arrays with the same number of matches for each pair.

    There are N frames. Row k holds the matches between the frames k and k+1.

    Attributes:
        first: (N-1,K,3) unit directions in the first frame; 0 where a pair has fewer than K matches.
        second: (N-1,K,3) unit directions in the second frame.
        first_delay: (N-1,K) exposure time of the pixel in the first frame minus the frame time, as a multiple
            of the readout time.
        second_delay: (N-1,K) the same in the second frame.
        used: (N-1,K) True for each match, False where a pair has fewer matches.
        noise_rad: Expected deviation of a match from a pure rotation, radians.
    """

    first: FloatArray
    second: FloatArray
    first_delay: FloatArray
    second_delay: FloatArray
    used: BoolArray
    noise_rad: float

    @staticmethod
    def of(matches: FrameMatches, camera: Camera, frame_count: int) -> MatchedRays:
        """Return the matches of a camera as rays. Matches without a ray are left out."""
        px = [matches.first_px.astype(np.float64), matches.second_px.astype(np.float64)]
        rays = [unit_directions(camera.unproject(each)) for each in px]
        rows = np.flatnonzero(np.isfinite(np.concatenate(rays, axis=1)).all(axis=1))
        bounds = np.searchsorted(matches.frame[rows], np.arange(frame_count))
        pair, slot, chosen = _spread_rows(bounds)
        shape = (max(0, frame_count - 1), _MATCHES)
        used = np.zeros(shape, dtype=bool)
        used[pair, slot] = True
        out = []
        for each, each_px in zip(rays, px, strict=True):
            padded, delay = np.zeros((*shape, 3)), np.zeros(shape)
            padded[pair, slot] = each[rows[chosen]]
            delay[pair, slot] = row_delay(camera, each_px[rows[chosen]])
            out.append((padded, delay))
        noise_px = _NOISE_PX * pixel_scale(camera.width_px, camera.height_px)
        return MatchedRays(out[0][0], out[1][0], out[0][1], out[1][1], used, noise_px / camera.focal_px)

    def at_mid_row(self, path: RotationPath, readout_s: float) -> tuple[FloatArray, FloatArray]:
        """Return the rays (N-1,K,3) of both frames, turned to the instants of the middle rows."""
        pairs, count = self.used.shape
        frame = np.repeat(np.arange(pairs), count)
        out = []
        for rays, delay, offset in ((self.first, self.first_delay, 0), (self.second, self.second_delay, 1)):
            turn = path.rotvec_to_instant(frame + offset, delay.ravel() * readout_s)
            out.append(_turned(turn, rays.reshape(-1, 3)).reshape(pairs, count, 3))
        return out[0], out[1]


def _turned(rotvec_rad: FloatArray, vector: FloatArray) -> FloatArray:
    """Return vectors (M,3) turned by rotation vectors (M,3), by Rodrigues' formula."""
    angle = np.sqrt(np.einsum("mi,mi->m", rotvec_rad, rotvec_rad))[:, None]
    sine = np.sinc(angle / np.pi)
    cosine = 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    cross = np.cross(rotvec_rad, vector)
    return np.asarray(vector + sine * cross + cosine * np.cross(rotvec_rad, cross))


def _spread_rows(bounds: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Select up to `_MATCHES` rows of each pair, spread evenly over its rows.

    Args:
        bounds: (N,) first row of each pair; the last entry is the number of rows.

    Returns:
        The pair, the place among the pair's selected rows, and the row, for each selected row.
    """
    pairs, slots, rows = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for pair, (start, stop) in enumerate(zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True)):
        count = min(stop - start, _MATCHES)
        pairs.append(np.full(count, pair))
        slots.append(np.arange(count))
        rows.append(start + (np.arange(count) * (stop - start)) // max(count, 1))
    return np.concatenate(pairs), np.concatenate(slots), np.concatenate(rows)


def fit_rotation_path(
    matches: FrameMatches, camera: Camera, times_ns: IntArray, readout_s: float
) -> RotationPath:
    """Estimate the rotation of a camera over time.

    Each point is exposed in another row in each frame, so the time between its two observations differs from
    the frame interval. The rays are therefore turned to the instants of the middle rows, with the spline
    through the rotations that were estimated before. This is repeated until the rotations do not change.

    Args:
        matches: Matches between adjacent frames.
        camera: The camera model.
        times_ns: (N,) frame times, nanoseconds.
        readout_s: Readout time, seconds.

    Source: Ringaby, Forssén, "Efficient video rectification and stabilisation for cell-phones", IJCV 2012,
        for rotation as the model of a rolling shutter. Here the spline passes through the rotations of pairs.
    """
    return fit_to_rays(MatchedRays.of(matches, camera, len(times_ns)), times_ns, readout_s)


def fit_to_rays(
    rays: MatchedRays,
    times_ns: IntArray,
    readout_s: float,
    start: RotationPath | None = None,
    *,
    with_rates: bool = True,
) -> RotationPath:
    """Estimate the rotation of a camera over time from rays; see `fit_rotation_path`.

    Args:
        rays: The matches.
        times_ns: (N,) frame times, nanoseconds.
        readout_s: Readout time, seconds.
        start: The path for a similar readout time. None: it is unknown.
        with_rates: True to estimate the angular velocities of frames from their matches, too. False: they are
            those of the smoothest path through the orientations, without a bias towards small velocities.
    """
    if start is None:
        step, known = _first_rotations(rays)
        path = RotationPath.from_steps(times_ns, step, known, shrunk=with_rates)
    else:
        path = start
    for _ in range(_SPLINE_ROUNDS):
        before, _ = path.steps()
        first, second = rays.at_mid_row(path, readout_s)
        step, inlier = _refine_rotations(before, first, second, rays)
        known = _is_known(inlier, rays)
        path = RotationPath.from_steps(times_ns, step, known, shrunk=with_rates)
        change = np.linalg.norm((step - before)[known], axis=(1, 2))
        if readout_s == 0.0 or change.max(initial=0.0) < _CONVERGED_RAD:
            break
    for _ in range(_RATE_ROUNDS if readout_s and with_rates else 0):
        path = _with_rates(path, rays, readout_s)
    return path


def _with_rates(path: RotationPath, rays: MatchedRays, readout_s: float) -> RotationPath:
    """Return the path with angular velocities that fit the matches, besides the rotations between frames.

    The rows of a frame are exposed one after another, so matches of a frame determine its angular velocity.
    This matters where the velocity changes much from one frame to the next, and at the ends of segments. The
    velocity of the spline is used as a prior.
    """
    step, known = path.steps()
    first, second = rays.at_mid_row(path, readout_s)
    turned = first @ np.swapaxes(step, 1, 2)
    deviation = second - turned
    size = np.linalg.norm(deviation, axis=2)
    weight = _weights(size, rays)
    inlier = rays.used & (size < _INLIER_SCALE * rays.noise_rad)
    weight *= _INDEPENDENT_RATIO * (_is_known(inlier, rays) | known)[:, None]
    leverage = [
        path.rate_leverage_s(
            np.broadcast_to(np.arange(len(delay))[:, None] + offset, delay.shape), delay * readout_s
        )[:, :, None, None]
        for offset, delay in ((0, rays.first_delay), (1, rays.second_delay))
    ]
    jacobian = np.concatenate(
        [
            skew(turned),
            leverage[0] * np.einsum("pij,pkjl->pkil", step, skew(first)),
            -leverage[1] * skew(second),
        ],
        axis=3,
    )
    normal = np.einsum("pkia,pkib,pk->pab", jacobian, jacobian, weight)
    gradient = np.einsum("pkia,pki,pk->pa", jacobian, deviation, weight)
    normal[:, :3, :3] += np.eye(3)
    to_turn = np.linalg.solve(normal[:, :3, :3], normal[:, :3, 3:])
    turn = np.linalg.solve(normal[:, :3, :3], gradient[:, :3, None])[:, :, 0]
    reduced = normal[:, 3:, 3:] - np.einsum("pai,paj->pij", normal[:, :3, 3:], to_turn)
    right = gradient[:, 3:] - np.einsum("pai,pa->pi", normal[:, :3, 3:], turn)
    prior = RotationPath.from_steps(path.times_ns, step, known)
    information = 1.0 / _rate_sigma(prior) ** 2
    change = -_solve_chain(reduced, right, information, information[:, None] * (path.rate - prior.rate))
    pair_change = np.concatenate([change[:-1], change[1:]], axis=1)
    turn = -(turn + np.einsum("pij,pj->pi", to_turn, pair_change))
    return RotationPath.from_steps(path.times_ns, so3_exp(turn) @ step, known, path.rate + change)


def _rate_sigma(path: RotationPath) -> FloatArray:
    """Return the expected errors (N,) of the angular velocities of a spline, rad/s."""
    step, known = path.steps()
    interval_s = np.diff(path.times_ns)[:, None] * 1e-9
    mean = np.where(known[:, None], -so3_log(step) / interval_s, np.nan)
    nothing = np.full((1, 3), np.nan)
    bend = np.linalg.norm(np.concatenate([mean, nothing]) - np.concatenate([nothing, mean]), axis=1)
    end = _END_RATE_SIGMA + _END_RATE_SIGMA_RATIO * np.linalg.norm(path.rate, axis=1)
    return np.asarray(
        np.where(np.isfinite(bend), _MIN_RATE_SIGMA + _RATE_SIGMA_RATIO * np.nan_to_num(bend), end)
    )


def _solve_chain(
    normal: FloatArray, right: FloatArray, information: FloatArray, prior: FloatArray
) -> FloatArray:
    """Solve normal equations that couple successive frames.

    Args:
        normal: (N-1,6,6) normal matrix of each pair of frames.
        right: (N-1,6) right-hand side of each pair.
        information: (N,) information of the prior of each frame.
        prior: (N,3) right-hand side of the prior of each frame.

    Returns:
        The solution (N,3).
    """
    from scipy.linalg import solveh_banded

    count = len(information)
    banded, vector = np.zeros((6, 3 * count)), prior.copy()
    banded[0] = np.repeat(information, 3)
    vector[:-1] += right[:, :3]
    vector[1:] += right[:, 3:]
    for row in range(6):
        for column in range(row + 1):
            banded[row - column, column : 3 * (count - 1) + column : 3] += normal[:, row, column]
    return np.asarray(solveh_banded(banded, vector.ravel(), lower=True)).reshape(count, 3)


def _is_known(inlier: BoolArray, rays: MatchedRays) -> BoolArray:
    """Return a mask (P,) of the pairs with enough inliers in different directions.

    Args:
        inlier: (P,K) True for each inlier.
        rays: The matches.
    """
    count = inlier.sum(axis=1)
    enough = (count >= _MIN_INLIERS) & (count >= _MIN_INLIER_RATIO * rays.used.sum(axis=1))
    directions = rays.first * inlier[:, :, None]
    scatter = np.swapaxes(directions, 1, 2) @ directions / np.maximum(count, 1)[:, None, None]
    return np.asarray(enough & (np.linalg.eigvalsh(scatter)[:, 1] > _MIN_SAMPLE_SINE**2))


def _first_rotations(rays: MatchedRays) -> tuple[FloatArray, BoolArray]:
    """Estimate the rotations of all pairs from random samples of two matches.

    Returns:
        The rotations second_from_first (P,3,3), and a mask (P,) of the pairs with enough matches.
    """
    rng = np.random.default_rng(_SEED)
    rotation = np.tile(np.eye(3), (len(rays.used), 1, 1))
    count = rays.used.sum(axis=1)
    enough = count >= _MIN_INLIERS
    drawn = rng.random((2, _SAMPLES))
    for start in range(0, len(count), _BATCH_FRAMES):
        rows = start + np.flatnonzero(enough[start : start + _BATCH_FRAMES])
        if len(rows) == 0:
            continue
        i = (drawn[0] * count[rows, None]).astype(np.int64)
        j = (i + 1 + (drawn[1] * (count[rows, None] - 1)).astype(np.int64)) % count[rows, None]
        (first, first_sine), (second, second_sine) = (
            _frames_of(np.take_along_axis(each, i[:, :, None], 1), np.take_along_axis(each, j[:, :, None], 1))
            for each in (rays.first[rows], rays.second[rows])
        )
        samples = second @ np.swapaxes(first, 2, 3)
        turned = rays.first[rows][:, None] @ np.swapaxes(samples, 2, 3)
        error = np.linalg.norm(turned - rays.second[rows][:, None], axis=3)
        cost = np.minimum(error / (_SAMPLE_SCALE * rays.noise_rad), 1.0)
        cost = (cost * rays.used[rows][:, None]).sum(axis=2)
        cost[np.minimum(first_sine, second_sine) < _MIN_SAMPLE_SINE] = np.inf
        best = cost.argmin(axis=1)
        is_found = np.isfinite(cost.min(axis=1))
        rotation[rows[is_found]] = samples[np.flatnonzero(is_found), best[is_found]]
        enough[rows[~is_found]] = False
    return rotation, enough


def _frames_of(first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return orthonormal frames (...,3,3) with the first axes `first` (...,3) that contain `second`.

    The sines (...) of the angles between both directions are returned, too. Without an angle, there is no
    frame.
    """
    normal = np.cross(first, second)
    sine = np.linalg.norm(normal, axis=-1)
    normal /= np.maximum(sine, 1e-12)[..., None]
    return np.stack([first, normal, np.cross(first, normal)], axis=-1), sine


def _refine_rotations(
    rotation: FloatArray, first: FloatArray, second: FloatArray, rays: MatchedRays
) -> tuple[FloatArray, BoolArray]:
    """Refine the rotations of all pairs robustly.

    Args:
        rotation: (P,3,3) first estimates.
        first: (P,K,3) directions in the first frames.
        second: (P,K,3) directions in the second frames.
        rays: The matches, with their expected deviation.

    Returns:
        The rotations second_from_first (P,3,3), and a mask (P,K) of the inliers.

    Source: Kabsch, "A solution for the best rotation to relate two sets of vectors", 1976, with Cauchy
        weights whose scale is the median residual.
    """
    for _ in range(_WEIGHT_ROUNDS):
        error = np.linalg.norm(first @ np.swapaxes(rotation, 1, 2) - second, axis=2)
        weight = _weights(error, rays)
        rotation = nearest_rotation(np.swapaxes(second * weight[:, :, None], 1, 2) @ first)
    error = np.linalg.norm(first @ np.swapaxes(rotation, 1, 2) - second, axis=2)
    return rotation, np.asarray(rays.used & (error < _INLIER_SCALE * rays.noise_rad))


def _weights(error: FloatArray, rays: MatchedRays) -> FloatArray:
    """Return the weights (P,K) of matches with deviations `error` (P,K), radians: their inverse variances.

    They are Cauchy weights. The scale of a pair is its median deviation, within limits.
    """
    low, high = _MIN_SCALE * rays.noise_rad, _INLIER_SCALE * rays.noise_rad
    ordered = np.sort(np.where(rays.used, error, np.inf), axis=1)
    middle = np.maximum(rays.used.sum(axis=1) - 1, 0) // 2
    median = ordered[np.arange(len(error)), middle]
    scale = np.clip(median, low, high)[:, None]
    return np.asarray(rays.used / (scale**2 + error**2))
