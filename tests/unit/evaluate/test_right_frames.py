"""The right frames of a path: confirmed by fresh matches, without truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.evaluate.breaks import contradicted_times, scale_jumps
from bodycap_batch.evaluate.fresh_features import CELLS, FrameFeatures, detect_features, match_features
from bodycap_batch.evaluate.right_frames import (
    Pictures,
    _not_fixed_to_camera,
    find_right_frames,
)
from bodycap_batch.evaluate.three_view import judge_legs
from bodycap_batch.evaluate.two_view import Outcome
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import (
    interpolate_pose,
    invert,
    make_transform,
    rotation_angle_rad,
    so3_exp,
    so3_log,
    transform_points,
)
from bodycap_batch.model.rotation_chain import RotationChain
from bodycap_batch.tracks.relative_motion import RayMatches, refine_motion

FRAMES = 100
PIXEL_RAD = 1 / 500
NOISE_PX = 0.5
BREAK = 50
BORDER_FRAMES = 15
"""Frames beside a break that may be joined to either side: the distance of frames whose parallax, 6 degrees
here, shows it."""


def true_path() -> FloatArray:
    """A camera that walks along a wall at 4 m, 2.5 cm a frame, and looks to and fro by 15 degrees."""
    time = np.arange(FRAMES)
    yaw = np.deg2rad(15) * np.sin(time / 20)
    turn = so3_exp(np.column_stack([np.zeros(FRAMES), yaw, 0.02 * np.sin(time / 7)]))
    return make_transform(turn, np.column_stack([0.025 * time, 0.02 * np.sin(time / 5), 0 * time]))


def pictures(path: FloatArray, seed: int = 0, readout: float = 0.0) -> list[FrameFeatures | None]:
    """The features of points on a wall and on furniture before it, with noise and wrong descriptors.

    `readout` is the readout time in units of the time from frame to frame.
    """
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-5, 8, 600), rng.uniform(-3, 3, 600), rng.uniform(2.5, 4.5, 600)])
    names = rng.integers(0, 256, (len(points), 32)).astype(np.uint8)
    features: list[FrameFeatures | None] = []
    for index in range(len(path)):
        later, earlier = path[min(index + 1, len(path) - 1)], path[max(index - 1, 0)]
        rows = np.zeros(len(points))
        for _ in range(3 if readout else 1):  # the row of a point depends on the pose at the time of its row
            at = 0.5 + 0.5 * np.clip(readout * rows, -1, 1)
            if readout:
                seen = transform_points(invert(interpolate_pose(earlier, later, at)), points)
            else:
                seen = transform_points(invert(path[index]), points)
            plane = seen[:, :2] / seen[:, 2:]
            rows = np.clip(plane[:, 1] / 0.96, -0.5, 0.5)
        plane = plane + NOISE_PX * PIXEL_RAD * rng.normal(size=(len(points), 2))
        inside = (np.abs(plane[:, 0]) < 0.64) & (np.abs(plane[:, 1]) < 0.48) & (seen[:, 2] > 0)
        descriptors = names[inside].copy()
        replaced = rng.random(len(descriptors)) < 0.2
        descriptors[replaced] = rng.integers(0, 256, (np.count_nonzero(replaced), 32))
        rays = np.column_stack([plane[inside], np.ones(np.count_nonzero(inside))])
        column = ((plane[inside, 0] + 0.64) / 1.28 * CELLS[0]).astype(np.int64)
        row = ((plane[inside, 1] + 0.48) / 0.96 * CELLS[1]).astype(np.int64)
        features.append(
            FrameFeatures(
                rays=rays / np.linalg.norm(rays, axis=1, keepdims=True),
                cells=row * CELLS[0] + column,
                descriptors=descriptors,
                pixel_rad=np.full(len(rays), PIXEL_RAD),
                row=plane[inside, 1] / 0.96,
            )
        )
    return features


@pytest.fixture(scope="module")
def path() -> FloatArray:
    return true_path()


@pytest.fixture(scope="module")
def seen(path: FloatArray) -> Pictures:
    return Pictures(pictures(path))


def outcomes(seen: Pictures, path: FloatArray) -> np.ndarray:
    return np.array([str(each) for each in find_right_frames(seen, path).outcome])


def test_a_true_path_is_right(seen: Pictures, path: FloatArray) -> None:
    found = find_right_frames(seen, path)
    assert found.count(Outcome.RIGHT) == FRAMES
    assert found.links.get(Outcome.WRONG, 0) == 0
    assert found.positions.get(Outcome.WRONG, 0) == 0
    assert found.positions[Outcome.RIGHT] > 40


def test_another_gauge_changes_nothing(seen: Pictures, path: FloatArray) -> None:
    moved = make_transform(so3_exp([0.3, -1.0, 0.5]), [3.0, 1.0, -2.0]) @ path
    moved[:, :3, 3] *= 0.07
    assert (outcomes(seen, moved) == "right").all()


def test_noise_of_the_poses_is_no_error(seen: Pictures, path: FloatArray) -> None:
    rng = np.random.default_rng(3)
    noise = make_transform(so3_exp(np.deg2rad(0.3) * rng.normal(size=(FRAMES, 3))), np.zeros((FRAMES, 3)))
    noisy = path @ noise
    noisy[:, :3, 3] += 0.003 * rng.normal(size=(FRAMES, 3))
    assert (outcomes(seen, noisy) == "right").all()


def fold(path: FloatArray) -> FloatArray:
    """Turn a part of the path by 90 degrees about its first pose."""
    start = path[BREAK]
    return start @ make_transform(so3_exp([0, np.pi / 2, 0]), np.zeros(3)) @ invert(start) @ path


def leap(path: FloatArray) -> FloatArray:
    moved = path.copy()
    moved[:, :3, 3] += [0.3, 0.9, -0.5]
    return moved


def other_scale(path: FloatArray) -> FloatArray:
    scaled = path.copy()
    scaled[:, :3, 3] = path[BREAK, :3, 3] + 1.3 * (path[:, :3, 3] - path[BREAK, :3, 3])
    return scaled


@pytest.mark.parametrize("harm", [fold, leap, other_scale])
def test_a_broken_path_is_found(
    seen: Pictures, path: FloatArray, harm: Callable[[FloatArray], FloatArray]
) -> None:
    broken = np.concatenate([path[:BREAK], harm(path)[BREAK:]])
    found = outcomes(seen, broken)
    assert (found[: BREAK - BORDER_FRAMES] == "right").all()
    assert (found[BREAK + BORDER_FRAMES :] == "wrong").all()


def test_pairs_across_lost_frames_confirm_a_path_and_contradict_none(
    seen: Pictures, path: FloatArray
) -> None:
    posed = np.ones(FRAMES, dtype=bool)
    posed[25:75] = False
    # Frames that are 45 apart have no pose across the gap, so only the pairs between can join the two parts.
    delivered = np.where(posed[:, None, None], path, np.nan)
    assert find_right_frames(seen, delivered).count(Outcome.RIGHT) == np.count_nonzero(posed)
    folded = delivered.copy()
    folded[75:] = fold(path)[75:]
    found = outcomes(seen, folded)
    assert (found[:25] == "right").all()
    assert (found[25:75] == "None").all()
    assert (found[75:] == "not measurable").all()


def test_the_turn_of_the_video_shows_a_fold_across_lost_frames(path: FloatArray) -> None:
    posed = np.ones(FRAMES, dtype=bool)
    posed[40:60] = False
    blurred = [None if 40 <= frame < 60 else each for frame, each in enumerate(pictures(path))]
    turns = RotationChain(
        frames=np.arange(FRAMES),
        turns=so3_log(np.swapaxes(path[1:, :3, :3], 1, 2) @ path[:-1, :3, :3]),
        sigma_rad=np.full(FRAMES - 1, 1e-4),
        turn_sigma=0.05,
    )
    seen = Pictures(blurred, rotation_chain=turns)
    delivered = np.where(posed[:, None, None], path, np.nan)
    assert find_right_frames(seen, delivered).count(Outcome.WRONG) == 0
    folded = delivered.copy()
    folded[60:] = fold(path)[60:]
    assert find_right_frames(seen, folded).count(Outcome.WRONG) == 40


@pytest.mark.parametrize(("has_features", "outcome"), [(True, "right"), (False, "not measurable")])
def test_pairs_decide_where_the_turn_of_the_video_is_inexact(
    path: FloatArray, has_features: bool, outcome: str
) -> None:
    posed = np.ones(FRAMES, dtype=bool)
    # Without the first frames, no frame is far enough from another one for a second view of its place.
    posed[:15], posed[25:75] = False, False
    seen = [each if has_features or posed[frame] else None for frame, each in enumerate(pictures(path))]
    turns = so3_log(np.swapaxes(path[1:, :3, :3], 1, 2) @ path[:-1, :3, :3])
    turns[50] += np.deg2rad([0.0, 7.0, 0.0])
    sigma_rad = np.where(np.arange(FRAMES - 1) == 50, np.deg2rad(3.0), 1e-4)
    chain = RotationChain(frames=np.arange(FRAMES), turns=turns, sigma_rad=sigma_rad, turn_sigma=0.0)
    found = outcomes(Pictures(seen, rotation_chain=chain), np.where(posed[:, None, None], path, np.nan))
    assert (found[15:25] == outcome).all()
    assert (found[75:] == "right").all(), "the larger part"


def test_one_wrong_measurement_among_right_ones_is_no_break() -> None:
    right = [(index, index + 1) for index in range(9)]
    assert contradicted_times([(2, 7)], right, 10, 1) == []
    without = [pair for pair in right if pair != (4, 5)]
    assert contradicted_times([(2, 7)], without, 10, 1) == [5]


def test_rays_of_a_rolling_shutter_are_moved_to_the_middle_row() -> None:
    time, readout = np.arange(8), 0.5
    turn = so3_exp(np.column_stack([0.05 * time, 0.08 * time, 0.03 * time]))
    path = make_transform(turn, np.zeros((8, 3)))
    seen = pictures(path, readout=readout)
    errors = []
    for shutter in (0.0, readout):
        pair = Pictures(seen, time.astype(float), shutter).pair(3, 4).measured
        assert pair is not None
        errors.append(float(rotation_angle_rad(pair.rotation.T @ path[4, :3, :3].T @ path[3, :3, :3])))
    # The noise of a hundred points, with the direction of the translation unknown, is a pixel or two.
    assert errors[1] < 2 * PIXEL_RAD
    assert errors[1] < 0.5 * errors[0]


def test_without_matches_nothing_is_claimed(path: FloatArray) -> None:
    blank: list[FrameFeatures | None] = [None] * FRAMES
    found = find_right_frames(Pictures(blank), path)
    assert found.count(Outcome.UNMEASURABLE) == FRAMES


def everywhere(px: np.ndarray) -> np.ndarray:
    return np.ones(len(px), dtype=bool)


def test_features_of_a_picture_are_spread_and_found_again() -> None:
    rng = np.random.default_rng(0)
    import cv2

    image = cv2.GaussianBlur(rng.integers(0, 256, (480, 640)).astype(np.uint8), (0, 0), 2.0)
    camera = Camera(model="PINHOLE", width_px=640, height_px=480, params=np.array([500.0, 500, 320, 240]))
    first = detect_features(image, camera, everywhere)
    assert len(np.unique(first.cells)) == CELLS[0] * CELLS[1]
    moved = np.roll(image, 12, axis=1)
    second = detect_features(moved, camera, everywhere)
    rows = match_features(first, second)
    assert len(rows) > 300
    shift = (
        second.rays[rows[:, 1], 0] / second.rays[rows[:, 1], 2]
        - first.rays[rows[:, 0], 0] / first.rays[rows[:, 0], 2]
    )
    # A shift of 12 px of 500 px; half a pixel of ORB's corners.
    assert np.median(shift) == pytest.approx(12 / 500, abs=0.5 / 500)


def test_matches_on_the_own_hand_are_left_out(path: FloatArray) -> None:
    first, second = pictures(path)[:2]
    assert first is not None
    assert second is not None
    turn = so3_exp([0.0, 0.1, 0.0])
    turned = replace(second, rays=first.rays @ turn.T, pixel_rad=first.pixel_rad)
    rays = turned.rays.copy()
    rays[::3] = first.rays[::3]  # a third of the matches is on a hand that is fixed to the camera
    rows = np.column_stack([np.arange(len(rays))] * 2)
    kept = _not_fixed_to_camera(first, replace(turned, rays=rays), rows)
    assert not set(kept[:, 0].tolist()) & set(range(0, len(rays), 3))
    assert len(kept) == len(rays) - len(range(0, len(rays), 3))
    # If the camera stands still, all of it stays in the picture.
    assert len(_not_fixed_to_camera(first, first, rows)) == len(rows)
    assert len(_not_fixed_to_camera(first, first, rows[:0])) == 0


def test_what_matches_do_not_determine_is_uncertain_and_no_error() -> None:
    """Through a lens with an absurd focal length, all rays lie on one line and no translation is seen."""
    x = np.random.default_rng(2).uniform(-1e-3, 1e-3, 80)
    rays = np.column_stack([x, np.zeros(80), np.ones(80)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    matches = RayMatches(first=rays, second=rays, cells=np.arange(80), noise_rad=np.full(80, 1e-9))
    measured = refine_motion(matches, np.eye(3), turn=False)
    assert np.isfinite(measured.covariance).all()
    assert measured.covariance.diagonal().max() > 1e6


def test_ratios_that_show_a_small_part_of_a_jump_do_not_measure_it() -> None:
    # Even steps. Four ratios begin at the first frame: a jump after it would change them by 50, 10, 2.5 and
    # 0.7 %. Their errors are ten times as large as that. Further on, five ratios of each length are right.
    def leg(error: float) -> Any:
        return SimpleNamespace(log_ratio=(-error, 0.02), parallax=1.0, translations=np.eye(2, 3))

    gaps = (2, 10, 40, 150)
    legs = [((0, gap, 2 * gap), leg(10.0 / gap)) for gap in gaps]
    legs += [((at, at + gap, at + 2 * gap), leg(0.0)) for gap in gaps for at in range(400, 2000, 320)]
    centres = np.column_stack([np.arange(2400.0), np.zeros((2400, 2))])
    assert scale_jumps(legs, centres, []) == []


def test_of_legs_that_pictures_confirm_equally_those_next_to_the_path_are_taken(
    seen: Pictures, path: FloatArray
) -> None:
    """A camera that moves towards a wall sees several legs with equal support; here a search found others."""
    frames = (10, 40, 70)
    triple = seen.triple(frames)
    assert triple is not None
    assert triple.measured is not None
    poses = path[list(frames)]
    rotations = np.swapaxes(poses[1, :3, :3].T @ poses[[0, 2], :3, :3], 1, 2)
    legs = np.diff(poses[:, :3, 3], axis=0) @ poses[1, :3, :3]
    true_ratio = float(np.log(np.linalg.norm(legs[1]) / np.linalg.norm(legs[0])))
    other = triple.measured.translations * np.array([[1.0], [1.3]])
    search = replace(triple.measured, translations=other / np.linalg.norm(other))
    _, confirmed = judge_legs(triple.common, search, rotations, legs)
    assert confirmed is not None
    # Legs of 6 degrees with a noise of half a pixel (0.06 degrees) of a hundred points.
    assert confirmed.log_ratio[0] == pytest.approx(true_ratio, abs=0.05)


@pytest.mark.parametrize(("parallax_deg", "found"), [(1.5, 0), (6.0, 0), (15.0, 1)])
def test_short_legs_change_their_ratio_by_errors_of_positions(parallax_deg: float, found: int) -> None:
    """Legs of 1.5 degrees have an error of 40 % through positions that are right to 0.15 degrees.

    Of legs of 6 degrees, the eight ratios that show a jump have an error of 3 % in common.
    """
    parallax = np.deg2rad(parallax_deg) * np.sqrt(2)

    def leg(error: float) -> Any:
        translations = np.eye(2, 3) / np.sqrt(2)
        return SimpleNamespace(log_ratio=(-error, 0.02), parallax=parallax, translations=translations)

    legs = [((at - 5, at, at + 5), leg(0.15 if 46 <= at <= 53 else 0.0)) for at in range(10, 90)]
    centres = np.column_stack([np.arange(100.0), np.zeros((100, 2))])
    assert len(scale_jumps(legs, centres, [])) == found
