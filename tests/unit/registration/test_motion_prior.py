"""Smoothing of camera centres by the statistics of the motion, and the Kalman filter."""

from __future__ import annotations

import tracemalloc

import numpy as np

from bodycap_batch.registration.recovery.motion_prior import (
    CentreKalmanFilter,
    MotionStatistics,
    PositionEstimate,
    smooth_centres,
)

TIMES = np.arange(40.0)
PATH = np.column_stack([np.sin(TIMES / 6.0), np.cos(TIMES / 8.0), 0.02 * TIMES])
STEADY = MotionStatistics(jerk_sigma=0.01, cubic_residual_sigma=0.002)


def _positions(sigma: float, rng: np.random.Generator) -> dict[int, PositionEstimate]:
    return {
        frame: PositionEstimate(PATH[frame] + rng.normal(0, sigma, 3), np.eye(3) * sigma**2)
        for frame in range(len(TIMES))
    }


def test_smoothing_reduces_the_error_of_noisy_positions() -> None:
    found = _positions(0.05, np.random.default_rng(1))
    smoothed = smooth_centres(np.arange(40), TIMES, found, (), STEADY)
    off = np.array([smoothed.positions[f].centre - PATH[f] for f in range(40)])
    before = np.array([found[f].centre - PATH[f] for f in range(40)])
    assert np.sqrt((off**2).mean()) < 0.6 * np.sqrt((before**2).mean())
    sigma = np.sqrt([np.trace(smoothed.positions[f].covariance) for f in range(40)])
    # Typical positions have half weight under the loss, so the sigmas are too large by about the root of two.
    assert 0.2 < (np.linalg.norm(off, axis=1) ** 2 / sigma**2).mean() < 1.5


def test_a_wrong_position_is_reported_and_does_not_bend_the_path() -> None:
    found = _positions(0.01, np.random.default_rng(2))
    found[20] = PositionEstimate(PATH[20] + [0.5, 0.0, 0.0], np.eye(3) * 0.01**2)
    smoothed = smooth_centres(np.arange(40), TIMES, found, (), STEADY)
    assert smoothed.disagreement[20] > 100.0
    assert np.linalg.norm(smoothed.positions[20].centre - PATH[20]) < 0.03
    assert max(value for frame, value in smoothed.disagreement.items() if frame != 20) < 25.0


def test_far_from_all_positions_the_sigma_is_large() -> None:
    found = {
        frame: place for frame, place in _positions(0.01, np.random.default_rng(3)).items() if frame < 10
    }
    smoothed = smooth_centres(np.arange(40), TIMES, found, (), STEADY)
    sigma = [float(np.sqrt(np.trace(smoothed.positions[frame].covariance))) for frame in (9, 11, 15, 25)]
    assert sigma == sorted(sigma)
    assert sigma[2] > 5.0 * sigma[0]


def test_memory_grows_linearly_with_the_interval() -> None:
    frames = np.arange(1500)
    ends = [*range(8), *range(1492, 1500)]
    found = {frame: PositionEstimate(np.array([0.01 * frame, 0.0, 0.0]), np.eye(3) * 1e-4) for frame in ends}
    tracemalloc.start()
    smoothed = smooth_centres(frames, frames.astype(np.float64), found, found.keys(), STEADY)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # Some 144 numbers for every four frames, a few times over; a square of all of them would take 160 MB.
    assert peak < 12e6
    np.testing.assert_allclose(smoothed.positions[4].centre, found[4].centre, atol=1e-3)


def test_uneven_times_do_not_bend_a_smooth_path() -> None:
    times = np.cumsum(np.random.default_rng(4).choice([1.0, 2.0], 40))
    path = np.column_stack([0.1 * times, 0.01 * times**2, 0.001 * times**3])
    found = {frame: PositionEstimate(path[frame], np.eye(3) * 1e-6) for frame in range(0, 40, 3)}
    smoothed = smooth_centres(np.arange(40), times, found, (), STEADY)
    off = [np.linalg.norm(smoothed.positions[frame].centre - path[frame]) for frame in range(40)]
    assert max(off[:37]) < 1e-2


def test_motion_statistics_follow_the_path_and_its_scale() -> None:
    centres = PATH.copy()
    centres[10] = np.nan
    smooth, large = MotionStatistics.estimate(TIMES, centres), MotionStatistics.estimate(TIMES, 7.0 * centres)
    assert smooth is not None
    assert large is not None
    np.testing.assert_allclose(
        [large.jerk_sigma, large.cubic_residual_sigma],
        [7.0 * smooth.jerk_sigma, 7.0 * smooth.cubic_residual_sigma],
    )
    # The third derivative of sin(t/6) is 1/216.
    assert 0.0005 < smooth.jerk_sigma < 0.005
    assert MotionStatistics.estimate(TIMES[:5], centres[:5]) is None


def test_the_filter_predicts_the_path_with_correct_sigmas() -> None:
    path = CentreKalmanFilter(STEADY, PositionEstimate(PATH[0], np.eye(3) * 1e-4))
    for frame in range(1, 20):
        path.predict(1.0)
        path.update(PositionEstimate(PATH[frame], np.eye(3) * 1e-4))
    ahead = [path.predict(1.0) for _ in range(4)]
    off = [np.linalg.norm(place.centre - PATH[20 + number]) for number, place in enumerate(ahead)]
    sigma = [np.sqrt(np.trace(place.covariance)) for place in ahead]
    assert all(o < 3.0 * s for o, s in zip(off, sigma, strict=True))
    assert sigma == sorted(sigma)
    assert off[0] < 0.02
