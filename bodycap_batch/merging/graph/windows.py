"""Solves long timelines in overlapping windows, so that the memory does not grow with the length."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.merging.cameras.track import MAX_SAMPLE_GAP_NS, CameraTrack
from bodycap_batch.merging.graph.error_modes import ErrorModes
from bodycap_batch.merging.graph.joint_covariance import joint_covariance
from bodycap_batch.merging.graph.motion_graph import (
    MotionGraph,
    MotionSolution,
    measurement_residuals,
)
from bodycap_batch.model.geometry import interpolate_pose

WINDOW_TICKS = 500
"""Usual number of ticks of a window without its overlaps. Evidence: docs/decisions/merging.md."""
OVERLAP_S = 3.0
"""Time (seconds) by which a window is extended before its first tick and after its last tick. A window does
not contain the measurements outside its ends. Its solution is therefore less accurate near its ends. The
measurements outside hardly influence ticks that are more than three seconds away. Evidence: none."""
_PREFERRED_OVERLAPS, _MIN_OVERLAPS = 4.0, 2.0
"""Preferred and minimum length of a window without its overlaps, as multiples of `OVERLAP_S`, for timelines
with many ticks per second. With a length of four overlaps, each tick is solved 1.5 times on average. With a
length of two overlaps, each tick is solved twice on average."""
_MAX_WINDOW_BYTES = 5e8
"""Maximum memory (bytes) of a window with its overlaps. A window of the minimum length may need more."""
_STATE_BYTES = 25e3
"""Memory (bytes) of one state of the graph. `max_window_ticks` assumes one state per tick for each bone, and
one state per tick for each camera, because the frames of a camera can lie between the ticks. Evidence:
docs/decisions/merging.md."""
_MIN_WINDOW_TICKS = 300
"""Minimum number of ticks of a window without its overlaps. Evidence: none."""
_BLEND_S = 1.0
"""Time (seconds) before and after a boundary in which the poses change gradually from one window's solution
to the next. The other two seconds of each overlap are not used. Evidence: docs/decisions/merging.md."""
_MAX_BOUNDARY_SHIFT = 0.25
"""Maximum shift of a window's boundary, as a fraction of the window's length. A boundary is shifted to a tick
near which more cameras are localised. Evidence: none."""
MAX_ITERATIONS = 20
"""Maximum number of iterations of the optimiser for one window. Evidence: none."""


class SolverProgress(Protocol):
    """Callback that reports the progress of the optimisation. It may raise to stop the optimisation."""

    def __call__(self, what: str = "", /) -> None:
        """Report the end of an iteration, or the start of a part of the computation.

        Args:
            what: Name of the part that starts; empty at the end of an iteration.
        """


def solve_windows(
    build: Callable[[IntArray, Sequence[CameraTrack]], MotionGraph],
    tick_times_ns: IntArray,
    tracks: Sequence[CameraTrack],
    step: SolverProgress,
    *,
    window_ticks: int = WINDOW_TICKS,
    error_modes: ErrorModes | None = None,
) -> MotionSolution:
    """Solve a timeline, in windows if it is long.

    Args:
        build: Makes the graph of a window from the times of its ticks and from its tracks.
        tick_times_ns: (T,) times of the timeline's ticks.
        tracks: Tracks without outliers, poses in metres.
        step: Called without a name after each iteration, and with the name of each part of the work before
            the part starts. It may raise an exception to stop the work.
        window_ticks: Maximum number of ticks of a window without its overlaps. The shift of the boundaries
            may make a window longer by up to a quarter.
        error_modes: Error modes of the calibration. Without them, the covariance of the joints is not
            computed.
    """
    parts: list[tuple[MotionSolution, int, int]] = []
    for first, last in split_timeline(tick_times_ns, tracks, window_ticks):
        low, high = with_overlap(tick_times_ns, first, last)
        clipped = [_clip_track(track, tick_times_ns, low, high) for track in tracks]
        measured = [track for track in clipped if len(track.times_ns)]
        graph = build(tick_times_ns[low:high], measured)
        if error_modes is not None:
            step("solving")
        solution = graph.solve(MAX_ITERATIONS, step)
        if error_modes is not None:
            uncertainty = joint_covariance(graph, solution.world_from_bone, error_modes, step)
            solution = replace(solution, uncertainty=uncertainty)
        parts.append((solution, first, low))
    return parts[0][0] if len(parts) == 1 else _blend_windows(parts, tick_times_ns, tracks)


def with_overlap(tick_times_ns: IntArray, first: int, last: int) -> tuple[int, int]:
    """Return the first tick of a window with its overlaps, and the index after the last tick.

    Args:
        tick_times_ns: (T,) times of the timeline's ticks.
        first: Index of the window's first tick without overlaps.
        last: Index after the window's last tick without overlaps.
    """
    overlap_ns = round(OVERLAP_S * 1e9)
    low = int(np.searchsorted(tick_times_ns, tick_times_ns[first] - overlap_ns))
    high = int(np.searchsorted(tick_times_ns, tick_times_ns[last - 1] + overlap_ns, side="right"))
    return low, high


def max_window_ticks(bones: int, tracks: Sequence[CameraTrack], tick_times_ns: IntArray) -> int:
    """Return the maximum number of ticks of a window without its overlaps.

    At high rates, this number is larger than `WINDOW_TICKS`, so that the overlaps do not need more work than
    the windows. With many bones and cameras, this number is smaller, so that the memory stays bounded.

    Args:
        bones: Number of bones of the graph.
        tracks: Tracks of the cameras.
        tick_times_ns: (T,) times of the timeline's ticks.
    """
    ticks_per_s = 1e9 / float(np.median(np.diff(tick_times_ns))) if len(tick_times_ns) > 1 else 1.0
    overlap = OVERLAP_S * ticks_per_s
    in_memory = _MAX_WINDOW_BYTES / (_STATE_BYTES * (bones + len(tracks))) - 2.0 * overlap
    preferred = max(WINDOW_TICKS, _PREFERRED_OVERLAPS * overlap)
    return round(max(min(preferred, in_memory), _MIN_OVERLAPS * overlap, _MIN_WINDOW_TICKS))


def split_timeline(
    tick_times_ns: IntArray, tracks: Sequence[CameraTrack], window_ticks: int
) -> list[tuple[int, int]]:
    """Split the ticks into windows of about equal length that each contain measurements.

    Each boundary is shifted to a tick near which most cameras are localised. If a boundary were in a time
    without poses, neither window would contain the poses at both ends of this time. The shift may make a
    window longer than `window_ticks` by up to a quarter.

    Args:
        tick_times_ns: (T,) times of the timeline's ticks.
        tracks: Tracks of the cameras.
        window_ticks: Maximum number of ticks of a window before the boundaries are shifted.

    Returns:
        Index of the first tick of each window, and index after its last tick.
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
        # Ticks after the last measurement belong to the window of that measurement.
        out[-1] = (out[-1][0], count)
    return out


def _boundaries(tick_times_ns: IntArray, tracks: Sequence[CameraTrack], parts: int) -> list[int]:
    """Return the index after each window's last tick.

    The function starts from windows of equal length. It then shifts each boundary to a tick near which most
    cameras are localised.
    """
    count = len(tick_times_ns)
    even = np.linspace(0, count, parts + 1).round().astype(int)
    max_shift = int(_MAX_BOUNDARY_SHIFT * count / parts)
    localised = _localised_cameras_near(tick_times_ns, tracks) if parts > 1 else np.zeros(count)
    ends = [0]
    for end in even[1:-1].tolist():
        near = np.arange(end - max_shift, min(end, ends[-1] + count // parts) + max_shift + 1)
        best = near[localised[near] >= localised[near].max() - 1e-9]
        ends.append(int(best[np.argmin(np.abs(best - end))]))
    return [*ends[1:], count]


def _localised_cameras_near(tick_times_ns: IntArray, tracks: Sequence[CameraTrack]) -> FloatArray:
    """Return the mean number (T,) of localised cameras within `_BLEND_S` of each tick."""
    cameras = np.zeros(len(tick_times_ns))
    for track in tracks:
        after = np.searchsorted(track.times_ns, tick_times_ns)
        inside = (after > 0) & (after < len(track.times_ns))
        interval = np.diff(track.times_ns)
        # A camera with a low frame rate is treated as localised between two successive frames.
        max_gap = max(MAX_SAMPLE_GAP_NS, 2.0 * float(np.median(interval))) if len(interval) else 0.0
        cameras[inside] += interval[after[inside] - 1] <= max_gap
    total = np.concatenate([[0.0], np.cumsum(cameras)])
    half_ns = round(_BLEND_S * 1e9)
    low = np.searchsorted(tick_times_ns, tick_times_ns - half_ns)
    high = np.searchsorted(tick_times_ns, tick_times_ns + half_ns, side="right")
    return np.asarray((total[high] - total[low]) / (high - low))


def _time_span(tick_times_ns: IntArray, first: int, last: int) -> tuple[int, int]:
    """Return the times (nanoseconds) of the ticks `first` and `last`.

    The first time is -2**62 if `first` is 0. The second time is 2**62 if `last` is the number of ticks.
    """
    low = int(tick_times_ns[first]) if first > 0 else -(2**62)
    high = int(tick_times_ns[last]) if last < len(tick_times_ns) else 2**62
    return low, high


def _clip_track(track: CameraTrack, tick_times_ns: IntArray, first: int, last: int) -> CameraTrack:
    low, high = _time_span(tick_times_ns, first, last)
    return track.keep((track.times_ns >= low) & (track.times_ns < high))


def _blend_weight(times_ns: IntArray, boundary_ns: int) -> FloatArray:
    """Return the weight (N,) of the later window at times (N,) near a boundary: a smooth step from 0 to 1."""
    x = np.clip(0.5 + 0.5e-9 * (times_ns - boundary_ns) / _BLEND_S, 0.0, 1.0)
    return np.asarray(x * x * (3.0 - 2.0 * x))


def _blend_windows(
    parts: Sequence[tuple[MotionSolution, int, int]],
    tick_times_ns: IntArray,
    tracks: Sequence[CameraTrack],
) -> MotionSolution:
    """Join the solutions of the windows. Near each boundary, blend from one solution to the next.

    Args:
        parts: For each window, its solution with the overlaps, its first tick without the overlaps, and the
            tick at which the solution starts.
        tick_times_ns: (T,) times of the timeline's ticks.
        tracks: Tracks of all cameras on the whole timeline.
    """
    start = parts[0][0]
    poses, uncertainty = start.world_from_bone, start.uncertainty
    cameras = {track.camera: np.zeros((0, 4, 4)) for track in tracks} | dict(start.world_from_cam)
    for solution, first, low in parts[1:]:
        boundary_ns = int(tick_times_ns[first])
        weight = _blend_weight(tick_times_ns[low : len(poses)], boundary_ns)
        poses = _blend_poses(poses, solution.world_from_bone, weight)
        if uncertainty is not None and solution.uncertainty is not None:
            uncertainty = uncertainty.blended(solution.uncertainty, low, weight)
        from_ns, _ = _time_span(tick_times_ns, low, low)
        for track in tracks:
            before, after = cameras[track.camera], solution.world_from_cam.get(track.camera)
            if after is not None:
                times = track.times_ns[np.searchsorted(track.times_ns, from_ns) : len(before)]
                cameras[track.camera] = _blend_poses(before, after, _blend_weight(times, boundary_ns))
    return MotionSolution(
        world_from_bone=poses,
        residuals={track.camera: measurement_residuals(track, cameras[track.camera]) for track in tracks},
        world_from_cam=cameras,
        iterations=max(solution.iterations for solution, *_ in parts),
        errors={kind: sum(solution.errors[kind] for solution, *_ in parts) for kind in start.errors},
        uncertainty=uncertainty,
    )


def _blend_poses(before: FloatArray, after: FloatArray, weight: FloatArray) -> FloatArray:
    """Join the poses of two windows. In the overlap, interpolate between the poses of both windows.

    Args:
        before: (M,...,4,4) poses of the earlier window.
        after: (N,...,4,4) poses of the later window. Its first S poses have the times of the last S poses of
            `before`.
        weight: (S,) weights of the poses of `after` in the overlap.
    """
    overlap = len(weight)
    alpha = weight.reshape(-1, *[1] * (before.ndim - 3))
    blended = interpolate_pose(before[len(before) - overlap :], after[:overlap], alpha)
    return np.concatenate([before[: len(before) - overlap], blended, after[overlap:]])
