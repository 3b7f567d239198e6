"""Decide which frame ranges of a video are tracked, and reuse earlier tracks in the other ranges."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from threading import Event, Lock

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.scene import FrameStatus, Registration
from bodycap_batch.registration.tracking.klt import KeyframePoints, MeasuredTurns, Tracks, track_range

_MIN_RANGE_FRAMES = 15
"""Minimum number of frames in the last part of a frame range, if the range is split between threads. A
shorter part is not split off, because it is not worth opening another video decoder. Evidence: none."""


@dataclass(frozen=True, slots=True)
class TrackCache:
    """The tracks of an earlier round of registration, kept to avoid repeated tracking.

    Attributes:
        tracks: The tracked observations.
        keyframes: Frame indices of the keyframes of that round, increasing. The tracks start in these
            keyframes.
    """

    tracks: Tracks
    keyframes: list[int]

    @staticmethod
    def from_registration(previous: Registration | None) -> TrackCache | None:
        """Return the tracks of an earlier registration; None if there is no earlier registration."""
        if previous is None:
            return None
        status = previous.trajectory.status
        frames = [index for index, value in enumerate(status) if value is FrameStatus.KEYFRAME]
        tracks = Tracks(previous.obs_frame, previous.obs_keyframe, previous.obs_feature, previous.obs_px)
        return TrackCache(tracks, frames)


def track_all(
    camera: CaptureCamera,
    points_by_keyframe: Mapping[int, KeyframePoints],
    cache: TrackCache | None,
    context: StageContext,
    turns: MeasuredTurns | None = None,
) -> Tracks:
    """Track map points in every interval between successive keyframes, or use the tracks of an earlier round.

    Args:
        camera: The camera.
        points_by_keyframe: Map points of the keyframes, by frame index.
        cache: Tracks of an earlier round. They are used in intervals that have the same two keyframes as
            before.
        context: Threads, progress and cancellation.
        turns: Rotations between frames that a gyroscope measured; None if there are none.

    Returns:
        All tracks of the camera, ordered by frame, keyframe and feature.
    """
    count = len(camera.times_ns)
    frames = sorted(points_by_keyframe)
    intervals = list(zip([None, *frames], [*frames, None], strict=True))
    cached: set[tuple[int | None, int | None]] = set()
    parts = []
    if cache is not None:
        cached = set(zip([None, *cache.keyframes], [*cache.keyframes, None], strict=True))
        parts.append(
            _reusable(cache.tracks, [interval for interval in intervals if interval in cached], count)
        )
    missing = _merge_ranges([interval for interval in intervals if interval not in cached], count)
    ranges = _split_by_thread(missing, frames, context.threads)
    parts += _track_ranges(camera, points_by_keyframe, ranges, context, turns)
    return Tracks.join_and_clear(parts)  # no other reference exists, so the memory is released


def _track_ranges(
    camera: CaptureCamera,
    points_by_keyframe: Mapping[int, KeyframePoints],
    ranges: list[tuple[int, int]],
    context: StageContext,
    turns: MeasuredTurns | None,
) -> list[Tracks]:
    """Track several ranges of frames in parallel, each on one thread.

    The result does not depend on the number of threads.
    """
    stopped, lock = Event(), Lock()
    total = sum(stop - start for start, stop in ranges)
    position = [start for start, _ in ranges]

    def track_one(index: int) -> list[Tracks]:
        def report(frame: int) -> None:
            with lock:
                position[index] = frame
                done = sum(frame - start for frame, (start, _) in zip(position, ranges, strict=True))
                context.progress(done, total, "frames tracked")

        stoppable = replace(context, cancelled=lambda: stopped.is_set() or context.cancelled())
        parts = []
        for part in track_range(camera, points_by_keyframe, *ranges[index], stoppable, turns):
            parts.append(part)
            if part.frame[0] > position[index]:
                report(int(part.frame[0]))
        return parts

    with ThreadPoolExecutor(max_workers=max(1, context.threads), thread_name_prefix="track") as pool:
        pending = [pool.submit(track_one, index) for index in range(len(ranges))]
        try:
            return [part for future in pending for part in future.result()]
        finally:
            stopped.set()


def _split_by_thread(
    ranges: list[tuple[int, int]], keyframes: list[int], threads: int
) -> list[tuple[int, int]]:
    """Split long ranges at keyframes, so that the threads can share the frames about equally."""
    total = sum(stop - start for start, stop in ranges)
    thread_frames = -(-total // max(1, threads))
    out = []
    for start, stop in ranges:
        range_start = start
        for keyframe in keyframes:
            if range_start + thread_frames <= keyframe < stop - 1 - _MIN_RANGE_FRAMES:
                out.append((range_start, keyframe + 1))
                range_start = keyframe
        out.append((range_start, stop))
    return out


def _merge_ranges(intervals: list[tuple[int | None, int | None]], count: int) -> list[tuple[int, int]]:
    """Merge intervals that share a keyframe into ranges [start, stop) of frames. Keyframes are included."""
    ranges: list[tuple[int, int]] = []
    for first, last in intervals:
        start, stop = first or 0, count if last is None else last + 1
        if ranges and start < ranges[-1][1]:
            ranges[-1] = (ranges[-1][0], stop)
        else:
            ranges.append((start, stop))
    return ranges


def _reusable(tracks: Tracks, intervals: list[tuple[int | None, int | None]], count: int) -> Tracks:
    """Select the tracks that are in a given interval and start at one of the two keyframes that bound it.

    A keyframe bounds two intervals, one before it and one after it. If one of the two intervals is tracked
    again, the old tracks from the keyframe into this interval are removed. Otherwise the interval would have
    two copies of each track.
    """
    kept_frames = np.zeros(
        (count, 2), dtype=np.int64
    )  # number of frames before (column 0) and after (column 1) a keyframe in which its tracks are kept
    for first, last in intervals:
        if first is not None:
            kept_frames[first, 1] = (count if last is None else last) - first
        if last is not None:
            kept_frames[last, 0] = last - (0 if first is None else first)
    offset = tracks.frame - tracks.keyframe
    backward, forward = kept_frames[tracks.keyframe].T
    return tracks.select((-backward <= offset) & (offset <= forward))
