"""What moves by itself, from tracks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.point_tracks import PointTracks
from bodycap_batch.tracks import estimate_lens, find_moving_regions, find_moving_tracks

WIDTH, HEIGHT, FRAMES, FPS = 640, 480, 60, 30
LENS = Camera(
    model="SIMPLE_RADIAL", width_px=WIDTH, height_px=HEIGHT, params=np.array([400.0, 320.0, 240.0, 0.0])
)
TIMES_NS = (np.arange(FRAMES) * 1e9 / FPS).astype(np.int64)
HAND = 100
"""Number of points on the hand, half a metre ahead of the camera: they are the first tracks."""


def tracks_with_hand(hand_m: float, motion: float = 1.0) -> PointTracks:
    """Return tracks of a room, and of a square hand before the camera that moves to and fro by itself.

    Args:
        hand_m: How far the hand moves, metres.
        motion: How far the camera moves and turns, relative to a quick walk.
    """
    rng = np.random.default_rng(2)
    room = rng.uniform((-4, -3, 1.5), (4, 3, 5), (1200, 3))
    hand = rng.uniform((-0.1, -0.1, 0.45), (0.1, 0.1, 0.55), (HAND, 3))
    first, track, px = [0], [], []
    for time in np.arange(FRAMES) / FPS:
        turn = so3_exp(motion * np.array([0.1 * np.sin(3 * time), 0.2 * np.sin(2 * time), 0.0]))
        centre = motion * np.array([0.3 * np.sin(2.5 * time), 0.1 * np.sin(4 * time), 0.3 * time])
        moved = hand + hand_m * np.array([np.sin(5 * time), np.cos(4 * time), 0.5 * np.sin(3 * time)])
        seen: FloatArray = np.concatenate([moved, (room - centre) @ turn])
        found = LENS.project(seen)
        inside = (seen[:, 2] > 0.3) & ((found > 5) & (found < (WIDTH - 5, HEIGHT - 5))).all(axis=1)
        low, high = found[:HAND].min(axis=0), found[:HAND].max(axis=0)
        inside[HAND:] &= ~((found[HAND:] > low) & (found[HAND:] < high)).all(axis=1)
        rows = np.flatnonzero(inside)
        track.append(rows)
        px.append(found[rows] + rng.normal(0, 0.2, (len(rows), 2)))
        first.append(first[-1] + len(rows))
    return PointTracks(
        camera="head",
        width_px=WIDTH,
        height_px=HEIGHT,
        first=np.array(first),
        track=np.concatenate(track),
        px=np.concatenate(px).astype(np.float32),
    )


def seen_often(tracks: PointTracks) -> BoolArray:
    """Return a mask (T,) of the tracks that are long enough to be compared several times."""
    return np.bincount(tracks.track) > FPS


def test_a_hand_is_found_before_a_camera_that_moves() -> None:
    tracks = tracks_with_hand(0.08)
    moving = find_moving_tracks(tracks, LENS, TIMES_NS)
    judged = seen_often(tracks)
    assert moving[:HAND][judged[:HAND]].mean() > 0.9
    assert moving[HAND:][judged[HAND:]].mean() < 0.02


def test_the_regions_follow_the_hand_and_leave_the_room() -> None:
    tracks = tracks_with_hand(0.08)
    regions = find_moving_regions(tracks, find_moving_tracks(tracks, LENS, TIMES_NS))
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


def test_nothing_moves_by_itself_in_a_still_room() -> None:
    tracks = tracks_with_hand(0.0, 0.0)
    assert not find_moving_tracks(tracks, LENS, TIMES_NS).any()


def test_nothing_is_left_out_if_no_motion_has_most_of_the_picture() -> None:
    # Shadows of leaves on water, say: each point moves on its own.
    tracks = tracks_with_hand(0.0, 0.0)
    frame = np.repeat(np.arange(FRAMES), np.diff(tracks.first))
    speed = np.random.default_rng(4).normal(0, 3.0, (1 + tracks.track.max(), 2))
    wild = replace(tracks, px=tracks.px + (frame[:, None] * speed[tracks.track]).astype(np.float32))
    assert not find_moving_tracks(wild, LENS, TIMES_NS).any()


def test_the_lens_is_found_without_the_hand() -> None:
    tracks = tracks_with_hand(0.08)
    regions = find_moving_regions(tracks, find_moving_tracks(tracks, LENS, TIMES_NS))
    found = estimate_lens(tracks.outside(regions), TIMES_NS)
    assert found is not None
    assert abs(np.log(found.lens.focal_px / LENS.focal_px)) < 0.05
