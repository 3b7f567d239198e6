"""What moves by itself, from tracks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

import bodycap_batch.tracks
from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import BoolArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import rotation_angle_rad, so3_exp
from bodycap_batch.model.point_tracks import PointTracks
from bodycap_batch.tasks.keyframes import regions_and_lens
from bodycap_batch.tracks import (
    estimate_lens,
    find_moving_regions,
    find_moving_tracks,
    measure_rotation_chain,
)
from tests.unit.tracks.simulated import project, tracks_of_views

WIDTH, HEIGHT, FRAMES, FPS = 640, 480, 60, 30
LENS = Camera(
    model="SIMPLE_RADIAL", width_px=WIDTH, height_px=HEIGHT, params=np.array([400.0, 320.0, 240.0, 0.0])
)
TIMES_NS = (np.arange(FRAMES) * 1e9 / FPS).astype(np.int64)
HAND = 100
"""Number of points on the hand, half a metre ahead of the camera: they are the first tracks."""


def tracks_with_hand(hand_m: float, motion: float = 1.0, half_side_m: float = 0.1) -> PointTracks:
    """Return tracks of a room, and of a square hand before the camera that moves to and fro by itself.

    Args:
        hand_m: How far the hand moves, metres.
        motion: How far the camera moves and turns, relative to a quick walk.
        half_side_m: Half of the side of the hand.
    """
    rng = np.random.default_rng(2)
    room = rng.uniform((-4, -3, 1.5), (4, 3, 5), (1200, 3))
    hand = rng.uniform((-half_side_m, -half_side_m, 0.45), (half_side_m, half_side_m, 0.55), (HAND, 3))
    views = []
    for time in np.arange(FRAMES) / FPS:
        turn = so3_exp(motion * np.array([0.1 * np.sin(3 * time), 0.2 * np.sin(2 * time), 0.0]))
        centre = motion * np.array([0.3 * np.sin(2.5 * time), 0.1 * np.sin(4 * time), 0.3 * time])
        moved = hand + hand_m * np.array([np.sin(5 * time), np.cos(4 * time), 0.5 * np.sin(3 * time)])
        px, seen = project(LENS, np.concatenate([moved, (room - centre) @ turn]))
        low, high = px[:HAND].min(axis=0), px[:HAND].max(axis=0)
        seen[HAND:] &= ~((px[HAND:] > low) & (px[HAND:] < high)).all(axis=1)
        views.append((px, seen))
    return tracks_of_views(LENS, views, rng)


@pytest.fixture(scope="module")
def tracks() -> PointTracks:
    """Tracks of a hand that moves by itself before a camera that moves."""
    return tracks_with_hand(0.08)


@pytest.fixture(scope="module")
def moving(tracks: PointTracks) -> BoolArray:
    """Which of the tracks move by themselves."""
    return find_moving_tracks(tracks, LENS, TIMES_NS)


@pytest.fixture(scope="module")
def regions(tracks: PointTracks, moving: BoolArray) -> BoolArray:
    """Where the pictures show what moves by itself."""
    return find_moving_regions(tracks, moving)


def test_a_chain_of_tracks_turns_as_the_camera_does(tracks: PointTracks) -> None:
    time = np.arange(FRAMES) / FPS
    true = so3_exp(np.column_stack([0.1 * np.sin(3 * time), 0.2 * np.sin(2 * time), 0 * time]))
    chain = measure_rotation_chain(tracks, LENS, 0.01, np.arange(FRAMES))
    last = FRAMES - 2  # the links have two, four or six frames
    found = chain.between(0, last)
    assert found is not None
    error = float(rotation_angle_rad(found[0] @ (true[last].T @ true[0]).T))
    assert error < min(3 * found[1], np.deg2rad(2.0))
    # Without the frames from 20 to 40, which are copies of frame 20 for example, their numbers count others.
    frames = np.array([*range(21), *range(41, FRAMES)])
    rest = measure_rotation_chain(tracks, LENS, 0.01, frames)
    assert rest.frames[-1] == len(frames) - 1


def test_without_tracks_no_rotation_is_claimed(tracks: PointTracks) -> None:
    blank = np.zeros((FRAMES, 1, 1), dtype=bool)
    blank[25:36] = True
    chain = measure_rotation_chain(tracks.outside(blank), LENS, 0.01, np.arange(FRAMES))
    assert chain.between(24, 36) is None
    assert chain.between(0, 24) is not None


def seen_often(tracks: PointTracks) -> BoolArray:
    """Return a mask (T,) of the tracks that are long enough to be compared several times."""
    return np.bincount(tracks.track) > FPS


def test_a_hand_is_found_before_a_camera_that_moves(tracks: PointTracks, moving: BoolArray) -> None:
    judged = seen_often(tracks)
    assert moving[:HAND][judged[:HAND]].mean() > 0.9
    assert moving[HAND:][judged[HAND:]].mean() < 0.02


def test_the_regions_follow_the_hand_and_leave_the_room(tracks: PointTracks, regions: BoolArray) -> None:
    assert regions.shape == (FRAMES, 30, 40)
    on_hand, in_room = [], []
    for frame in range(FRAMES):
        number, px = tracks.at(frame)
        cell = (px / 16.0).astype(int)
        inside = regions[frame, cell[:, 1], cell[:, 0]]
        on_hand.append(inside[number < HAND].mean())
        in_room.append(inside[number >= HAND].mean())
    assert np.mean(on_hand) > 0.9
    # Some points of the room lie beside the edge of the hand, in the same cells.
    assert np.mean(in_room) < 0.1


def test_a_room_before_a_camera_that_moves_does_not_move_by_itself() -> None:
    # The hand is fixed to the camera here.
    moving = find_moving_tracks(tracks_with_hand(0.0), LENS, TIMES_NS)
    assert moving[HAND:].mean() < 0.02


def test_nothing_is_left_out_if_no_motion_has_most_of_the_picture() -> None:
    # Shadows of leaves on water, say: each point moves on its own.
    tracks = tracks_with_hand(0.0, 0.0)
    frame = np.repeat(np.arange(FRAMES), np.diff(tracks.first))
    speed = np.random.default_rng(4).normal(0, 3.0, (1 + tracks.track.max(), 2))
    wild = replace(tracks, px=tracks.px + (frame[:, None] * speed[tracks.track]).astype(np.float32))
    assert not find_moving_tracks(wild, LENS, TIMES_NS).any()


def test_the_lens_is_found_without_the_hand(tracks: PointTracks, regions: BoolArray) -> None:
    found = estimate_lens(tracks.outside(regions), TIMES_NS)
    assert found is not None
    assert abs(np.log(found.lens.focal_px / LENS.focal_px)) < 0.05


@pytest.mark.parametrize(("half_side_m", "is_left_out"), [(0.1, True), (0.02, False)])
def test_only_a_thing_of_some_size_is_left_out(
    half_side_m: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, is_left_out: bool
) -> None:
    # The tracks come from a simulation, since a flat picture does not show what moves by itself.
    found = tracks_with_hand(0.08, half_side_m=half_side_m)
    monkeypatch.setattr(bodycap_batch.tracks, "track_video", lambda camera, progress: found)
    camera = cast(CaptureCamera, SimpleNamespace(camera=LENS, times_ns=TIMES_NS))
    shown = regions_and_lens(camera, StageContext(work_dir=tmp_path))
    fixed, moving, lens = shown.fixed, shown.moving, shown.lens
    assert not fixed.any()
    assert lens is None, "the lens is given"
    assert (moving.mean() > 0.02) if is_left_out else (moving.size == 0)
