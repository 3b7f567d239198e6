"""A long timeline in windows: where the boundaries lie, and how the solutions are blended."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.merging.graph.motion_graph import JointUncertainty, MotionSolution
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
    """Return a stationary camera that is lost during the given seconds."""
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
    lost_masks = [(track.times_ns >= 1e9 * start) & (track.times_ns < 1e9 * end) for start, end in lost]
    return track.keep(~np.any(lost_masks, axis=0)) if lost_masks else track


def test_boundaries_lie_where_all_cameras_are_localised():
    whole = _track("torso")
    assert split_timeline(TICKS, [whole, _track("palm")], 450) == [(0, 450), (450, 900)]
    for start, end in ((13.0, 16.0), (12.0, 15.2), (14.8, 17.0)):
        ((_, cut), _) = split_timeline(TICKS, [whole, _track("palm", (start, end))], 450)
        # The boundary lies a second away from the gap, on its nearer side.
        nearest = min(FPS * (start - 1.0), FPS * (end + 1.0), key=lambda tick: abs(tick - 450))
        assert cut == pytest.approx(nearest, abs=4)
    # The camera is lost for longer than a boundary may move: the split is even.
    assert split_timeline(TICKS, [whole, _track("palm", (5.0, 25.0))], 450) == [(0, 450), (450, 900)]
    cuts = split_timeline(TICKS, [whole, _track("palm", (7.0, 11.0), (14.0, 17.0), (20.0, 22.0))], 150)
    assert max(last - first for first, last in cuts) <= 188
    assert cuts[0][0] == 0
    assert cuts[-1][1] == 900


class _ShiftedSolution:
    """A graph with a solution that is rotated and moved in proportion to its number."""

    def __init__(self, number: int, ticks: np.ndarray, seen: list[CameraTrack]) -> None:
        self._number, self._ticks, self._seen = number, ticks, seen

    def solve(self, *_: object) -> MotionSolution:
        pose = np.eye(4)
        pose[:3, :3] = so3_exp(np.array([0.0, 0.0, 0.3 * self._number]))
        pose[0, 3] = 0.08 * self._number
        return MotionSolution(
            world_from_bone=np.tile(pose, (len(self._ticks), 2, 1, 1)),
            residuals={},
            world_from_cam={track.camera: np.tile(pose, (len(track.times_ns), 1, 1)) for track in self._seen},
            iterations=1,
            errors={"joints": 1.0},
            uncertainty=JointUncertainty(
                np.full((len(self._ticks), 2, 3, 3), 1.0 + self._number),
                np.full((len(self._ticks), 2), 1.0 + self._number),
            ),
        )


def test_blended_solutions_do_not_jump_at_a_boundary():
    numbers = iter(range(9))
    tracks = [_track("torso"), _track("palm", (8.0, 14.0)), _track("late", (0.0, 21.5))]
    blended = solve_windows(
        lambda ticks, seen: _ShiftedSolution(next(numbers), ticks, seen),  # type: ignore[arg-type,return-value]
        TICKS,
        tracks,
        lambda: None,
        window_ticks=300,
    )
    poses = blended.world_from_bone
    assert len(poses) == len(TICKS)
    assert [poses[tick, 0, 0, 3] for tick in (0, 450, 899)] == pytest.approx([0.0, 0.08, 0.16])
    # 8 cm and 17 degrees over two seconds; the steepest part is half as steep again as a linear change.
    steps = np.linalg.norm(np.diff(poses[..., :3, 3], axis=0), axis=-1)
    turns = rotation_angle_rad(poses[1:, ..., :3, :3] @ np.swapaxes(poses[:-1, ..., :3, :3], -1, -2))
    assert steps.max() < 1.51 * 0.08 / (2 * FPS)
    assert turns.max() < 1.51 * 0.3 / (2 * FPS)
    assert blended.uncertainty is not None
    assert blended.uncertainty.centre_m2.shape == (*poses.shape[:2], 3, 3)
    assert blended.uncertainty.flexion_rad2.shape == poses.shape[:2]
    for variance in (blended.uncertainty.centre_m2, blended.uncertainty.flexion_rad2):
        assert np.abs(np.diff(variance, axis=0)).max() < 1.51 / (2 * FPS)
    for track in tracks:
        there = np.searchsorted(TICKS, track.times_ns)
        assert_allclose(blended.world_from_cam[track.camera], poses[there, 0], atol=1e-12)
        # The residuals are those of the blended poses.
        assert_allclose(blended.residuals[track.camera].distance_m, poses[there, 0, 0, 3], atol=1e-12)


@pytest.mark.parametrize(("fps", "repeats"), [(30, 1.4), (60, 1.5), (120, 1.8), (240, 2.0)])
def test_ticks_are_solved_at_most_twice_on_average_at_every_rate(fps, repeats):
    ticks = np.round(np.arange(200 * fps) * 1e9 / fps).astype(np.int64)
    track = replace(_track("torso"), times_ns=ticks)
    parts = split_timeline(ticks, [track], max_window_ticks(9, [track] * 3, ticks))
    solved = sum(int(np.diff(with_overlap(ticks, *part))[0]) for part in parts)
    assert solved <= repeats * len(ticks)


def test_windows_get_shorter_with_many_cameras():
    tracks = [_track("torso")] * 12
    assert max_window_ticks(9, tracks[:3], TICKS) == max_window_ticks(17, tracks[:11], TICKS) == WINDOW_TICKS
    many = max_window_ticks(21, [*tracks, *tracks[:2]], TICKS)
    assert 300 < many < 0.8 * WINDOW_TICKS
    assert max_window_ticks(40, tracks * 4, TICKS) == 300
    assert max_window_ticks(9, tracks[:3], TICKS[:1]) == WINDOW_TICKS
