"""Parts of the merge stage: clocks, bones, outliers, mounts as points, planes, floor, all joints, limits."""

from __future__ import annotations

from dataclasses import replace
from itertools import accumulate

import numpy as np
import pytest
from numpy.testing import assert_allclose

from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging.body.bones import anatomical_axes, hinges, kinematic_chain
from bodycap_batch.merging.body.completion import complete_skeleton, observed_joints
from bodycap_batch.merging.body.initial_poses import fill_gaps, pose_bones
from bodycap_batch.merging.body.provisional_scale import provisional_scale, reach_constraint
from bodycap_batch.merging.body_calibration.scale import (
    ScaleSource,
    chi_square,
    scale_from_floor,
    weighted_mean,
)
from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.merging.cameras.track_outliers import remove_outliers
from bodycap_batch.merging.graph.adaptive_motion_noise import scale_motion_noise
from bodycap_batch.merging.graph.factors import (
    MountPoints,
    add_mount_prior,
    bone_key,
    insert_mount_points,
    mount_from_points,
    mount_jacobian,
)
from bodycap_batch.merging.graph.joint_distance_limits import activity_limits, arm_reach_limits, hinge_limits
from bodycap_batch.merging.world.floor import (
    floor_beside_path,
    floor_from_feet,
    floor_from_points,
    standing_height,
)
from bodycap_batch.merging.world.planes import (
    BENT_TILT_LIMIT_DEG,
    TILT_LIMIT_DEG,
    find_planes,
    vertical_from_planes,
)
from bodycap_batch.merging.world.vertical import Vertical
from bodycap_batch.merging.world.world_frame import initial_heading, rotation_to_z_up, world_from_solved_frame
from bodycap_batch.model.camera_clock import CameraClock
from bodycap_batch.model.geometry import invert, make_transform, so3_exp, so3_log
from bodycap_batch.model.nominal_mounts import nominal_mount
from bodycap_batch.model.skeleton_presets import load_skeleton, rest_positions

SECOND = 1_000_000_000
PAPER = ("Spine1", "LeftHand", "RightHand")
UP = np.array([0.0, 0.0, 1.0])


def _track(
    centres: np.ndarray, bone: int = 0, *, rotation: np.ndarray | None = None, fps: float = 30.0
) -> CameraTrack:
    count = len(centres)
    turns = np.tile(np.eye(3), (count, 1, 1)) if rotation is None else rotation
    return CameraTrack(
        camera=f"cam{bone}",
        bone=bone,
        frames=np.arange(count),
        times_ns=np.round(np.arange(count) * SECOND / fps).astype(np.int64),
        map_from_cam=make_transform(turns, centres),
        sigma_rad=np.full(count, 0.003),
        sigma_map=np.full(count, 0.003),
    )


def test_common_time_is_camera_time_plus_offset():
    clock = CameraClock(nominal_fps=30.0, offset_s=0.12)
    assert clock.common_times_ns(np.array([5 * SECOND])).tolist() == [5_120_000_000]


def test_lower_rows_are_exposed_later():
    # Row r of h at frame time + (r/h − ½) · 20 ms: the last row 10 ms late, the first 10 ms early.
    clock = CameraClock(nominal_fps=30.0, rolling_shutter_s=0.020)
    times = clock.common_times_ns(np.array([SECOND] * 3), np.array([1.0, 0.5, 0.0]))
    assert times.tolist() == [1_010_000_000, SECOND, 990_000_000]
    assert clock.common_times_ns(np.array([SECOND])).tolist() == [SECOND]


def test_trunk_and_palm_cameras_give_nine_bones():
    skeleton = load_skeleton("upper_body", 1.75)
    bones = kinematic_chain(skeleton, PAPER)
    assert [bone.role for bone in bones] == [
        "Spine1", "LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand",
        "RightShoulder", "RightArm", "RightForeArm", "RightHand",
    ]  # fmt: skip
    assert [bone.parent for bone in bones] == [-1, 0, 1, 2, 3, 0, 5, 6, 7]


def test_the_graph_contains_the_bones_between_the_cameras():
    skeleton = load_skeleton("full_body", 1.75)
    roles = {bone.role for bone in kinematic_chain(skeleton, ("Head", "LeftFoot"))}
    assert roles == {"Hips", "Spine", "Spine1", "Neck", "Head", "LeftUpLeg", "LeftLeg", "LeftFoot"}
    assert [bone.role for bone in kinematic_chain(skeleton, ("LeftArm", "LeftHand"))] == [
        "LeftArm",
        "LeftForeArm",
        "LeftHand",
    ]


@pytest.mark.parametrize("side", ["Left", "Right"])
def test_the_rest_pose_has_hanging_arms_and_bent_elbows(side):
    skeleton = load_skeleton("upper_body", 1.75)
    bones = kinematic_chain(skeleton, PAPER)
    poses = pose_bones(skeleton, bones, {0: np.eye(4)[None]})[0]
    index = {bone.role: i for i, bone in enumerate(bones)}
    shoulder, elbow, wrist = (poses[index[side + part], :3, 3] for part in ("Arm", "ForeArm", "Hand"))
    assert elbow[2] < shoulder[2] - 0.3
    assert wrist[2] < elbow[2] - 0.2
    assert wrist[1] < elbow[1] - 0.05
    assert (elbow[0] > shoulder[0]) == (side == "Left")


def test_hinge_ranges_allow_flexion_and_twist_but_no_sideways_bend():
    skeleton = load_skeleton("upper_body", 1.75)
    bones = kinematic_chain(skeleton, ("LeftArm", "LeftHand"))
    hinge = hinges(skeleton, bones)[0]
    axes = anatomical_axes(skeleton, "LeftArm")
    length = 0.146 * 1.75

    def misfit(bend: np.ndarray) -> float:
        wrist = bones[1].offset_m + length * (axes @ so3_exp(bend) @ [1.0, 0.0, 0.0])
        return float(np.abs(np.linalg.norm(hinge.anchors_m - wrist, axis=1) - hinge.range_m).max())

    assert misfit(np.array([0.0, 0.0, 1.2])) < 1e-12
    assert misfit(np.array([0.0, 0.5, 0.0])) > 0.05


@pytest.mark.parametrize("side", ["Left", "Right"])
def test_inverse_kinematics_puts_the_wrist_at_its_measured_position(side):
    skeleton = load_skeleton("upper_body", 1.75)
    bones = kinematic_chain(skeleton, ("Spine1", side + "Hand"))
    hand = make_transform(np.eye(3)[None], np.array([[0.25 if side == "Left" else -0.25, -0.3, 0.0]]))
    poses = pose_bones(skeleton, bones, {0: np.eye(4)[None], 4: hand})[0]
    elbow = poses[3]
    reached = elbow[:3, :3] @ bones[4].offset_m + elbow[:3, 3]
    assert_allclose(reached, hand[0, :3, 3], atol=1e-9)
    # The elbow points out and back, not through the chest.
    line = 0.5 * (poses[2, :3, 3] + hand[0, :3, 3])
    assert elbow[1, 3] > line[1]


def test_provisional_scale_from_the_reach_of_the_arms():
    skeleton = load_skeleton("upper_body", 1.75)
    bones = kinematic_chain(skeleton, PAPER)
    mounts = {f"cam{bone}": nominal_mount(f"cam{bone}", bones[bone].role, skeleton) for bone in (0, 4, 8)}
    swing = so3_exp(np.outer(0.5 * np.sin(np.arange(60) / 5.0), [1.0, 0.0, 0.0]))
    still = np.tile(np.eye(4), (60, 1, 1))
    at_rest = pose_bones(skeleton, bones, {0: still})
    tracks = []
    for bone, arm in ((0, None), (4, 2), (8, 6)):
        pose = at_rest[:, bone].copy()
        if arm is not None:
            shoulder = at_rest[:, arm, :3, 3]
            centre = np.einsum("tij,tj->ti", swing, pose[:, :3, 3] - shoulder) + shoulder
            pose = make_transform(swing @ pose[:, :3, :3], centre)
        camera = pose @ mounts[f"cam{bone}"].joint_from_cam
        tracks.append(_track(camera[:, :3, 3] / 3.0, bone, rotation=camera[:, :3, :3]))
    # The largest extension counts as 0.96 of the arm's length; at 25° of flexion it is 0.98.
    assert provisional_scale(bones, tracks, mounts) == pytest.approx(3.0, rel=0.04)


def test_provisional_scale_needs_two_places_on_the_body():
    skeleton = load_skeleton("upper_body", 1.75)
    bones = kinematic_chain(skeleton, ("Spine1",))
    mounts = {"cam0": nominal_mount("cam0", "Spine1", skeleton)}
    with pytest.raises(EstimationError, match="no two cameras"):
        provisional_scale(bones, [_track(np.zeros((30, 3)))], mounts)


def test_outliers_are_removed_and_a_throw_is_kept():
    seconds = np.arange(90) / 30.0
    # 2 Hz at 0.25 m is a violent arm: 3 m/s, 40 m/s².
    throw = np.stack([0.25 * np.sin(4.0 * np.pi * seconds), seconds, 0.0 * seconds], axis=1)
    track = _track(throw)
    assert remove_outliers(track, 1.0, 30.0).frames.tolist() == track.frames.tolist()
    wrong = throw.copy()
    wrong[[20, 21, 50]] += [0.4, -0.4, 0.2]
    kept = remove_outliers(_track(wrong / 5.0), 5.0, 30.0)
    assert len(kept.frames) == len(throw) - 3
    assert not {20, 21, 50} & set(kept.frames.tolist())


def test_a_throw_faster_than_a_quadratic_is_kept():
    seconds = np.arange(90) / 30.0
    # 2.5 Hz at 0.35 m: 5.5 m/s and 86 m/s²; a quadratic over 0.4 s, a whole period, is off by the amplitude.
    throw = np.stack([0.35 * np.sin(5.0 * np.pi * seconds), seconds, 0.0 * seconds], axis=1)
    assert len(remove_outliers(_track(throw), 1.0, 30.0).frames) == len(throw)


def test_a_fast_swing_around_the_shoulder_is_kept():
    # A stretched arm starts a swing of 180 degrees and stops: 10 m/s, and 13 cm of acceleration in a frame.
    angle = np.pi / (1.0 + np.exp(-(np.arange(60) - 30) / 1.5))
    swing = 0.65 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    assert np.linalg.norm(np.diff(swing, n=2, axis=0), axis=1).max() > 0.13
    assert len(remove_outliers(_track(swing), 1.0, 30.0).frames) == len(swing)
    some = np.delete(np.arange(60), [27, 28])
    lost = _track(swing).keep(np.isin(np.arange(60), some))
    assert remove_outliers(lost, 1.0, 30.0).frames.tolist() == some.tolist()
    wrong = swing.copy()
    wrong[[29, 30]] += [0.1, 0.1, 0.15]
    kept = remove_outliers(_track(wrong), 1.0, 30.0).frames.tolist()
    assert not {29, 30} & set(kept)


@pytest.mark.parametrize("lost", [0, 1, 2, 3])
@pytest.mark.parametrize("off_m", [0.2, 0.5])
def test_wrong_frames_between_lost_frames_are_removed(lost, off_m):
    seconds = np.arange(60) / 30.0
    path = np.stack([seconds, 0.0 * seconds, 0.0 * seconds], axis=1)
    path[[30, 31], 1] += off_m
    gaps = [*range(30 - lost, 30), *range(32, 32 + lost)]
    some = np.isin(np.arange(60), gaps, invert=True)
    kept = remove_outliers(_track(path).keep(some), 1.0, 30.0).frames.tolist()
    assert kept == [number for number in np.flatnonzero(some).tolist() if number not in {30, 31}]


@pytest.mark.parametrize("lost", [5, 15])
@pytest.mark.parametrize("wrong", [[89], [88, 89], [0], [0, 1], [44], [44, 45], [46]])
def test_outliers_at_the_ends_of_a_run_are_removed(wrong, lost):
    seconds = np.arange(90) / 30.0
    path = np.stack([0.3 * np.sin(4.0 * np.pi * seconds), seconds, 0.0 * seconds], axis=1)
    path[wrong] += [0.5, -0.3, 0.4]
    track = _track(path)
    # The frames 46 and later follow after a gap.
    times_ns = track.times_ns + np.where(np.arange(90) > 45, lost * SECOND // 30, 0)
    kept = remove_outliers(replace(track, times_ns=times_ns), 1.0, 30.0)
    removed = set(range(90)) - set(kept.frames.tolist())
    # A right frame between a wrong one and the gap may be lost.
    assert set(wrong) <= removed <= {*wrong, 45}


def test_right_frames_behind_a_short_gap_at_the_end_of_a_run_are_kept():
    """The frames before the gap predict nothing behind it: the hand turns round in these four frames."""
    seconds = np.arange(94) / 30.0
    path = np.stack([0.3 * np.sin(4.0 * np.pi * seconds), seconds, 0.0 * seconds], axis=1)
    seen = np.delete(np.arange(94), [88, 89, 90, 91])
    track = _track(path).keep(np.isin(np.arange(94), seen))
    assert remove_outliers(track, 1.0, 30.0).frames.tolist() == seen.tolist()


def test_poses_in_gaps_and_outside_a_track_are_invalid():
    track = _track(np.stack([np.arange(10.0), np.zeros(10), np.zeros(10)], axis=1))
    with_gap = track.keep(np.array([True] * 3 + [False] * 4 + [True] * 3))
    times = np.round(np.array([0.5, 1.0, 4.5, 9.0, 12.0]) * SECOND / 30).astype(np.int64)
    poses, valid = with_gap.poses_at(times, max_gap_ns=SECOND // 10)
    assert valid.tolist() == [True, True, False, True, False]
    assert_allclose(poses[:, 0, 3], [0.5, 1.0, 4.5, 9.0, 9.0], atol=1e-6)


def test_gaps_are_filled_on_se3_and_ends_held():
    poses = make_transform(
        so3_exp(np.outer(np.arange(5.0), [0, 0, 0.2])), np.outer(np.arange(5.0), [1.0, 0, 0])
    )
    valid = np.array([False, True, False, True, False])
    filled = fill_gaps(np.where(valid[:, None, None], poses, np.nan), valid)
    assert_allclose(filled[2], poses[2], atol=1e-12)
    assert_allclose(filled[[0, 4]], poses[[1, 3]], atol=1e-12)


def test_violent_motion_raises_the_noise_of_the_limb_above_the_camera():
    skeleton = load_skeleton("upper_body", 1.75)
    bones = kinematic_chain(skeleton, PAPER)
    rng = np.random.default_rng(0)
    turns = so3_exp(np.cumsum(rng.normal(scale=0.06, size=(90, 3)), axis=0))
    spin = np.array(list(accumulate(turns, np.matmul)))
    tracks = [
        _track(np.zeros((90, 3)), 0),
        _track(np.zeros((90, 3)), 4, rotation=spin),
        _track(np.zeros((90, 3)), 8),
    ]
    ratio = [
        after.psd[0] / before.psd[0]
        for before, after in zip(bones, scale_motion_noise(bones, tracks), strict=True)
    ]
    # Increments of 0.06 rad a frame: 0.0036 / (2/3 · (1/30)³) = 146 rad²/s³ against the table's 30.
    assert ratio[4] == pytest.approx(146 / 30, rel=0.3)
    assert ratio[3] == ratio[2] == ratio[4]
    assert ratio[0] == ratio[7] == ratio[8] == 1.0
    leaps = [tracks[0], _track(rng.normal(size=(90, 3)), 4), tracks[2]]
    # Nobody moves by a metre from frame to frame: the ratio is bounded.
    assert (
        max(
            each.psd[3] / bone.psd[3]
            for bone, each in zip(bones, scale_motion_noise(bones, leaps), strict=True)
        )
        == 100
    )


def test_mount_points_carry_exactly_the_pose_they_stand_for():
    import gtsam

    points, mount = MountPoints(0.01, 0.005), make_transform(so3_exp([0.3, -0.2, 1.0]), [0.1, 0.02, -0.05])
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    add_mount_prior(graph, 0, mount, points, sigma_rad=0.2, sigma_m=0.03)
    insert_mount_points(values, 0, mount, points)
    assert_allclose(mount_from_points(values, 0, points), mount, atol=1e-12)
    keys = gtsam.KeyVector([gtsam.symbol("m", i) for i in range(4)])
    covariance = gtsam.Marginals(graph, values).jointMarginalCovariance(keys).fullMatrix()
    change = mount_jacobian(mount, points)
    assert_allclose(np.diag(change @ covariance @ change.T)[:3], 0.2**2)
    # The derivative of reading the mount, by moving each coordinate of each point.
    for column in range(12):
        moved = gtsam.Values(values)
        point, axis = divmod(column, 3)
        moved.update(keys[point], values.atPoint3(keys[point]) + 1e-6 * np.eye(3)[axis])
        off = invert(mount) @ mount_from_points(moved, 0, points)
        numeric = np.array([*so3_log(off[:3, :3]), *off[:3, 3]]) / 1e-6
        assert_allclose(change[:, column], numeric, atol=1e-4)


def test_walls_and_floor_give_the_vertical_and_the_floor():
    rng = np.random.default_rng(4)
    wall = rng.uniform([0, 0, 0], [4, 0, 2.5], (150, 3))
    side = rng.uniform([0, 0, 0], [0, 3, 2.5], (120, 3))
    floor = rng.uniform([0, 0, 0], [4, 3, 0], (80, 3))
    clutter = rng.uniform([0, 0, 0.1], [4, 3, 2.5], (150, 3))
    room = np.concatenate([wall, side, floor, clutter]) + rng.normal(scale=0.005, size=(500, 3))
    turn = so3_exp([0.4, -0.9, 0.3])
    planes = find_planes(room @ turn.T, np.random.default_rng(0))
    found = vertical_from_planes(planes, so3_exp([0.15, 0.1, 0.0]) @ turn @ UP, TILT_LIMIT_DEG)
    assert found is not None
    # Planes 3 m wide with 5 mm of noise tilt by a fraction of a degree.
    assert np.degrees(np.arccos(found.up @ turn @ UP)) < 0.5
    body = turn @ so3_exp([0.5, 0.2, 0.0]) @ UP  # 31 degrees: a person who bends most of the time
    assert vertical_from_planes(planes, body, TILT_LIMIT_DEG) is None
    bent = vertical_from_planes(planes, body, BENT_TILT_LIMIT_DEG)
    assert bent is not None
    assert np.degrees(np.arccos(bent.up @ turn @ UP)) < 0.5
    floor_found = floor_from_points(
        room @ UP, Vertical(up=UP, source="map", sigma_deg=0.0, body_off_deg=0.0, share=1.0), 0.08, 1.2
    )
    assert floor_found.source == "map"
    assert floor_found.height_m == pytest.approx(0.0, abs=0.01)
    assert (
        floor_from_points(
            room @ UP, Vertical(up=UP, source="body", sigma_deg=0.0, body_off_deg=None, share=0.0), 0.08, 1.2
        ).height_m
        == 0.08
    )


@pytest.mark.parametrize(("floor", "source"), [(0, "map"), (3, "map"), (13, "standing hip height")])
def test_a_surface_above_the_floor_is_not_the_floor(floor, source):
    """35 points of a surface 8 cm high, and a few points of the floor, among thousands of the room."""
    rng = np.random.default_rng(2)
    heights = np.concatenate(
        [
            rng.normal(scale=0.01, size=floor),
            rng.normal(0.08, 0.01, size=35),
            rng.uniform(0.12, 0.5, size=60),
            rng.uniform(0.5, 2.5, size=3000),
        ]
    )
    found = floor_from_points(
        heights, Vertical(up=UP, source="map", sigma_deg=0.0, body_off_deg=0.0, share=1.0), 0.01, 1.2
    )
    assert found.source == source
    if source != "map":
        assert found.height_m == 0.01


def _beside_a_walk(rng, floor, clutter):
    """Return a path of four metres, with points of the floor and of clutter near it, and of a room."""
    path = np.column_stack([np.linspace(0.0, 4.0, 60), np.zeros(60), np.full(60, 1.2)])
    return path, np.vstack(
        [
            rng.uniform([0.0, -0.7, -0.01], [4.0, 0.7, 0.01], (floor, 3)),
            rng.uniform([0.0, -0.7, -0.25], [4.0, 0.7, 0.35], (clutter, 3)),
            rng.uniform([0.0, 1.0, 0.05], [4.0, 3.0, 2.5], (900, 3)),
        ]
    )


@pytest.mark.parametrize("expected", [-0.15, 0.0, 0.2])
def test_a_few_points_beside_the_path_show_the_floor(expected):
    path, points = _beside_a_walk(np.random.default_rng(1), 8, 3)
    found = floor_beside_path(
        points, path, Vertical(up=UP, source="map", sigma_deg=0.0, body_off_deg=0.0, share=1.0), expected, 1.2
    )
    assert found.source == "map"
    assert 8 <= found.support <= 11
    # The points are within a centimetre of it; one point of clutter moves the median by no more.
    assert found.height_m == pytest.approx(0.0, abs=0.01)
    assert (
        floor_from_points(
            points @ UP,
            Vertical(up=UP, source="map", sigma_deg=0.0, body_off_deg=0.0, share=1.0),
            expected,
            1.2,
        ).source
        != "map"
    )


@pytest.mark.parametrize(
    ("floor", "clutter", "source"), [(4, 0, "map"), (8, 20, "map"), (8, 3, "walk"), (0, 0, "map")]
)
def test_clutter_beside_the_path_is_not_the_floor(floor, clutter, source):
    path, points = _beside_a_walk(np.random.default_rng(1), floor, clutter)
    assert (
        floor_beside_path(
            points, path, Vertical(up=UP, source=source, sigma_deg=0.0, body_off_deg=0.0, share=1.0), 0.0, 1.2
        )
        is None
    )
    assert (
        floor_beside_path(
            points[:0],
            path,
            Vertical(up=UP, source=source, sigma_deg=0.0, body_off_deg=0.0, share=1.0),
            0.0,
            1.2,
        )
        is None
    )


@pytest.mark.parametrize("depth_m", [0.08, 0.12, 0.16])
def test_a_wall_with_a_ledge_does_not_tilt_the_vertical(depth_m):
    """The upper part of a wall stands back, as behind shelves. A plane through both parts is not a wall."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        side = rng.uniform([3.0, 0.0, 0.0], [3.0, 3.0, 2.5], (600, 3))
        lower = rng.uniform([0.0, 3.0, 0.5], [3.0, 3.0, 1.2], (230, 3))
        upper = rng.uniform([0.0, 3.0 + depth_m, 1.2], [3.0, 3.0 + depth_m, 1.9], (230, 3))
        clutter = rng.uniform([0, 0, 0.1], [3, 3, 2.5], (200, 3))
        room = np.concatenate([side, lower, upper, clutter])
        room += rng.normal(scale=0.006, size=room.shape)
        found = vertical_from_planes(find_planes(room, np.random.default_rng(seed)), UP, TILT_LIMIT_DEG)
        assert found is not None
        assert np.degrees(np.arccos(found.up @ UP)) < 1.0


def test_one_wall_does_not_determine_the_vertical():
    rng = np.random.default_rng(4)
    wall = rng.uniform([0, 0, 0], [4, 0.005, 2.5], (300, 3))
    assert vertical_from_planes(find_planes(wall, np.random.default_rng(0)), UP, BENT_TILT_LIMIT_DEG) is None
    assert vertical_from_planes([], UP, BENT_TILT_LIMIT_DEG) is None
    assert find_planes(wall[:50], np.random.default_rng(0)) == []


def test_the_floor_corrects_the_scale_by_its_share_and_is_not_believed_when_far_off():
    body = ScaleSource(name="height", scale=2.0, sigma_log=0.06)
    floor = scale_from_floor(body, 0.97 * 1.2 / 1.06, 1.2)
    assert floor.used
    assert floor.scale == pytest.approx(2.0 * 1.06)
    # Equal sigmas: halfway.
    scale, sigma = weighted_mean([body, floor])
    assert scale == pytest.approx(2.0 * np.sqrt(1.06))
    assert sigma == pytest.approx(0.06 / np.sqrt(2.0))
    assert not scale_from_floor(body, 0.8, 1.2).used
    assert not scale_from_floor(body, -0.1, 1.2).used
    assert weighted_mean([body, scale_from_floor(body, 0.8, 1.2)]) == pytest.approx((2.0, 0.06))


def test_disagreement_counts_sources_that_were_not_believed():
    sources = [
        ScaleSource(name="height", scale=1.0, sigma_log=0.03),
        ScaleSource(name="floor", scale=float(np.exp(0.12)), sigma_log=0.03, used=False),
    ]
    # Two values 4 sigma of one apart: 0.12² / (2 · 0.03²) = 8 about their mean.
    assert chi_square(sources) == pytest.approx((8.0, 1))
    assert chi_square(sources[:1]) == pytest.approx((0.0, 0))


def test_world_has_hips_over_the_origin_and_faces_minus_y():
    up = np.array([0.6, 0.0, 0.8])
    rotation = rotation_to_z_up(up)
    assert_allclose(rotation @ up, UP, atol=1e-12)
    world = world_from_solved_frame(rotation, np.array([3.0, 2.0, 1.4]), 0.5, np.radians(30.0))
    assert_allclose(world.apply(np.array([3.0, 2.0, 1.4]) @ rotation), [0.0, 0.0, 0.9], atol=1e-12)
    facing = np.array([np.cos(np.radians(30.0)), np.sin(np.radians(30.0)), 0.0]) @ rotation
    assert_allclose(world.rotation @ facing, [0.0, -1.0, 0.0], atol=1e-12)
    assert_allclose(rotation_to_z_up(-UP) @ -UP, UP, atol=1e-12)


def test_heading_waits_for_the_first_step():
    forward = np.concatenate([np.tile([1.0, 0.0, 0.0], (60, 1)), np.tile([0.0, 1.0, 0.0], (60, 1))])
    centre = np.zeros((120, 3))
    centre[60:, 1] = np.arange(60) / 30.0
    # The step is detected up to a quarter of a second early: 7 of 30 ticks have the other heading.
    assert initial_heading(forward, centre, 30.0) == pytest.approx(np.pi / 2, abs=np.arctan(7 / 23) + 1e-9)
    assert initial_heading(forward[:60], centre[:60], 30.0) == 0.0


def test_standing_height_adds_the_legs_up():
    skeleton = load_skeleton("full_body", 1.75)
    assert standing_height(skeleton, 0) == pytest.approx(0.530 * 1.75, abs=0.005)
    spread = np.array(skeleton.offsets_m)
    spread[0] = 0.0
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        knee = skeleton.roles.index(f"{side}Leg")
        spread[knee] = so3_exp([0.0, sign * -0.4, 0.0]) @ spread[knee]
    lying = replace(skeleton, offsets_m=spread)
    assert standing_height(lying, 0) == pytest.approx(0.530 * 1.75, abs=0.005)


def test_unsolved_joints_stand_under_a_leaning_chest():
    skeleton = load_skeleton("upper_body", 1.75)
    bones = kinematic_chain(skeleton, ("Spine1",))
    lean = make_transform(so3_exp([[0.3, 0.0, 0.0]]), np.array([[0.0, 0.0, 1.225]]))
    joints, solved = complete_skeleton(skeleton, bones, lean[:, None])
    assert solved.sum() == 1
    hips, foot = skeleton.roles.index("Hips"), skeleton.roles.index("LeftFoot")
    assert_allclose(joints[0, hips, :3, :3], np.eye(3), atol=1e-12)
    assert joints[0, foot, 2, 3] == pytest.approx(joints[0, hips, 2, 3] - 0.491 * 1.75)
    # Each joint keeps its offset from its parent.
    parents, rest = skeleton.parents, rest_positions(skeleton)
    for joint in range(1, len(rest)):
        offset = (invert(joints[0, parents[joint]]) @ joints[0, joint])[:3, 3]
        assert_allclose(offset, skeleton.offsets_m[joint], atol=1e-9)


def test_helpers_of_a_rig_stay_at_zero_under_a_leaning_chest():
    plain = load_skeleton("upper_body", 1.75)
    roles = tuple("" if role == "Spine" else role for role in plain.roles)
    skeleton = replace(plain, roles=roles)
    lean = make_transform(so3_exp([[0.3, 0.0, 0.0]]), np.array([[0.0, 0.0, 1.225]]))
    joints, _ = complete_skeleton(skeleton, kinematic_chain(skeleton, ("Spine1",)), lean[:, None])
    hips, helper = 0, plain.roles.index("Spine")
    assert_allclose(joints[0, helper, :3, :3], joints[0, hips, :3, :3], atol=1e-12)


def test_a_joint_is_observed_by_its_camera_or_by_cameras_on_both_sides():
    skeleton = load_skeleton("upper_body", 1.75)
    bones = kinematic_chain(skeleton, PAPER)
    ticks = np.round(np.arange(90) * SECOND / 30).astype(np.int64)
    torso, left, right = (_track(np.zeros((90, 3)), bone) for bone in (0, 4, 8))
    left = left.keep((np.arange(90) < 30) | (np.arange(90) > 45))
    right = right.keep(np.arange(90) < 20)
    observed = observed_joints(skeleton, bones, [torso, left, right], ticks, 0.4)
    role = skeleton.roles.index
    assert observed[:, role("Spine1")].all()
    assert observed[:30, role("LeftForeArm")].all()
    assert not observed[31:45, role("LeftForeArm")].any()
    assert observed[47:, role("LeftHand")].all()
    assert observed[:20, role("RightHand")].all()
    assert not observed[21:, role("RightHand")].any()
    assert not observed[21:, role("RightArm")].any()
    assert not observed[:, role("Head")].any()
    assert observed_joints(skeleton, bones, [torso, left, right], ticks, 1.0)[:, role("LeftHand")].all()


def test_solved_feet_give_the_floor():
    skeleton = load_skeleton("full_body", 1.75)
    joints = np.tile(make_transform(np.eye(3), rest_positions(skeleton))[None], (50, 1, 1, 1))
    joints[:, :, 2, 3] += 0.3
    solved = np.zeros(len(skeleton.joints), dtype=bool)
    assert floor_from_feet(skeleton, joints, solved) is None
    solved[skeleton.roles.index("LeftFoot")] = True
    floor = floor_from_feet(skeleton, joints, solved)
    assert floor is not None
    assert floor.source == "feet"
    assert floor.height_m == pytest.approx(0.3, abs=1e-9)


def test_walking_palms_stay_low_and_on_their_side():
    skeleton = load_skeleton("upper_body", 1.75)
    bones = kinematic_chain(skeleton, PAPER)
    assert activity_limits(skeleton, bones, "generic") == ()
    limits = {limit.name: limit for limit in activity_limits(skeleton, bones, "walk")}
    poses = pose_bones(skeleton, bones, {0: np.eye(4)[None]})
    assert all(not limit.violation_m(poses).any() for limit in limits.values())
    poses[0, 4, :3, 3] = [0.2, -0.3, 0.5]
    assert (limits["Left palm below the shoulder"].violation_m(poses) > 0.0).all()
    poses[0, 4, :3, 3] = [-0.35, -0.3, -0.1]
    assert (limits["Left palm on its side"].violation_m(poses) > 0.0).all()
    assert not limits["Left palm below the shoulder"].violation_m(poses).any()


def test_a_limit_costs_only_outside_its_bounds():
    import gtsam

    skeleton = load_skeleton("upper_body", 1.75)
    bones = kinematic_chain(skeleton, PAPER)
    limit = activity_limits(skeleton, bones, "walk")[0]
    poses = pose_bones(skeleton, bones, {0: np.eye(4)[None]})
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    limit.add(graph, 0)
    values.insert(bone_key(0, 0), gtsam.Pose3(np.eye(4)))
    values.insert(bone_key(0, 4), gtsam.Pose3(poses[0, 4]))
    assert graph.error(values) == pytest.approx(0.0, abs=1e-12)
    raised = poses[0, 4].copy()
    raised[2, 3] = 0.6
    values.update(bone_key(0, 4), gtsam.Pose3(raised))
    distance = np.linalg.norm(raised[:3, 3] - limit.anchor_m)
    # A quadratic cost with a sigma of 5 cm outside the bound.
    assert graph.error(values) == pytest.approx(0.5 * ((limit.low_m - distance) / 0.05) ** 2)


def test_the_reach_from_the_head_to_a_palm_starts_at_the_shoulder():
    skeleton = load_skeleton("upper_body", 1.75)
    bones = kinematic_chain(skeleton, ("Head", "LeftHand"))
    index = {bone.role: i for i, bone in enumerate(bones)}
    found = reach_constraint(bones, index["LeftHand"], index["Head"])
    assert found is not None
    rest = rest_positions(skeleton)
    shoulder = rest[skeleton.roles.index("LeftArm")] - rest[skeleton.roles.index("Head")]
    anchor_m, reach_m = found
    assert_allclose(anchor_m, shoulder, atol=1e-12)
    assert reach_m == pytest.approx((0.186 + 0.146) * 1.75)
    palms = kinematic_chain(skeleton, ("LeftHand", "RightHand"))
    assert reach_constraint(palms, 4, len(palms) - 1) is None


@pytest.mark.parametrize("roles", [("Spine1", "LeftHand", "RightHand"), ("Hips", "LeftFoot", "RightFoot")])
def test_elbows_and_knees_bend_one_way(roles):
    skeleton = load_skeleton("full_body", 1.75)
    bones = kinematic_chain(skeleton, roles)
    index = {bone.role: position for position, bone in enumerate(bones)}
    for limit in hinge_limits(skeleton, bones):
        side = limit.name.split()[0]
        upper, lower, end = ("Arm", "ForeArm", "Hand") if "elbow" in limit.name else ("UpLeg", "Leg", "Foot")
        axis = anatomical_axes(skeleton, side + upper)[:, 2]
        for degrees, wrong in ((0.0, False), (40.0, False), (120.0, False), (-15.0, True)):
            bend = degrees if upper == "Arm" else -degrees
            poses = np.tile(np.eye(4), (1, len(bones), 1, 1))
            joint = poses[:, index[side + upper]] @ make_transform(
                np.eye(3), bones[index[side + lower]].offset_m
            )
            turned = joint @ make_transform(so3_exp(np.radians(bend) * axis), np.zeros(3))
            poses[:, index[side + end]] = turned @ make_transform(
                np.eye(3), bones[index[side + end]].offset_m
            )
            # At -15 degrees the end is 3 to 5 cm too far; at 0 only by rounding.
            assert bool(limit.violation_m(poses)[0] > 0.02) is wrong
    assert len(hinge_limits(skeleton, bones)) == 2


def test_palms_stay_within_an_arms_length():
    skeleton = load_skeleton("upper_body", 1.75)
    bones = kinematic_chain(skeleton, PAPER)
    left = next(limit for limit in arm_reach_limits(skeleton, bones) if limit.name.startswith("Left"))
    assert left.high_m == pytest.approx((0.186 + 0.146) * 1.75 + 0.05)
    poses = np.tile(np.eye(4), (1, len(bones), 1, 1))
    poses[:, left.bone, :3, 3] = left.anchor_m - np.array([0.0, left.high_m + 0.1, 0.0])
    assert left.violation_m(poses) == pytest.approx([0.1])
