"""The instant at which the mount of a camera slips."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.cameras.mount_slips import find_slip, without_slip
from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.model.geometry import invert, make_transform, rotation_angle_rad, so3_exp
from bodycap_batch.model.skeleton import MountSlip

SECONDS, SLIP_S = 6.0, 3.5
NOISE_M, NOISE_RAD = 0.001, 0.0005
AXIS = np.array([2.0, -1.0, 2.0]) / 3.0
TURN = make_transform(so3_exp(np.radians(15.0) * AXIS), np.zeros(3))
MOVE = make_transform(np.eye(3), 0.03 * AXIS)
BOTH = make_transform(so3_exp(np.radians(-12.0) * AXIS), 0.02 * AXIS)


def _arm(fps: float = 30.0) -> CameraTrack:
    """Return the path of a camera on an arm that swings about the shoulder of a person who walks."""
    rng = np.random.default_rng(3)
    times_s = np.arange(round(SECONDS * fps)) / fps
    swing = 0.6 * np.sin(5.5 * times_s) + 0.1 * np.sin(13.0 * times_s + 1.0)
    turns = so3_exp(np.column_stack([swing, 0.3 * np.sin(3.0 * times_s), 0.1 * swing]))
    walk = np.column_stack([1.1 * times_s, 0.02 * np.sin(11.0 * times_s), 0.03 * np.cos(11.0 * times_s)])
    centres = walk + turns @ np.array([0.1, 0.0, -0.5])
    count = len(times_s)
    noise = so3_exp(rng.normal(scale=NOISE_RAD, size=(count, 3)))
    return CameraTrack(
        camera="left_palm",
        bone=0,
        frames=np.arange(count),
        times_ns=np.round(1e9 * times_s).astype(np.int64),
        map_from_cam=make_transform(turns @ noise, centres + rng.normal(scale=NOISE_M, size=(count, 3))),
        sigma_rad=np.full(count, NOISE_RAD),
        sigma_map=np.full(count, NOISE_M),
    )


def _with_step(track: CameraTrack, step: FloatArray, start_s: float, end_s: float = np.inf) -> CameraTrack:
    moved = (track.times_ns >= 1e9 * start_s) & (track.times_ns < 1e9 * end_s)
    return replace(
        track, map_from_cam=np.where(moved[:, None, None], track.map_from_cam @ step, track.map_from_cam)
    )


@pytest.mark.parametrize("step", [TURN, MOVE, BOTH], ids=["turn", "move", "both"])
@pytest.mark.parametrize("fps", [30.0, 60.0])
def test_a_slip_is_found_with_its_instant_and_step(step: FloatArray, fps: float) -> None:
    track = _arm(fps)
    slip = find_slip(_with_step(track, step, SLIP_S))
    assert slip is not None
    assert abs(1e-9 * slip.time_ns - SLIP_S) <= 1.0 / 30.0
    # 4 sigma per axis bound the length of an error with three axes in 99.9 % of the cases.
    off = invert(step) @ slip.before_from_after
    assert rotation_angle_rad(off[:3, :3]) < 4.0 * slip.sigma_rad
    assert np.linalg.norm(off[:3, 3]) < 4.0 * slip.sigma_m
    # A tenth of the steps, so that these bounds mean something.
    assert slip.sigma_rad < np.radians(1.5)
    assert slip.sigma_m < 0.005


def test_a_slip_that_lasts_two_frames_is_found() -> None:
    half = make_transform(so3_exp(np.radians(7.5) * AXIS), np.zeros(3))
    slip = find_slip(_with_step(_with_step(_arm(), half, SLIP_S - 0.001), half, SLIP_S + 0.03))
    assert slip is not None
    assert abs(1e-9 * slip.time_ns - SLIP_S) <= 2.0 / 30.0
    # 4 sigma per axis bound the length of an error with three axes in 99.9 % of the cases.
    assert rotation_angle_rad(TURN[:3, :3].T @ slip.before_from_after[:3, :3]) < 4.0 * slip.sigma_rad


def test_a_smooth_path_has_no_slip() -> None:
    assert find_slip(_arm()) is None


@pytest.mark.parametrize(
    ("start_s", "end_s"),
    [(SLIP_S, SLIP_S + 0.1), (SLIP_S, SLIP_S + 1.0)],
    ids=["three wrong frames", "a second in another part of the map"],
)
def test_a_path_that_comes_back_has_no_slip(start_s: float, end_s: float) -> None:
    assert find_slip(_with_step(_arm(), TURN, start_s, end_s)) is None


def test_a_path_with_several_steps_has_no_slip() -> None:
    assert find_slip(_with_step(_with_step(_arm(), TURN, 2.0), BOTH, 4.0)) is None


def test_a_move_beyond_the_width_of_a_limb_is_no_slip() -> None:
    far = make_transform(so3_exp(0.5 * AXIS), 0.3 * AXIS)
    assert find_slip(_with_step(_arm(), far, SLIP_S)) is None


def test_frames_that_a_recording_lacks_are_no_slip() -> None:
    """The path jumps along itself: two frames are missing, and the timestamps do not show it."""
    track = _arm()
    count = len(track.times_ns)
    lacking = track.keep(~np.isin(np.arange(count), [round(30 * SLIP_S), round(30 * SLIP_S) + 1]))
    assert find_slip(replace(lacking, times_ns=track.times_ns[: count - 2])) is None


def test_a_slip_along_the_path_without_the_turn_of_the_limb_is_found() -> None:
    track = _arm()
    before = round(30 * SLIP_S) - 1
    ahead = (invert(track.map_from_cam[before - 1]) @ track.map_from_cam[before])[:3, 3]
    step = make_transform(np.eye(3), 0.03 * ahead / np.linalg.norm(ahead))
    slip = find_slip(_with_step(track, step, SLIP_S))
    assert slip is not None
    # 4 sigma per axis bound the length of an error with three axes in 99.9 % of the cases.
    assert np.linalg.norm((invert(step) @ slip.before_from_after)[:3, 3]) < 4.0 * slip.sigma_m


def test_a_short_path_has_no_slip() -> None:
    track = _arm()
    assert find_slip(track.keep(np.arange(len(track.times_ns)) < 5)) is None


def test_a_path_without_its_slip_is_that_of_the_place_before() -> None:
    scale = 0.5
    track = _arm()
    slipped = _with_step(track, BOTH, SLIP_S)
    slip = MountSlip(time_ns=round(1e9 * SLIP_S), before_from_after=BOTH, sigma_rad=0.01, sigma_m=0.01)
    again = without_slip(slipped.scaled(1.0 / scale), slip, scale).scaled(scale)
    np.testing.assert_allclose(again.map_from_cam, track.map_from_cam, atol=1e-12)
    moved = slip.as_moved(again.map_from_cam, again.times_ns)
    np.testing.assert_allclose(moved, slipped.map_from_cam, atol=1e-12)
