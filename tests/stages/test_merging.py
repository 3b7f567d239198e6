"""The merging stage on a simulated walk: accuracy, clocks, gauges, gaps, gross errors, refusals."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import Cancelled, EstimationError
from bodycap_batch.inertial import align_sensor, force_windows
from bodycap_batch.merging import merge_trajectories
from bodycap_batch.merging.body.bones import kinematic_chain
from bodycap_batch.merging.cameras.camera_axes import with_axes_of_cameras
from bodycap_batch.merging.cameras.track import make_track
from bodycap_batch.merging.graph.motion_graph import MotionGraph, MotionSolution
from bodycap_batch.merging.graph.windows import solve_windows, split_timeline
from bodycap_batch.merging.stage import timeline
from bodycap_batch.model.camera_clock import CameraClock
from bodycap_batch.model.geometry import Similarity, align_points, make_transform, so3_exp, transform_points
from bodycap_batch.model.inertial_camera import ForceWindows
from bodycap_batch.model.merge_data import BoardView, MergeResult
from bodycap_batch.model.picture_turns import PictureTurns
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.synthetic import SynthOptions
from bodycap_batch.synthetic.stabilisation import turn_of_pictures
from bodycap_batch.telemetry.picture_orientation import unrecorded_turns
from bodycap_batch.telemetry.streams import CameraTelemetry
from tests.bench.posed import posed
from tests.inertial import Sensor
from tests.stages.walker import FPS, ROLES, Walk, make_inputs, make_walk, record

GAUGE = Similarity(0.37, Rotation.from_rotvec([1.0, -0.7, 0.4]).as_matrix(), np.array([2.0, -1.0, 0.5]))

TWIN = {"LeftForeArm": "RightForeArm", "LeftHand": "RightHand", "RightArm": "LeftArm", "Spine1": "Spine1"}


@pytest.fixture(scope="module")
def context(tmp_path_factory) -> StageContext:
    return StageContext(work_dir=tmp_path_factory.mktemp("merging"))


@pytest.fixture(scope="module")
def walk() -> Walk:
    return make_walk(np.random.default_rng(1), off_deg=6.0, off_m=0.015)


@pytest.fixture(scope="module")
def base(walk, context) -> MergeResult:
    return merge_trajectories(make_inputs(walk, _recorded(walk)), MergeOptions(), context)


def _recorded(walk: Walk, gauge: Similarity = GAUGE, **changes: dict) -> list:
    rng = np.random.default_rng(7)
    return [record(walk, name, rng, gauge=gauge, **changes.get(name, {})) for name in ROLES]


def _known(walk: Walk) -> dict:
    mounts = tuple(
        replace(mount, sigma_rad=np.radians(0.5), sigma_m=0.003, by_name=False)
        for mount in walk.mounts.values()
    )
    return {"mounts": mounts}


def _relative(result: MergeResult, camera: str) -> np.ndarray:
    """(T,3) a hand's camera in the torso camera's frame, from the solved joints and mounts."""
    mounts = {mount.camera: mount for mount in result.mounts}
    roles = result.skeleton.roles
    torso, palm = (
        result.graph_world_from_joint[:, roles.index(ROLES[name])] @ mounts[name].joint_from_cam
        for name in ("torso", camera)
    )
    return np.linalg.solve(torso, palm)[:, :3, 3]


def _true_relative(walk: Walk, result: MergeResult, camera: str) -> np.ndarray:
    seconds = result.times_ns() * 1e-9
    return np.linalg.solve(walk.camera("torso", seconds), walk.camera(camera, seconds))[:, :3, 3]


def _palm_error_m(walk: Walk, result: MergeResult, camera: str = "left_palm") -> np.ndarray:
    return np.linalg.norm(_relative(result, camera) - _true_relative(walk, result, camera), axis=1)


def test_known_mounts_give_scale_and_palms(walk, context):
    result = merge_trajectories(make_inputs(walk, _recorded(walk), **_known(walk)), MergeOptions(), context)
    # The stated sigma is 3 % for this short walk. A palm is 0.6 m from the chest; joints have 5 mm of slack.
    sigma = result.report.scale.relative_sigma
    assert 0.005 < sigma < 0.05
    assert result.world_from_map["map-0"].scale == pytest.approx(1.0 / GAUGE.scale, rel=2.0 * sigma)
    for camera in ("left_palm", "right_palm"):
        assert _palm_error_m(walk, result, camera).mean() < 0.6 * 2.0 * sigma + 0.005
    elbow = result.skeleton.roles.index("LeftForeArm")
    moved = align_points(
        result.graph_world_from_joint[:, 0, :3, 3],
        walk.joints(result.times_ns() * 1e-9)[:, 0, :3, 3],
        with_scale=False,
    )
    assert moved.rotation[2, 2] > np.cos(np.radians(10.0))
    assert result.solved[elbow]
    assert not result.solved[0]


def test_nominal_mounts_are_solved_towards_the_truth(walk, base):
    for mount in base.mounts:
        truth = walk.mounts[mount.camera].joint_from_cam
        off = np.linalg.norm(mount.joint_from_cam[:3, 3] - truth[:3, 3])
        # Three stated sigmas, over three axes.
        assert off < 3.0 * np.sqrt(3.0) * mount.sigma_m
        assert 0.005 < mount.sigma_m <= 0.08
    sigma = base.report.scale.relative_sigma
    assert 0.02 < sigma < 0.15
    assert base.world_from_map["map-0"].scale == pytest.approx(1.0 / GAUGE.scale, rel=2.0 * sigma)


def test_world_is_upright_on_the_floor_and_faces_the_first_second(base):
    hips = base.graph_world_from_joint[:, 0]
    assert_allclose(hips[0, :2, 3], 0.0, atol=1e-9)
    # Without a map's floor the hips walk at 0.97 of their standing height, 0.53 of 1.75 m.
    assert np.median(hips[:, 2, 3]) == pytest.approx(0.97 * 0.53 * 1.75, abs=1e-6)
    forward = -hips[: int(FPS), :3, 1].mean(axis=0)
    assert forward[1] < -0.9
    head, foot = (base.skeleton.roles.index(role) for role in ("Head", "LeftFoot"))
    assert (base.graph_world_from_joint[:, head, 2, 3] > 1.3).all()
    assert (np.abs(base.graph_world_from_joint[:, foot, 2, 3]) < 0.2).all()


@pytest.mark.slow
@pytest.mark.parametrize("bend_deg", [35.0, 80.0])
def test_a_bent_person_is_upright_with_accelerometers(context, bend_deg):
    """Without walls, floor and walk, the body alone is wrong by tens of degrees."""
    upright = make_walk(np.random.default_rng(1))
    bent = Bent(upright.skeleton, upright.mounts, float(np.radians(bend_deg)))
    rng = np.random.default_rng(7)
    paths = [record(bent, name, rng, gauge=GAUGE, seconds=BENT_S) for name in ROLES]
    windows = {path.camera: _force_windows(bent, path) for path in paths}
    inputs = make_inputs(bent, paths)
    plain, measured = (
        merge_trajectories(each, MergeOptions(), context)
        for each in (inputs, replace(inputs, force_windows=windows))
    )
    off_deg = [_tilt_deg(each) for each in (plain, measured)]
    assert off_deg[0] > 10.0
    assert off_deg[1] < 1.0
    assert measured.report.up.source == "accelerometers"
    assert measured.report.up.sigma_deg < 1.0
    assert off_deg[1] < 3.0 * measured.report.up.sigma_deg


BENT_S = 5.0


@dataclass(frozen=True)
class Bent(Walk):
    """The same person on the spot, who turns to both sides and bends forward all the time."""

    bend_rad: float

    def joints(self, seconds: np.ndarray) -> np.ndarray:
        """Return world_from_joint (T,J,4,4) at any times (T,)."""
        joints = Walk.joints(self, seconds)
        turn = so3_exp(np.outer(0.9 * np.sin(0.5 * seconds), [0.0, 0.0, 1.0]))
        bend = turn @ so3_exp([self.bend_rad, 0.0, 0.0]) @ np.swapaxes(turn, 1, 2)
        moved = joints[..., :3, 3] - joints[:, :1, :3, 3]
        return make_transform(bend[:, None] @ joints[..., :3, :3], np.einsum("tij,tkj->tki", bend, moved))


@dataclass(frozen=True)
class Carried:
    """A camera that a person carries."""

    walk: Walk
    name: str

    def poses(self, times_s: np.ndarray) -> np.ndarray:
        """Return world_from_cam (T,4,4)."""
        return self.walk.camera(self.name, times_s)


def _tilt_deg(result: MergeResult) -> float:
    up = result.world_from_map["map-0"].rotation @ GAUGE.rotation[:, 2]
    return float(np.degrees(np.arccos(np.clip(up[2], -1.0, 1.0))))


def _force_windows(walk: Walk, path: Trajectory) -> ForceWindows:
    """Return what a consumer's sensor on the camera measures."""
    telemetry = Sensor().samples(Carried(walk, path.camera), BENT_S, seed=list(ROLES).index(path.camera))
    aligned = align_sensor(path, telemetry)
    assert aligned.fit is not None
    assert aligned.samples is not None
    return force_windows(path, aligned.samples, aligned.fit.rotation_sigma_rad)


def test_another_gauge_gives_the_same_motion(walk, base, context):
    other = Similarity(8.0, Rotation.from_rotvec([-2.0, 0.3, 1.0]).as_matrix(), np.array([-30.0, 5.0, 1.0]))
    result = merge_trajectories(make_inputs(walk, _recorded(walk, gauge=other)), MergeOptions(), context)
    # Only rounding differs; the optimiser stops at a relative decrease of 1e-5.
    assert_allclose(
        result.graph_world_from_joint[..., :3, 3], base.graph_world_from_joint[..., :3, 3], atol=2e-3
    )
    ratio = result.world_from_map["map-0"].scale / base.world_from_map["map-0"].scale
    assert ratio == pytest.approx(GAUGE.scale / other.scale, rel=2e-3)


def test_a_mirrored_walk_gives_the_mirrored_motion(walk, base, context):
    flip = np.diag([-1.0, 1.0, 1.0, 1.0])
    swap = {"torso": "torso", "left_palm": "right_palm", "right_palm": "left_palm"}
    mirrored = [
        replace(
            each,
            camera=swap[each.camera],
            gauge_from_cam=flip @ each.gauge_from_cam @ flip,
        )
        for each in _recorded(walk)
    ]
    result = merge_trajectories(make_inputs(walk, mirrored), MergeOptions(), context)
    roles = result.skeleton.roles
    for role, other in TWIN.items():
        mine = result.graph_world_from_joint[:, roles.index(role), :3, 3]
        twin = base.graph_world_from_joint[:, roles.index(other), :3, 3]
        # Rounding and the stopping rule again.
        assert_allclose(mine * [-1.0, 1.0, 1.0], twin, atol=3e-3)


def test_a_clock_offset_has_the_documented_sign(walk, context):
    # The left palm's own clock runs 0.12 s behind: common time = camera time + 0.12.
    recorded = _recorded(walk, left_palm={"shift_s": 0.12})
    clocks = {name: CameraClock(nominal_fps=FPS) for name in ROLES}
    clocks["left_palm"] = CameraClock(nominal_fps=FPS, offset_s=0.12)
    result = merge_trajectories(
        make_inputs(walk, recorded, clocks=clocks, **_known(walk)), MergeOptions(), context
    )
    # As with no offset at all. With the wrong sign the hand is taken 0.24 s away, at 1 m/s in the room.
    assert _palm_error_m(walk, result)[10:75].mean() < 0.03
    hand = _true_relative(walk, result, "left_palm")
    late = round(0.24 * FPS)
    assert np.linalg.norm(hand[late:] - hand[:-late], axis=1).mean() > 0.1


def test_the_motion_begins_when_all_cameras_that_were_started_by_hand_run(walk, context):
    recorded = _recorded(walk, left_palm={"shift_s": 0.5})
    clocks = {name: CameraClock(nominal_fps=FPS) for name in ROLES}
    clocks["left_palm"] = CameraClock(nominal_fps=FPS, offset_s=0.5, sigma_s=0.002, source="sound")
    result = merge_trajectories(
        make_inputs(walk, recorded, clocks=clocks, **_known(walk)), MergeOptions(), context
    )
    whole_s = 1e-9 * (recorded[0].times_ns[-1] - recorded[0].times_ns[0])
    times_s = result.times_ns() * 1e-9
    assert times_s[0] == pytest.approx(0.5, abs=0.01)
    assert times_s[-1] == pytest.approx(whole_s, abs=0.05)
    assert {path.camera: len(path.status) for path in result.trajectories} == {
        path.camera: len(path.status) for path in recorded
    }
    gaps = {name: camera.longest_gap_s for name, camera in result.report.cameras.items()}
    assert max(gaps.values()) < 0.2
    stated = {**clocks, "left_palm": replace(clocks["left_palm"], source="stated")}
    whole_ns = timeline(stated, recorded, FPS)
    assert 1e-9 * whole_ns[[0, -1]] == pytest.approx([0.0, whole_s + 0.5], abs=0.05)


def test_frames_between_ticks_are_not_moved_onto_them(walk, base, context):
    # 11 ms late, as webcams without genlock: at 2 m/s a frame pulled to its tick would be 2 cm off.
    recorded = _recorded(walk, left_palm={"shift_s": 0.011})
    clocks = {
        name: CameraClock(nominal_fps=FPS, offset_s=0.011 if name == "left_palm" else 0.0) for name in ROLES
    }
    result = merge_trajectories(make_inputs(walk, recorded, clocks=clocks), MergeOptions(), context)
    assert_allclose(_relative(result, "left_palm")[5:-5], _relative(base, "left_palm")[5:-5], atol=0.012)


def test_a_short_gap_is_filled_and_a_long_one_marked(walk, context):
    recorded = _recorded(walk, left_palm={"lost": (1.0, 1.4)}, right_palm={"lost": (1.0, 2.4)})
    result = merge_trajectories(make_inputs(walk, recorded, **_known(walk)), MergeOptions(), context)
    roles = result.skeleton.roles
    seconds = result.times_ns() * 1e-9
    short, long = (seconds > 1.02) & (seconds < 1.38), (seconds > 1.02) & (seconds < 2.38)
    assert result.observed[short, roles.index("LeftHand")].all()
    assert not result.observed[long, roles.index("RightHand")].any()
    assert result.observed[seconds < 1.0, roles.index("RightHand")].all()
    assert result.observed[:, roles.index("Spine1")].all()
    assert not result.observed[:, roles.index("LeftLeg")].any()
    # Half a swing is lost: the arm cannot be further off than the swing is wide.
    assert _palm_error_m(walk, result)[short].max() < 0.25


def test_gross_errors_do_not_move_the_body(walk, base, context):
    rng = np.random.default_rng(3)
    recorded = []
    for each in _recorded(walk):
        poses = each.gauge_from_cam.copy()
        for start in (17, 43, 70):
            burst = slice(start, start + 2)
            poses[burst, :3, 3] += GAUGE.scale * rng.uniform(0.3, 1.0) * np.array([1.0, -1.0, 0.5])
        recorded.append(replace(each, gauge_from_cam=poses))
    result = merge_trajectories(make_inputs(walk, recorded), MergeOptions(), context)
    # 18 of 270 poses, 7 %, are wrong by 0.45 to 1.5 m. The others must give the result to a fraction of that.
    assert np.abs(_relative(result, "left_palm") - _relative(base, "left_palm")).max() < 0.04
    dropped = [camera.dropped_as_gross_errors for camera in result.report.cameras.values()]
    assert all(6 <= count <= 10 for count in dropped)
    for trajectory, count in zip(result.trajectories, dropped, strict=True):
        refused = np.array([status is FrameStatus.POSE_JUMP for status in trajectory.status])
        assert refused.sum() == count
        assert refused[[17, 18, 43, 44, 70, 71]].all()
        assert np.isnan(trajectory.gauge_from_cam[refused]).all()


def test_world_trajectories_have_poses_and_metric_covariance(walk, context):
    measured = MergeOptions(camera_paths="measured")
    result = merge_trajectories(make_inputs(walk, _recorded(walk)), measured, context)
    place = result.world_from_map["map-0"]
    for before, after in zip(
        _recorded(walk), sorted(result.trajectories, key=lambda e: list(ROLES).index(e.camera)), strict=True
    ):
        assert after.gauge == "world"
        assert_allclose(after.gauge_from_cam, place.apply_to_poses(before.gauge_from_cam))
        assert_allclose(after.covariance[:, :3, :3], before.covariance[:, :3, :3])
        assert_allclose(after.covariance[:, 3:, 3:], place.scale**2 * before.covariance[:, 3:, 3:])


def test_cameras_solved_with_the_body_are_nearer_to_the_truth_than_measured(walk, base):
    place = base.world_from_map["map-0"]
    for before in _recorded(walk):
        after = next(each for each in base.trajectories if each.camera == before.camera)
        measured = place.apply_to_poses(before.gauge_from_cam)
        exact = place.after(GAUGE).apply_to_poses(walk.camera(before.camera, before.times_ns * 1e-9))
        off, noise = (
            np.sqrt(((poses - exact)[:, :3, 3] ** 2).sum(axis=1).mean())
            for poses in (after.gauge_from_cam, measured)
        )
        # With white noise and a smooth motion, at least three frames determine a centre (1/sqrt(3) is 0.58).
        assert off < 0.8 * noise
        assert_allclose(after.gauge_from_cam[:, :3, :3], measured[:, :3, :3], atol=1e-9)


def test_a_camera_of_another_map_is_named_not_used(walk, context):
    recorded = _recorded(walk)
    recorded[2] = replace(recorded[2], gauge="map-1")
    result = merge_trajectories(make_inputs(walk, recorded), MergeOptions(), context)
    assert list(result.unused_cameras) == ["right_palm"]
    assert "map-1" in result.unused_cameras["right_palm"]
    assert {each.camera for each in result.trajectories} == {"torso", "left_palm"}
    assert not result.solved[result.skeleton.roles.index("RightHand")]


def test_a_lost_torso_is_refused_with_numbers(walk, context):
    recorded = _recorded(walk, torso={"lost": (0.2, 9.0)})
    with pytest.raises(EstimationError, match=r"'torso': only 6 of 90 frames were localised"):
        merge_trajectories(make_inputs(walk, recorded), MergeOptions(), context)


@pytest.mark.parametrize("kept", [6, pytest.param(24, marks=pytest.mark.slow)])
def test_the_head_is_the_reference_if_the_torso_is_lost(tmp_path, kept):
    cameras = ("torso", "head", "left_palm", "right_palm")
    capture = posed(SynthOptions(seconds=5.0, cameras=cameras, seed=5, poses_only=True))
    trajectories = list(capture.inputs.trajectories)
    seen = np.flatnonzero(trajectories[0].localised)[:kept]
    lost = np.setdiff1d(np.arange(len(trajectories[0].status)), seen)
    poses = np.array(trajectories[0].gauge_from_cam)
    poses[lost] = np.nan
    status = [FrameStatus.FEW_TRACKS] * len(poses)
    for frame in seen.tolist():
        status[frame] = trajectories[0].status[frame]
    trajectories[0] = replace(trajectories[0], gauge_from_cam=poses, status=tuple(status))
    context = StageContext(work_dir=tmp_path)
    result = merge_trajectories(
        replace(capture.inputs, trajectories=tuple(trajectories)), MergeOptions(), context
    )
    assert ("torso" in result.unused_cameras) is (kept < 15)
    assert result.mounts[0].camera == "head"
    roles = result.skeleton.roles
    true = capture.world_from_joint()[..., :3, 3]
    mine = result.graph_world_from_joint[: len(true), ..., :3, 3]
    joints = [roles.index(role) for role in ("Head", "LeftHand", "RightHand", "LeftArm")]
    placed = align_points(mine[:, joints].reshape(-1, 3), true[:, joints].reshape(-1, 3), with_scale=False)
    off = np.linalg.norm(placed.apply(mine[:, joints]) - true[:, joints], axis=-1)
    # Five seconds with nominal mounts state some 6 % of scale and 3 cm of mount: of an arm's length, 5 cm.
    assert off.mean() < 0.08
    assert result.world_from_map["map-0"].scale * capture.gauges["map-0"].scale == pytest.approx(
        1.0, abs=2.0 * result.report.scale.relative_sigma
    )


def test_one_camera_has_no_scale(walk, context):
    with pytest.raises(EstimationError, match="no two cameras"):
        merge_trajectories(make_inputs(walk, _recorded(walk)[:1]), MergeOptions(), context)


def test_stops_between_iterations(walk, tmp_path):
    steps = []
    context = StageContext(
        work_dir=tmp_path,
        progress=lambda done, total, what: steps.append((done, total)),
        cancelled=lambda: len(steps) > 3,
    )
    with pytest.raises(Cancelled):
        merge_trajectories(make_inputs(walk, _recorded(walk)), MergeOptions(), context)
    assert len(steps) == 4


def test_same_inputs_same_result(walk, base, context):
    again = merge_trajectories(make_inputs(walk, _recorded(walk)), MergeOptions(), context)
    assert (again.graph_world_from_joint == base.graph_world_from_joint).all()
    assert again.report == base.report


def test_two_cameras_with_nearly_equal_times_share_a_state(walk, context):
    # Two torso cameras are 12.0 and 12.4 ms behind the ticks. Two states that close would be singular.
    recorded = _recorded(walk, torso={"shift_s": 0.0120}, left_palm={"shift_s": 0.0})
    twin = replace(
        record(walk, "torso", np.random.default_rng(9), gauge=GAUGE, shift_s=0.0124), camera="torso_2"
    )
    mounts = (*make_inputs(walk, recorded).mounts, replace(walk.mounts["torso"], camera="torso_2"))
    clocks = {name: CameraClock(nominal_fps=FPS) for name in ROLES}
    clocks["torso"] = CameraClock(nominal_fps=FPS, offset_s=0.0120)
    clocks["torso_2"] = CameraClock(nominal_fps=FPS, offset_s=0.0124)
    result = merge_trajectories(
        make_inputs(walk, [*recorded, twin], mounts=mounts, clocks=clocks), MergeOptions(), context
    )
    assert np.isfinite(result.graph_world_from_joint).all()
    assert result.report.cameras["torso_2"].residual_m.p50 < 0.01


def test_windows_of_a_long_capture_join_without_a_discontinuity(walk):
    recorded = _recorded(walk, **{name: {"seconds": 7.0} for name in ROLES})
    bones = kinematic_chain(walk.skeleton, set(ROLES.values()))
    index = {bone.role: position for position, bone in enumerate(bones)}
    inputs = make_inputs(walk, recorded)
    tracks = []
    for each in recorded:
        track = make_track(inputs, each, index[ROLES[each.camera]])
        poses = track.map_from_cam.copy()
        poses[:, :3, 3] /= GAUGE.scale
        tracks.append(replace(track, map_from_cam=poses, sigma_map=track.sigma_map / GAUGE.scale))
    ticks = tracks[0].times_ns
    mounts = {name: mount.joint_from_cam for name, mount in walk.mounts.items()}

    def solve(window_ticks: int) -> MotionSolution:
        return solve_windows(
            lambda times, seen: MotionGraph(walk.skeleton, bones, times, seen, mounts),
            ticks,
            tracks,
            lambda: None,
            window_ticks=window_ticks,
        )

    whole, pieces = solve(1000), solve(70)
    # Three windows. Measurements 3 s away have no weight; the tolerance is that of the stopping rule.
    assert_allclose(pieces.world_from_bone[..., :3, 3], whole.world_from_bone[..., :3, 3], atol=1e-3)
    for camera, residuals in whole.residuals.items():
        assert_allclose(pieces.residuals[camera].distance_m, residuals.distance_m, atol=1e-3)
    assert split_timeline(ticks, tracks, 70) == [(0, 70), (70, 140), (140, 210)]
    assert split_timeline(ticks, [tracks[0].keep(np.arange(210) < 20)], 70) == [(0, 210)]


def _turned(walk: Walk, path: Trajectory, *, recorded: bool) -> tuple[Trajectory, PictureTurns]:
    """Return the path of a camera that stabilises its pictures, and what is known about their turns."""
    turns = turn_of_pictures(lambda seconds: walk.camera(path.camera, seconds), path.seconds)
    exact = PictureTurns(mode="", cam_from_picture=turns, sigma_rad=np.zeros(len(turns)))
    unknown = unrecorded_turns(CameraTelemetry(stabilisation="on"), len(turns))
    return exact.picture_path(path), exact if recorded else unknown


@pytest.mark.parametrize("recorded", [True, False])
def test_stabilised_pictures(walk, base, context, recorded):
    found = [_turned(walk, path, recorded=recorded) for path in _recorded(walk)]
    turns = {path.camera: each for path, each in found}
    inputs = make_inputs(walk, [path for path, _ in found], picture_turns=turns)
    result = merge_trajectories(inputs, MergeOptions(), context)
    # The paths of the result have the axes of the pictures, as the inputs.
    for path, before in zip(result.trajectories, inputs.trajectories, strict=True):
        to_world = result.world_from_map[before.gauge].rotation
        assert_allclose(
            path.gauge_from_cam[:, :3, :3], to_world @ before.gauge_from_cam[:, :3, :3], atol=1e-9
        )
        assert_allclose(path.covariance[:, :3, :3], before.covariance[:, :3, :3], atol=1e-9)
    sigma, usual = (
        np.nanmedian(each.joint_sigma_m()[:, each.observed.any(axis=0)], axis=0) for each in (result, base)
    )
    if recorded:
        assert_allclose(result.graph_world_from_joint, base.graph_world_from_joint, atol=1e-4)
        assert_allclose(sigma, usual, atol=1e-4)
        return
    # The mounts have slack: joints are less certain. Nominal mounts and the scale give most of their sigma.
    moving = usual > 0.0
    assert (sigma[moving] > usual[moving]).all()
    assert (sigma[moving] / usual[moving]).max() > 1.03
    # The sigma covers the error.
    for camera in ("left_palm", "right_palm"):
        palm = result.skeleton.roles.index(ROLES[camera])
        # Three sigmas over three axes.
        assert _palm_error_m(walk, result, camera).mean() < 3.0 * np.sqrt(3.0) * np.nanmedian(
            result.joint_sigma_m()[:, palm]
        )


def test_a_board_in_a_turned_picture_is_where_it_was():
    rng = np.random.default_rng(4)
    board = rng.uniform(-0.3, 0.3, (20, 3)) * [1.0, 1.0, 0.0]
    cam_from_board = make_transform(so3_exp([0.2, -0.1, 0.3]), np.array([0.1, -0.2, 1.5]))
    cam_from_picture = so3_exp([0.05, -0.08, 0.06])
    picture_from_board = make_transform(cam_from_picture.T, np.zeros(3)) @ cam_from_board
    in_cam, in_picture = (transform_points(pose, board) for pose in (cam_from_board, picture_from_board))
    path = record(make_walk(rng), "torso", rng)
    count = len(path.status)
    view = BoardView(
        camera="torso",
        frame=7,
        board_m=board,
        rays=in_picture[:, :2] / in_picture[:, 2:],
        cam_from_board=picture_from_board,
    )
    turns = PictureTurns(
        mode="", cam_from_picture=np.tile(cam_from_picture, (count, 1, 1)), sigma_rad=np.zeros(count)
    )
    inputs = make_inputs(make_walk(rng), [path], board_views=(view,), picture_turns={"torso": turns})
    (turned,) = with_axes_of_cameras(inputs).board_views
    assert_allclose(turned.cam_from_board, cam_from_board, atol=1e-12)
    assert_allclose(turned.rays, in_cam[:, :2] / in_cam[:, 2:], atol=1e-12)
