"""Layouts for animation: joint names, spine joints, rates and roots; the joints do not move in the world."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bodycap_batch.config.options import ExportOptions
from bodycap_batch.export.layout import apply_layout
from bodycap_batch.export.layout.resampling import resample, smooth
from bodycap_batch.export.layout.root_motion import heading_rad
from bodycap_batch.export.motion_files import motion_difference
from bodycap_batch.formats.bvh import assign_roles, read_bvh, write_bvh
from bodycap_batch.model.geometry import rotation_angle_rad, so3_exp
from bodycap_batch.model.skeleton import Motion
from tests.bodies import reaching

NAMES = ("hik", "mixamo", "biped", "unreal", "unity")
ROOTS = ("hips", "ground", "in_place")


def laid_out(motion: Motion, **options: Any) -> Motion:
    return apply_layout(motion, ExportOptions.model_validate(options))


def poses(motion: Motion, roles: tuple[str, ...]) -> np.ndarray:
    """Return the poses (T,R,4,4) of the joints with these roles."""
    return motion.world_from_joint()[:, [motion.skeleton.roles.index(role) for role in roles]]


def looking_about(ticks: int = 40) -> Motion:
    """Return a motion with bends and half turns of head and chest."""
    motion = reaching(ticks)
    local = motion.local_rotation.copy()
    for role, scale in (("Head", 1.2), ("Spine1", 3.5)):
        joint = motion.skeleton.roles.index(role)
        local[:, joint] = so3_exp(np.linspace(-1, 1, ticks)[:, None] * np.array([0.4, 0.2, 1.0]) * scale)
    return replace(motion, local_rotation=local)


@pytest.mark.parametrize("names", NAMES)
@pytest.mark.parametrize("root", ["hips", "ground"])
def test_no_joint_moves_or_rotates_in_the_world(names: str, root: str) -> None:
    motion = looking_about()
    out = laid_out(motion, names=names, root=root)
    roles = motion.skeleton.roles
    np.testing.assert_allclose(poses(out, roles), motion.world_from_joint(), atol=1e-12)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ("hik", "Hips Spine Spine1 Neck Head LeftShoulder LeftArm LeftForeArm LeftHand"),
        (
            "mixamo",
            "mixamorig:Hips mixamorig:Spine mixamorig:Spine1 mixamorig:Spine2 mixamorig:Neck mixamorig:Head "
            "mixamorig:LeftShoulder mixamorig:LeftArm mixamorig:LeftForeArm mixamorig:LeftHand",
        ),
        ("biped", "Hips Chest Chest2 Neck Head LeftCollar LeftShoulder LeftElbow LeftWrist"),
        (
            "unreal",
            "root pelvis spine_01 spine_02 spine_03 spine_04 spine_05 neck_01 neck_02 head clavicle_l "
            "upperarm_l lowerarm_l hand_l",
        ),
    ],
)
def test_names_and_spine_counts(names: str, expected: str) -> None:
    body = laid_out(reaching(2), names=names).skeleton
    assert " ".join(body.joints).startswith(expected + " ")
    chest, collar = body.index_of_role("Spine1"), body.index_of_role("RightShoulder")
    assert collar is not None
    assert body.parents[collar] == chest
    legs = {"biped": "RightHip RightKnee RightAnkle RightToe", "unreal": "thigh_r calf_r foot_r ball_r"}
    assert " ".join(body.joints).endswith(legs.get(names, "RightToeBase"))


@pytest.mark.parametrize("names", NAMES)
@pytest.mark.parametrize("root", ROOTS)
def test_files_keep_names_roles_and_motion(tmp_path: Path, names: str, root: str) -> None:
    motion = laid_out(reaching(30), names=names, root=root, tpose=True)
    write_bvh(tmp_path / "a.bvh", motion)
    model, back = read_bvh(tmp_path / "a.bvh")
    assert model.joints == motion.skeleton.joints
    assert assign_roles(model.joints, model.parents.tolist()) == motion.skeleton.roles
    # six decimals of a centimetre and of a degree, along a chain of nine joints with a total length of 2 m
    position_m, angle_deg = motion_difference(back, motion)
    assert position_m < 1e-6
    assert angle_deg < 1e-4


def test_added_joints_have_equal_parts_of_the_twist() -> None:
    motion = reaching(2)
    local = motion.local_rotation.copy()
    joint = motion.skeleton.roles.index("Spine1")
    axis = motion.skeleton.offsets_m[joint] / np.linalg.norm(motion.skeleton.offsets_m[joint])
    swing = so3_exp(np.cross(axis, [0.0, 0.0, 1.0]) * 0.5 + np.array([0.3, 0.0, 0.0]))
    local[:, joint] = so3_exp(1.2 * axis) @ swing
    out = laid_out(replace(motion, local_rotation=local), names="unreal")
    added = [out.skeleton.joints.index(f"spine_0{n}") for n in (2, 3, 4)]
    angles = rotation_angle_rad(out.local_rotation[0, added])
    np.testing.assert_allclose(angles, angles[0], atol=1e-12)
    np.testing.assert_allclose(angles[0], 1.2 / 4, atol=0.05)  # the swing has a little twist of its own
    lengths = np.linalg.norm(out.skeleton.offsets_m[[*added, added[-1] + 1]], axis=1)
    np.testing.assert_allclose(lengths, lengths[0])


def test_on_the_ground_the_root_has_path_and_heading() -> None:
    motion = reaching(60)
    out = laid_out(motion, root="ground")
    assert out.skeleton.joints[:2] == ("Reference", "Hips")
    np.testing.assert_allclose(out.root_in_world_m[:, :2], motion.root_in_world_m[:, :2])
    np.testing.assert_allclose(out.root_in_world_m[:, 2], 0.0)
    expected = so3_exp(0.4 * np.arange(60)[:, None] / 30.0 * [0.0, 0.0, 1.0])
    np.testing.assert_allclose(out.local_rotation[:, 0], expected, atol=1e-12)
    assert out.hips_in_root_m is not None
    np.testing.assert_allclose(out.hips_in_root_m[:, :2], 0.0, atol=1e-12)
    np.testing.assert_allclose(out.hips_in_root_m[:, 2], motion.root_in_world_m[:, 2])


def test_the_root_on_the_ground_does_not_sway_and_stops_with_the_person() -> None:
    motion = reaching(240)
    time = np.arange(240) / 30.0
    walked = np.cumsum(np.where(time < 5.0, 1.1, 0.0)) / 30.0
    sway = np.where(time < 5.0, 0.03 * np.sin(2.0 * np.pi * time), 0.0)
    zero = 0.0 * time
    local = motion.local_rotation.copy()
    local[:, 0] = so3_exp(np.column_stack([zero, zero, np.radians(8.0) * sway / 0.03]))
    height = motion.root_in_world_m[:1, 2].repeat(240)
    motion = replace(motion, root_in_world_m=np.column_stack([sway, -walked, height]), local_rotation=local)
    out = laid_out(motion, root="ground")
    before, after = motion.world_from_joint(), out.world_from_joint()[:, 1:]
    np.testing.assert_allclose(after, before, atol=1e-9)
    path, inside = out.root_in_world_m, slice(30, 120)
    # A Gaussian of 0.4 s leaves exp(-(2π 0.4)²/2) = 4 % of a sway of 1 Hz.
    assert np.abs(path[inside, 0]).max() < 0.05 * 0.03
    assert np.abs(heading_rad(out.local_rotation[:, 0])[inside]).max() < 0.05 * np.radians(8.0)
    speed = np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1) * 30.0
    np.testing.assert_allclose(speed[inside], 1.1, atol=0.05)
    # The person stands from 5 s on: 2.5 sigmas later, less than 1 % of the speed is left.
    assert speed[180:].max() < 0.011


def test_a_t_pose_does_not_turn_the_root_that_follows_it() -> None:
    motion = reaching(60)
    whole, after = laid_out(motion, root="ground"), laid_out(motion, root="ground", tpose=True)
    np.testing.assert_allclose(after.local_rotation[1:, 0], whole.local_rotation[:, 0], atol=1e-12)
    np.testing.assert_allclose(after.root_in_world_m[1:], whole.root_in_world_m, atol=1e-12)


def test_heading_is_continuous_and_survives_a_body_upside_down() -> None:
    turns = np.linspace(0.0, 9.0, 200)
    np.testing.assert_allclose(heading_rad(so3_exp(turns[:, None] * [0.0, 0.0, 1.0])), turns, atol=1e-9)
    flip = Rotation.from_euler("x", np.linspace(0, 360, 181)[:, None], degrees=True).as_matrix()
    assert np.abs(np.diff(heading_rad(flip))).max() < 1e-6
    assert heading_rad(Rotation.from_euler("x", [[180.0]], degrees=True).as_matrix()) == 0.0


def test_in_place_the_hips_stay_above_the_origin() -> None:
    for names in NAMES:
        out = laid_out(reaching(30), names=names, root="in_place")
        hips = poses(out, ("Hips",))[:, 0]
        np.testing.assert_allclose(hips[:, :2, 3], 0.0, atol=1e-12)
        np.testing.assert_allclose(hips[:, 2, 3], reaching(30).root_in_world_m[:, 2])
        np.testing.assert_allclose(hips[:, :3, :3], reaching(30).local_rotation[:, 0], atol=1e-12)


@pytest.mark.parametrize("root", ROOTS)
def test_the_t_pose_is_the_first_frame_and_other_times_do_not_change(root: str) -> None:
    motion = reaching(10)
    out = laid_out(motion, tpose=True, root=root)
    assert len(out.root_in_world_m) == 11
    assert out.times_ns()[1] == motion.times_ns()[0]
    hands = poses(out, ("LeftHand", "RightHand", "LeftArm", "LeftToeBase", "LeftFoot"))[0, :, :3, 3]
    assert hands[0, 0] - hands[1, 0] > 1.5
    np.testing.assert_allclose(hands[0, 2], hands[2, 2], atol=1e-9)
    assert hands[3, 1] < hands[4, 1]
    assert 0.0 < hands[3, 2] < 0.03


@pytest.mark.parametrize("fps", [30.0, 60.0, 120.0])
def test_resampling_keeps_every_old_tick_and_interpolates_linearly(fps: float) -> None:
    motion = reaching(31)
    out = resample(motion, fps)
    factor = round(fps / 30)
    assert (out.fps, len(out.root_in_world_m)) == (fps, 30 * factor + 1)
    np.testing.assert_allclose(out.local_rotation[::factor], motion.local_rotation, atol=1e-12)
    np.testing.assert_allclose(out.root_in_world_m[::factor], motion.root_in_world_m, atol=1e-12)
    step = np.swapaxes(out.local_rotation[:-1], -1, -2) @ out.local_rotation[1:]
    angle = rotation_angle_rad(step).reshape(30, factor, -1)
    np.testing.assert_allclose(angle, np.broadcast_to(angle[:, :1], angle.shape), atol=1e-9)


def test_resampling_down_follows_the_motion() -> None:
    fast = reaching(240)
    out = resample(resample(fast, 120.0), 24.0)
    assert len(out.root_in_world_m) == 192
    at = np.arange(192) / 24.0
    np.testing.assert_allclose(out.root_in_world_m[:, 1], -1.1 * at, atol=1e-9)


def test_a_tick_is_observed_if_both_neighbours_were() -> None:
    motion = replace(reaching(4), observed=np.repeat([[True], [True], [False], [True]], 21, axis=1))
    out = resample(motion, 60.0)
    assert out.observed[:, 0].tolist() == [True, True, True, False, False, False, True]


def test_smoothing_removes_noise_and_keeps_slow_motion(rng: np.random.Generator) -> None:
    motion = reaching(300)
    noise = so3_exp(rng.normal(scale=0.02, size=(*motion.local_rotation.shape[:2], 3)))
    noisy = replace(
        motion,
        local_rotation=motion.local_rotation @ noise,
        root_in_world_m=motion.root_in_world_m + rng.normal(scale=0.01, size=(300, 3)),
    )
    out = smooth(noisy, 4.0)

    def error(other: Motion) -> float:
        turned = np.swapaxes(motion.local_rotation, -1, -2) @ other.local_rotation
        return float(np.sqrt((rotation_angle_rad(turned) ** 2).mean()))

    # The filter passes this fraction of white noise: sqrt(4 Hz / 15 Hz) = 0.52
    assert 0.4 < error(out) / error(noisy) < 0.62
    inside = slice(10, -10)  # the filter keeps the first and the last position
    path = out.root_in_world_m - motion.root_in_world_m
    assert 0.4 < path[inside].std() / 0.01 < 0.62
    assert smooth(motion, 20.0) is motion


def test_nothing_is_changed_by_default() -> None:
    motion = reaching(5)
    out = laid_out(motion)
    assert out.skeleton.joints == motion.skeleton.joints
    np.testing.assert_array_equal(out.local_rotation, motion.local_rotation)
    np.testing.assert_array_equal(out.root_in_world_m, motion.root_in_world_m)
    assert out.hips_in_root_m is None


def test_a_users_own_skeleton_keeps_its_names() -> None:
    motion = reaching(3)
    channels = ("Zrotation", "Xrotation", "Yrotation")
    body = replace(motion.skeleton, bvh_channels=(channels,) * len(motion.skeleton.joints))
    out = laid_out(replace(motion, skeleton=body), names="unreal")
    assert out.skeleton.joints == body.joints


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(11)
