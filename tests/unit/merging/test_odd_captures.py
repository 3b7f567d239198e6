"""The merging stage on unusual captures: cameras never measured together, single frames, no scale."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging.body.bones import kinematic_chain
from bodycap_batch.merging.body.provisional_scale import reach_constraint
from bodycap_batch.merging.body_calibration import mount_calibration_graph
from bodycap_batch.merging.body_calibration.calibration_covariance import (
    error_modes,
    mounts_with_sigmas,
)
from bodycap_batch.merging.body_calibration.known_distance import known_distance
from bodycap_batch.merging.body_calibration.mount_calibration_graph import CalibrationGraph
from bodycap_batch.merging.body_calibration.samples import take_samples
from bodycap_batch.merging.body_calibration.scale import estimate_scale
from bodycap_batch.merging.cameras.track import inflate_sigmas, make_track
from bodycap_batch.merging.graph.motion_graph import MotionGraph
from bodycap_batch.merging.graph.windows import with_overlap
from bodycap_batch.merging.map_alignment.initial_alignment import require_common_time
from bodycap_batch.merging.world.planes import find_planes
from bodycap_batch.model.geometry import Similarity
from bodycap_batch.model.skeleton_presets import load_skeleton
from tests.stages.walker import ROLES, make_inputs, make_walk, record


@pytest.fixture(scope="module")
def walk():
    return make_walk(np.random.default_rng(3), off_deg=8.0, off_m=0.03)


@pytest.fixture(scope="module")
def recorded(walk):
    return [
        record(walk, name, np.random.default_rng(number), seconds=6.0) for number, name in enumerate(ROLES)
    ]


@pytest.fixture(scope="module")
def body(walk, recorded):
    """Inputs, bones, and each camera's track in metres."""
    inputs = make_inputs(walk, recorded)
    bones = kinematic_chain(walk.skeleton, set(ROLES.values()))
    index = {bone.role: place for place, bone in enumerate(bones)}
    return inputs, bones, [make_track(inputs, each, index[ROLES[each.camera]]) for each in recorded]


def _only(track, from_s, to_s):
    return track.keep((track.times_ns >= from_s * 1e9) & (track.times_ns < to_s * 1e9))


def test_a_camera_rarely_measured_with_the_others_is_sampled(body):
    trunk, left, right = body[2]
    samples = take_samples([trunk, _only(left, 0.0, 5.5), _only(right, 5.6, 6.0)], 1.0, 12)
    assert samples.valid[2].sum() >= 8
    assert samples.valid[1].sum() >= 10


def test_a_camera_never_measured_with_others_keeps_its_nominal_mount_and_its_sigma(body):
    inputs, bones, (trunk, left, right) = body
    tracks = [_only(trunk, 0.0, 3.0), _only(left, 0.0, 3.2), _only(right, 3.5, 6.0)]
    samples = take_samples(tracks, 1.0, 12)
    assert not samples.valid[2].any()
    mounts = {mount.camera: mount for mount in inputs.mounts}
    calibration = CalibrationGraph(inputs.skeleton, bones, samples, mounts, 1.0, lambda: None)
    assert np.isfinite(calibration.solve(1.0))
    usual = mounts["right_palm"].joint_from_cam
    assert np.abs(calibration.mounts["right_palm"] - usual).max() < 1e-3
    constant, _ = error_modes(calibration, 0.05, {name: np.zeros((4, 4)) for name in ROLES}, {})
    solved = {mount.camera: mount for mount in mounts_with_sigmas(calibration, constant)}
    loose = inflate_sigmas(tracks[2], solved["right_palm"])
    # 15 degrees in all, 8.7 per axis.
    assert (loose.sigma_rad > np.radians(8.6)).all()
    assert (loose.sigma_map > 0.039).all()
    assert inflate_sigmas(tracks[1], solved["left_palm"]) is tracks[1]
    turned = replace(solved["left_palm"], sigma_rad=np.radians(12.0), sigma_m=0.02)
    assert inflate_sigmas(tracks[1], turned) is tracks[1]


def test_bone_lengths_from_a_height_vary_on_both_sides_alike(body):
    inputs, bones, tracks = body
    samples = take_samples(tracks, 1.0, 12)
    mounts = {mount.camera: mount for mount in inputs.mounts}
    calibration = CalibrationGraph(inputs.skeleton, bones, samples, mounts, 1.0, lambda: None)
    calibration.solve(1.0)
    slope = {name: np.zeros((4, 4)) for name in ROLES}
    known, _ = error_modes(calibration, 0.01, slope, {})
    likely, transient = error_modes(calibration, 0.01, slope, {}, 1.75)
    assert not known.offsets_m.any()
    index = {bone.role: place for place, bone in enumerate(bones)}
    for side in ("Left", "Right"):
        hand = index[f"{side}Hand"]
        longer = likely.offsets_m[hand]
        assert np.linalg.norm(longer) == pytest.approx(0.04 * np.linalg.norm(bones[hand].offset_m))
    columns = [
        np.flatnonzero(np.abs(likely.offsets_m[index[f"{side}Hand"]]).sum(axis=0))
        for side in ("Left", "Right")
    ]
    assert columns[0].tolist() == columns[1].tolist()
    # A palm's mount follows a longer arm, which adds to its uncertainty.
    before, after = (np.linalg.norm(each.mounts["left_palm"][3:]) for each in (known, likely))
    assert before < after < 2.0 * before
    # Another placement of the joints is a transient mode.
    assert transient.offsets_m.any()


def test_a_camera_never_measured_with_the_reference_camera_is_sampled_with_another(body):
    trunk, left, right = body[2]
    samples = take_samples([_only(trunk, 0.0, 3.0), left, _only(right, 3.5, 6.0)], 1.0, 12)
    alone = ~samples.valid[0]
    assert (samples.valid[1:, alone]).all()
    assert samples.valid[2].sum() == alone.sum() == 10
    assert (np.diff(samples.times_ns) > 0).all()


def test_cameras_never_measured_together_are_refused(body):
    trunk, left, right = body[2]
    with pytest.raises(EstimationError, match="'torso' was localised together with another camera in only 0"):
        take_samples([_only(trunk, 0.0, 2.0), _only(left, 2.5, 4.0), _only(right, 4.5, 6.0)], 1.0, 12)


def test_a_t_pose_that_the_trunk_missed_adds_no_samples(body):
    trunk, left, _ = body[2]
    samples = take_samples([_only(trunk, 2.5, 6.0), left], 1.0, 12, None, (0, 2_000_000_000))
    assert len(samples.times_ns) == 12
    assert not samples.posture.t_pose.any()


def test_a_t_pose_is_no_gesture(body, monkeypatch):
    inputs, bones, tracks = body
    mounts = {mount.camera: mount for mount in inputs.mounts}
    samples = take_samples(tracks, 1.0, 12, None, (0, 2_000_000_000))
    posed = samples.posture.t_pose
    calibration = CalibrationGraph(inputs.skeleton, bones, samples, mounts, 1.0, lambda: None)
    calibration.solve(1.0, iterations=1)
    asked = []
    monkeypatch.setattr(
        mount_calibration_graph, "widen_joint_priors", lambda *args: asked.append(args[2:]) or bones
    )
    calibration.widen_joint_priors()
    ((poses, times_ns),) = asked
    assert 0 < len(times_ns) < len(posed)
    assert (times_ns == samples.times_ns[~posed]).all()
    assert (poses == calibration.poses()[~posed]).all()
    nothing_else = replace(samples.posture, t_pose=np.ones_like(posed))
    calibration.samples = replace(samples, posture=nothing_else)
    calibration.widen_joint_priors()
    assert len(asked) == 1


def test_frames_that_are_all_far_apart_are_a_start(walk, body):
    inputs, bones, (trunk, left, right) = body
    mounts = {mount.camera: mount.joint_from_cam for mount in inputs.mounts}
    sparse = right.keep(np.arange(len(right.times_ns)) % 10 == 3)
    one = left.keep(np.arange(len(left.times_ns)) == 20)
    graph = MotionGraph(walk.skeleton, bones, trunk.times_ns[:60] + 5_000_000, [trunk, one, sparse], mounts)
    assert np.isfinite(graph.solve(1, lambda: None).world_from_bone).all()


def test_bursts_are_no_common_walk(body):
    trunk, left, _ = body[2]
    require_common_time(trunk, [left])
    ends = left.keep((left.times_ns < 2.5e8) | (left.times_ns > 5.75e9))
    with pytest.raises(EstimationError, match="less than 4 s"):
        require_common_time(trunk, [ends])


class _Sliding:
    """A calibration graph with a cost that has no minimum."""

    def __init__(self):
        self.mounts = {"cam": np.eye(4)}

    def solve(self, scale):
        return 10.0 - float(np.log(scale))


def test_a_cost_without_minimum_leaves_the_scale_unknown():
    estimate = estimate_scale(_Sliding(), 1.0)
    assert estimate.sigma_log == 1.0
    assert np.isfinite(estimate.mount_slope["cam"]).all()


def test_a_known_distance_in_a_further_map_is_in_that_maps_units(body, recorded):
    inputs = replace(
        body[0],
        trajectories=tuple(
            replace(each, gauge="map-1") if each.camera == "right_palm" else each for each in recorded
        ),
    )
    asked = ("right_palm:0", "right_palm:90", 2.0)
    half = Similarity(0.5, np.eye(3), np.zeros(3))
    alone = known_distance(inputs.trajectories, asked, {"map-1": Similarity(1.0, np.eye(3), np.zeros(3))})
    placed = known_distance(inputs.trajectories, asked, {"map-0": half, "map-1": half})
    assert placed.scale == pytest.approx(2.0 * alone.scale)
    with pytest.raises(EstimationError, match="not aligned with the main map"):
        known_distance(inputs.trajectories, asked, {"map-0": half})


def test_a_swinging_upper_arm_does_not_say_where_the_other_arm_is():
    bones = kinematic_chain(load_skeleton("upper_body"), ("LeftArm", "LeftHand", "RightHand"))
    index = {bone.role: place for place, bone in enumerate(bones)}
    assert reach_constraint(bones, index["RightHand"], index["LeftArm"]) is None
    assert reach_constraint(bones, index["LeftHand"], index["LeftArm"]) is not None


@pytest.mark.slow
def test_planes_of_a_long_captures_map_take_little_memory():
    rng = np.random.default_rng(0)
    points = rng.uniform(0.0, 5.0, (60_000, 3))
    points[:40_000, 2] = 0.0
    tracemalloc.start()
    planes = find_planes(points, np.random.default_rng(0))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert abs(planes[0].normal[2]) > 0.999
    assert peak < 400e6


@pytest.mark.parametrize("fps", [30, 60, 120])
def test_stretches_share_three_seconds_at_any_rate(fps):
    ticks = np.round(np.arange(20 * fps) * 1e9 / fps).astype(np.int64)
    assert with_overlap(ticks, 8 * fps, 12 * fps) == (5 * fps, 15 * fps)
    assert with_overlap(ticks, 0, 19 * fps) == (0, 20 * fps)
