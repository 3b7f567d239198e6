"""Detection of cameras with a wrong clock offset."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.merging.cameras.clock_check import best_time_shift, suspicious_clocks
from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.merging.reporting.advice import describe_clock
from bodycap_batch.model.geometry import make_transform, so3_exp


def _track(camera: str, poses, times_s) -> CameraTrack:
    count = len(times_s)
    return CameraTrack(
        camera=camera,
        bone=0,
        frames=np.arange(count),
        times_ns=np.round(1e9 * times_s).astype(np.int64),
        map_from_cam=poses,
        sigma_rad=np.full(count, 0.01),
        sigma_map=np.full(count, 0.01),
    )


def _walk(turns: float, seconds: float = 8.0) -> tuple[CameraTrack, CameraTrack]:
    """Return a trunk that walks and turns to and fro by an angle (rad), and a palm that swings beside it."""
    times_s = np.arange(0.0, seconds, 1.0 / 30.0)
    heading = turns * np.sin(2.0 * np.pi * times_s / 3.7) * np.array([[0.0], [0.0], [1.0]])
    place = np.column_stack([0.9 * times_s, 0.0 * times_s, 0.0 * times_s])
    trunk = make_transform(so3_exp(heading.T), place)
    swing = 0.15 * np.sin(2.0 * np.pi * times_s / 1.1)
    in_trunk = np.column_stack([0.2 + swing, np.full(len(times_s), 0.3), np.full(len(times_s), -0.5)])
    palm = trunk @ make_transform(np.tile(np.eye(3), (len(times_s), 1, 1)), in_trunk)
    return _track("torso", trunk, times_s), _track("palm", palm, times_s)


def _straight_walk_of_turns_and_swings() -> tuple[CameraTrack, CameraTrack]:
    """Return a trunk that walks straight and turns with each step, and a palm that swings across it."""
    times_s = np.arange(0.0, 8.0, 1.0 / 30.0)
    step = np.sin(2.0 * np.pi * times_s / 1.1)
    place = np.column_stack([0.9 * times_s, 0.0 * times_s, 0.0 * times_s])
    trunk = make_transform(so3_exp(0.2 * step[:, None] * [0.0, 0.0, 1.0]), place)
    in_trunk = np.column_stack([np.full(len(times_s), 0.1), 0.05 + 0.1 * step, np.full(len(times_s), -0.3)])
    palm = trunk @ make_transform(np.tile(np.eye(3), (len(times_s), 1, 1)), in_trunk)
    return _track("torso", trunk, times_s), _track("palm", palm, times_s)


def _late(track: CameraTrack, seconds: float) -> CameraTrack:
    return replace(track, times_ns=track.times_ns + round(1e9 * seconds))


@pytest.mark.parametrize("late_s", [-1.2, -0.5, 0.4, 1.5])
def test_a_wrong_clock_is_reported_with_the_right_offset(late_s: float) -> None:
    trunk, palm = _walk(turns=1.0)
    (doubt,) = suspicious_clocks([trunk, _late(palm, late_s)]).values()
    # One step of the search, and another one for the swing of the arm, which sometimes follows the turns.
    assert doubt["shift_s"] == pytest.approx(-late_s, abs=0.1)
    assert doubt["scatter_left"] < 0.7
    way = "behind" if late_s < 0.0 else "ahead"
    assert f"s {way}: with an offset_s of about 2.0, its position" in describe_clock(
        "palm", **doubt, offset_s=2.0
    )


def test_right_clocks_straight_walks_and_short_clips_are_not_suspicious() -> None:
    trunk, palm = _walk(turns=1.0)
    assert suspicious_clocks([trunk, palm]) == {}
    assert suspicious_clocks([trunk, _late(palm, 0.1)]) == {}
    straight, swinging = _walk(turns=0.0)
    # The body moves along its path, which looks like another mount.
    assert suspicious_clocks([straight, _late(swinging, 0.5)]) == {}
    # Half a step later, the trunk's turns cancel the arm's swing, but the arm is half a metre ahead.
    trunk_turns, arm_swings = _straight_walk_of_turns_and_swings()
    found = best_time_shift(trunk_turns, arm_swings)
    assert found is not None
    assert found.shift_s > 0.25
    assert found.scatter_ratio < 0.7
    assert suspicious_clocks([trunk_turns, arm_swings]) == {}
    assert best_time_shift(trunk, palm.keep(palm.times_ns < 1_000_000_000)) is None
    assert best_time_shift(trunk, _late(palm, 9.0)) is None
