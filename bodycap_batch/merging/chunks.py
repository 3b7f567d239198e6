"""Long captures in overlapping stretches of the timeline, so that memory does not grow with them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from bodycap_batch.arrays import FloatArray, IntArray
from bodycap_batch.merging.solve import MotionGraph, Solution
from bodycap_batch.merging.spread import Spread
from bodycap_batch.merging.tracks import Track

CHUNK_TICKS = 500
"""Of 24 s of three cameras the solver takes 160 MB at once, in two stretches 100."""
OVERLAP_S = 3.0
"""Two solutions of a stretch differ by what lies beyond; three seconds of measurements forget it."""
MAX_ITERATIONS = 20
_SHORTEST_TICKS = 300
_CHAIN_BYTES = 8e8
"""Of a stretch's covariance: two square blocks a tick, of twelve unknowns for each bone and each camera whose
frames lie between the ticks."""


Part = tuple[Solution, Sequence[Track], tuple[int, int], int]
"""A stretch's solution, its tracks, the ticks it answers for and the first tick it was solved at."""


def solve_motion(
    build: Callable[[IntArray, Sequence[Track]], MotionGraph],
    tick_times_ns: IntArray,
    tracks: Sequence[Track],
    step: Callable[[], None],
    *,
    chunk_ticks: int = CHUNK_TICKS,
    spread: Spread | None = None,
) -> Solution:
    """Solve the whole timeline, stretch by stretch where it is long.

    Args:
        build: Makes the graph of a stretch from its ticks and tracks.
        tick_times_ns: (T,) the timeline.
        tracks: Cleaned tracks, poses in metres.
        step: Called after each iteration; may raise to stop.
        chunk_ticks: Longest stretch, without its overlaps.
        spread: How far off the calibration may be; with it the joints' covariance is computed.
    """
    parts: list[Part] = []
    for first, last in stretches(tick_times_ns, tracks, chunk_ticks):
        low, high = with_overlap(tick_times_ns, first, last)
        inside = [_between(track, tick_times_ns, low, high) for track in tracks]
        seen = [track for track in inside if len(track.times_ns)]
        solution = build(tick_times_ns[low:high], seen).solve(MAX_ITERATIONS, step, spread)
        parts.append((solution, seen, (first, last), low))
    return parts[0][0] if len(parts) == 1 else _joined(parts, tick_times_ns)


def with_overlap(tick_times_ns: IntArray, first: int, last: int) -> tuple[int, int]:
    """First tick, and the one after the last, of a stretch with what it shares with its neighbours."""
    reach_ns = round(OVERLAP_S * 1e9)
    low = int(np.searchsorted(tick_times_ns, tick_times_ns[first] - reach_ns))
    high = int(np.searchsorted(tick_times_ns, tick_times_ns[last - 1] + reach_ns, side="right"))
    return low, high


def longest_stretch(bones: int, tracks: Sequence[Track]) -> int:
    """Ticks that one stretch may have, so that its memory stays bounded however many cameras there are."""
    block = 12 * (bones + len(tracks))
    return int(np.clip(_CHAIN_BYTES / (16.0 * block**2), _SHORTEST_TICKS, CHUNK_TICKS))


def stretches(tick_times_ns: IntArray, tracks: Sequence[Track], chunk_ticks: int) -> list[tuple[int, int]]:
    """Cut the ticks into about equal stretches, each with measurements of its own."""
    count = len(tick_times_ns)
    cuts = np.linspace(0, count, max(1, -(-count // chunk_ticks)) + 1).round().astype(int).tolist()
    times = np.sort(np.concatenate([track.times_ns for track in tracks]))
    out: list[tuple[int, int]] = []
    first = 0
    for last in cuts[1:]:
        low, high = _window(tick_times_ns, first, last)
        if np.searchsorted(times, high) > np.searchsorted(times, low):
            out.append((first, last))
            first = last
    if first < count:
        # What follows the last measurement belongs to the stretch that has it.
        out[-1] = (out[-1][0], count)
    return out


def _window(tick_times_ns: IntArray, first: int, last: int) -> tuple[int, int]:
    """From the first tick's time to the tick after the last; open at the ends of the timeline."""
    low = int(tick_times_ns[first]) if first > 0 else -(2**62)
    high = int(tick_times_ns[last]) if last < len(tick_times_ns) else 2**62
    return low, high


def _between(track: Track, tick_times_ns: IntArray, first: int, last: int) -> Track:
    low, high = _window(tick_times_ns, first, last)
    return track.keep((track.times_ns >= low) & (track.times_ns < high))


def _joined(parts: Sequence[Part], tick_times_ns: IntArray) -> Solution:
    poses = [solution.world_from_bone[first - low : last - low] for solution, _, (first, last), low in parts]
    spreads = [
        solution.joint_covariance[first - low : last - low]
        for solution, _, (first, last), low in parts
        if solution.joint_covariance is not None
    ]
    kinds = ("residual_m", "residual_rad", "weights", "world_from_cam")
    collected: dict[str, dict[str, list[FloatArray]]] = {kind: {} for kind in kinds}
    errors: dict[str, float] = {}
    for solution, tracks, (first, last), _ in parts:
        low, high = _window(tick_times_ns, first, last)
        for track in tracks:
            own = (track.times_ns >= low) & (track.times_ns < high)
            for name, by_camera in collected.items():
                by_camera.setdefault(track.camera, []).append(getattr(solution, name)[track.camera][own])
        for kind, error in solution.errors.items():
            errors[kind] = errors.get(kind, 0.0) + error
    joined = {
        name: {camera: np.concatenate(pieces) for camera, pieces in by_camera.items()}
        for name, by_camera in collected.items()
    }
    return Solution(
        world_from_bone=np.concatenate(poses),
        residual_m=joined["residual_m"],
        residual_rad=joined["residual_rad"],
        weights=joined["weights"],
        world_from_cam=joined["world_from_cam"],
        iterations=max(solution.iterations for solution, *_ in parts),
        errors=errors,
        joint_covariance=np.concatenate(spreads) if spreads else None,
    )
