"""Which stretches of a video are tracked, and which are known from an earlier round."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from threading import Event, Lock

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.scene import FrameStatus, Registration
from bodycap_batch.registration.tracking.klt import Anchor, Tracks, track_stretch

_MIN_RANGE = 15
"""A shorter rest is not worth a decoder of its own."""


@dataclass(frozen=True, slots=True)
class Known:
    """What was tracked before.

    Attributes:
        tracks: The observations.
        keyframes: The frames they were tracked from and between, increasing.
    """

    tracks: Tracks
    keyframes: list[int]

    @staticmethod
    def of(previous: Registration | None) -> Known | None:
        """What an earlier registration tracked."""
        if previous is None:
            return None
        status = previous.trajectory.status
        frames = [index for index, value in enumerate(status) if value is FrameStatus.KEYFRAME]
        tracks = Tracks(previous.obs_frame, previous.obs_keyframe, previous.obs_feature, previous.obs_px)
        return Known(tracks, frames)


def all_tracks(
    camera: CaptureCamera,
    anchors: Mapping[int, Anchor],
    known: Known | None,
    context: StageContext,
) -> Tracks:
    """Track every stretch between neighbouring keyframes, or reuse what was tracked there before."""
    count = len(camera.times_ns)
    frames = sorted(anchors)
    stretches = list(zip([None, *frames], [*frames, None], strict=True))
    done: set[tuple[int | None, int | None]] = set()
    parts = []
    if known is not None:
        done = set(zip([None, *known.keyframes], [*known.keyframes, None], strict=True))
        parts.append(_inside(known.tracks, [stretch for stretch in stretches if stretch in done], count))
    todo = _joined([stretch for stretch in stretches if stretch not in done], count)
    parts += _track(camera, anchors, _shared_out(todo, frames, context.threads), context)
    return Tracks.join(parts)  # which takes them out one by one: nothing else may hold them


def _track(
    camera: CaptureCamera,
    anchors: Mapping[int, Anchor],
    ranges: list[tuple[int, int]],
    context: StageContext,
) -> list[Tracks]:
    """Track ranges of frames, as many at a time as there are threads; what is found is the same."""
    stopped, lock = Event(), Lock()
    total = sum(stop - start for start, stop in ranges)
    reached = [start for start, _ in ranges]

    def work(index: int) -> list[Tracks]:
        def told(frame: int) -> None:
            with lock:
                reached[index] = frame
                done = sum(frame - start for frame, (start, _) in zip(reached, ranges, strict=True))
                context.progress(done, total, "frames tracked")

        halting = replace(context, cancelled=lambda: stopped.is_set() or context.cancelled())
        found = []
        for part in track_stretch(camera, anchors, *ranges[index], halting):
            found.append(part)
            if part.frame[0] > reached[index]:
                told(int(part.frame[0]))
        return found

    with ThreadPoolExecutor(max_workers=max(1, context.threads), thread_name_prefix="track") as pool:
        pending = [pool.submit(work, index) for index in range(len(ranges))]
        try:
            return [part for future in pending for part in future.result()]
        finally:
            stopped.set()


def _shared_out(ranges: list[tuple[int, int]], keyframes: list[int], threads: int) -> list[tuple[int, int]]:
    """Cut ranges at keyframes where they are longer than a thread's even share."""
    total = sum(stop - start for start, stop in ranges)
    share = -(-total // max(1, threads))
    out = []
    for start, stop in ranges:
        begin = start
        for keyframe in keyframes:
            if begin + share <= keyframe < stop - 1 - _MIN_RANGE:
                out.append((begin, keyframe + 1))
                begin = keyframe
        out.append((begin, stop))
    return out


def _joined(stretches: list[tuple[int | None, int | None]], count: int) -> list[tuple[int, int]]:
    """Merge stretches that touch into ranges [start, stop) of frames, keyframes included."""
    ranges: list[tuple[int, int]] = []
    for first, last in stretches:
        start, stop = first or 0, count if last is None else last + 1
        if ranges and start < ranges[-1][1]:
            ranges[-1] = (ranges[-1][0], stop)
        else:
            ranges.append((start, stop))
    return ranges


def _inside(tracks: Tracks, stretches: list[tuple[int | None, int | None]], count: int) -> Tracks:
    """Tracks from a keyframe at an end of one of the stretches to where they lie in it.

    A keyframe ends two stretches: what was tracked into it across one that is tracked again is left out, or
    it would count twice.
    """
    reach = np.zeros((count, 2), dtype=np.int64)  # how far back and ahead of a keyframe its tracks are kept
    for first, last in stretches:
        if first is not None:
            reach[first, 1] = (count if last is None else last) - first
        if last is not None:
            reach[last, 0] = last - (0 if first is None else first)
    ahead = tracks.frame - tracks.keyframe
    back, forth = reach[tracks.keyframe].T
    return tracks.select((-back <= ahead) & (ahead <= forth))
