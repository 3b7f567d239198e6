"""Map points and bones in a camera's picture: where they stand, and what is cut off."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import Similarity, make_transform, so3_exp
from bodycap_batch.model.merge_data import CameraClock
from bodycap_batch.model.scene import FrameStatus, Map, Registration, Trajectory
from bodycap_batch.overlay import Bones, body_of, bone_lines, camera_views, draw_overlay
from bodycap_batch.overlay.field import field_limit_rad
from tests.bodies import merged, reaching
from tests.scenes import small_map

LENS = Camera(model="PINHOLE", width_px=640, height_px=480, params=np.array([400.0, 400, 320, 240]))
# An action camera's barrel: its cubic turns back at r = 1/sqrt(3 * 0.3) = 1.054, 46.5 degrees off the axis.
BARREL = Camera(
    model="OPENCV", width_px=640, height_px=480, params=np.array([400.0, 400, 320, 240, -0.3, 0, 0, 0])
)
AHEAD = np.eye(4)


def one_bone(start: list[float], end: list[float], *, observed: bool = True) -> Bones:
    return Bones(ends_in_world=np.array([[start, end]]), observed=np.array([observed]))


def registration(scene: Map, *, lost: int = -1) -> Registration:
    """The torso's frames of `small_map`; frame 4, a keyframe, was also tracked into frame 5 unmoved."""
    rows = scene.keyframes_of("torso")
    poses = np.full((9, 4, 4), np.nan)
    poses[scene.keyframe_frame[rows]] = scene.map_from_cam[rows]
    poses[5] = poses[4]
    status = [FrameStatus.KEYFRAME if np.isfinite(pose).all() else FrameStatus.BLUR for pose in poses]
    mine = scene.obs_keyframe == rows[1]
    assert scene.keyframe_frame[rows[1]] == 4
    path = Trajectory(
        camera="torso",
        gauge=scene.gauge,
        frame_numbers=np.arange(9),
        times_ns=np.arange(9) * 33_000_000,
        gauge_from_cam=poses,
        covariance=np.where(np.isfinite(poses[:, :1, :1]), np.eye(6), np.nan),
        status=tuple(status),
        inliers=np.zeros(9, dtype=np.int64),
        error_px=np.zeros(9),
    )
    none = np.zeros(0, dtype=np.int64)
    return Registration(
        trajectory=path,
        obs_frame=np.full(mine.sum(), 5),
        obs_keyframe=np.full(mine.sum(), 4),
        obs_feature=scene.obs_feature[mine],
        obs_px=scene.obs_px[mine].astype(np.float32),
        wanted_keyframes=none,
        tried_keyframes=none,
    )


CLOCKS = {"torso": CameraClock(nominal_fps=30.0, offset_s=2.0)}


def test_points_stand_where_the_camera_saw_them_tracked_or_in_a_keyframe() -> None:
    scene = small_map()
    (view,) = camera_views([registration(scene)], [scene], CLOCKS)
    assert view.frame == scene.gauge
    keyframe, tracked = view.points_at(4), view.points_at(5)
    assert len(keyframe.px) == len(tracked.px) == (scene.obs_keyframe == 2).sum() > 10
    # Observations are exact; the tracked ones are kept in single precision: 640 px * 2^-24.
    np.testing.assert_allclose(tracked.px, tracked.observed_px, atol=1e-4)
    np.testing.assert_array_equal(np.sort(keyframe.point), np.sort(tracked.point))
    assert len(view.points_at(6).px) == 0, "a lost frame shows no points"
    assert view.nearest_frame(2_000_000_000 + 4 * 33_000_000 + 10_000_000) == 4
    assert view.nearest_frame(0) is None


def test_points_that_lie_off_are_no_inliers() -> None:
    scene = small_map()
    moved = np.array(scene.points)
    moved[0] += 0.5
    (view,) = camera_views([registration(scene)], [dataclasses.replace(scene, points=moved)], CLOCKS)
    assert 0 in scene.obs_point[scene.obs_keyframe == 2], "the moved point must be one that was seen"
    assert 0 not in view.points_at(4).point
    assert len(view.points_at(4).px) == (scene.obs_keyframe == 2).sum() - 1


def test_the_view_follows_the_camera_into_the_world() -> None:
    scene = small_map()
    turn = so3_exp(np.array([0.1, -0.4, 1.0]))
    world_from_map = Similarity(2.5, turn, np.array([1.0, 2.0, 3.0]))
    found = registration(scene)
    motion = reaching(ticks=9)
    result, _ = merged(motion, world_from_map={scene.gauge: world_from_map})
    placed = dataclasses.replace(
        found.trajectory,
        gauge="world",
        gauge_from_cam=world_from_map.apply_to_poses(found.trajectory.gauge_from_cam),
    )
    result = dataclasses.replace(result, trajectories=(placed,))
    (local,) = camera_views([found], [scene], CLOCKS)
    (world,) = camera_views([found], [scene], CLOCKS, result)
    assert world.frame == "world"
    # A similarity of points and poses moves no pixel; 1e-6 px is double precision at this scale.
    np.testing.assert_allclose(world.points_at(4).px, local.points_at(4).px, atol=1e-6)
    np.testing.assert_allclose(world.points_at(4).depth, 2.5 * local.points_at(4).depth, rtol=1e-9)


def test_a_bone_is_drawn_through_the_pixels_of_its_own_points() -> None:
    (line,) = bone_lines(BARREL, AHEAD, one_bone([-0.5, 0.2, 1.0], [0.5, 0.2, 1.0]))
    share = np.linspace(0.0, 1.0, len(line.px))[:, None]
    on_bone = (1 - share) * [-0.5, 0.2, 1.0] + share * [0.5, 0.2, 1.0]
    np.testing.assert_allclose(line.px, BARREL.project(on_bone), atol=1e-9)
    middle, ends = line.px[len(line.px) // 2, 1], line.px[[0, -1], 1]
    assert (middle > ends + 3.0).all(), "the barrel bends the line by more than 3 px"


def test_a_bone_through_the_camera_plane_is_cut_there() -> None:
    (line,) = bone_lines(LENS, AHEAD, one_bone([0.1, 0.1, -1.0], [0.1, 0.1, 1.0]))
    assert (line.depth_m > 0.03).all()
    assert np.isfinite(line.px).all()
    assert not bone_lines(LENS, AHEAD, one_bone([0.0, 0.0, -1.0], [0.3, 0.1, -0.5]))


def test_what_the_lens_model_folds_back_is_left_out() -> None:
    """A bone 60 degrees off the axis: the cubic would put it inside the picture."""
    outside = [np.tan(np.deg2rad(60.0)), 0.0, 1.0]
    folded = BARREL.project(np.array([outside]))
    assert 0 < folded[0, 0] < BARREL.width_px, "the case the cut is for"
    assert not bone_lines(BARREL, AHEAD, one_bone(outside, [outside[0], 0.1, 1.0]))
    # The grid of angles is half a degree wide.
    assert np.rad2deg(field_limit_rad(BARREL)) == pytest.approx(46.5, abs=0.6)


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("PINHOLE", [400.0, 400, 320, 240]),
        ("OPENCV_FISHEYE", [300.0, 300, 320, 240, 0.02, -0.003, 0.0, 0.0]),
    ],
)
def test_a_lens_that_never_folds_keeps_its_whole_field(model: str, params: list[float]) -> None:
    lens = Camera(model=model, width_px=640, height_px=480, params=np.array(params))
    assert np.rad2deg(field_limit_rad(lens)) == pytest.approx(89.0)


def test_the_body_has_a_bone_to_every_child_and_tip_and_knows_its_sides() -> None:
    motion = reaching(ticks=4)
    body = body_of(motion)
    joints, roles = motion.world_from_joint(), motion.skeleton.roles
    forearm = [i for i, joint in enumerate(body.joint) if roles[joint] == "LeftForeArm"]
    assert [body.side[i] for i in forearm] == ["Left"]
    ends = body.ends_in_world[:, forearm[0]]
    np.testing.assert_allclose(ends[:, 0], joints[:, roles.index("LeftForeArm"), :3, 3])
    np.testing.assert_allclose(ends[:, 1], joints[:, roles.index("LeftHand"), :3, 3])
    hand = [i for i, joint in enumerate(body.joint) if roles[joint] == "RightHand"]
    tip = joints[:, roles.index("RightHand")] @ np.array(
        [*motion.skeleton.end_offsets_m[roles.index("RightHand")], 1.0]
    )
    np.testing.assert_allclose(body.ends_in_world[:, hand[0], 1], tip[:, :3])
    lengths = np.linalg.norm(np.diff(body.ends_in_world, axis=2)[..., 0, :], axis=-1)
    np.testing.assert_allclose(lengths, lengths[:1].repeat(4, axis=0), atol=1e-12)


def test_between_two_ticks_the_body_is_between_them_and_outside_there_is_none() -> None:
    motion = reaching(ticks=4)
    observed = np.zeros((4, len(motion.skeleton.joints)), dtype=bool)
    observed[:2] = True
    body = body_of(dataclasses.replace(motion, observed=observed))
    middle = body.at(int(body.times_ns[1:3].mean()))
    assert middle is not None
    np.testing.assert_allclose(middle.ends_in_world, body.ends_in_world[1:3].mean(axis=0), atol=1e-7)
    assert not middle.observed.any(), "half of it was inferred"
    exact = body.at(int(body.times_ns[1]))
    assert exact is not None
    assert exact.observed.all()
    assert body.at(int(body.times_ns[0]) - 1) is None
    assert body.at(int(body.times_ns[-1]) + 1) is None


def drawn(bones: Bones, size: tuple[int, int] = (480, 640)) -> FloatArray:
    image = np.zeros((*size, 3), dtype=np.uint8)
    out = draw_overlay(image, LENS.width_px, None, bone_lines(LENS, AHEAD, bones), ["Left"])
    assert not image.any(), "the picture given is not touched"
    return np.asarray(out.max(axis=2), dtype=float)


def test_a_drawn_bone_lies_on_its_pixels_at_any_picture_size() -> None:
    bone = one_bone([-0.4, 0.1, 1.0], [0.4, 0.1, 1.0])  # row 240 + 0.1 * 400 = 280, columns 160 to 480
    for size in ((480, 640), (240, 320)):
        bright = np.argwhere(drawn(bone, size) > 100)
        scale = size[1] / 640
        # COLMAP's row 280 is between cv2's rows 279 and 280; the line's width is symmetric about it.
        assert bright[:, 0].mean() == pytest.approx(280 * scale - 0.5, abs=0.3)
        assert bright[:, 1].min() == pytest.approx(160 * scale, abs=4)
        assert bright[:, 1].max() == pytest.approx(480 * scale, abs=4)


def test_an_inferred_bone_is_told_from_a_measured_one() -> None:
    ends = ([-0.4, 0.1, 1.0], [0.4, 0.1, 1.0])
    solid, dashed = drawn(one_bone(*ends)), drawn(one_bone(*ends, observed=False))
    columns = slice(180, 460)
    assert (solid[278:282, columns].max(axis=0) > 100).all()
    gaps = (dashed[278:282, columns].max(axis=0) < 100).mean()
    assert 0.2 < gaps < 0.8, "about every other piece is left out"


def test_a_wrong_pose_shows_in_the_colour_of_the_points() -> None:
    scene = small_map()
    found = registration(scene)
    off = found.trajectory.gauge_from_cam @ make_transform(np.eye(3), [0.02, 0.0, 0.0])
    wrong = dataclasses.replace(found.trajectory, gauge_from_cam=off)
    blank = np.zeros((480, 640, 3), dtype=np.uint8)
    sums = []
    for each in (found, dataclasses.replace(found, trajectory=wrong)):
        (view,) = camera_views([each], [scene], CLOCKS)
        picture = draw_overlay(blank, view.lens.width_px, view.points_at(4), [], [])
        sums.append(picture.reshape(-1, 3).sum(axis=0, dtype=float))
    right, misfit = sums
    assert right[1] > 2 * right[0], "green"
    # 0.02 / 5 of depth * 500 px = 2 px off: two thirds of the way to red.
    assert misfit[0] > 1.2 * misfit[1], "red"
