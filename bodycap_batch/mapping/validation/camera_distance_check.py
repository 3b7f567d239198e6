"""Cameras on one body stay within its reach: a check of a map that has no scale yet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.scene import Map

Reach = Mapping[tuple[str, str], tuple[float, float]]
"""Smallest and largest distance of two cameras, metres, by camera names in alphabetical order."""

MIN_WITHIN_REACH = 0.8
"""Share of distances that a scale has to put within reach; below, no verdict is given."""
_MIN_DISTANCES = 20
_MAX_GAP_NS = 1_000_000_000
"""Between keyframes further apart a limb can be anywhere."""
_SLACK_SIGMAS = 2.0
_MIN_RUN = 3
"""Successive keyframes out of reach that make a violation; one or two are noise of their poses."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DistanceCheck:
    """What the body's reach says about a map.

    Attributes:
        distances: How many (camera pair, instant) distances there are.
        explained: Share of them that the provisional scale puts within reach.
        metres_per_unit: The provisional scale; None where there is nothing to tell it from.
        violating: (K,) keyframes of the map that lie out of the body's reach, over runs of frames.
    """

    distances: int
    explained: float
    metres_per_unit: float | None
    violating: BoolArray

    @property
    def judged(self) -> bool:
        """False where no scale fits the body: a wrong body or a wrong map, and no telling which."""
        return self.metres_per_unit is not None and self.explained >= MIN_WITHIN_REACH

    def to_log(self) -> dict[str, object]:
        """JSON-able account, free of the map's arbitrary scale."""
        if self.metres_per_unit is None:
            return {"judged": False, "reason": f"{self.distances} distances between cameras are too few"}
        out: dict[str, object] = {
            "judged": self.judged,
            "distances": self.distances,
            "within_reach": round(self.explained, 4),
            "keyframes_out_of_reach": int(self.violating.sum()),
        }
        if not self.judged:
            out["reason"] = f"no scale puts {MIN_WITHIN_REACH:.0%} of the distances within the body's reach"
        return out


def check_distances(scene: Map, common_ns: Mapping[str, IntArray], reach: Reach) -> DistanceCheck:
    """Hold the distances between cameras, at the keyframes' instants, against the body.

    Args:
        scene: A map.
        common_ns: Common time of every frame, by camera.
        reach: Smallest and largest distance of camera pairs.

    A camera's place between two of its keyframes is interpolated; how far they lie apart is what may be
    wrong with it. Distances are ratios to one provisional scale, so the map's own does not matter.
    """
    none = np.zeros(len(scene.keyframe_camera), dtype=bool)
    found = [_distances_both_ways(scene, common_ns, pair) for pair in combinations(sorted(scene.cameras), 2)]
    found = [each for each in found if each.pair in reach and len(each.distance)]
    count = sum(len(each.distance) for each in found)
    if count < _MIN_DISTANCES:
        return DistanceCheck(distances=count, explained=0.0, metres_per_unit=None, violating=none)
    low = np.concatenate([np.log(reach[each.pair][0] / each.longest()) for each in found])
    high = np.concatenate([np.log(reach[each.pair][1] / each.shortest()) for each in found])
    scale, explained = find_best_scale(low, high)
    verdict = DistanceCheck(
        distances=count, explained=explained, metres_per_unit=float(np.exp(scale)), violating=none
    )
    if not verdict.judged:
        return verdict
    outside = (scale < low) | (scale > high)
    votes = np.zeros((len(none), 2), dtype=np.int64)
    rows = np.concatenate([each.keyframe for each in found])
    np.add.at(votes, (rows, outside.astype(np.int64)), 1)
    bad = votes[:, 1] > votes[:, 0]
    return DistanceCheck(
        distances=count,
        explained=explained,
        metres_per_unit=float(np.exp(scale)),
        violating=_keep_long_runs(scene, bad),
    )


def find_best_scale(low: FloatArray, high: FloatArray) -> tuple[float, float]:
    """The value that lies in most intervals [low, high] (the middle of where it does), and their share.

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
    pair: tuple[str, str]
    keyframe: IntArray
    distance: FloatArray
    sigma: FloatArray

    def longest(self) -> FloatArray:
        return self.distance + _SLACK_SIGMAS * self.sigma

    def shortest(self) -> FloatArray:
        return np.maximum(self.distance - _SLACK_SIGMAS * self.sigma, 1e-9 * self.distance + 1e-300)


def _distances_both_ways(scene: Map, common_ns: Mapping[str, IntArray], pair: tuple[str, str]) -> _Distances:
    """Distances of two cameras at the instants of either's keyframes, from the other's interpolated path."""
    parts = [_distances_at_keyframes(scene, common_ns, a, b) for a, b in (pair, pair[::-1])]
    return _Distances(pair, *(np.concatenate(each) for each in zip(*parts, strict=True)))


def _distances_at_keyframes(
    scene: Map, common_ns: Mapping[str, IntArray], camera: str, other: str
) -> tuple[IntArray, FloatArray, FloatArray]:
    mine, theirs = scene.keyframes_of(camera), scene.keyframes_of(other)
    at = common_ns[camera][scene.keyframe_frame[mine]]
    times = common_ns[other][scene.keyframe_frame[theirs]]
    after = np.searchsorted(times, at)
    inside = np.flatnonzero((after > 0) & (after < len(times)))
    before, after = theirs[after[inside] - 1], theirs[after[inside]]
    gap = common_ns[other][scene.keyframe_frame[after]] - common_ns[other][scene.keyframe_frame[before]]
    near = gap <= _MAX_GAP_NS
    inside, before, after, gap = inside[near], before[near], after[near], gap[near]
    share = (at[inside] - common_ns[other][scene.keyframe_frame[before]]) / np.maximum(gap, 1)
    centres = scene.map_from_cam[:, :3, 3]
    path = centres[after] - centres[before]
    distance = np.linalg.norm(centres[before] + share[:, None] * path - centres[mine[inside]], axis=1)
    # A path that bends leaves its chord by up to a fraction of it, most in the middle.
    sigma = np.linalg.norm(path, axis=1) * share * (1.0 - share)
    return mine[inside], distance, sigma


def _keep_long_runs(scene: Map, bad: BoolArray) -> BoolArray:
    """Keep runs of successive keyframes of one camera."""
    out = np.zeros(len(bad), dtype=bool)
    for camera in sorted(scene.cameras):
        rows = scene.keyframes_of(camera)
        for run in np.split(rows, np.flatnonzero(np.diff(bad[rows].astype(np.int8))) + 1):
            if len(run) >= _MIN_RUN and bad[run[0]]:
                out[run] = True
    return out
