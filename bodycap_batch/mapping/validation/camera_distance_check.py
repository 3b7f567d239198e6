"""Check that the distances between cameras stay within the body's reach, for a map without a metric scale."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, runs
from bodycap_batch.model.scene import Map

Reach = Mapping[tuple[str, str], tuple[float, float]]
"""Smallest and largest distance of two cameras, metres, by camera names in alphabetical order."""

MIN_WITHIN_REACH = 0.8
"""Ratio of distances that the provisional scale must put within reach; else the check is inconclusive.
Evidence: none."""
_MIN_DISTANCES = 20
"""Distances that the check needs. Evidence: none."""
_MAX_GAP_NS = 1_000_000_000
"""Largest time between two keyframes to interpolate between, nanoseconds: in more time, a limb can be
anywhere."""
_SLACK_SIGMAS = 2.0
"""Standard deviations by which a distance may leave the reach. Evidence: none."""
_MIN_RUN = 3
"""Successive keyframes out of reach that make a violation; one or two are noise of their poses."""
_SMALLEST_UNIT = 1e-300
"""Keeps a distance of zero positive for the logarithm, map units."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DistanceCheck:
    """The result of the check.

    Attributes:
        distances: Number of distances (camera pair, instant).
        within_reach: Ratio of these that the provisional scale puts within reach.
        metres_per_unit: The provisional scale; None if there are too few distances.
        violations: (K,) True for keyframes of the map that are out of reach in runs of several keyframes.
    """

    distances: int
    within_reach: float
    metres_per_unit: float | None
    violations: BoolArray

    @property
    def is_conclusive(self) -> bool:
        """False if no scale fits the body: the body or the map is wrong, and the check cannot know which."""
        return self.metres_per_unit is not None and self.within_reach >= MIN_WITHIN_REACH

    def to_log(self) -> dict[str, object]:
        """Return the entries for the log; they do not depend on the map's arbitrary scale."""
        if self.metres_per_unit is None:
            return {"judged": False, "reason": f"{self.distances} distances between cameras are too few"}
        out: dict[str, object] = {
            "judged": self.is_conclusive,
            "distances": self.distances,
            "within_reach": round(self.within_reach, 4),
            "keyframes_out_of_reach": int(self.violations.sum()),
        }
        if not self.is_conclusive:
            out["reason"] = f"no scale puts {MIN_WITHIN_REACH:.0%} of the distances within the body's reach"
        return out


def check_distances(scene: Map, common_ns: Mapping[str, IntArray], reach: Reach) -> DistanceCheck:
    """Compare the distances between cameras at the keyframes' instants with the body's reach.

    The position of a camera between two of its keyframes is interpolated; its uncertainty grows with their
    distance. All distances are related to one provisional scale, so the map's own scale does not matter.

    Args:
        scene: A map.
        common_ns: Common time of every frame, by camera, nanoseconds.
        reach: Smallest and largest distance of camera pairs.
    """
    none = np.zeros(len(scene.keyframe_camera), dtype=bool)
    parts = [_distances_both_ways(scene, common_ns, pair) for pair in combinations(sorted(scene.cameras), 2)]
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
    """Return the value that lies in most intervals, and the ratio of these intervals.

    If a whole range of values does, its middle is returned.

    Args:
        low: (N,) lower ends of the intervals.
        high: (N,) upper ends.

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
    """Distances between two cameras.

    Attributes:
        pair: Camera names in alphabetical order.
        keyframe: (N,) row in the map of the keyframe at whose instant the distance is taken.
        distance: (N,) map units.
        sigma: (N,) standard deviation from interpolation, map units.
    """

    pair: tuple[str, str]
    keyframe: IntArray
    distance: FloatArray
    sigma: FloatArray

    def longest(self) -> FloatArray:
        """Return the upper ends (N,) of the distances' confidence intervals."""
        return self.distance + _SLACK_SIGMAS * self.sigma

    def shortest(self) -> FloatArray:
        """Return the lower ends (N,), which are positive."""
        return np.maximum(self.distance - _SLACK_SIGMAS * self.sigma, 1e-9 * self.distance + _SMALLEST_UNIT)


def _distances_both_ways(scene: Map, common_ns: Mapping[str, IntArray], pair: tuple[str, str]) -> _Distances:
    """Return the distances of two cameras at the instants of the keyframes of either."""
    parts = [_distances_at_keyframes(scene, common_ns, a, b) for a, b in (pair, pair[::-1])]
    return _Distances(pair, *(np.concatenate(part) for part in zip(*parts, strict=True)))


def _distances_at_keyframes(
    scene: Map, common_ns: Mapping[str, IntArray], camera: str, other: str
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return keyframes of one camera, their distances to the other's path, and standard deviations."""
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
    # A bent path leaves its chord by up to a fraction of the chord's length, most in the middle.
    sigma = np.linalg.norm(step, axis=1) * alpha * (1.0 - alpha)
    return own[inside], distance, sigma


def _keep_long_runs(scene: Map, mask: BoolArray) -> BoolArray:
    """Return the mask (K,) without runs of fewer than `_MIN_RUN` successive keyframes of one camera."""
    out = np.zeros(len(mask), dtype=bool)
    for camera in sorted(scene.cameras):
        rows = scene.keyframes_of(camera)
        for start, stop in runs(mask[rows]):
            if stop - start >= _MIN_RUN:
                out[rows[start:stop]] = True
    return out
