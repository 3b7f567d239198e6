"""Weakly observed centres are smoothed; well-observed centres stay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.config.lost_frames import LEAST_LOST
from bodycap_batch.model.geometry import make_transform, so3_exp
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.registration.recovery.path_smoothing import smooth_if_final, smooth_weak_centres

COUNT = 90
WEAK = np.arange(40, 50)
STRONG_M, WEAK_M = 1e-3, 0.03


def _truth() -> np.ndarray:
    frames = np.arange(COUNT)
    centres = np.column_stack([0.02 * frames, 0.3 * np.sin(frames / 8.0), 0.1 * np.cos(frames / 6.0)])
    return make_transform(so3_exp(np.outer(frames, [0.0, 0.05, 0.01])), centres)


def _measured(count: int = COUNT) -> Trajectory:
    """The truth with noise as the covariances state it, turned and weakly seen in the middle."""
    rng = np.random.default_rng(4)
    sigma = np.full(COUNT, STRONG_M)
    sigma[WEAK] = WEAK_M
    poses = _truth()
    poses[:, :3, 3] += rng.normal(size=(COUNT, 3)) * sigma[:, None]
    covariance = np.zeros((COUNT, 6, 6))
    covariance[:, :3, :3] = np.eye(3) * 1e-6
    covariance[:, 3:, 3:] = np.eye(3) * sigma[:, None, None] ** 2
    return Trajectory(
        camera="torso",
        gauge="map-0",
        frame_numbers=np.arange(count),
        times_ns=np.arange(count, dtype=np.int64) * 33_333_333,
        gauge_from_cam=poses[:count],
        covariance=covariance[:count],
        status=(FrameStatus.REGISTERED,) * count,
        inliers=np.full(count, 50),
        error_px=np.full(count, 0.5),
    )


def _off_m(path: Trajectory) -> np.ndarray:
    return np.asarray(np.linalg.norm(path.gauge_from_cam[:, :3, 3] - _truth()[:, :3, 3], axis=1))


def test_weak_centres_improve_and_strong_ones_stay() -> None:
    before = _measured()
    after = smooth_weak_centres(before)
    assert np.sqrt((_off_m(after)[WEAK] ** 2).mean()) < 0.7 * np.sqrt((_off_m(before)[WEAK] ** 2).mean())
    strong = np.setdiff1d(np.arange(COUNT), WEAK)
    np.testing.assert_array_equal(after.gauge_from_cam[strong], before.gauge_from_cam[strong])


def test_covariances_and_statuses_stay() -> None:
    before = _measured()
    after = smooth_weak_centres(before)
    np.testing.assert_array_equal(after.covariance, before.covariance)
    assert after.status == before.status


def test_a_centre_that_contradicts_the_motion_stays() -> None:
    before = _measured()
    poses = before.gauge_from_cam.copy()
    poses[45, :3, 3] += 20.0 * WEAK_M
    leaping = _with(before, poses)
    np.testing.assert_array_equal(smooth_weak_centres(leaping).gauge_from_cam[45], poses[45])


def test_the_rotation_follows_the_centre_as_far_as_they_are_correlated() -> None:
    """Points two metres ahead: a centre moved sideways is turned back towards them."""
    before = _measured()
    covariance = before.covariance.copy()
    lever = np.array([[0.0, -0.5, 0.0], [0.5, 0.0, 0.0], [0.0, 0.0, 0.0]])
    spread = covariance[:, 3:, 3:]
    covariance[:, :3, 3:] = lever @ spread
    covariance[:, 3:, :3] = (lever @ spread).swapaxes(1, 2)
    covariance[:, :3, :3] += lever @ spread @ lever.T
    tied = _with(before, before.gauge_from_cam, covariance)
    after = smooth_weak_centres(tied)
    shift = (after.gauge_from_cam - before.gauge_from_cam)[WEAK, :3, 3]
    frame = int(WEAK[np.argmax(np.linalg.norm(shift, axis=1))])
    turned = after.gauge_from_cam[frame, :3, :3].T @ before.gauge_from_cam[frame, :3, :3]
    moved = before.gauge_from_cam[frame, :3, :3].T @ (
        after.gauge_from_cam[frame, :3, 3] - before.gauge_from_cam[frame, :3, 3]
    )
    np.testing.assert_allclose(turned, so3_exp(lever @ -moved), atol=1e-6)


@pytest.mark.parametrize("count", [1, 3, 19])
def test_a_path_too_short_for_motion_statistics_stays(count: int) -> None:
    before = _measured(count)
    np.testing.assert_array_equal(smooth_weak_centres(before).gauge_from_cam, before.gauge_from_cam)


@pytest.mark.parametrize("scale", [0.01, 100.0])
def test_the_unit_of_the_map_does_not_matter(scale: float) -> None:
    before = _measured()
    poses, covariance = before.gauge_from_cam.copy(), before.covariance.copy()
    poses[:, :3, 3] *= scale
    covariance[:, 3:, 3:] *= scale**2
    after = smooth_weak_centres(_with(before, poses, covariance)).gauge_from_cam
    np.testing.assert_allclose(
        after[:, :3, 3] / scale, smooth_weak_centres(before).gauge_from_cam[:, :3, 3], rtol=1e-5, atol=1e-6
    )


def test_only_adjustable_centres_move() -> None:
    before, movable = _measured(), np.ones(COUNT, dtype=bool)
    movable[WEAK[:5]] = False
    after = smooth_weak_centres(before, movable)
    moved = (after.gauge_from_cam != before.gauge_from_cam).any(axis=(1, 2))
    assert not moved[WEAK[:5]].any()
    assert moved[WEAK[5:]].any()


@pytest.mark.parametrize(("lost", "moves"), [(LEAST_LOST - 1, True), (LEAST_LOST, False)])
def test_a_path_is_not_smoothed_before_recovery(lost: int, moves: bool) -> None:
    path = _measured()
    gone = np.arange(COUNT) < lost
    none = np.where(gone[:, None, None], np.nan, 1.0)
    status = tuple(FrameStatus.BLUR if away else FrameStatus.REGISTERED for away in gone.tolist())
    path = replace(
        path, gauge_from_cam=path.gauge_from_cam * none, covariance=path.covariance * none, status=status
    )
    after = smooth_if_final(path)
    assert (after.gauge_from_cam[WEAK] != path.gauge_from_cam[WEAK]).any() == moves


def _with(path: Trajectory, poses: np.ndarray, covariance: np.ndarray | None = None) -> Trajectory:
    return replace(
        path, gauge_from_cam=poses, covariance=path.covariance if covariance is None else covariance
    )
