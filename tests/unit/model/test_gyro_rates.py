"""The rotation of a camera as its gyroscope measures it, and the paths that are made of it."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import make_transform, so3_exp, so3_log
from bodycap_batch.model.gyro_rates import GyroOrientation, GyroRates
from bodycap_batch.model.rotation_path import PosePath, RotationPath

RATE_HZ, FPS, SECONDS = 200.0, 30.0, 3.0
TIMES_NS = np.round(np.arange(0.2, SECONDS - 0.2, 1.0 / FPS) * 1e9).astype(np.int64)


def rate(times_s: FloatArray) -> FloatArray:
    """Return angular velocities (N,3) of a hand that is thrown about, rad/s."""
    return np.stack(
        [9.0 * np.sin(11.0 * times_s), 7.0 * np.cos(9.0 * times_s), 5.0 * np.sin(14.0 * times_s)], 1
    )


def measured() -> GyroRates:
    times_s = np.arange(0.0, SECONDS, 1.0 / RATE_HZ)
    return GyroRates(times_s=times_s, rate_rad_s=rate(times_s))


def true_orientation() -> GyroOrientation:
    times_s = np.arange(0.0, SECONDS, 1.0 / 20_000.0)
    return GyroOrientation(times_s, rate(times_s))


def angles(first: FloatArray, second: FloatArray) -> FloatArray:
    return np.linalg.norm(so3_log(np.swapaxes(first, 1, 2) @ second), axis=1)


def test_rotation_over_short_times_follows_the_change_of_the_axis() -> None:
    start_s = np.linspace(0.3, SECONDS - 0.3, 200)
    delay_s = np.linspace(-0.015, 0.015, 200)
    truth = true_orientation()
    turned = so3_exp(measured().rotvec_between(start_s, delay_s))
    expected = np.swapaxes(truth.at(start_s), 1, 2) @ truth.at(start_s + delay_s)
    # Samples every 5 ms of a sine of 14 rad/s are joined by lines: (0.005 · 14)² / 8 of 12 rad/s in 15 ms.
    assert angles(turned, expected).max() < 2e-4


def test_path_of_a_gyroscope_is_nearer_to_the_truth_than_the_spline_through_frames() -> None:
    truth = true_orientation()
    seconds = TIMES_NS * 1e-9
    at_frames = truth.at(seconds)
    step = np.swapaxes(at_frames[1:], 1, 2) @ at_frames[:-1]
    spline = RotationPath.from_steps(TIMES_NS, step, np.ones(len(step), dtype=bool))
    gyro = RotationPath.from_gyro(TIMES_NS, measured())
    assert gyro.measured().all()
    frame = np.repeat(np.arange(5, len(TIMES_NS) - 5), 2)
    delay_s = np.tile([-0.01, 0.01], len(frame) // 2)
    expected = np.swapaxes(truth.at(seconds[frame]), 1, 2) @ truth.at(seconds[frame] + delay_s)
    error = {
        name: angles(path.frame_from_instant(frame, delay_s), expected)
        for name, path in (("gyro", gyro), ("spline", spline))
    }
    assert error["gyro"].max() < 3e-4
    assert np.median(error["spline"]) > 5.0 * np.median(error["gyro"])


def test_frames_without_samples_keep_the_path_of_the_pictures() -> None:
    gyro = measured()
    gap = (gyro.times_s > 1.0) & (gyro.times_s < 1.4)
    cut = GyroRates(
        times_s=gyro.times_s[~gap], rate_rad_s=gyro.rate_rad_s[~gap], gaps_s=np.array([[1.0, 1.4]])
    )
    at_frames = true_orientation().at(TIMES_NS * 1e-9)
    step = np.swapaxes(at_frames[1:], 1, 2) @ at_frames[:-1]
    pictures = RotationPath.from_steps(TIMES_NS, step, np.ones(len(step), dtype=bool))
    path = RotationPath.from_gyro(TIMES_NS, cut, pictures)
    seconds = TIMES_NS * 1e-9
    inside = (seconds > 1.0) & (seconds < 1.4)
    assert not path.measured()[inside].any()
    assert path.measured()[(seconds < 0.95) | (seconds > 1.45)].all()
    frame = np.flatnonzero(inside)
    delay_s = np.full(len(frame), 0.005)
    np.testing.assert_allclose(
        path.rotvec_to_instant(frame, delay_s), pictures.rotvec_to_instant(frame, delay_s), atol=2e-3
    )
    alone = RotationPath.from_gyro(TIMES_NS, cut)
    assert not alone.is_known(int(frame[len(frame) // 2]))


def test_poses_do_not_replace_measured_angular_velocities() -> None:
    rng = np.random.default_rng(2)
    seconds = TIMES_NS * 1e-9
    noisy = true_orientation().at(seconds) @ so3_exp(rng.normal(0.0, 0.01, (len(seconds), 3)))
    poses = make_transform(noisy, np.zeros((len(seconds), 3)))
    path = PosePath.create(poses, TIMES_NS, RotationPath.from_gyro(TIMES_NS, measured()))
    inner = slice(3, -3)
    off = np.linalg.norm(path.rotation.rate - rate(seconds), axis=1)[inner]
    assert off.max() < 0.2  # without the gyroscope, noise of 0.01 rad in a frame interval is 0.4 rad/s
    assert path.rotation.gyro is not None
