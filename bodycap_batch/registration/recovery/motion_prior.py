"""Model the motion of a body-worn camera's centre: its acceleration changes little between frames."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.model.block_tridiagonal import BlockTridiagonal

_PERCENTILE = 80.0
"""Percentile of the size of the third or fourth differences of a camera's centres in successive frames. This
percentile of the sizes is used as the sigma of the differences. The percentile is high, because frames are
lost mainly during fast movements. Evidence: none."""
_MAX_INTERVAL_DEVIATION = 0.1
"""Maximum deviation of a frame interval from the median interval, as a fraction of the median. Differences
across an interval with a larger deviation are not used. Evidence: none."""
_ITERATIONS = 5
"""Number of iterations of reweighted least squares. Evidence: none."""
_LOSS_WIDTH = 4.0
"""Width of the Cauchy loss: the squared Mahalanobis distance at which a position or a motion residual has
half of its full weight. Evidence: none."""
_VELOCITY_SIGMA_JERKS, _ACCELERATION_SIGMA_JERKS = 30.0, 4.0
"""Initial sigma of the velocity and initial sigma of the acceleration in the Kalman filter, in units of the
camera's jerk sigma. Evidence: none."""
MAX_DISAGREEMENT = 11.3
"""Maximum squared Mahalanobis distance between a found centre and its smoothed position. If the distance is
larger, the centre or the smoothed position is wrong, and the smoothed position is not used. Origin: the 99 %
quantile of the chi-squared distribution with three degrees of freedom."""
_NEIGHBOURS = 4
"""Number of neighbouring frames that determine a cubic path: two frames before and two frames after."""
_PRIOR = 1e-9
"""Information of a weak prior on every centre, as a fraction of the mean information. It only prevents a
singular matrix."""


def times_in_intervals(times_ns: IntArray) -> FloatArray:
    """Return the times (N,) of frames since the first frame, in units of the median frame interval."""
    times = (times_ns - times_ns[0]).astype(np.float64)
    return np.asarray(times / np.median(np.diff(times)))


@dataclass(frozen=True, slots=True)
class PositionEstimate:
    """Position of a camera, with its uncertainty.

    Attributes:
        centre: (3,) camera centre in the map.
        covariance: (3,3) covariance of the centre in the axes of the map.
    """

    centre: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class MotionStatistics:
    """How smoothly a camera moves. All values are in map units along one axis, for frames one interval apart.

    Attributes:
        jerk_sigma: Sigma of the third difference of the centre over successive frames.
        cubic_residual_sigma: Sigma of the distance between a centre and a cubic path. This path passes
            through the two centres before and the two centres after the centre.
    """

    jerk_sigma: float
    cubic_residual_sigma: float

    @staticmethod
    def estimate(times: FloatArray, centres: FloatArray) -> MotionStatistics | None:
        """Estimate the statistics of a path.

        Args:
            times: (N,) times of the frames, in units of the frame interval.
            centres: (N,3) camera centres in the map; NaN for frames without a pose.

        Returns:
            The statistics; None if too few successive centres are known, or if the camera does not move.
        """
        sizes = []
        for order in (3, 4):
            differences = np.diff(centres, order, axis=0)
            is_uneven = np.abs(np.diff(times) - 1.0) > _MAX_INTERVAL_DEVIATION
            is_broken = np.convolve(is_uneven, np.ones(order), "valid")[: len(differences)] > 0.0
            differences = differences[np.isfinite(differences).all(axis=1) & ~is_broken]
            if len(differences) < _NEIGHBOURS:
                return None
            sizes.append(float(np.percentile(np.sqrt((differences**2).mean(axis=1)), _PERCENTILE)))
        # The fourth difference is six times the distance of the middle centre from the cubic.
        return (
            MotionStatistics(jerk_sigma=sizes[0], cubic_residual_sigma=sizes[1] / 6.0)
            if min(sizes) > 0.0
            else None
        )


class CentreKalmanFilter:
    """Kalman filter of a camera's centre, velocity and acceleration, run forward or backward in time.

    Source: Tang, Yoon, Barfoot, "A white-noise-on-jerk motion prior for continuous-time trajectory estimation
        on SE(3)", RA-L 2019. It is applied to the centre alone, because a hand rotates freely.
    """

    def __init__(self, statistics: MotionStatistics, start: PositionEstimate) -> None:
        jerk = statistics.jerk_sigma
        self._jerk = jerk
        self._state = np.concatenate([start.centre, np.zeros(6)])
        self._covariance = np.zeros((9, 9))
        self._covariance[:3, :3] = start.covariance
        self._covariance[3:6, 3:6] = np.eye(3) * (_VELOCITY_SIGMA_JERKS * jerk) ** 2
        self._covariance[6:, 6:] = np.eye(3) * (_ACCELERATION_SIGMA_JERKS * jerk) ** 2

    def predict(self, interval: float) -> PositionEstimate:
        """Advance the state by `interval` (> 0) frame intervals, and return the predicted position."""
        powers = np.array([[1.0, interval, interval**2 / 2.0], [0.0, 1.0, interval], [0.0, 0.0, 1.0]])
        transition = np.kron(powers, np.eye(3))
        noise = np.array([interval**3 / 6.0, interval**2 / 2.0, interval]) * self._jerk
        self._state = transition @ self._state
        self._covariance = transition @ self._covariance @ transition.T + np.kron(
            np.outer(noise, noise), np.eye(3)
        )
        return PositionEstimate(self._state[:3].copy(), self._covariance[:3, :3].copy())

    def update(self, observed: PositionEstimate) -> None:
        """Update the state with an observed position."""
        gain = self._covariance[:, :3] @ np.linalg.inv(self._covariance[:3, :3] + observed.covariance)
        self._state = self._state + gain @ (observed.centre - self._state[:3])
        covariance = self._covariance - gain @ self._covariance[:3]
        self._covariance = 0.5 * (covariance + covariance.T)


@dataclass(frozen=True, slots=True)
class SmoothedCentres:
    """Smoothed positions of successive frames.

    Attributes:
        positions: Smoothed position of each frame, by frame.
        disagreement: Squared Mahalanobis distance between observed and smoothed position, by observed frame.
    """

    positions: Mapping[int, PositionEstimate]
    disagreement: Mapping[int, float]


def smooth_centres(
    frames: IntArray,
    times: FloatArray,
    observed: Mapping[int, PositionEstimate],
    trusted: Collection[int],
    statistics: MotionStatistics,
) -> SmoothedCentres:
    """Smooth the centres of successive frames, given observed positions and the statistics of the motion.

    A Cauchy loss reduces the weight of outliers: a position may be wrong, and a hand may stop suddenly.

    Args:
        frames: (N,) indices of successive frames.
        times: (N,) times of these frames, in units of the frame interval.
        observed: Observed positions, by frame.
        trusted: Indices of the frames whose positions always have their full weight.
        statistics: How smoothly the camera moves.
    """
    at = {frame: index for index, frame in enumerate(frames.tolist())}
    rows, sigma = _cubic_residual_rows(times, statistics.cubic_residual_sigma)
    windows = np.arange(len(rows))[:, None] + np.arange(_NEIGHBOURS + 1)
    robust_weight, row_weight = dict.fromkeys(observed, 1.0), np.ones(len(rows))
    centres, covariance = np.zeros((len(frames), 3)), np.zeros((len(frames), 3, 3))
    disagreement: dict[int, float] = {}
    for _ in range(_ITERATIONS):
        information_sum, weighted_sum = np.zeros((len(frames), 3, 3)), np.zeros((len(frames), 3))
        for frame, position in observed.items():
            information = robust_weight[frame] * np.linalg.inv(position.covariance)
            information_sum[at[frame]] += information
            weighted_sum[at[frame]] += information @ position.centre
        centres, covariance = _solve_block_tridiagonal(
            rows, row_weight / sigma**2, information_sum, weighted_sum
        )
        for frame, position in observed.items():
            difference = position.centre - centres[at[frame]]
            disagreement[frame] = float(difference @ np.linalg.solve(position.covariance, difference))
            if frame not in trusted:
                robust_weight[frame] = 1.0 / (1.0 + disagreement[frame] / _LOSS_WIDTH)
        residual = np.einsum("nj,njc->nc", rows, centres[windows])
        row_weight = 1.0 / (1.0 + (residual**2).mean(axis=1) / sigma**2 / _LOSS_WIDTH)
    positions = {frame: PositionEstimate(centres[i], covariance[i]) for frame, i in at.items()}
    return SmoothedCentres(positions, disagreement)


def _solve_block_tridiagonal(
    rows: FloatArray, weight: FloatArray, information: FloatArray, weighted: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Solve the least-squares problem of motion residuals and observed positions.

    A motion residual connects five frames. Frames are therefore grouped into blocks of four. Each block is
    connected only to the blocks before and after it. Time and memory then grow linearly with the number of
    frames.

    Args:
        rows: (N−4,5) linear maps from `_cubic_residual_rows`.
        weight: (N−4,) information of each motion residual.
        information: (N,3,3) information of the positions.
        weighted: (N,3) product of the information and the position.

    Returns:
        Centres (N,3) and their covariances (N,3,3).
    """
    count, size = len(information), 3 * _NEIGHBOURS
    groups = -(-count // _NEIGHBOURS)
    own, ahead = _information_blocks(rows, weight, groups)
    own, ahead = (np.asarray(np.kron(each, np.eye(3)), np.float64) for each in (own, ahead))
    for index in range(count):
        group, block_rows = index // _NEIGHBOURS, index % _NEIGHBOURS * 3
        own[group, block_rows : block_rows + 3, block_rows : block_rows + 3] += information[index]
    own += np.eye(size) * (_PRIOR * np.trace(own, axis1=1, axis2=2).sum() / (3 * count))
    right = np.zeros((groups, size))
    right.reshape(-1, 3)[:count] = weighted
    system = BlockTridiagonal.from_blocks(own, ahead[:-1])
    centres = np.concatenate(system.solve(right.reshape(-1, 1)))
    covariance = np.empty_like(own)
    system.marginals(covariance.__setitem__)
    blocks = covariance.reshape(groups, _NEIGHBOURS, 3, _NEIGHBOURS, 3)
    diagonal = np.einsum("gaiaj->gaij", blocks).reshape(-1, 3, 3)
    return centres.reshape(-1, 3)[:count], diagonal[:count]


def _information_blocks(rows: FloatArray, weight: FloatArray, groups: int) -> tuple[FloatArray, FloatArray]:
    """Return the information of the motion residuals, in G blocks of four frames.

    Returns:
        Information (G,4,4) within each block, and information (G,4,4) between each block and the next block.
    """
    pairs = np.zeros((groups + 1, 2 * _NEIGHBOURS, 2 * _NEIGHBOURS))
    for number, row in enumerate(rows):
        group, first = divmod(number, _NEIGHBOURS)
        columns = slice(first, first + _NEIGHBOURS + 1)
        pairs[group, columns, columns] += weight[number] * np.outer(row, row)
    own = pairs[:-1, :_NEIGHBOURS, :_NEIGHBOURS].copy()
    own[1:] += pairs[: groups - 1, _NEIGHBOURS:, _NEIGHBOURS:]
    return own, pairs[:-1, :_NEIGHBOURS, _NEIGHBOURS:]


def _cubic_residual_rows(times: FloatArray, bend: float) -> tuple[FloatArray, FloatArray]:
    """Return the linear map from five successive centres to the distance of the middle centre from a cubic.

    The cubic passes through the other four centres. Row n refers to the frames n to n+4.

    Args:
        times: (N,) times of the frames, in units of the frame interval.
        bend: Sigma of the distance for frames one interval apart.

    Returns:
        Coefficients (N−4,5), and the sigma (N−4,) of each distance.
    """
    count = max(0, len(times) - _NEIGHBOURS)
    rows, sigma = np.zeros((count, _NEIGHBOURS + 1)), np.full(count, bend)
    others = (0, 1, 3, 4)
    for number in range(count):
        window = times[number : number + _NEIGHBOURS + 1]
        rows[number, 2] = 1.0
        for index in others:
            rest = window[[each for each in others if each != index]]
            rows[number, index] = -np.prod((window[2] - rest) / (window[index] - rest))
        # The residual of a cubic grows with the third power of the time that it spans.
        sigma[number] *= ((window[-1] - window[0]) / _NEIGHBOURS) ** 3
    return rows, sigma
