"""Pose from points, its covariance, and where the map should grow."""

from __future__ import annotations

import threading
import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert, make_transform, so3_exp, so3_log
from bodycap_batch.model.scene import FrameStatus
from bodycap_batch.registration.poses import batched_pnp
from bodycap_batch.registration.poses.batched_pnp import RateErrors, make_observations
from bodycap_batch.registration.poses.keyframe_requests import lost_intervals, request_keyframes
from bodycap_batch.registration.poses.pnp import (
    AcceptanceCriteria,
    FramePose,
    solve_poses,
)

CAMERA = Camera(
    model="OPENCV",
    width_px=640,
    height_px=480,
    params=np.array([420.0, 430.0, 322.0, 238.0, -0.2, 0.05, 1e-3, -5e-4]),
)
READOUT_S, RATE_SIGMA = 0.03, 2.0
"""Readout time of a rolling shutter, and error of its angular velocity about an axis, rad/s."""
CRITERIA = AcceptanceCriteria(max_error_px=2.5, min_inliers=15, max_sigma_depth=0.05)


def _scene(rng: np.random.Generator, count: int, patch_px: float | None = None) -> tuple[np.ndarray, ...]:
    """Points (N,3) in the gauge, their exact pixels and cam_from_gauge; depth 2 to 5."""
    low, high = np.array([20.0, 20.0]), np.array([620.0, 460.0])
    if patch_px is not None:
        low, high = np.array([300.0, 200.0]), np.array([300.0, 200.0]) + patch_px
    px = rng.uniform(low, high, (count, 2))
    rays = CAMERA.unproject(px)
    depth = rng.uniform(2.0, 5.0, (count, 1)) if patch_px is None else np.full((count, 1), 3.0)
    x_in_cam = np.hstack([rays, np.ones((count, 1))]) * depth
    cam_from_gauge = make_transform(so3_exp([0.3, -0.5, 0.2]), [0.4, -0.2, 1.0])
    gauge_from_cam = invert(cam_from_gauge)
    points = x_in_cam @ gauge_from_cam[:3, :3].T + gauge_from_cam[:3, 3]
    return points, CAMERA.project(x_in_cam), gauge_from_cam


def _solve(points: np.ndarray, px: np.ndarray, start: np.ndarray | None = None) -> FramePose:
    """One frame alone, from a starting cam_from_gauge or from none."""
    views = make_observations(CAMERA, np.array([0, len(px)]), points, px)
    first = np.full((4, 4), np.nan) if start is None else start
    return solve_poses(CAMERA, views, px, first[None], CRITERIA)[0]


def test_pose_survives_a_third_of_wrong_points() -> None:
    rng = np.random.default_rng(0)
    points, px, truth = _scene(rng, 120)
    seen = px + rng.normal(0, 0.5, px.shape)
    seen[:40] += rng.uniform(10, 60, (40, 2))
    found = _solve(points, seen)
    assert found.status is FrameStatus.REGISTERED
    assert 75 <= found.inliers <= 82
    assert found.gauge_from_cam is not None
    # 80 inliers at 0.5 px and 420 px focal length: about 3.5 m · 0.5/420 · 3/√80 ≈ 1.4 mm.
    assert np.linalg.norm(found.gauge_from_cam[:3, 3] - truth[:3, 3]) < 0.006


@pytest.mark.parametrize(("degrees", "metres"), [(3.0, 0.05), (20.0, 0.3)])
def test_a_start_that_is_off_leads_to_the_same_pose(degrees: float, metres: float) -> None:
    rng = np.random.default_rng(4)
    points, px, truth = _scene(rng, 120)
    seen = px + rng.normal(0, 0.5, px.shape)
    seen[:30] += rng.uniform(10, 60, (30, 2))
    off = make_transform(so3_exp(np.radians(degrees) * np.array([0.6, 0.0, 0.8])), [metres, 0.0, 0.0])
    sampled, started = _solve(points, seen), _solve(points, seen, off @ invert(truth))
    assert sampled.gauge_from_cam is not None
    assert started.gauge_from_cam is not None
    # Both end where the step is below 1e-2 px: 3.5 m · 1e-2/420 · 6, and one inlier more or less.
    assert np.linalg.norm(started.gauge_from_cam[:3, 3] - sampled.gauge_from_cam[:3, 3]) < 1e-3


def test_threads_of_a_task_solve_the_same_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(6)
    scenes = [_scene(rng, 90) for _ in range(12)]
    px = np.concatenate([scene[1] + rng.normal(0, 0.5, scene[1].shape) for scene in scenes])
    start = np.stack([make_transform(np.eye(3), [0.05, 0.0, 0.0]) @ invert(scene[2]) for scene in scenes])
    points, bounds = np.concatenate([scene[0] for scene in scenes]), np.arange(13) * 90
    views = make_observations(CAMERA, bounds, points, px)
    monkeypatch.setattr(batched_pnp, "_CHUNK_FRAMES", 2)
    workers: set[str] = set()
    step = batched_pnp._gauss_newton_step

    def noted(*arguments: Any) -> Any:
        workers.add(threading.current_thread().name.partition("_")[0])
        return step(*arguments)

    monkeypatch.setattr(batched_pnp, "_gauss_newton_step", noted)
    found = {}
    for threads, name in ((1, "MainThread"), (2, "poses")):
        workers.clear()
        found[threads] = batched_pnp.refine_poses(views, start, CRITERIA.max_error_px, threads)
        assert workers == {name}
    assert (found[1] == found[2]).all()


def test_observations_are_undistorted_in_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    count = 200_000
    px = np.random.default_rng(0).uniform((20.0, 20.0), (620.0, 460.0), (count, 2))
    points = np.ones((count, 3))
    tracemalloc.start()
    views = make_observations(CAMERA, np.array([0, count]), points, px)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    kept = views.rays.nbytes + views.px_from_ray.nbytes + views.weight.nbytes
    # Besides the result: several arrays of rays, pixels and points of one batch, at most 24 bytes per row.
    assert kept <= peak < kept + 16 * 24 * batched_pnp._BATCH_ROWS
    monkeypatch.setattr(batched_pnp, "_BATCH_ROWS", count)
    whole = make_observations(CAMERA, np.array([0, count]), points, px)
    assert np.array_equal(whole.rays, views.rays)
    assert np.array_equal(whole.px_from_ray, views.px_from_ray)


def test_frames_solved_together_do_not_influence_each_other() -> None:
    rng = np.random.default_rng(5)
    scenes = [_scene(rng, count) for count in (90, 4, 60, 2, 120)]
    px = [scene[1] + rng.normal(0, 0.5, scene[1].shape) for scene in scenes]
    start = np.stack([invert(scene[2]) for scene in scenes])
    bounds = np.concatenate([[0], np.cumsum([len(part) for part in px])])
    points, pixels = np.concatenate([scene[0] for scene in scenes]), np.concatenate(px)
    together = solve_poses(CAMERA, make_observations(CAMERA, bounds, points, pixels), pixels, start, CRITERIA)
    assert [pose.status for pose in together] == [
        FrameStatus.REGISTERED if len(part) > 50 else FrameStatus.FEW_TRACKS for part in px
    ]
    for index in (0, 2, 4):
        alone = _solve(scenes[index][0], px[index], start[index])
        assert together[index].gauge_from_cam is not None
        np.testing.assert_allclose(together[index].gauge_from_cam, alone.gauge_from_cam, atol=1e-12)
        np.testing.assert_allclose(together[index].covariance, alone.covariance, rtol=1e-9)


def test_uncertain_points_have_less_weight() -> None:
    rng = np.random.default_rng(6)
    points, px, truth = _scene(rng, 100)
    seen = px + rng.normal(0, 0.3, px.shape)
    displaced = np.arange(100) < 50
    seen[displaced, 0] += 1.0
    start = invert(truth)[None]

    def solve(weight: float) -> np.ndarray:
        views = make_observations(CAMERA, np.array([0, 100]), points, seen, np.where(displaced, weight, 1.0))
        pose = solve_poses(CAMERA, views, seen, start, CRITERIA)[0].gauge_from_cam
        assert pose is not None
        return pose

    alone = _solve(points[~displaced], seen[~displaced], start[0]).gauge_from_cam
    off = [np.linalg.norm(solve(weight) - alone) for weight in (1.0, 0.1, 0.01)]
    # A tenth of the weight is about a tenth of the pull.
    assert off[1] < 0.3 * off[0]
    assert off[2] < 0.3 * off[1]


def test_normalised_error_of_the_covariance_is_near_one() -> None:
    errors = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        points, px, truth = _scene(rng, 80)
        found = _solve(points, px + rng.normal(0, 0.5, px.shape))
        assert found.gauge_from_cam is not None
        assert found.covariance is not None
        delta = invert(truth) @ found.gauge_from_cam
        error = np.concatenate([so3_log(delta[:3, :3]), delta[:3, 3]])
        errors.append(error @ np.linalg.solve(found.covariance, error) / 6)
    # The map is exact here.
    # χ²(360)/360 lies in [0.86, 1.15] with 95 %; the noise is itself estimated from 80 points (± 10 %).
    assert 0.7 < np.mean(errors) < 1.4


@pytest.mark.parametrize("kind", ["common", "large"])
def test_the_covariance_contains_common_and_large_errors(kind: str) -> None:
    """Neighbouring points have common errors, or one point in six has a four times larger error."""
    errors = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        points, px, truth = _scene(rng, 240)
        noise = rng.normal(0, 0.2, px.shape)
        if kind == "common":
            _, cell = np.unique(np.floor(px / 50.0).astype(int) @ [100, 1], return_inverse=True)
            noise += rng.normal(0, 0.3, (cell.max() + 1, 2))[cell]
        else:
            noise[:40] *= 4.0
        found = _solve(points, px + noise)
        assert found.gauge_from_cam is not None
        assert found.covariance is not None
        delta = invert(truth) @ found.gauge_from_cam
        error = np.concatenate([so3_log(delta[:3, :3]), delta[:3, 3]])
        errors.append(error @ np.linalg.solve(found.covariance, error) / 6)
    # From the median noise, as if all errors were independent, the mean for common errors is 4. The robust
    # loss reduces large errors; this advantage is not counted.
    assert (0.6 if kind == "common" else 0.3) < np.mean(errors) < 1.7


def test_a_frame_without_inliers_of_a_rolling_shutter_has_no_pose() -> None:
    rng = np.random.default_rng(3)
    points, px, truth = _scene(rng, 60)
    lag_s = (px[:, 1] / CAMERA.height_px - 0.5) * READOUT_S
    rates = RateErrors(lag_s, np.full(len(px), RATE_SIGMA))
    for wrong in (rng.permutation(points), -points):
        views = replace(make_observations(CAMERA, np.array([0, len(px)]), wrong, px), rates=rates)
        assert solve_poses(CAMERA, views, px, invert(truth)[None], CRITERIA)[0].gauge_from_cam is None


def test_the_covariance_contains_the_angular_velocity_of_a_rolling_shutter() -> None:
    """The angular velocity of each frame is fitted to its rows together with the pose."""
    squared: dict[bool, list[float]] = {True: [], False: []}
    for seed in range(60):
        rng = np.random.default_rng(seed)
        points, px, truth = _scene(rng, 150)
        lag_s = (px[:, 1] / CAMERA.height_px - 0.5) * READOUT_S
        turn = so3_exp(lag_s[:, None] * rng.normal(0.0, RATE_SIGMA, 3))
        seen = CAMERA.project(np.einsum("mij,mj->mi", turn, _in_cam(points, truth)))
        seen += rng.normal(0, 0.5, px.shape)
        rates = RateErrors(lag_s, np.full(len(px), RATE_SIGMA))
        views = _with_fitted_rate(points, seen, truth, rates)
        for known in (True, False):
            chosen = replace(views, rates=None if known else rates)
            found = solve_poses(CAMERA, chosen, seen, invert(truth)[None], CRITERIA)[0]
            assert found.gauge_from_cam is not None
            assert found.covariance is not None
            off = invert(found.gauge_from_cam) @ truth
            error = np.concatenate([so3_log(off[:3, :3]), off[:3, 3]])
            squared[known].append(float(error @ np.linalg.solve(found.covariance, error)) / 6.0)
    # χ²(360)/360 lies in [0.86, 1.15] with 95 %; the noise is itself estimated from 150 points (± 6 %).
    assert 0.7 < np.mean(squared[False]) < 1.3
    # As if the angular velocities were known, the errors are larger than stated.
    assert np.mean(squared[True]) > 1.5


def test_a_rate_of_which_nothing_is_known_is_no_error_if_no_observation_depends_on_it() -> None:
    nothing = RateErrors(np.zeros(4), np.full(4, np.inf))
    jacobian = np.random.default_rng(0).normal(size=(2, 6, 4))
    taken = batched_pnp._information_of_rates(
        nothing, np.arange(4), jacobian, np.ones(4), np.array([0]), np.array([0.25])
    )
    assert taken.shape == (1, 6, 6)
    assert not taken.any()


def _with_fitted_rate(
    points: np.ndarray, px: np.ndarray, truth: np.ndarray, rates: RateErrors
) -> batched_pnp.Observations:
    """Return the observations of a frame, turned to its middle row with the angular velocity that fits."""
    views = make_observations(CAMERA, np.array([0, len(px)]), points, px)
    residual, jacobian, _ = batched_pnp.linearise(
        views, np.arange(len(px)), np.tile(invert(truth), (len(px), 1, 1))
    )
    whole = np.concatenate([jacobian, jacobian[:, :3] * rates.leverage_s], axis=1)
    prior = np.diag([0.0] * 6 + [0.5**2 / RATE_SIGMA**2] * 3)
    normal = np.einsum("dim,djm->ij", whole, whole) + prior
    rate = -np.linalg.solve(normal, np.einsum("dim,dm->i", whole, residual))[6:]
    back = so3_exp(-rates.leverage_s[:, None] * rate)
    rays = np.einsum("mij,mj->mi", back, np.column_stack([views.rays, np.ones(len(px))]))
    return replace(views, rays=rays[:, :2] / rays[:, 2:])


def _in_cam(points: np.ndarray, gauge_from_cam: np.ndarray) -> np.ndarray:
    cam_from_gauge = invert(gauge_from_cam)
    return points @ cam_from_gauge[:3, :3].T + cam_from_gauge[:3, 3]


def test_inliers_in_a_small_patch_are_rejected() -> None:
    rng = np.random.default_rng(1)
    points, px, _ = _scene(rng, 25, patch_px=42.0)
    found = _solve(points, px + rng.normal(0, 0.5, px.shape))
    assert found.status is FrameStatus.UNCONSTRAINED
    assert found.gauge_from_cam is None


@pytest.mark.parametrize(("count", "status"), [(10, FrameStatus.FEW_TRACKS), (60, FrameStatus.FEW_INLIERS)])
def test_a_rejected_pose_has_its_reason_as_status(count: int, status: FrameStatus) -> None:
    rng = np.random.default_rng(2)
    points, px, _ = _scene(rng, count)
    found = _solve(points, rng.permutation(px))
    assert found.status is status
    assert found.gauge_from_cam is None


def test_lost_intervals_are_maximal() -> None:
    localised = np.array([0, 1, 1, 0, 0, 1, 0], dtype=bool)
    assert lost_intervals(localised) == [(0, 1), (3, 5), (6, 7)]
    assert lost_intervals(np.ones(4, dtype=bool)) == []


def test_the_sharpest_lost_frames_and_those_next_to_them_are_requested() -> None:
    localised = np.ones(40, dtype=bool)
    localised[10:16] = False
    sharpness = np.ones(40)
    sharpness[[11, 14]] = 2.0
    wanted = request_keyframes(localised, sharpness, np.array([0, 39]))
    assert wanted.tolist() == [9, 11, 14, 16]


def test_nothing_is_requested_once_every_lost_interval_was_tried() -> None:
    localised = np.ones(40, dtype=bool)
    localised[10:16] = False
    tried = np.array([0, 11, 14, 39])
    assert len(request_keyframes(localised, np.ones(40), tried)) == 0


def test_the_number_of_requests_is_bounded() -> None:
    wanted = request_keyframes(np.zeros(3000, dtype=bool), np.ones(3000), np.arange(0, 3000, 50))
    assert 20 <= len(wanted) <= 30
    assert (np.diff(wanted) > 0).all()
