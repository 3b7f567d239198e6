"""The vertical, the scale and the biases from accelerometers along solved paths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.inertial import align_sensor, force_windows
from bodycap_batch.model.geometry import Similarity, skew, so3_exp
from bodycap_batch.model.gravity import fit_gravity
from bodycap_batch.model.inertial_camera import ForceWindows
from tests.inertial import Hand, Sensor, solved

SECONDS = 10.0
GAUGE = Similarity(2.7, so3_exp([0.4, -1.1, 0.3]), np.array([5.0, -3.0, 2.0]))


def _windows(hand: Hand, sensor: Sensor, gauge: Similarity = GAUGE, seed: int = 2, **changes) -> ForceWindows:
    path = solved(hand, SECONDS, gauge_from_world=gauge, seed=seed, **changes)
    aligned = align_sensor(path, sensor.samples(hand, SECONDS, seed))
    assert aligned.fit is not None
    assert aligned.samples is not None
    return force_windows(path, aligned.samples, aligned.fit.rotation_sigma_rad)


def _off_deg(up, gauge: Similarity = GAUGE) -> float:
    return float(np.degrees(np.arccos(np.clip(up @ gauge.rotation[:, 2], -1.0, 1.0))))


@pytest.mark.parametrize("seed", range(4))
def test_one_hand_gives_the_vertical_and_the_scale(seed):
    found = fit_gravity([_windows(Hand(seed), Sensor(), seed=seed)])
    assert found is not None
    assert _off_deg(found.up) < max(3.0 * found.sigma_deg, 0.05)
    assert found.sigma_deg < 0.4
    assert abs(np.log(found.metres_per_unit * GAUGE.scale)) < 4.0 * found.scale_sigma
    assert found.scale_sigma < 0.03
    bias = so3_exp(Sensor().turn_rad) @ Sensor().force_bias
    assert found.solution[4:7] == pytest.approx(bias, abs=0.1)


def test_a_camera_that_hardly_moves_has_a_vertical_with_the_sigma_of_its_bias():
    """The trunk of a person who stands bent: the bias of the accelerometer looks like a tilt."""
    found = fit_gravity([_windows(Hand(1, reach_m=0.01, turn_rad=0.12), Sensor())])
    assert found is not None
    assert _off_deg(found.up) < 3.0 * found.sigma_deg
    # 0.1 m/s² of 9.81 are 0.6°.
    assert 0.2 < found.sigma_deg < 1.5


def test_several_cameras_are_better_than_one():
    sensors = [Sensor(force_bias=tuple(bias)) for bias in np.random.default_rng(3).normal(0.0, 0.1, (3, 3))]
    windows = [_windows(Hand(seed), each, seed=seed) for seed, each in enumerate(sensors)]
    together, alone = fit_gravity(windows), fit_gravity(windows[:1])
    assert together is not None
    assert alone is not None
    assert together.sigma_deg < alone.sigma_deg
    assert _off_deg(together.up) < 3.0 * together.sigma_deg


def test_the_distance_of_the_sensor_from_the_lens_is_estimated():
    lever = (0.02, -0.015, 0.01)
    found = fit_gravity([_windows(Hand(2, turn_rad=1.2), Sensor(lever_m=lever))])
    assert found is not None
    assert found.solution[7:10] == pytest.approx(np.array(lever), abs=0.006)
    assert _off_deg(found.up) < max(3.0 * found.sigma_deg, 0.05)


def test_wrong_poses_in_a_few_windows_do_not_tilt_the_vertical():
    path = solved(Hand(1), SECONDS, gauge_from_world=GAUGE)
    aligned = align_sensor(path, Sensor().samples(Hand(1), SECONDS))
    poses = path.gauge_from_cam.copy()
    poses[100:120, :3, 3] += [1.0, -1.0, 0.5]
    assert aligned.samples is not None
    windows = force_windows(replace(path, gauge_from_cam=poses), aligned.samples, np.full(3, 0.003))
    found = fit_gravity([windows])
    assert found is not None
    assert _off_deg(found.up) < 0.5


def test_the_axes_of_a_gauge_do_not_matter():
    windows = _windows(Hand(1), Sensor())
    other = Similarity(0.3, so3_exp([2.0, 0.1, -0.7]), np.array([1.0, 2.0, 3.0]))
    here, there = fit_gravity([windows]), fit_gravity([windows.in_gauge(other)])
    assert here is not None
    assert there is not None
    assert there.up == pytest.approx(other.rotation @ here.up, abs=1e-6)
    assert there.metres_per_unit == pytest.approx(here.metres_per_unit / 0.3, rel=1e-4)


def test_lost_frames_and_missing_samples_leave_out_windows():
    sensor, hand = Sensor(), Hand(1)
    whole, lost = _windows(hand, sensor), _windows(hand, sensor, lost=range(100, 120))
    assert 10 < len(lost.times_s) < len(whole.times_s)
    assert not ((lost.times_s > 99 / 30 - 0.39) & (lost.times_s < 4.0 + 0.39)).any()


def test_too_few_windows_give_nothing():
    windows = _windows(Hand(1), Sensor(), lost=[frame for frame in range(300) if frame > 70])
    assert 0 < len(windows.times_s) < 5
    assert fit_gravity([windows]) is None
    assert fit_gravity([]) is None


def _drawn_windows(
    rng: np.random.Generator, count: int, path_noise: float, force_noise: float = 0.005
) -> ForceWindows:
    """Return windows of a sensor with a bias alone, in a gauge of metres, with accelerations of 1 m/s²."""
    turn = so3_exp(rng.normal(0.0, 0.7, (count, 3)))
    acceleration, up = rng.normal(0.0, 1.0, (count, 3)), np.array([0.0, 0.0, 9.81])
    bias = rng.normal(0.0, 0.1, 3)
    force = acceleration + up + turn @ bias + rng.normal(0.0, force_noise, (count, 3))
    return ForceWindows(
        times_s=0.4 * np.arange(count),
        force=force,
        rotation=turn,
        turned_force=turn @ skew(np.einsum("nji,nj->ni", turn, force)),
        acceleration=acceleration + rng.normal(0.0, path_noise, (count, 3)),
        lever=rng.normal(0.0, 3.0, (count, 3, 3)),
        rotation_sigma_rad=np.full(3, 0.005),
    )


def test_the_noise_of_the_path_does_not_make_the_scale_too_small():
    """The squared noise adds to the squared accelerations: uncorrected, the scale would be 14 % too small."""
    rng = np.random.default_rng(5)
    found = fit_gravity([_drawn_windows(rng, 300, path_noise=0.4)])
    assert found is not None
    # 300 windows with three axes: 0.4 / sqrt(900) is 1.3 %.
    assert abs(np.log(found.metres_per_unit)) < 3.0 * 0.013
    assert abs(np.log(found.metres_per_unit)) < 3.0 * found.scale_sigma


def test_the_sigma_of_the_scale_holds_with_few_windows_for_each_camera():
    """Eleven windows with 31 unknowns: their residuals are much smaller than the noise."""
    errors = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        found = fit_gravity([_drawn_windows(rng, count, path_noise=0.1) for count in (5, 1, 5)])
        assert found is not None
        errors.append(np.log(found.metres_per_unit) / found.scale_sigma)
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.4
    assert np.mean(np.abs(errors) < 2.0) > 0.88


def test_the_sigma_of_the_scale_contains_the_sensitivity_of_the_accelerometer():
    windows = [_drawn_windows(np.random.default_rng(seed), 200, path_noise=0.0) for seed in range(3)]
    one, three = fit_gravity(windows[:1]), fit_gravity(windows)
    assert one is not None
    assert three is not None
    # 1 % for each axis; the three axes of each camera are independent.
    assert one.scale_sigma == pytest.approx(0.01 / np.sqrt(3.0), rel=0.1)
    assert three.scale_sigma == pytest.approx(0.01 / 3.0, rel=0.1)
