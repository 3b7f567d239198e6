"""Long captures in overlapping stretches of the timeline, so that memory does not grow with them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.merging.cameras.track import MAX_SAMPLE_GAP_NS, CameraTrack
from bodycap_batch.merging.graph.error_modes import ErrorModes
from bodycap_batch.merging.graph.motion_graph import (
    MotionGraph,
    MotionSolution,
    SolverProgress,
    measurement_residuals,
)
from bodycap_batch.model.geometry import interpolate_pose

WINDOW_TICKS = 500
"""Of 24 s of three cameras the solver takes 160 MB at once, in two stretches 100."""
OVERLAP_S = 3.0
"""Two solutions of a stretch differ by what lies beyond; three seconds of measurements forget it."""
_PREFERRED_OVERLAPS, _MIN_OVERLAPS = 4.0, 2.0
"""Overlaps in a stretch of many ticks a second: at four every tick is solved 1.5 times, at two twice."""
_MAX_WINDOW_BYTES = 5e8
"""Of a stretch with its overlaps, where more than `_MIN_OVERLAPS` allow it."""
_STATE_BYTES = 25e3
"""A tick of a stretch took 0.29 MB with nine bones and three cameras, 0.71 with 17 and eleven: so much for
each bone and each camera whose frames lie between the ticks."""
_MIN_WINDOW_TICKS = 300
_BLEND_S = 1.0
"""So long before and after a seam one solution passes into the next: where a camera is lost they may differ
by 16° and 8 cm, which 2 s spread to less than a swinging arm moves a tick. Two seconds of overlap remain."""
_MAX_BOUNDARY_SHIFT = 0.25
"""Of a stretch: how far a seam may be moved to where more cameras are measured."""
MAX_ITERATIONS = 20


WindowSolution = tuple[MotionSolution, Sequence[CameraTrack], tuple[int, int], int]
"""A stretch's solution, its tracks, the ticks it answers for and the first tick it was solved at."""


def solve_windows(
    build: Callable[[IntArray, Sequence[CameraTrack]], MotionGraph],
    tick_times_ns: IntArray,
    tracks: Sequence[CameraTrack],
    step: SolverProgress,
    *,
    window_ticks: int = WINDOW_TICKS,
    spread: ErrorModes | None = None,
) -> MotionSolution:
    """Solve the whole timeline, stretch by stretch where it is long.

    Args:
        build: Makes the graph of a stretch from its ticks and tracks.
        tick_times_ns: (T,) the timeline.
        tracks: Cleaned tracks, poses in metres.
        step: Called after each iteration, and with the name of each part of the work; may raise to stop.
        window_ticks: Longest stretch, without its overlaps.
        spread: How far off the calibration may be; with it the joints' covariance is computed.
    """
    parts: list[WindowSolution] = []
    for first, last in split_timeline(tick_times_ns, tracks, window_ticks):
        low, high = with_overlap(tick_times_ns, first, last)
        inside = [_clip_track(track, tick_times_ns, low, high) for track in tracks]
        seen = [track for track in inside if len(track.times_ns)]
        solution = build(tick_times_ns[low:high], seen).solve(MAX_ITERATIONS, step, spread)
        parts.append((solution, seen, (first, last), low))
    return parts[0][0] if len(parts) == 1 else _blend_windows(parts, tick_times_ns, tracks)


def with_overlap(tick_times_ns: IntArray, first: int, last: int) -> tuple[int, int]:
    """First tick, and the one after the last, of a stretch with what it shares with its neighbours."""
    reach_ns = round(OVERLAP_S * 1e9)
    low = int(np.searchsorted(tick_times_ns, tick_times_ns[first] - reach_ns))
    high = int(np.searchsorted(tick_times_ns, tick_times_ns[last - 1] + reach_ns, side="right"))
    return low, high


def max_window_ticks(bones: int, tracks: Sequence[CameraTrack], tick_times_ns: IntArray) -> int:
    """Ticks that one stretch may have without its overlaps.

    At high rates that is more than `WINDOW_TICKS`, for the overlaps not to cost more than the stretches; many
    bones and cameras make it fewer, for its memory to stay bounded.
    """
    ticks_s = 1e9 / float(np.median(np.diff(tick_times_ns))) if len(tick_times_ns) > 1 else 1.0
    overlap = OVERLAP_S * ticks_s
    room = _MAX_WINDOW_BYTES / (_STATE_BYTES * (bones + len(tracks))) - 2.0 * overlap
    wanted = max(WINDOW_TICKS, _PREFERRED_OVERLAPS * overlap)
    return round(max(min(wanted, room), _MIN_OVERLAPS * overlap, _MIN_WINDOW_TICKS))


def split_timeline(
    tick_times_ns: IntArray, tracks: Sequence[CameraTrack], window_ticks: int
) -> list[tuple[int, int]]:
    """Cut the ticks into about equal stretches, each with measurements of its own.

    Seams lie where most cameras are measured: in a gap neither side sees both its ends. A stretch gets longer
    than `window_ticks` by that, by a quarter at most.
    """
    count = len(tick_times_ns)
    times = np.sort(np.concatenate([track.times_ns for track in tracks]))
    out: list[tuple[int, int]] = []
    first = 0
    for last in _boundaries(tick_times_ns, tracks, max(1, -(-count // window_ticks))):
        low, high = _time_span(tick_times_ns, first, last)
        if np.searchsorted(times, high) > np.searchsorted(times, low):
            out.append((first, last))
            first = last
    if first < count:
        # What follows the last measurement belongs to the stretch that has it.
        out[-1] = (out[-1][0], count)
    return out


def _boundaries(tick_times_ns: IntArray, tracks: Sequence[CameraTrack], parts: int) -> list[int]:
    """Where each of so many stretches ends: the best measured tick near its even share."""
    count = len(tick_times_ns)
    even = np.linspace(0, count, parts + 1).round().astype(int)
    aside = int(_MAX_BOUNDARY_SHIFT * count / parts)
    measured = _cameras_measured_near(tick_times_ns, tracks) if parts > 1 else np.zeros(count)
    cuts = [0]
    for place in even[1:-1].tolist():
        near = np.arange(place - aside, min(place, cuts[-1] + count // parts) + aside + 1)
        best = near[measured[near] >= measured[near].max() - 1e-9]
        cuts.append(int(best[np.argmin(np.abs(best - place))]))
    return [*cuts[1:], count]


def _cameras_measured_near(tick_times_ns: IntArray, tracks: Sequence[CameraTrack]) -> FloatArray:
    """(T,) how many cameras are measured, on average, where a seam at that tick would be blended."""
    seen = np.zeros(len(tick_times_ns))
    for track in tracks:
        after = np.searchsorted(track.times_ns, tick_times_ns)
        inside = (after > 0) & (after < len(track.times_ns))
        span = np.diff(track.times_ns)
        # A slow camera's frames are no gaps.
        reach = max(MAX_SAMPLE_GAP_NS, 2.0 * float(np.median(span))) if len(span) else 0.0
        seen[inside] += span[after[inside] - 1] <= reach
    total = np.concatenate([[0.0], np.cumsum(seen)])
    reach_ns = round(_BLEND_S * 1e9)
    low = np.searchsorted(tick_times_ns, tick_times_ns - reach_ns)
    high = np.searchsorted(tick_times_ns, tick_times_ns + reach_ns, side="right")
    return np.asarray((total[high] - total[low]) / (high - low))


def _time_span(tick_times_ns: IntArray, first: int, last: int) -> tuple[int, int]:
    """From the first tick's time to the tick after the last; open at the ends of the timeline."""
    low = int(tick_times_ns[first]) if first > 0 else -(2**62)
    high = int(tick_times_ns[last]) if last < len(tick_times_ns) else 2**62
    return low, high


def _clip_track(track: CameraTrack, tick_times_ns: IntArray, first: int, last: int) -> CameraTrack:
    low, high = _time_span(tick_times_ns, first, last)
    return track.keep((track.times_ns >= low) & (track.times_ns < high))


def _blend_weight(times_ns: IntArray, seam_ns: int) -> FloatArray:
    """(N,) how far times about a seam are on its later side, 0 to 1, without a kink."""
    x = np.clip(0.5 + 0.5e-9 * (times_ns - seam_ns) / _BLEND_S, 0.0, 1.0)
    return np.asarray(x * x * (3.0 - 2.0 * x))


def _blend_windows(
    parts: Sequence[WindowSolution], tick_times_ns: IntArray, tracks: Sequence[CameraTrack]
) -> MotionSolution:
    """The stretches' solutions in one, each passing into the next about the seam."""
    poses, spread = parts[0][0].world_from_bone, parts[0][0].joint_covariance
    cameras = {track.camera: np.zeros((0, 4, 4)) for track in tracks} | dict(parts[0][0].world_from_cam)
    for solution, _, (first, _), low in parts[1:]:
        seam_ns = int(tick_times_ns[first])
        share = _blend_weight(tick_times_ns[low : len(poses)], seam_ns)
        poses = _blend_poses(poses, solution.world_from_bone, share)
        if spread is not None and solution.joint_covariance is not None:
            later, both = solution.joint_covariance, share[:, None, None, None]
            blended = (1.0 - both) * spread[low:] + both * later[: len(share)]
            spread = np.concatenate([spread[:low], blended, later[len(share) :]])
        from_ns, _ = _time_span(tick_times_ns, low, low)
        for track in tracks:
            before, after = cameras[track.camera], solution.world_from_cam.get(track.camera)
            if after is not None:
                times = track.times_ns[np.searchsorted(track.times_ns, from_ns) : len(before)]
                cameras[track.camera] = _blend_poses(before, after, _blend_weight(times, seam_ns))
    return _assemble(parts, tracks, poses, spread, cameras)


def _blend_poses(before: FloatArray, after: FloatArray, share: FloatArray) -> FloatArray:
    """Join poses (M,...,4,4) and (N,...,4,4) whose last and first S share their times, by `share` (S,)."""
    both = len(share)
    alpha = share.reshape(-1, *[1] * (before.ndim - 3))
    blended = interpolate_pose(before[len(before) - both :], after[:both], alpha)
    return np.concatenate([before[: len(before) - both], blended, after[both:]])


def _assemble(
    parts: Sequence[WindowSolution],
    tracks: Sequence[CameraTrack],
    poses: FloatArray,
    spread: FloatArray | None,
    cameras: dict[str, FloatArray],
) -> MotionSolution:
    """The solution of blended poses: what measurements miss them by is theirs."""
    errors: dict[str, float] = {}
    for solution, *_ in parts:
        for kind, error in solution.errors.items():
            errors[kind] = errors.get(kind, 0.0) + error
    off = {track.camera: measurement_residuals(track, cameras[track.camera]) for track in tracks}
    return MotionSolution(
        world_from_bone=poses,
        residual_m={camera: metres for camera, (metres, _, _) in off.items()},
        residual_rad={camera: turns for camera, (_, turns, _) in off.items()},
        weights={camera: weights for camera, (_, _, weights) in off.items()},
        world_from_cam=cameras,
        iterations=max(solution.iterations for solution, *_ in parts),
        errors=errors,
        joint_covariance=spread,
    )
