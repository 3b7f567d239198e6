"""A long capture in stretches: where its seams lie, and how one solution passes into the next."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.merging.graph.motion_graph import MotionSolution
from bodycap_batch.merging.graph.windows import (
    WINDOW_TICKS,
    max_window_ticks,
    solve_windows,
    split_timeline,
    with_overlap,
)
from bodycap_batch.model.geometry import rotation_angle_rad, so3_exp

FPS = 30
TICKS = np.round(np.arange(30 * FPS) * 1e9 / FPS).astype(np.int64)


def _track(camera: str, *lost: tuple[float, float]) -> CameraTrack:
    """A camera that does not move, lost for those seconds."""
    count = len(TICKS)
    track = CameraTrack(
        camera=camera,
        bone=0,
        frames=np.arange(count),
        times_ns=TICKS,
        map_from_cam=np.tile(np.eye(4), (count, 1, 1)),
        sigma_rad=np.full(count, 0.01),
        sigma_map=np.full(count, 0.01),
    )
    gone = [(track.times_ns >= 1e9 * start) & (track.times_ns < 1e9 * end) for start, end in lost]
    return track.keep(~np.any(gone, axis=0)) if gone else track


def test_seams_lie_where_all_cameras_are_measured():
    whole = _track("torso")
    assert split_timeline(TICKS, [whole, _track("palm")], 450) == [(0, 450), (450, 900)]
    for start, end in ((13.0, 16.0), (12.0, 15.2), (14.8, 17.0)):
        ((_, cut), _) = split_timeline(TICKS, [whole, _track("palm", (start, end))], 450)
        # A second beside the gap, and on its nearer side.
        nearest = min(FPS * (start - 1.0), FPS * (end + 1.0), key=lambda tick: abs(tick - 450))
        assert cut == pytest.approx(nearest, abs=4)
    # Lost longer than a seam may be moved: as even as ever.
    assert split_timeline(TICKS, [whole, _track("palm", (5.0, 25.0))], 450) == [(0, 450), (450, 900)]
    cuts = split_timeline(TICKS, [whole, _track("palm", (7.0, 11.0), (14.0, 17.0), (20.0, 22.0))], 150)
    assert max(last - first for first, last in cuts) <= 188
    assert cuts[0][0] == 0
    assert cuts[-1][1] == 900


class _Turned:
    """A solution by itself: everything turned and moved by as much as its number says."""

    def __init__(self, number: int, ticks: np.ndarray, seen: list[CameraTrack]) -> None:
        self._number, self._ticks, self._seen = number, ticks, seen

    def solve(self, *_: object) -> MotionSolution:
        pose = np.eye(4)
        pose[:3, :3] = so3_exp(np.array([0.0, 0.0, 0.3 * self._number]))
        pose[0, 3] = 0.08 * self._number
        none = {track.camera: np.zeros(len(track.times_ns)) for track in self._seen}
        return MotionSolution(
            world_from_bone=np.tile(pose, (len(self._ticks), 2, 1, 1)),
            residual_m=none,
            residual_rad=none,
            weights=none,
            world_from_cam={track.camera: np.tile(pose, (len(track.times_ns), 1, 1)) for track in self._seen},
            iterations=1,
            errors={"joints": 1.0},
            joint_covariance=np.full((len(self._ticks), 2, 3, 3), 1.0 + self._number),
        )


def test_however_solutions_differ_none_jumps_at_a_seam():
    numbers = iter(range(9))
    tracks = [_track("torso"), _track("palm", (8.0, 14.0)), _track("late", (0.0, 21.5))]
    joined = solve_windows(
        lambda ticks, seen: _Turned(next(numbers), ticks, seen),  # type: ignore[arg-type,return-value]
        TICKS,
        tracks,
        lambda: None,
        window_ticks=300,
    )
    poses = joined.world_from_bone
    assert len(poses) == len(TICKS)
    assert [poses[tick, 0, 0, 3] for tick in (0, 450, 899)] == pytest.approx([0.0, 0.08, 0.16])
    # 8 cm and 17 degrees over two seconds: at most half as much again as evenly.
    steps = np.linalg.norm(np.diff(poses[..., :3, 3], axis=0), axis=-1)
    turns = rotation_angle_rad(poses[1:, ..., :3, :3] @ np.swapaxes(poses[:-1, ..., :3, :3], -1, -2))
    assert steps.max() < 1.51 * 0.08 / (2 * FPS)
    assert turns.max() < 1.51 * 0.3 / (2 * FPS)
    assert joined.joint_covariance is not None
    assert np.abs(np.diff(joined.joint_covariance, axis=0)).max() < 1.51 / (2 * FPS)
    for track in tracks:
        there = np.searchsorted(TICKS, track.times_ns)
        assert_allclose(joined.world_from_cam[track.camera], poses[there, 0], atol=1e-12)
        # What measurements miss is told of the poses that are handed out.
        assert_allclose(joined.residual_m[track.camera], poses[there, 0, 0, 3], atol=1e-12)


@pytest.mark.parametrize(("fps", "again"), [(30, 1.4), (60, 1.5), (120, 1.8), (240, 2.0)])
def test_at_no_rate_are_most_ticks_solved_more_than_twice(fps, again):
    ticks = np.round(np.arange(200 * fps) * 1e9 / fps).astype(np.int64)
    track = replace(_track("torso"), times_ns=ticks)
    parts = split_timeline(ticks, [track], max_window_ticks(9, [track] * 3, ticks))
    solved = sum(int(np.diff(with_overlap(ticks, *part))[0]) for part in parts)
    assert solved <= again * len(ticks)


def test_stretches_get_shorter_with_many_cameras():
    tracks = [_track("torso")] * 12
    assert max_window_ticks(9, tracks[:3], TICKS) == max_window_ticks(17, tracks[:11], TICKS) == WINDOW_TICKS
    many = max_window_ticks(21, [*tracks, *tracks[:2]], TICKS)
    assert 300 < many < 0.8 * WINDOW_TICKS
    assert max_window_ticks(40, tracks * 4, TICKS) == 300
    assert max_window_ticks(9, tracks[:3], TICKS[:1]) == WINDOW_TICKS
