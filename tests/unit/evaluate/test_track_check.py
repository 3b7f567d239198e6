"""The check of a path by the tracks of its video."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.evaluate.track_check import (
    TrackedVideo,
    check_with_tracks,
    count_frames,
)
from bodycap_batch.evaluate.two_view import Outcome
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert, transform_points
from bodycap_batch.model.point_tracks import STORED_STEP
from tests.unit.evaluate.test_right_frames import BREAK, FRAMES, fold, true_path
from tests.unit.tracks.simulated import tracks_of_views

LENS = Camera(model="SIMPLE_PINHOLE", width_px=640, height_px=480, params=np.array([500.0, 320.0, 240.0]))


def video(path: FloatArray) -> TrackedVideo:
    """The tracks of points on a wall and on furniture before it."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-5, 8, 600), rng.uniform(-3, 3, 600), rng.uniform(2.5, 4.5, 600)])
    views = []
    for pose in path:
        seen = transform_points(invert(pose), points)
        px = LENS.project(seen)
        views.append((px, (seen[:, 2] > 0) & (np.abs(px - [320, 240]) < [320, 240]).all(axis=1)))
    tracks = tracks_of_views(LENS, views, rng).chosen(np.arange(len(path)), STORED_STEP)
    assert [len(tracks.at(frame)[0]) > 0 for frame in (0, 1, 2, 3)] == [True, False, True, False]
    return TrackedVideo(tracks=tracks, lens=LENS, times_s=np.arange(len(path)) / 30)


@pytest.fixture(scope="module")
def seen() -> TrackedVideo:
    return video(true_path())


def test_the_true_path_is_confirmed_in_every_stored_frame(seen: TrackedVideo) -> None:
    found = check_with_tracks(seen, true_path())
    assert count_frames(found) == {"compared": FRAMES // 2, "contradicted": 0, "contradicted_frames": []}
    assert found.positions[Outcome.RIGHT] > FRAMES / 4


@pytest.mark.parametrize("kind", ["fold", "leap", "scale"])
def test_a_break_of_the_path_is_contradicted(seen: TrackedVideo, kind: str) -> None:
    """One of the two parts is wrong; which one is not known."""
    path = true_path()
    if kind == "fold":
        path[BREAK:] = fold(path)[BREAK:]
    elif kind == "leap":
        path[BREAK:, 0, 3] += 0.5
    else:
        path[BREAK:, :3, 3] = path[BREAK, :3, 3] + 3.0 * (path[BREAK:, :3, 3] - path[BREAK, :3, 3])
    found = count_frames(check_with_tracks(seen, path))
    assert 0.4 * found["compared"] < found["contradicted"] < 0.6 * found["compared"]
    first, last = found["contradicted_frames"]
    assert (first < 6 and abs(last - BREAK) < 6) or (abs(first - BREAK) < 6 and last >= FRAMES - 6)


def test_lost_frames_are_not_compared(seen: TrackedVideo) -> None:
    path = true_path()
    path[30:60] = np.nan
    found = check_with_tracks(seen, path)
    assert count_frames(found) == {
        "compared": (FRAMES - 30) // 2,
        "contradicted": 0,
        "contradicted_frames": [],
    }


def test_a_rolling_shutter_needs_the_turns_of_the_known_poses(seen: TrackedVideo) -> None:
    """Frames without a pose have no speed; the points of a global shutter are moved by a wrong readout."""
    path = true_path()
    path[10:12] = np.nan
    rolling = TrackedVideo(tracks=seen.tracks, lens=LENS, times_s=seen.times_s, readout_s=1e-4)
    assert count_frames(check_with_tracks(rolling, path))["contradicted"] == 0
