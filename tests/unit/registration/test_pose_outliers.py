"""Outlier poses are found, fast motion is not an outlier."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.registration.poses.pose_outliers import find_outlier_poses, isolated_poses

SIGMA = np.full(60, 0.004)
TIMES_NS = np.arange(60) * 33_333_333


def _swing(hz: float) -> np.ndarray:
    t = np.arange(60) / 30.0
    return np.stack([0.3 * np.sin(2 * np.pi * hz * t), 1.2 * t, 0.1 * np.cos(2 * np.pi * hz * t)], axis=1)


@pytest.mark.parametrize("scale", [0.1, 1.0, 10.0])
def test_one_wrong_pose_is_found_at_any_scale(scale: float) -> None:
    rng = np.random.default_rng(0)
    centres = _swing(1.0) + rng.normal(0, 0.004, (60, 3))
    centres[31] += [0.0, 0.35, -0.2]
    assert np.flatnonzero(find_outlier_poses(scale * centres, scale * SIGMA, TIMES_NS)).tolist() == [31]


@pytest.mark.parametrize("scale", [0.1, 10.0])
@pytest.mark.parametrize("together", [True, False])
@pytest.mark.parametrize("length", [2, 3])
def test_runs_of_wrong_poses_are_found_and_no_correct_pose(
    *, length: int, together: bool, scale: float
) -> None:
    rng = np.random.default_rng(6)
    centres = _swing(1.0) + rng.normal(0, 0.002, (60, 3))
    off = rng.normal(size=(1 if together else length, 3))
    centres[31 : 31 + length] += 0.4 * off / np.linalg.norm(off, axis=1, keepdims=True)
    found = np.flatnonzero(find_outlier_poses(scale * centres, 0.5 * scale * SIGMA, TIMES_NS))
    assert found.tolist() == list(range(31, 31 + length))


def test_a_sidestep_or_a_rebound_is_not_a_run_of_wrong_poses() -> None:
    rng = np.random.default_rng(7)
    aside = np.cumsum(np.full((60, 3), 0.02), axis=0) + rng.normal(0, 0.0002, (60, 3))
    aside[30:] += [0.0, 0.3, 0.0]
    assert find_outlier_poses(aside, 0.0003 * np.ones(60), TIMES_NS).sum() <= 1
    # A hand at 3 m/s that hits a wall and comes back as fast.
    rebound = np.abs(np.arange(60) - 30.4)[:, None] * [0.1, 0.0, 0.0] + rng.normal(0, 0.0002, (60, 3))
    assert not find_outlier_poses(rebound, 0.0003 * np.ones(60), TIMES_NS).any()


@pytest.mark.parametrize(
    ("hz", "seconds"), [(10, 0.3), (10, 0.4), (12, 0.3), (15, 0.25), (20, 0.2), (20, 0.25)]
)
@pytest.mark.parametrize("height", [0.12, 0.2])
def test_a_fast_gesture_there_and_back_is_not_an_outlier(hz: int, seconds: float, height: float) -> None:
    refused = 0
    for shift in np.linspace(0, 1, 8, endpoint=False):
        times = (np.arange(60) + shift) / hz
        done = np.clip((times - 30 / hz) / seconds + 0.5, 0, 1)
        centres = np.random.default_rng(8).normal(0, 0.0007, (60, 3))
        centres[:, 0] += height * np.sin(np.pi * done) ** 2
        refused += find_outlier_poses(
            centres, np.full(60, 0.001), np.round(times * 1e9).astype(np.int64)
        ).sum()
    # A gesture seen by a single frame, with rest before and after, cannot be distinguished from an outlier.
    assert refused <= 1


@pytest.mark.parametrize("hz", [10, 15, 20])
def test_a_wrong_pose_of_a_slow_video_is_found(hz: int) -> None:
    times = np.arange(60) / hz
    centres = np.stack([0.2 * np.sin(2 * times), 0.5 * times, 0.0 * times], axis=1)
    centres += np.random.default_rng(9).normal(0, 0.002, (60, 3))
    centres[31] += [0.0, 0.2, -0.2]
    found = find_outlier_poses(centres, np.full(60, 0.002), np.round(times * 1e9).astype(np.int64))
    assert np.flatnonzero(found).tolist() == [31]


def test_a_fast_swing_is_not_an_outlier() -> None:
    rng = np.random.default_rng(1)
    for hz in (0.5, 2.0, 4.0):
        assert not find_outlier_poses(_swing(hz) + rng.normal(0, 0.004, (60, 3)), SIGMA, TIMES_NS).any()


def test_a_sudden_stop_is_not_an_outlier() -> None:
    centres = np.cumsum(np.where(np.arange(60) < 30, 0.05, 0.0))[:, None] * np.array([1.0, 0.2, 0.0])
    noisy = centres + np.random.default_rng(2).normal(0, 0.004, (60, 3))
    assert not find_outlier_poses(noisy, SIGMA, TIMES_NS).any()


def test_a_jerk_with_small_sigmas_is_not_an_outlier() -> None:
    # 2 m/s to rest within one frame: a second difference of 3 cm, 100 sigmas, on a straight path.
    centres = np.cumsum(np.where(np.arange(60) < 30, 0.067, 0.0))[:, None] * np.array([1.0, 0.2, 0.0])
    noisy = centres + np.random.default_rng(5).normal(0, 0.0002, (60, 3))
    assert not find_outlier_poses(noisy, 0.0003 * np.ones(60), TIMES_NS).any()
    noisy[12] += [0.0, 0.033, 0.0]
    assert np.flatnonzero(find_outlier_poses(noisy, 0.0003 * np.ones(60), TIMES_NS)).tolist() == [12]


def test_large_covariances_and_gaps_give_no_outliers() -> None:
    rng = np.random.default_rng(3)
    centres = _swing(1.0) + rng.normal(0, 0.004, (60, 3))
    centres[31] += 0.2
    assert not find_outlier_poses(centres, np.where(np.arange(60) == 31, 0.1, SIGMA), TIMES_NS).any()
    centres[30] = np.nan
    assert not find_outlier_poses(centres, np.where(np.arange(60) == 31, 0.1, SIGMA), TIMES_NS).any()
    assert np.flatnonzero(find_outlier_poses(centres, SIGMA, TIMES_NS)).tolist() == [31]
    centres[33] = np.nan
    assert not find_outlier_poses(centres, SIGMA, TIMES_NS).any()
    assert find_outlier_poses(centres[:2], SIGMA[:2], TIMES_NS[:2]).tolist() == [False, False]


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("wrong", [30, 31, 32])
def test_a_wrong_pose_next_to_a_lost_interval_is_distinguished_from_its_neighbour(
    *, wrong: int, backwards: bool
) -> None:
    centres = _swing(1.0) + np.random.default_rng(4).normal(0, 0.004, (60, 3))
    centres[20:30] = np.nan
    if backwards:
        centres = centres[::-1].copy()
    assert not find_outlier_poses(centres, SIGMA, TIMES_NS).any()
    frame = 59 - wrong if backwards else wrong
    centres[frame] += [0.0, 0.2, -0.1]
    assert np.flatnonzero(find_outlier_poses(centres, SIGMA, TIMES_NS)).tolist() == [frame]


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("length", [1, 2, 3])
def test_a_few_poses_between_a_lost_interval_and_a_step_are_wrong(*, length: int, backwards: bool) -> None:
    """They agree with each other. Without the first right pose, nothing contradicts them."""
    centres = _swing(1.0) + np.random.default_rng(4).normal(0, 0.004, (60, 3))
    centres[20:30] = np.nan
    centres[30 : 30 + length] += [0.0, 0.8, -0.4]
    wrong = list(range(30, 30 + length))
    if backwards:
        centres, wrong = centres[::-1].copy(), [59 - frame for frame in reversed(wrong)]
    assert np.flatnonzero(find_outlier_poses(centres, SIGMA, TIMES_NS)).tolist() == wrong


def test_a_step_far_from_lost_frames_is_no_single_outlier() -> None:
    """Which side is wrong is not known here."""
    centres = _swing(1.0) + np.random.default_rng(4).normal(0, 0.004, (60, 3))
    centres[30:] += [0.0, 0.8, -0.4]
    assert not find_outlier_poses(centres, SIGMA, TIMES_NS).any()


@pytest.mark.parametrize(
    ("seen", "refused"),
    [
        ("....#....", [4]),
        ("....##....", [4, 5]),
        ("...###....", []),
        ("..#..#....", []),
        ("#....", [0]),
        ("#########", []),
    ],
)
def test_an_isolated_pose_needs_more_inliers(seen: str, refused: list[int]) -> None:
    localised = np.array([letter == "#" for letter in seen])
    inliers = np.where(localised, 40, 0)
    assert np.flatnonzero(isolated_poses(localised, inliers, 60)).tolist() == refused
    assert not isolated_poses(localised, inliers, 40).any(), "strong evidence stands alone"
