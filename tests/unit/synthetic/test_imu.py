"""Inertial samples of synthetic captures: consistent with the true path, with the stated errors."""

import json

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from bodycap_batch.core.context import StageContext
from bodycap_batch.formats.tum import read_tum
from bodycap_batch.synthetic import SynthOptions, synthesise
from bodycap_batch.synthetic.options import ImuOptions
from bodycap_batch.telemetry.text_files import read_imu_file


def _capture(folder, **values):
    options = SynthOptions(seconds=4.0, poses_only=True, cameras=("torso", "left_palm"), seed=3, **values)
    synthesise(options, folder, StageContext(work_dir=folder.parent))
    return folder


def _path(folder, camera):
    poses = read_tum(folder / "gt" / f"{camera}.tum")
    return poses.times_ns * 1e-9, poses.world_from_cam


@pytest.mark.parametrize("camera", ["torso", "left_palm"])
def test_perfect_samples_integrate_to_the_true_path(tmp_path, camera):
    folder = _capture(tmp_path / "c", imu="perfect", offsets_s={"left_palm": 0.4})
    telemetry = read_imu_file(folder / f"{camera}.imu.csv")
    times, poses = _path(folder, camera)
    gyro = telemetry.gyro
    assert gyro.rate_hz == pytest.approx(200.0, rel=1e-6)
    # Rotation: a sample is the mean rate of the interval around its time.
    first, last = 30, 90
    inside = (gyro.times_s >= times[first]) & (gyro.times_s <= times[last])
    steps = gyro.values[inside] / 200.0
    steps[[0, -1]] *= 0.5
    turned = Rotation.identity()
    for step in steps:
        turned = turned * Rotation.from_rotvec(step)
    truth = Rotation.from_matrix(poses[first, :3, :3].T @ poses[last, :3, :3])
    assert np.degrees((truth.inv() * turned).magnitude()) < 0.2
    # Gravity: the mean specific force in the world is upwards.
    at = np.searchsorted(times, gyro.times_s).clip(0, len(times) - 1)
    force = np.einsum("nij,nj->ni", poses[at, :3, :3], telemetry.accelerometer.values)
    assert force.mean(axis=0)[2] == pytest.approx(9.81, abs=0.25)
    assert np.abs(force.mean(axis=0)[:2]).max() < 0.5


def test_the_errors_are_those_of_the_truth_file(tmp_path):
    settings = {
        "rate_hz": 400.0,
        "gyro_noise_rad_s": 0.01,
        "turned_deg": 30.0,
        "late_s": 0.02,
        "gyro_bias_rad_s": 0.2,
    }
    folder = _capture(tmp_path / "a", imu=settings)
    exact = _capture(tmp_path / "b", imu={**_no_errors(), "rate_hz": 400.0})
    truth = json.loads((folder / "gt" / "torso.imu.json").read_text())
    measured, true = (read_imu_file(each / "torso.imu.csv").gyro for each in (folder, exact))
    np.testing.assert_allclose(measured.times_s, true.times_s + 0.02, atol=2e-6)
    turned = np.array(truth["cam_from_sensor"])
    assert np.degrees(Rotation.from_matrix(turned).magnitude()) == pytest.approx(30.0, abs=1e-6)
    error = measured.values - true.values @ turned - truth["gyro_bias_rad_s"]
    # 400 samples per second have twice the noise of 100.
    assert error.std() == pytest.approx(0.02, rel=0.1)
    assert np.abs(error.mean(axis=0)).max() < 0.003
    assert np.abs(truth["gyro_bias_rad_s"]).max() > 0.01


def _no_errors():
    return {
        name: 0.0
        for name in ImuOptions.model_fields
        if not name.endswith(("rate_hz", "range_deg_s", "range_g"))
    }


def test_the_range_cuts_off_and_the_seed_repeats(tmp_path):
    one = _capture(tmp_path / "a", imu={"gyro_range_deg_s": 10.0, "accelerometer_range_g": 0.5})
    other = _capture(tmp_path / "b", imu={"gyro_range_deg_s": 10.0, "accelerometer_range_g": 0.5})
    telemetry = read_imu_file(one / "torso.imu.csv")
    assert np.abs(telemetry.gyro.values).max() == pytest.approx(np.radians(10.0), abs=1e-6)
    assert np.abs(telemetry.accelerometer.values).max() == pytest.approx(0.5 * 9.80665, abs=1e-5)
    assert (one / "torso.imu.csv").read_bytes() == (other / "torso.imu.csv").read_bytes()
    assert (one / "torso.imu.csv").read_bytes() != (one / "left_palm.imu.csv").read_bytes()


def test_without_the_option_nothing_changes(tmp_path):
    plain, with_imu = _capture(tmp_path / "a"), _capture(tmp_path / "b", imu=True)
    assert not list(plain.glob("*.imu.csv"))
    assert len(list(with_imu.glob("*.imu.csv"))) == 2
    for name in ("gt/torso.tum", "poses/torso.tum", "gt/motion.bvh", "calib.json"):
        assert (plain / name).read_bytes() == (with_imu / name).read_bytes()


def test_words_and_bounds():
    assert SynthOptions(imu=True).imu == ImuOptions()
    assert SynthOptions(imu="consumer").imu == ImuOptions()
    assert SynthOptions(imu=False).imu is None
    assert SynthOptions(imu="perfect").imu.late_s == 0.0
    for wrong in ("best", {"rate": 3}, {"rate_hz": 0}, {"late_s": 9}):
        with pytest.raises(ValidationError):
            SynthOptions(imu=wrong)
