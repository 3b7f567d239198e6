"""Check that the distances between cameras in a map stay within the body's reach.

The map has no metric scale, so the check also finds the scale that fits best.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, runs
from bodycap_batch.core.percent import format_percent
from bodycap_batch.model.scene import Map

Reach = Mapping[tuple[str, str], tuple[float, float]]
"""Minimum and maximum distance (metres) between two cameras, by their names in alphabetical order."""

MIN_WITHIN_REACH = 0.8
"""Minimum fraction of the distances that must be within reach. The distances are converted to metres with the
provisional scale: the scale at which most distances are within reach. With a smaller fraction, the check is
inconclusive. Evidence: none."""
_MIN_DISTANCES = 20
"""Minimum number of distances that the check needs. Evidence: none."""
_MAX_GAP_NS = 1_000_000_000
"""Maximum time (nanoseconds) between two keyframes for an interpolation of the camera's position. In a longer
time, a limb can move anywhere."""
_SLACK_SIGMAS = 2.0
"""Half the width of a distance's confidence interval, in standard deviations. A distance is out of reach only
if its whole interval is out of reach. Evidence: none."""
_MIN_RUN = 3
"""Minimum length of a violation: number of successive keyframes of a camera that are out of reach. Shorter
runs are treated as noise of the keyframes' poses."""
_SMALLEST_UNIT = 1e-300
"""Minimum lower end (map units) of a distance's confidence interval. Because of this minimum, the lower end
is positive even for a distance of 0, and the logarithm of the lower end is defined."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DistanceCheck:
    """The result of comparing the distances between cameras with the body's reach.

    Attributes:
        distances: Number of compared distances, one for each camera pair and instant.
        within_reach: Fraction of the distances that are within reach at the provisional scale.
        metres_per_unit: The provisional scale: metres per map unit; None if there are too few distances.
        violations: (K,) True for each of the map's K keyframes that belongs to a run of at least `_MIN_RUN`
            successive keyframes out of reach.
    """

    distances: int
    within_reach: float
    metres_per_unit: float | None
    violations: BoolArray

    @property
    def is_conclusive(self) -> bool:
        """Whether a scale was found at which most distances are within reach.

        If there is no such scale, either the given body or the map is wrong, and the check cannot decide
        which.
        """
        return self.metres_per_unit is not None and self.within_reach >= MIN_WITHIN_REACH

    def to_log(self) -> dict[str, object]:
        """Return the entries for the log. The entries do not depend on the map's arbitrary scale."""
        if self.metres_per_unit is None:
            return {
                "judged": False,
                "reason": f"only {self.distances} distances between cameras are known, which is too few",
            }
        out: dict[str, object] = {
            "judged": self.is_conclusive,
            "distances": self.distances,
            "within_reach": round(self.within_reach, 4),
            "keyframes_out_of_reach": int(self.violations.sum()),
        }
        if not self.is_conclusive:
            out["reason"] = (
                f"for no scale, {format_percent(MIN_WITHIN_REACH)} of the distances between cameras are "
                "possible on one body"
            )
        return out


def check_distances(scene: Map, common_ns: Mapping[str, IntArray], reach: Reach) -> DistanceCheck:
    """Compare the distances between cameras at the keyframes' instants with the body's reach.

    The position of a camera between two of its keyframes is interpolated. The uncertainty of the position
    grows with the distance between these two keyframes. All distances are converted to metres with one
    provisional scale, so the map's own scale has no effect.

    Args:
        scene: The map to check.
        common_ns: Common time (nanoseconds) of every frame, by camera name. Cameras without an entry have an
            unknown clock and are not compared.
        reach: Minimum and maximum distance (metres) between the two cameras of each pair.
    """
    none = np.zeros(len(scene.keyframe_camera), dtype=bool)
    names = sorted(name for name in scene.cameras if name in common_ns)
    parts = [_distances_both_ways(scene, common_ns, pair) for pair in combinations(names, 2)]
    parts = [part for part in parts if part.pair in reach and len(part.distance)]
    count = sum(len(part.distance) for part in parts)
    if count < _MIN_DISTANCES:
        return DistanceCheck(distances=count, within_reach=0.0, metres_per_unit=None, violations=none)
    low = np.concatenate([np.log(reach[part.pair][0] / part.longest()) for part in parts])
    high = np.concatenate([np.log(reach[part.pair][1] / part.shortest()) for part in parts])
    scale, within_reach = find_best_scale(low, high)
    result = DistanceCheck(
        distances=count, within_reach=within_reach, metres_per_unit=float(np.exp(scale)), violations=none
    )
    if not result.is_conclusive:
        return result
    outside = (scale < low) | (scale > high)
    votes = np.zeros((len(none), 2), dtype=np.int64)
    rows = np.concatenate([part.keyframe for part in parts])
    np.add.at(votes, (rows, outside.astype(np.int64)), 1)
    out_of_reach = votes[:, 1] > votes[:, 0]
    return DistanceCheck(
        distances=count,
        within_reach=within_reach,
        metres_per_unit=float(np.exp(scale)),
        violations=_keep_long_runs(scene, out_of_reach),
    )


def find_best_scale(low: FloatArray, high: FloatArray) -> tuple[float, float]:
    """Find the value that lies in as many intervals as possible.

    If a range of values lies in the same intervals, the middle of the range is returned.

    Args:
        low: (N,) lower ends of the intervals. The unit is arbitrary; `check_distances` uses the logarithm of
            a scale.
        high: (N,) upper ends of the intervals.

    Returns:
        The value; the fraction of the intervals that contain the value.

    Source: the maximum of a sweep over sorted end points.
    """
    ends = np.concatenate([low, high])
    step = np.concatenate([np.ones(len(low)), -np.ones(len(high))])
    order = np.lexsort((-step, ends))
    inside = np.cumsum(step[order])
    top = int(np.argmax(inside))
    middle = 0.5 * (ends[order[top]] + ends[order[min(top + 1, len(order) - 1)]])
    return float(middle), float(inside[top] / len(low))


@dataclass(frozen=True, slots=True)
class _Distances:
    """Distances between two cameras at several instants, with their uncertainty.

    Attributes:
        pair: Camera names in alphabetical order.
        keyframe: (N,) index in the map of the keyframe that defines the instant of each distance.
        distance: (N,) distance between the two cameras, map units.
        sigma: (N,) standard deviation of the distance because of interpolation, map units.
    """

    pair: tuple[str, str]
    keyframe: IntArray
    distance: FloatArray
    sigma: FloatArray

    def longest(self) -> FloatArray:
        """Return the upper ends (N,) of the distances' confidence intervals, map units."""
        return self.distance + _SLACK_SIGMAS * self.sigma

    def shortest(self) -> FloatArray:
        """Return the lower ends (N,) of the distances' confidence intervals, map units, always positive."""
        return np.maximum(self.distance - _SLACK_SIGMAS * self.sigma, 1e-9 * self.distance + _SMALLEST_UNIT)


def _distances_both_ways(scene: Map, common_ns: Mapping[str, IntArray], pair: tuple[str, str]) -> _Distances:
    """Return the distances between two cameras at the instants of all keyframes of both cameras."""
    parts = [_distances_at_keyframes(scene, common_ns, a, b) for a, b in (pair, pair[::-1])]
    return _Distances(pair, *(np.concatenate(part) for part in zip(*parts, strict=True)))


def _distances_at_keyframes(
    scene: Map, common_ns: Mapping[str, IntArray], camera: str, other: str
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the distances between two cameras at the instants of the first camera's keyframes.

    Returns:
        (N,) indices of the keyframes of `camera` at which the position of `other` can be interpolated; (N,)
        distances between the two cameras, map units; (N,) standard deviations of the distances.
    """
    own, others = scene.keyframes_of(camera), scene.keyframes_of(other)
    at = common_ns[camera][scene.keyframe_frame[own]]
    times = common_ns[other][scene.keyframe_frame[others]]
    after = np.searchsorted(times, at)
    inside = np.flatnonzero((after > 0) & (after < len(times)))
    before, after = others[after[inside] - 1], others[after[inside]]
    gap = common_ns[other][scene.keyframe_frame[after]] - common_ns[other][scene.keyframe_frame[before]]
    near = gap <= _MAX_GAP_NS
    inside, before, after, gap = inside[near], before[near], after[near], gap[near]
    alpha = (at[inside] - common_ns[other][scene.keyframe_frame[before]]) / np.maximum(gap, 1)
    centres = scene.map_from_cam[:, :3, 3]
    step = centres[after] - centres[before]
    distance = np.linalg.norm(centres[before] + alpha[:, None] * step - centres[own[inside]], axis=1)
    # A curved path deviates from its chord. The deviation grows with the chord's length and is largest in
    # the middle.
    sigma = np.linalg.norm(step, axis=1) * alpha * (1.0 - alpha)
    return own[inside], distance, sigma


def _keep_long_runs(scene: Map, mask: BoolArray) -> BoolArray:
    """Return a copy of a mask (K,) of keyframes, without short runs.

    Each run of fewer than `_MIN_RUN` successive True keyframes of one camera becomes False.
    """
    out = np.zeros(len(mask), dtype=bool)
    for camera in sorted(scene.cameras):
        rows = scene.keyframes_of(camera)
        for start, stop in runs(mask[rows]):
            if stop - start >= _MIN_RUN:
                out[rows[start:stop]] = True
    return out
