"""Where a body-worn camera can be, from where it was: centres whose acceleration changes little."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.model.block_tridiagonal import BlockTridiagonal

_USUAL = 80.0
"""Percentile of a camera's own third and fourth differences: lost stretches are among its faster ones."""
_EVEN = 0.1
_ROUNDS = 5
_LOSS_WIDTH = 4.0
"""Squared Mahalanobis distance at which a place, or a bend of the path, counts half."""
_FAST, _HARD = 30.0, 4.0
"""Velocity and acceleration that nothing is known of, in the camera's usual third differences."""
_NEIGHBOURS = 4
_PRIOR = 1e-9


@dataclass(frozen=True, slots=True)
class Place:
    """Where a camera was.

    Attributes:
        centre: (3,) in the map.
        covariance: (3,3).
    """

    centre: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class Steadiness:
    """How evenly a camera moves, in the map's unit along an axis, for frames one interval apart.

    Attributes:
        jerk: Third difference of its centre from frame to frame.
        bend: Distance of a centre from the cubic through the two before it and the two after it.
    """

    jerk: float
    bend: float

    @staticmethod
    def of(times: FloatArray, centres: FloatArray) -> Steadiness | None:
        """From centres (N,3) at times (N,) in frame intervals, NaN where unknown; None where too few are."""
        sizes = []
        for order in (3, 4):
            change = np.diff(centres, order, axis=0)
            uneven = np.abs(np.diff(times) - 1.0) > _EVEN
            broken = np.convolve(uneven, np.ones(order), "valid")[: len(change)] > 0.0
            change = change[np.isfinite(change).all(axis=1) & ~broken]
            if len(change) < _NEIGHBOURS:
                return None
            sizes.append(float(np.percentile(np.sqrt((change**2).mean(axis=1)), _USUAL)))
        # The fourth difference is six times the distance from the cubic.
        return Steadiness(jerk=sizes[0], bend=sizes[1] / 6.0) if min(sizes) > 0.0 else None


class CentreFilter:
    """A camera's centre, velocity and acceleration while frames are walked through, forwards or backwards.

    Source: Tang, Yoon, Barfoot, "A white-noise-on-jerk motion prior for continuous-time trajectory
        estimation on SE(3)", RA-L 2019, for the prior, on the centre alone: a hand turns as it likes.
    """

    def __init__(self, steadiness: Steadiness, start: Place) -> None:
        jerk = steadiness.jerk
        self._jerk = jerk
        self._state = np.concatenate([start.centre, np.zeros(6)])
        self._covariance = np.zeros((9, 9))
        self._covariance[:3, :3] = start.covariance
        self._covariance[3:6, 3:6] = np.eye(3) * (_FAST * jerk) ** 2
        self._covariance[6:, 6:] = np.eye(3) * (_HARD * jerk) ** 2

    def predict(self, interval: float) -> Place:
        """Go on by some frame intervals (> 0); where the camera should be then."""
        powers = np.array([[1.0, interval, interval**2 / 2.0], [0.0, 1.0, interval], [0.0, 0.0, 1.0]])
        step = np.kron(powers, np.eye(3))
        pushed = np.array([interval**3 / 6.0, interval**2 / 2.0, interval]) * self._jerk
        self._state = step @ self._state
        self._covariance = step @ self._covariance @ step.T + np.kron(np.outer(pushed, pushed), np.eye(3))
        return Place(self._state[:3].copy(), self._covariance[:3, :3].copy())

    def update(self, seen: Place) -> None:
        """Take in where the camera was found."""
        gain = self._covariance[:, :3] @ np.linalg.inv(self._covariance[:3, :3] + seen.covariance)
        self._state = self._state + gain @ (seen.centre - self._state[:3])
        covariance = self._covariance - gain @ self._covariance[:3]
        self._covariance = 0.5 * (covariance + covariance.T)


@dataclass(frozen=True, slots=True)
class Smoothed:
    """Places of consecutive frames, each with what all of them tell.

    Attributes:
        places: By frame.
        disagreement: By frame that was found: squared Mahalanobis distance from its smoothed place.
    """

    places: Mapping[int, Place]
    disagreement: Mapping[int, float]


def smooth_centres(
    frames: IntArray,
    times: FloatArray,
    found: Mapping[int, Place],
    trusted: Collection[int],
    steadiness: Steadiness,
) -> Smoothed:
    """Centres of consecutive frames near where they were found, on a path that bends as it usually does.

    Both the places and the bends count under a Cauchy loss: a place may be wrong, and a hand may stop dead.

    Args:
        frames: (N,) frame indices.
        times: (N,) in frame intervals.
        found: Places, by frame.
        trusted: Frames whose places are never doubted.
        steadiness: The camera's.
    """
    at = {frame: index for index, frame in enumerate(frames.tolist())}
    bends, sigma = _bends(times, steadiness.bend)
    windows = np.arange(len(bends))[:, None] + np.arange(_NEIGHBOURS + 1)
    worth, bend_worth = dict.fromkeys(found, 1.0), np.ones(len(bends))
    centres, covariance = np.zeros((len(frames), 3)), np.zeros((len(frames), 3, 3))
    disagreement: dict[int, float] = {}
    for _ in range(_ROUNDS):
        known, pull = np.zeros((len(frames), 3, 3)), np.zeros((len(frames), 3))
        for frame, place in found.items():
            share = worth[frame] * np.linalg.inv(place.covariance)
            known[at[frame]] += share
            pull[at[frame]] += share @ place.centre
        centres, covariance = _solved(bends, bend_worth / sigma**2, known, pull)
        for frame, place in found.items():
            off = place.centre - centres[at[frame]]
            disagreement[frame] = float(off @ np.linalg.solve(place.covariance, off))
            if frame not in trusted:
                worth[frame] = 1.0 / (1.0 + disagreement[frame] / _LOSS_WIDTH)
        bent = np.einsum("nj,njc->nc", bends, centres[windows])
        bend_worth = 1.0 / (1.0 + (bent**2).mean(axis=1) / sigma**2 / _LOSS_WIDTH)
    places = {frame: Place(centres[i], covariance[i]) for frame, i in at.items()}
    return Smoothed(places, disagreement)


def _solved(
    bends: FloatArray, weight: FloatArray, known: FloatArray, pull: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Centres (N,3) and their covariances (N,3,3) of the least squares that bends and places make.

    A bend ties five frames together, so that groups of four are tied to the next group only: the time and
    memory grow with the number of frames, not with its powers.

    Args:
        bends: (N−4,5) as `_bends` gives them.
        weight: (N−4,) their information.
        known: (N,3,3) information of the places.
        pull: (N,3) the same times the places.
    """
    count, size = len(known), 3 * _NEIGHBOURS
    groups = -(-count // _NEIGHBOURS)
    own, ahead = _blocks(bends, weight, groups)
    own, ahead = (np.asarray(np.kron(each, np.eye(3)), np.float64) for each in (own, ahead))
    for index in range(count):
        group, rows = index // _NEIGHBOURS, index % _NEIGHBOURS * 3
        own[group, rows : rows + 3, rows : rows + 3] += known[index]
    own += np.eye(size) * (_PRIOR * np.trace(own, axis1=1, axis2=2).sum() / (3 * count))
    towards = np.zeros((groups, size))
    towards.reshape(-1, 3)[:count] = pull
    system = BlockTridiagonal.from_blocks(own, ahead[:-1])
    centres = np.concatenate(system.solve(towards.reshape(-1, 1)))
    covariance = np.empty_like(own)
    system.marginals(covariance.__setitem__)
    blocks = covariance.reshape(groups, _NEIGHBOURS, 3, _NEIGHBOURS, 3)
    diagonal = np.einsum("gaiaj->gaij", blocks).reshape(-1, 3, 3)
    return centres.reshape(-1, 3)[:count], diagonal[:count]


def _blocks(bends: FloatArray, weight: FloatArray, groups: int) -> tuple[FloatArray, FloatArray]:
    """(G,4,4) information that bends are about groups of four frames, and (G,4,4) with the group after."""
    both = np.zeros((groups + 1, 2 * _NEIGHBOURS, 2 * _NEIGHBOURS))
    for number, row in enumerate(bends):
        group, first = divmod(number, _NEIGHBOURS)
        rows = slice(first, first + _NEIGHBOURS + 1)
        both[group, rows, rows] += weight[number] * np.outer(row, row)
    own = both[:-1, :_NEIGHBOURS, :_NEIGHBOURS].copy()
    own[1:] += both[: groups - 1, _NEIGHBOURS:, _NEIGHBOURS:]
    return own, both[:-1, :_NEIGHBOURS, _NEIGHBOURS:]


def _bends(times: FloatArray, bend: float) -> tuple[FloatArray, FloatArray]:
    """Rows (N−4,5) that give a centre's distance from the cubic through its neighbours, and its sigma.

    Row n is about frames n to n+4.
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
        # What a cubic misses grows with the third power of the time it spans.
        sigma[number] *= ((window[-1] - window[0]) / _NEIGHBOURS) ** 3
    return rows, sigma
