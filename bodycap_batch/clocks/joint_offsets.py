"""Solve the clocks of all cameras together from the differences of pairs.

The unknowns of each camera are the offset at the start of its sound and the drift. The reference camera has
offset 0 and drift 0. Each pair gives one equation for the offset at its pivot and one for the drift. Pairs
that contradict the others of a loop are dropped.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.camera_clock import ClockRelation, ClockSource

CRYSTAL_SIGMA_PPM = 40.0
"""Standard deviation of the drift between two clocks, ppm, if it was not measured. Origin: crystals have a
tolerance of ±50 ppm, about 29 ppm of standard deviation each."""
MAX_DRIFT_PPM = 150.0
"""Maximum drift, ppm. Origin: twice the tolerance of crystals, with some room for cold and heat."""
MAX_SIGMAS = 3.0
"""Maximum difference of two offsets of a camera that do not contradict each other, in standard deviations."""
WAY_SIGMA_S = 0.0015
"""Standard deviation, seconds, of an offset due to the way of sound. Origin: the ways from a source to two
cameras on a body differ by up to 1 m, which is 3 ms."""
UNLIKE_SIGMA_S = 0.015
"""Standard deviation, seconds, of the offset of a camera of another model. Origin: the delay of the sound
relative to the picture differs between models by up to a frame."""
_MIN_SIGMA_S = 1e-4
"""Least standard deviation of the offset of a pair, seconds, so that no pair has an infinite weight."""
_MAX_CLOSURE_SIGMAS = 4.0
"""Maximum residual of a pair in a loop, in its standard deviations. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockPair:
    """What a measurement says about the clocks of two cameras.

    Time of the first camera = time of the second camera + `offset_s` at the time `pivot_s` of the second
    camera. From there the difference changes by `drift_ppm`.

    Attributes:
        first: Name of the first camera.
        second: Name of the second camera.
        accepted: True if the offset is determined.
        reason: Why the pair was not accepted; empty if it was.
        pivot_s: Time on the second camera's clock, seconds, at which offset and drift are not correlated.
        offset_s: Difference of the clocks at the pivot, seconds.
        sigma_s: Standard deviation of the offset, seconds.
        drift_ppm: Drift, parts per million; 0 if it was not measured.
        drift_sigma_ppm: Standard deviation of the drift.
        drift_measured: True if the drift was measured.
        evidence: How clear the offset is; each measurement has its own scale.
    """

    first: str
    second: str
    accepted: bool = False
    reason: str = ""
    pivot_s: float = 0.0
    offset_s: float = 0.0
    sigma_s: float = float("inf")
    drift_ppm: float = 0.0
    drift_sigma_ppm: float = CRYSTAL_SIGMA_PPM
    drift_measured: bool = False
    evidence: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class JointClocks:
    """The clocks of all cameras that are connected to the reference camera.

    Attributes:
        clocks: Clock of each connected camera, with the reference camera.
        dropped: Pairs that contradict a loop, with the residual in seconds.
    """

    clocks: dict[str, ClockRelation]
    dropped: tuple[tuple[ClockPair, float], ...]


def solve_clocks(
    reference: str,
    pairs: Sequence[ClockPair],
    starts_s: Mapping[str, float],
    floors_s: Mapping[str, float],
    source: ClockSource = "sound",
) -> JointClocks:
    """Solve the clocks of all cameras from accepted pairs.

    Args:
        reference: Name of the reference camera.
        pairs: The accepted pairs.
        starts_s: Start of the sound of each camera on its own clock, seconds.
        floors_s: Standard deviation, seconds, of the offset of each camera that more sound does not reduce:
            `WAY_SIGMA_S` or `UNLIKE_SIGMA_S`, or that of the motion.
        source: What was measured.
    """
    used = list(pairs)
    dropped: list[tuple[ClockPair, float]] = []
    while True:
        names = connected_cameras(reference, used)
        inside = [pair for pair in used if pair.first in names]
        solution, covariance, residuals = _solve(names, inside, starts_s)
        sigmas = np.array([np.hypot(pair.sigma_s, WAY_SIGMA_S) for pair in inside])
        if not inside or np.abs(residuals / sigmas).max() <= _MAX_CLOSURE_SIGMAS:
            break
        dropped.append(_worst_pair(names, inside, starts_s))
        used.remove(dropped[-1][0])
    clocks = {reference: ClockRelation()}
    measured = connected_cameras(reference, [pair for pair in inside if pair.drift_measured])
    for index, name in enumerate(names[1:]):
        # From the offset at the start of the sound to that at camera time 0.
        shift = np.array([[1.0, -1e-6 * starts_s[name]], [0.0, 1.0]])
        own = covariance[2 * index : 2 * index + 2, 2 * index : 2 * index + 2]
        offset_s, drift_ppm = (shift @ solution[2 * index : 2 * index + 2]).tolist()
        own = shift @ own @ shift.T + np.diag([floors_s[name] ** 2, 0.0])
        sigma_s, drift_sigma_ppm = np.sqrt(np.diag(own)).tolist()
        clocks[name] = ClockRelation(
            offset_s=offset_s,
            sigma_s=sigma_s,
            drift_ppm=drift_ppm if name in measured else 0.0,
            drift_sigma_ppm=drift_sigma_ppm,
            correlation=float(own[0, 1]) / (sigma_s * drift_sigma_ppm),
            source=source,
        )
    return JointClocks(clocks=clocks, dropped=tuple(dropped))


def connected_cameras(reference: str, pairs: Sequence[ClockPair]) -> list[str]:
    """Return the cameras that pairs connect to the reference camera, which is the first."""
    names = [reference]
    for name in names:
        for pair in pairs:
            for near, far in ((pair.first, pair.second), (pair.second, pair.first)):
                if near == name and far not in names:
                    names.append(far)
    return names


def _solve(
    names: Sequence[str], pairs: Sequence[ClockPair], starts_s: Mapping[str, float]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Solve the weighted equations of the pairs. A drift that no pair measures is 0 ± `CRYSTAL_SIGMA_PPM`.

    The first of the names is that of the reference camera.

    Returns:
        (2n,) offset at the start of the sound (seconds) and drift (ppm) of each camera but the reference, its
        covariance (2n,2n), and the residuals (P,) of the offsets of the pairs, seconds.
    """
    offsets, drifts = [], []
    for pair in pairs:
        offset, drift = _equations(pair, names, starts_s)
        offsets.append((offset, pair.offset_s, 1.0 / max(pair.sigma_s, _MIN_SIGMA_S)))
        if pair.drift_measured:
            drifts.append((drift, pair.drift_ppm, 1.0 / pair.drift_sigma_ppm))
    if not offsets:
        return np.zeros(0), np.zeros((0, 0)), np.zeros(0)
    measured = connected_cameras(names[0], [pair for pair in pairs if pair.drift_measured])
    count = len(names) - 1
    for index, name in enumerate(names[1:]):
        if name not in measured:
            drifts.append((np.eye(2 * count)[2 * index + 1], 0.0, 1.0 / CRYSTAL_SIGMA_PPM))
    matrix, target, weight = (np.array(each) for each in zip(*offsets, *drifts, strict=True))
    # The columns are scaled, because seconds and ppm have different sizes.
    scale = np.tile([1e-3, 1.0], count)
    weighted = matrix * weight[:, None] * scale
    inverse = np.linalg.pinv(weighted.T @ weighted)
    solution = scale * (inverse @ (weighted.T @ (target * weight)))
    return solution, inverse * np.outer(scale, scale), (target - matrix @ solution)[: len(offsets)]


def _equations(
    pair: ClockPair, names: Sequence[str], starts_s: Mapping[str, float]
) -> tuple[FloatArray, FloatArray]:
    """Return the rows (2n,) of a pair's offset and drift; the columns are as in `_solve`."""
    offset, drift = np.zeros(2 * len(names) - 2), np.zeros(2 * len(names) - 2)
    for name, time_s, sign in (
        (pair.second, pair.pivot_s, 1.0),
        (pair.first, pair.pivot_s + pair.offset_s, -1.0),
    ):
        if name != names[0]:
            column = 2 * names.index(name) - 2
            offset[column] = sign
            offset[column + 1] = sign * 1e-6 * (time_s - starts_s[name])
            drift[column + 1] = sign
    return offset, drift


def _worst_pair(
    names: Sequence[str], pairs: Sequence[ClockPair], starts_s: Mapping[str, float]
) -> tuple[ClockPair, float]:
    """Return the pair without which the others agree best; of equal ones, that with the least evidence.

    With it is returned its offset minus that which the other pairs give, seconds.
    """
    found = []
    for pair in pairs:
        rest = [each for each in pairs if each is not pair]
        if len(connected_cameras(names[0], rest)) == len(names):  # residuals exist only in loops
            solution, _, residuals = _solve(names, rest, starts_s)
            # Residuals below the way of sound are equal.
            disagreement = max(float(np.abs(residuals).max(initial=0.0)), 2.0 * WAY_SIGMA_S)
            closure_s = pair.offset_s - float(_equations(pair, names, starts_s)[0] @ solution)
            found.append(((disagreement, pair.evidence), pair, closure_s))
    _, worst, closure_s = min(found, key=lambda each: each[0])
    return worst, closure_s
