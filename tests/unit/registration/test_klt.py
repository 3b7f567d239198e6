"""Tracks between keyframes, from both sides; the number of threads does not change them."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pytest

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import Cancelled
from bodycap_batch.registration.tracking import frame_ranges
from bodycap_batch.registration.tracking.frame_ranges import TrackCache, track_all
from bodycap_batch.registration.tracking.klt import KeyframePoints, Tracks, track_range

STEP_PX = np.array([3.5, -1.25])
COUNT = 48
CONTEXT = StageContext(work_dir=Path())


def _video(visible_to_px: float = 640.0) -> CaptureCamera:
    """A textured plane that slides by `STEP_PX` a frame; a mask covers what is right of a column."""
    noise = np.random.default_rng(0).random((480, 640)).astype(np.float32)
    texture = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2.5), None, 0, 255, cv2.NORM_MINMAX)
    images = [
        cv2.warpAffine(texture, np.float32([[1, 0, dx], [0, 1, dy]]), (640, 480), borderMode=cv2.BORDER_WRAP)
        for dx, dy in np.arange(COUNT)[:, None] * STEP_PX
    ]

    def grey_frames(start: int = 0, stop: int | None = None) -> Iterator[tuple[int, Any]]:
        for index in range(*slice(start, stop).indices(COUNT)):
            yield index, images[index].astype(np.uint8)

    def is_unmasked(px: np.ndarray, frame: int | None = None) -> np.ndarray:
        return px[:, 0] < visible_to_px

    video = SimpleNamespace(times_ns=np.arange(COUNT), grey_frames=grey_frames, is_unmasked=is_unmasked)
    return cast("CaptureCamera", video)


def _keyframe_points(frames: list[int]) -> dict[int, KeyframePoints]:
    """A grid of points of the plane in each keyframe; a keyframe's detector is off by up to half a pixel."""
    rng = np.random.default_rng(1)
    grid = np.stack(np.meshgrid(np.arange(-120, 640, 40), np.arange(0, 600, 40)), axis=-1).reshape(-1, 2)
    out = {}
    for frame in frames:
        px = grid + frame * STEP_PX
        point = np.flatnonzero(((px > 25) & (px < (615, 455))).all(axis=1))
        seen = px[point] + rng.uniform(-0.5, 0.5, (len(point), 2))
        out[frame] = KeyframePoints(np.arange(len(point)) * 2, point, seen.astype(np.float32))
    return out


def _shift_from_start(tracks: Tracks, points_by_keyframe: dict[int, KeyframePoints]) -> np.ndarray:
    """(M,2) how much further each observation moved than the plane did."""
    began = np.array(
        [
            points_by_keyframe[k].px[f // 2]
            for k, f in zip(tracks.keyframe.tolist(), tracks.feature.tolist(), strict=True)
        ]
    )
    return tracks.px - began - (tracks.frame - tracks.keyframe)[:, None] * STEP_PX


def test_points_are_followed_from_both_keyframes_and_end_in_their_observations() -> None:
    points_by_keyframe = _keyframe_points([4, 20])
    tracks = Tracks.join_and_clear(list(track_range(_video(), points_by_keyframe, 0, 30, CONTEXT)))
    # Up to 16 steps of a few hundredths of a pixel each, and a wrapped border that enters some windows.
    assert np.median(np.linalg.norm(_shift_from_start(tracks, points_by_keyframe), axis=1)) < 0.15
    for frame in (5, 12, 19):
        for keyframe in (4, 20):
            mine = (tracks.frame == frame) & (tracks.keyframe == keyframe)
            assert mine.sum() > 0.7 * len(points_by_keyframe[keyframe].px)
            assert len(np.unique(tracks.feature[mine])) == mine.sum()
    assert set(np.unique(tracks.frame[tracks.keyframe == 20])) == set(range(30)) - {20} - set(range(4))


def test_a_point_that_the_next_keyframe_observes_elsewhere_is_tracked_by_itself() -> None:
    points_by_keyframe = _keyframe_points([4, 12])
    shared = np.isin(points_by_keyframe[12].point, points_by_keyframe[4].point)
    other = np.roll(points_by_keyframe[12].point, 1)
    wrong = KeyframePoints(
        points_by_keyframe[12].feature,
        np.where(shared, other, points_by_keyframe[12].point),
        points_by_keyframe[12].px,
    )
    tracks = Tracks.join_and_clear(
        list(track_range(_video(), {4: points_by_keyframe[4], 12: wrong}, 4, 13, CONTEXT))
    )
    # If the path of the neighbouring point were used, it would be off by the grid spacing of 40 px.
    assert np.linalg.norm(_shift_from_start(tracks, points_by_keyframe), axis=1).max() < 5.0


def test_tracks_end_where_the_mask_begins() -> None:
    tracks = Tracks.join_and_clear(
        list(track_range(_video(400.0), _keyframe_points([4, 20]), 0, 30, CONTEXT))
    )
    moved = tracks.frame != tracks.keyframe
    assert moved.sum() > 1000
    assert tracks.px[moved, 0].max() < 400.0 + STEP_PX[0] * 16


def test_a_keyframe_removed_and_restored_duplicates_no_track() -> None:
    video, points_by_keyframe = _video(), _keyframe_points([4, 14, 24, 40])
    fresh = track_all(video, points_by_keyframe, None, CONTEXT)
    rest = {frame: anchor for frame, anchor in points_by_keyframe.items() if frame != 24}
    without = track_all(video, rest, TrackCache(fresh, sorted(points_by_keyframe)), CONTEXT)
    again = track_all(video, points_by_keyframe, TrackCache(without, sorted(rest)), CONTEXT)
    for found, wanted in ((without, track_all(video, rest, None, CONTEXT)), (again, fresh)):
        for name in ("frame", "keyframe", "feature", "px"):
            np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))


def test_threads_find_the_same_tracks_and_report_growing_progress() -> None:
    video, points_by_keyframe = _video(), _keyframe_points([2, 10, 17, 25, 33, 44])
    reported: list[int] = []
    one = track_all(video, points_by_keyframe, None, CONTEXT)

    def report(done: int, total: int, what: str = "") -> None:
        if total:  # the next step of the stage begins with 0 of 0
            reported.append(done)

    context = StageContext(work_dir=Path(), threads=3, progress=report)
    three = track_all(video, points_by_keyframe, None, context)
    for name in ("frame", "keyframe", "feature", "px"):
        np.testing.assert_array_equal(getattr(one, name), getattr(three, name))
    assert reported == sorted(reported)
    assert len(reported) > 20


def test_cancelling_stops_all_threads() -> None:
    context = StageContext(work_dir=Path(), threads=2, cancelled=lambda: True)
    with pytest.raises(Cancelled):
        track_all(_video(), _keyframe_points([2, 20, 40]), None, context)


def test_tracks_of_a_long_video_are_joined_in_little_more_than_their_own_memory() -> None:
    rng = np.random.default_rng(2)
    tracemalloc.start()
    parts = [
        Tracks(*rng.integers(0, 9, (3, 2_000)), rng.random((2_000, 2)).astype(np.float32)) for _ in range(50)
    ]
    parts = [Tracks(part.frame + 0, part.keyframe + 0, part.feature + 0, part.px) for part in parts]
    own = tracemalloc.get_traced_memory()[0]
    tracemalloc.reset_peak()
    joined = Tracks.join_and_clear(parts)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(joined.frame) == 100_000
    assert (np.diff(joined.frame) >= 0).all()
    # 32 bytes for each observation, and 8 each for the order, the current field and sorting.
    assert peak < 1.8 * own


def test_reused_tracks_are_held_once_while_new_tracks_are_joined(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(2)
    frame = np.sort(rng.integers(3, COUNT - 3, 200_000))
    px = rng.random((len(frame), 2)).astype(np.float32)
    known = TrackCache(Tracks(frame, np.full(len(frame), 2), np.arange(len(frame)), px), [2, COUNT - 2])
    video = _video()
    monkeypatch.setattr(frame_ranges, "_track_ranges", lambda *_: [Tracks.join_and_clear([])])
    tracemalloc.start()
    points_by_keyframe = dict.fromkeys(
        (2, COUNT - 2, COUNT - 1), KeyframePoints(*np.zeros((2, 0), np.int64), np.zeros((0, 2)))
    )
    joined = track_all(video, points_by_keyframe, known, CONTEXT)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(joined.frame) == len(frame)
    # The reused tracks and the memory of joining; the factor is 2.5 if both are held while sorting.
    assert peak < 2.25 * len(frame) * 32
