"""The alignment of maps without common views: initial values, derivatives of the residuals, results."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from bodycap_batch.merging.body.bones import kinematic_chain
from bodycap_batch.merging.body_calibration.calibration_covariance import (
    measurement_jacobian,
    scale_jacobian,
)
from bodycap_batch.merging.body_calibration.mount_calibration_graph import CalibrationGraph
from bodycap_batch.merging.body_calibration.samples import take_samples
from bodycap_batch.merging.cameras.track import make_track
from bodycap_batch.merging.graph.factors import mount_keys
from bodycap_batch.merging.map_alignment.align import align_cameras
from bodycap_batch.merging.map_alignment.initial_alignment import align_map
from bodycap_batch.model.geometry import Similarity, so3_exp
from bodycap_batch.synthetic import SynthOptions
from tests.bench.joining import run_case
from tests.bench.posed import posed
from tests.bench.simulation import ARMS, PALMS
from tests.calibrations import calibration_of
from tests.stages.walker import ROLES, make_inputs, make_walk, record

FURTHER = Similarity(1.7, so3_exp([0.4, 1.1, -0.3]), np.array([0.5, -3.0, 1.0]))
"""further_from_main, where the main map is metric."""


@pytest.fixture(scope="module")
def walk():
    return make_walk(np.random.default_rng(3), off_deg=8.0, off_m=0.03)


@pytest.fixture(scope="module")
def recorded(walk):
    """Return twelve seconds of three cameras, the right palm's in a separate map."""
    out = []
    for number, name in enumerate(ROLES):
        gauge = FURTHER if name == "right_palm" else None
        path = record(walk, name, np.random.default_rng(number), seconds=12.0, gauge=gauge)
        out.append(replace(path, gauge="map-1") if gauge else path)
    return out


def _tracks(walk, recorded):
    inputs = make_inputs(walk, recorded)
    bones = kinematic_chain(walk.skeleton, set(ROLES.values()))
    index = {bone.role: place for place, bone in enumerate(bones)}
    return inputs, bones, [make_track(inputs, each, index[ROLES[each.camera]]) for each in recorded]


@pytest.fixture(scope="module")
def arms():
    """Five cameras in one map: samples of five a second, their calibration, metres per map unit."""
    return calibration_of(SynthOptions(seconds=12.0, cameras=ARMS, outliers=0.0, poses_only=True))


def _off_m(place: Similarity, track) -> float:
    """Return the median distance (m) of a track from its true position in the main map."""
    true = FURTHER.inverse().apply(track.map_from_cam[:, :3, 3])
    return float(np.median(np.linalg.norm(place.apply(track.map_from_cam[:, :3, 3]) - true, axis=1)))


def test_similarities_chain():
    first = Similarity(0.5, so3_exp([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 3.0]))
    x = np.array([[0.3, -0.2, 5.0]])
    assert_allclose(FURTHER.after(first).apply(x), FURTHER.apply(first.apply(x)))
    assert_allclose(FURTHER.after(FURTHER.inverse()).apply(x), x)


def test_the_path_and_the_rest_pose_give_initial_values(walk, recorded):
    inputs, bones, tracks = _tracks(walk, recorded)
    mounts = {mount.camera: mount for mount in inputs.mounts}
    start = align_map(bones, tracks[0], [tracks[2]], mounts, 1.0)
    # A palm moves by about half an upper arm from its rest pose; the path is a few metres long.
    assert _off_m(start, tracks[2]) < 0.25
    assert start.scale * FURTHER.scale == pytest.approx(1.0, abs=0.1)


def test_residuals_follow_moved_cameras_as_predicted(walk, recorded):
    inputs, bones, tracks = _tracks(walk, recorded[:2])
    mounts = {mount.camera: mount for mount in inputs.mounts}
    samples = take_samples(tracks, 1.0, 12)
    calibration = CalibrationGraph(inputs.skeleton, bones, samples, mounts, 1.0, lambda: None)
    calibration.solve(1.0)
    before = calibration.linearised().linear
    twist = np.array([0.3, -0.2, 0.5, 0.1, 0.4, -0.3]) * 1e-5
    directions = np.zeros((*samples.valid.shape, 1, 6))
    directions[1, :, 0] = twist
    predicted = measurement_jacobian(calibration, before, directions)[:, 0]
    poses = samples.map_from_cam.copy()
    poses[1, :, :3, :3] = so3_exp(twist[:3]) @ poses[1, :, :3, :3]
    poses[1, :, :3, 3] += twist[3:]
    calibration.samples = replace(samples, map_from_cam=poses)
    after = calibration.linearised().linear
    # The right-hand side changes with the movement; robust weights change in second order.
    assert np.abs(predicted).max() > 1e-4
    assert_allclose(after.rhs - before.rhs, predicted, atol=0.15 * np.abs(predicted).max())


def test_the_cost_follows_the_scale_as_predicted(arms):
    samples, calibration, metric = arms
    before, after = (calibration.solve(metric * float(np.exp(step))) for step in (-0.005, 0.005))
    calibration.solve(metric)
    mounts = calibration.linearised()
    directions = np.zeros((*samples.valid.shape, 1, 6))
    directions[..., 0, 3:] = metric * samples.map_from_cam[..., :3, 3]
    follow = measurement_jacobian(calibration, mounts.linear, directions)[:, 0]
    right, shrink = mounts.linear.rhs, scale_jacobian(calibration, mounts)
    # The cost is half the sum of squares, and all else is at its minimum: solves end within 1e-5 of theirs.
    end = 1e-5 * before / 0.01
    assert right @ (follow + shrink) == pytest.approx((after - before) / 0.01, abs=2.0 * end)
    assert abs(right @ shrink) > 20.0 * end


def test_errors_that_samples_share_do_not_count_in_an_alignment():
    samples, calibration, _ = calibration_of(SynthOptions(seconds=4.0, cameras=PALMS, poses_only=True))
    # Samples share the errors of the map, so that they are weighted down in the calibration of one map.
    assert samples.correlated_samples > 1.5
    calibration.leave_out_map_errors()
    found = calibration.samples
    assert_allclose(found.sigma_map, np.sqrt(samples.white_noise_share) * samples.sigma_map)
    assert_allclose(found.sigma_rad, np.sqrt(samples.white_noise_share) * samples.sigma_rad)
    assert found.white_noise_share == 1.0


def test_a_mount_that_its_camera_names_is_known_better_than_its_prior_says(arms):
    """Without it, calibrated palms had the sigma of uncalibrated ones, and their paths were not followed."""
    samples, calibration, metric = arms
    inputs = posed(SynthOptions(seconds=1.0, cameras=ARMS, poses_only=True)).inputs
    calibration.solve(metric)
    mounts = calibration.linearised()
    of_mounts = np.abs(mounts.row_variances() - 1.0 / 3.0) < 1e-9
    # 15 degrees an axis against 15 in all; three differences of three rows for each of five cameras.
    assert of_mounts.sum() == 5 * 9
    assert mounts.linear.matrix[of_mounts][:, : mounts.linear.columns[mount_keys(0)[0]]].nnz == 0
    # A job that knows it to 20 degrees only has said so, and no name.
    told = {
        mount.camera: replace(mount, sigma_rad=np.radians(20.0), by_name=False) for mount in inputs.mounts
    }
    stated = CalibrationGraph(inputs.skeleton, mounts.body.bones, samples, told, metric, lambda: None)
    stated.solve(metric, iterations=1)
    assert not (np.abs(stated.linearised().row_variances() - 1.0 / 3.0) < 1e-9).any()


@pytest.mark.slow
def test_a_walks_arms_are_placed():
    outcome = run_case("an arm each", 3, seconds=1000 / 30)
    assert not outcome["refused"]
    # All but a centimetre is the error of the camera's height above the shoulders: 1.5 cm, twice.
    assert max(outcome["off_m"].values()) < 0.03


@pytest.mark.slow
def test_a_palms_map_is_placed_or_refused_by_its_sigma(walk, recorded):
    inputs = make_inputs(walk, recorded)
    together = align_cameras(inputs, recorded[:2], recorded[2:], lambda: None)
    if "map-1" in together.main_from_gauge:
        turn, shift = together.sigmas["right_palm"]
        assert 0.0 < turn < np.radians(15.0)
        # The stated sigma in three dimensions, three times.
        assert _off_m(together.main_from_gauge["map-1"], make_track(inputs, recorded[2], 0)) < 9.0 * shift
        assert [each.gauge for each in together.trajectories] == ["map-0"] * 3
    else:
        assert "could not align the two maps" in together.unused["right_palm"]


def test_a_map_that_fits_no_person_is_left_out_with_the_reason(walk, recorded):
    far = replace(recorded[2], gauge_from_cam=recorded[2].gauge_from_cam[:, [1, 0, 2, 3]])
    lost = replace(far, times_ns=far.times_ns + 10**12)
    together = align_cameras(make_inputs(walk, recorded), recorded[:2], [lost], lambda: None)
    assert list(together.main_from_gauge) == ["map-0"]
    assert "map-1" in together.unused["right_palm"]
    assert len(together.trajectories) == 2


def test_a_map_whose_alignment_diverges_is_left_out_with_the_reason(walk, recorded, monkeypatch):
    def diverge(*_, **__):
        raise np.linalg.LinAlgError("SVD did not converge")

    monkeypatch.setattr(CalibrationGraph, "solve", diverge)
    together = align_cameras(make_inputs(walk, recorded), recorded[:2], recorded[2:], lambda: None)
    assert list(together.main_from_gauge) == ["map-0"]
    assert "does not determine the position of this map" in together.unused["right_palm"]


def test_without_further_maps_nothing_changes(walk, recorded):
    together = align_cameras(make_inputs(walk, recorded[:2]), recorded[:2], [], lambda: None)
    assert together.trajectories == tuple(recorded[:2])
    assert together.main_from_gauge["map-0"].scale == 1.0
    assert not together.unused
