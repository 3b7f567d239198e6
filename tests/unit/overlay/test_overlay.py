"""The positions of map points and bones in a camera's image, and the parts that are cut off."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.camera_clock import CameraClock
from bodycap_batch.model.geometry import Similarity, make_transform, so3_exp
from bodycap_batch.model.scene import FrameStatus, Map, Registration, Trajectory
from bodycap_batch.overlay import Bones, bones_from_motion, draw_overlay, make_camera_views, project_bones
from bodycap_batch.overlay.lens_field import max_field_angle_rad
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


def registration(scene: Map) -> Registration:
    """Return the torso's frames of `small_map`; keyframe 4 was tracked into frame 5 with the same pose."""
    rows = scene.keyframes_of("torso")
    poses = np.full((9, 4, 4), np.nan)
    poses[scene.keyframe_frame[rows]] = scene.map_from_cam[rows]
    poses[5] = poses[4]
    status = [FrameStatus.KEYFRAME if np.isfinite(pose).all() else FrameStatus.BLUR for pose in poses]
    of_keyframe = scene.obs_keyframe == rows[1]
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
        obs_frame=np.full(of_keyframe.sum(), 5),
        obs_keyframe=np.full(of_keyframe.sum(), 4),
        obs_feature=scene.obs_feature[of_keyframe],
        obs_px=scene.obs_px[of_keyframe].astype(np.float32),
        wanted_keyframes=none,
        tried_keyframes=none,
    )


CLOCKS = {"torso": CameraClock(nominal_fps=30.0, offset_s=2.0)}


def test_points_are_projected_to_their_observations_in_keyframes_and_tracked_frames() -> None:
    scene = small_map()
    (view,) = make_camera_views([registration(scene)], [scene], CLOCKS)
    assert view.reference_frame == scene.gauge
    keyframe, tracked = view.inliers_at(4), view.inliers_at(5)
    assert len(keyframe.px) == len(tracked.px) == (scene.obs_keyframe == 2).sum() > 10
    # Observations are exact; the tracked ones are kept in single precision: 640 px * 2^-24.
    np.testing.assert_allclose(tracked.px, tracked.observed_px, atol=1e-4)
    np.testing.assert_array_equal(np.sort(keyframe.point), np.sort(tracked.point))
    assert len(view.inliers_at(6).px) == 0, "a lost frame shows no points"
    assert view.times_ns[4] == 2_000_000_000 + 4 * 33_000_000, "common time = camera time + offset"


def test_points_with_a_large_error_are_no_inliers() -> None:
    scene = small_map()
    moved = np.array(scene.points)
    moved[0] += 0.5
    (view,) = make_camera_views([registration(scene)], [dataclasses.replace(scene, points=moved)], CLOCKS)
    assert 0 in scene.obs_point[scene.obs_keyframe == 2], "the moved point must be an observed one"
    assert 0 not in view.inliers_at(4).point
    assert len(view.inliers_at(4).px) == (scene.obs_keyframe == 2).sum() - 1


def test_a_view_in_the_world_has_the_same_projections() -> None:
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
    (local,) = make_camera_views([found], [scene], CLOCKS)
    (world,) = make_camera_views([found], [scene], CLOCKS, result)
    assert world.reference_frame == "world"
    # A similarity of points and poses changes no projection; 1e-6 px is double precision at this scale.
    np.testing.assert_allclose(world.inliers_at(4).px, local.inliers_at(4).px, atol=1e-6)
    np.testing.assert_allclose(world.inliers_at(4).depth, 2.5 * local.inliers_at(4).depth, rtol=1e-9)


def test_a_bone_is_drawn_through_the_projections_of_its_points() -> None:
    (line,) = project_bones(BARREL, AHEAD, one_bone([-0.5, 0.2, 1.0], [0.5, 0.2, 1.0]))
    share = np.linspace(0.0, 1.0, len(line.px))[:, None]
    on_bone = (1 - share) * [-0.5, 0.2, 1.0] + share * [0.5, 0.2, 1.0]
    np.testing.assert_allclose(line.px, BARREL.project(on_bone), atol=1e-9)
    middle, ends = line.px[len(line.px) // 2, 1], line.px[[0, -1], 1]
    assert (middle > ends + 3.0).all(), "the barrel bends the line by more than 3 px"


def test_a_bone_through_the_camera_plane_is_cut_there() -> None:
    (line,) = project_bones(LENS, AHEAD, one_bone([0.1, 0.1, -1.0], [0.1, 0.1, 1.0]))
    assert (line.depth_m > 0.03).all()
    assert np.isfinite(line.px).all()
    assert not project_bones(LENS, AHEAD, one_bone([0.0, 0.0, -1.0], [0.3, 0.1, -0.5]))


def test_a_bone_outside_the_valid_field_is_omitted() -> None:
    """The cubic would project a bone 60 degrees off the axis into the image."""
    outside = [np.tan(np.deg2rad(60.0)), 0.0, 1.0]
    projected = BARREL.project(np.array([outside]))
    assert 0 < projected[0, 0] < BARREL.width_px, "the case that the limit of the field excludes"
    assert not project_bones(BARREL, AHEAD, one_bone(outside, [outside[0], 0.1, 1.0]))
    # The grid of angles is half a degree wide.
    assert np.rad2deg(max_field_angle_rad(BARREL)) == pytest.approx(46.5, abs=0.6)


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("PINHOLE", [400.0, 400, 320, 240]),
        ("OPENCV_FISHEYE", [300.0, 300, 320, 240, 0.02, -0.003, 0.0, 0.0]),
    ],
)
def test_a_monotonic_lens_model_keeps_its_whole_field(model: str, params: list[float]) -> None:
    lens = Camera(model=model, width_px=640, height_px=480, params=np.array(params))
    assert np.rad2deg(max_field_angle_rad(lens)) == pytest.approx(89.0)


def test_the_body_has_a_bone_to_every_child_and_tip_with_its_side() -> None:
    motion = reaching(ticks=4)
    body = bones_from_motion(motion)
    joints, roles = motion.world_from_joint(), motion.skeleton.roles
    forearm = [i for i, joint in enumerate(body.joints) if roles[joint] == "LeftForeArm"]
    assert [body.sides[i] for i in forearm] == ["Left"]
    ends = body.ends_in_world[:, forearm[0]]
    np.testing.assert_allclose(ends[:, 0], joints[:, roles.index("LeftForeArm"), :3, 3])
    np.testing.assert_allclose(ends[:, 1], joints[:, roles.index("LeftHand"), :3, 3])
    hand = [i for i, joint in enumerate(body.joints) if roles[joint] == "RightHand"]
    tip = joints[:, roles.index("RightHand")] @ np.array(
        [*motion.skeleton.end_offsets_m[roles.index("RightHand")], 1.0]
    )
    np.testing.assert_allclose(body.ends_in_world[:, hand[0], 1], tip[:, :3])
    lengths = np.linalg.norm(np.diff(body.ends_in_world, axis=2)[..., 0, :], axis=-1)
    np.testing.assert_allclose(lengths, lengths[:1].repeat(4, axis=0), atol=1e-12)


def test_bones_are_interpolated_between_two_ticks_and_missing_outside() -> None:
    motion = reaching(ticks=4)
    observed = np.zeros((4, len(motion.skeleton.joints)), dtype=bool)
    observed[:2] = True
    body = bones_from_motion(dataclasses.replace(motion, observed=observed))
    middle = body.bones_at(int(body.times_ns[1:3].mean()))
    assert middle is not None
    np.testing.assert_allclose(middle.ends_in_world, body.ends_in_world[1:3].mean(axis=0), atol=1e-7)
    assert not middle.observed.any(), "one of the two ticks was inferred"
    exact = body.bones_at(int(body.times_ns[1]))
    assert exact is not None
    assert exact.observed.all()
    assert body.bones_at(int(body.times_ns[0]) - 1) is None
    assert body.bones_at(int(body.times_ns[-1]) + 1) is None


def draw_bones(bones: Bones, size: tuple[int, int] = (480, 640)) -> FloatArray:
    image = np.zeros((*size, 3), dtype=np.uint8)
    out = draw_overlay(image, LENS.width_px, None, project_bones(LENS, AHEAD, bones), ["Left"])
    assert not image.any(), "the given image is not changed"
    return np.asarray(out.max(axis=2), dtype=float)


def test_a_bone_is_drawn_at_its_projection_in_any_image_size() -> None:
    bone = one_bone([-0.4, 0.1, 1.0], [0.4, 0.1, 1.0])  # row 240 + 0.1 * 400 = 280, columns 160 to 480
    for size in ((480, 640), (240, 320)):
        bright = np.argwhere(draw_bones(bone, size) > 100)
        scale = size[1] / 640
        # COLMAP's row 280 is between cv2's rows 279 and 280; the line's width is symmetric about it.
        assert bright[:, 0].mean() == pytest.approx(280 * scale - 0.5, abs=0.3)
        assert bright[:, 1].min() == pytest.approx(160 * scale, abs=4)
        assert bright[:, 1].max() == pytest.approx(480 * scale, abs=4)


def test_an_inferred_bone_is_dashed_and_a_measured_one_solid() -> None:
    ends = ([-0.4, 0.1, 1.0], [0.4, 0.1, 1.0])
    solid, dashed = draw_bones(one_bone(*ends)), draw_bones(one_bone(*ends, observed=False))
    columns = slice(180, 460)
    assert (solid[278:282, columns].max(axis=0) > 100).all()
    gaps = (dashed[278:282, columns].max(axis=0) < 100).mean()
    assert 0.2 < gaps < 0.8, "about every second piece is omitted"


def test_the_colour_of_the_points_shows_a_wrong_pose() -> None:
    scene = small_map()
    found = registration(scene)
    off = found.trajectory.gauge_from_cam @ make_transform(np.eye(3), [0.02, 0.0, 0.0])
    wrong = dataclasses.replace(found.trajectory, gauge_from_cam=off)
    blank = np.zeros((480, 640, 3), dtype=np.uint8)
    sums = []
    for each in (found, dataclasses.replace(found, trajectory=wrong)):
        (view,) = make_camera_views([each], [scene], CLOCKS)
        picture = draw_overlay(blank, view.lens.width_px, view.inliers_at(4), [], [])
        sums.append(picture.reshape(-1, 3).sum(axis=0, dtype=float))
    right, misfit = sums
    assert right[1] > 2 * right[0], "green"
    # 0.02 m / 5 m of depth * 500 px = 2 px of error: two thirds of the way to red.
    assert misfit[0] > 1.2 * misfit[1], "red"
