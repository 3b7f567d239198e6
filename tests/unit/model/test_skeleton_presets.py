"""The preset skeleton: heights, mirrored sides, segment axes and nominal mounts."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from bodycap_batch.core.errors import JobError
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.nominal_mounts import nominal_mount
from bodycap_batch.model.skeleton import SkeletonModel, forward_kinematics
from bodycap_batch.model.skeleton_presets import (
    MEAN_HEIGHT_M,
    PRESETS,
    bone_vector,
    load_skeleton,
    rest_positions,
    segment_axes,
)

HUMAN_IK = (
    "Hips Spine Spine1 Neck Head LeftShoulder LeftArm LeftForeArm LeftHand RightShoulder RightArm "
    "RightForeArm RightHand LeftUpLeg LeftLeg LeftFoot LeftToeBase RightUpLeg RightLeg RightFoot RightToeBase"
)


def _place(skeleton: SkeletonModel, role: str) -> np.ndarray:
    return rest_positions(skeleton)[skeleton.roles.index(role)]


def _hanging(skeleton: SkeletonModel) -> SkeletonModel:
    """Return the same body with hanging arms in the zero pose."""
    offsets = np.array(skeleton.offsets_m)
    for role in ("LeftForeArm", "LeftHand", "RightForeArm", "RightHand"):
        joint = skeleton.roles.index(role)
        offsets[joint] = [0.0, 0.0, -np.linalg.norm(offsets[joint])]
    return SkeletonModel(
        name="hanging",
        joints=skeleton.joints,
        parents=skeleton.parents,
        offsets_m=offsets,
        end_offsets_m=np.nan_to_num(skeleton.end_offsets_m) * 0.0,
        roles=skeleton.roles,
        bvh_channels=skeleton.bvh_channels,
    )


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("height_m", [1.5, 1.92])
def test_heights_add_up(preset, height_m):
    skeleton = load_skeleton(preset, height_m)
    head = skeleton.roles.index("Head")
    assert _place(skeleton, "Head")[2] + skeleton.end_offsets_m[head][2] == pytest.approx(height_m)
    toe = skeleton.roles.index("LeftToeBase")
    assert _place(skeleton, "LeftToeBase")[2] + skeleton.end_offsets_m[toe][2] == pytest.approx(
        0.0, abs=1e-12
    )
    # Drillis and Contini: knee 0.285, hip 0.530, shoulder 0.818; arm 0.186 + 0.146 + 0.108.
    assert _place(skeleton, "LeftLeg")[2] == pytest.approx(0.285 * height_m)
    assert _place(skeleton, "LeftUpLeg")[2] == pytest.approx(0.530 * height_m)
    assert _place(skeleton, "LeftArm")[2] == pytest.approx(0.818 * height_m)
    hand = skeleton.roles.index("LeftHand")
    fingertip = _place(skeleton, "LeftHand") + skeleton.end_offsets_m[hand]
    assert fingertip[0] - _place(skeleton, "LeftArm")[0] == pytest.approx(0.440 * height_m)


def test_is_the_whole_humanoid_in_a_t_pose():
    skeleton = load_skeleton("upper_body")
    assert set(skeleton.roles) == set(HUMAN_IK.split())
    assert skeleton.joints == skeleton.roles
    arm = rest_positions(skeleton)[
        [skeleton.roles.index(role) for role in ("LeftArm", "LeftForeArm", "LeftHand")]
    ]
    assert (np.diff(arm[:, 0]) > 0.2).all()
    assert_allclose(arm[:, 1:], np.repeat(arm[:1, 1:], 3, axis=0))
    toes, ankle = _place(skeleton, "RightToeBase"), _place(skeleton, "RightFoot")
    assert toes[1] < ankle[1]
    assert _place(skeleton, "Head")[2] + skeleton.end_offsets_m[4][2] == pytest.approx(MEAN_HEIGHT_M)


def test_sides_mirror():
    skeleton = load_skeleton("full_body", 1.8)
    for role in HUMAN_IK.split():
        if role.startswith("Left"):
            left, right = _place(skeleton, role), _place(skeleton, role.replace("Left", "Right"))
            assert_allclose(left * [-1.0, 1.0, 1.0], right)


def test_zero_rotations_give_the_rest_pose():
    skeleton = load_skeleton("full_body", 1.8)
    root = skeleton.offsets_m[:1]
    still = np.tile(np.eye(3), (1, len(skeleton.joints), 1, 1))
    assert_allclose(forward_kinematics(skeleton, root, still)[0, :, :3, 3], rest_positions(skeleton))


def test_a_bent_elbow_moves_the_hand_only():
    skeleton = load_skeleton("full_body", 1.8)
    local = np.tile(np.eye(3), (1, len(skeleton.joints), 1, 1))
    elbow, hand = skeleton.roles.index("LeftForeArm"), skeleton.roles.index("LeftHand")
    local[0, elbow] = so3_exp([0.0, 0.0, -np.pi / 2])
    moved = forward_kinematics(skeleton, skeleton.offsets_m[:1], local)[0, :, :3, 3]
    rest = rest_positions(skeleton)
    assert_allclose(moved[elbow], rest[elbow])
    # Flexing by 90° brings the forearm forward, −Y.
    assert_allclose(moved[hand] - moved[elbow], [0.0, -0.146 * 1.8, 0.0], atol=1e-12)


@pytest.mark.parametrize(("side", "sign"), [("Left", 1.0), ("Right", -1.0)])
def test_segment_axes_follow_the_skeleton(side, sign):
    stretched = load_skeleton("full_body", 1.8)
    # T-pose with the palms down: the back of the hand points up, the thumb forward.
    assert_allclose(
        segment_axes(stretched, side + "Hand").T, [[sign, 0, 0], [0, -1, 0], [0, 0, 1]], atol=1e-12
    )
    # Hanging arms: the back of the hand points outward, the thumb still forward.
    hanging = _hanging(stretched)
    assert_allclose(
        segment_axes(hanging, side + "Hand").T, [[0, 0, -1], [0, -1, 0], [sign, 0, 0]], atol=1e-12
    )
    assert_allclose(segment_axes(hanging, side + "Arm").T, [[0, 0, -1], [0, -1, 0], [sign, 0, 0]], atol=1e-12)
    assert_allclose(
        segment_axes(stretched, side + "UpLeg").T, [[0, 0, -1], [0, -1, 0], [sign, 0, 0]], atol=1e-12
    )


@pytest.mark.parametrize("role", HUMAN_IK.split())
def test_nominal_mounts_are_poses_and_mirror(role):
    skeleton = load_skeleton("full_body", 1.7)
    mount = nominal_mount("cam", role, skeleton)
    rotation = mount.joint_from_cam[:3, :3]
    assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    # The camera never looks into the body, and it is near its bone.
    assert rotation[1, 2] < 0.0
    assert np.linalg.norm(mount.joint_from_cam[:3, 3]) < 0.3
    if role.startswith("Left"):
        twin = nominal_mount("cam", role.replace("Left", "Right"), skeleton).joint_from_cam
        flip = np.diag([-1.0, 1.0, 1.0, 1.0])
        assert_allclose(flip @ mount.joint_from_cam @ flip, twin, atol=1e-12)


def test_torso_camera_looks_forward_with_the_image_upright():
    mount = nominal_mount("torso", "Spine1", load_skeleton("upper_body", 1.75)).joint_from_cam
    assert_allclose(mount[:3, 2], [0.0, -1.0, 0.0], atol=1e-12)
    assert_allclose(mount[:3, 1], [0.0, 0.0, -1.0], atol=1e-12)
    assert mount[1, 3] < -0.05


def test_a_camera_on_the_back_looks_backwards():
    skeleton = load_skeleton("upper_body", 1.75)
    mount = nominal_mount("torso_back", "Spine1", skeleton).joint_from_cam
    assert_allclose(mount[:3, 2], [0.0, 1.0, 0.0], atol=1e-12)
    assert_allclose(mount[:3, 1], [0.0, 0.0, -1.0], atol=1e-12)
    assert mount[1, 3] > 0.05
    assert np.linalg.det(mount[:3, :3]) == pytest.approx(1.0)
    forward = nominal_mount("left_hand_back", "LeftHand", skeleton).joint_from_cam
    assert_allclose(forward[:3, 2], [0.0, -1.0, 0.0], atol=1e-12)


def test_palm_camera_sits_on_the_back_of_the_hand_fingers_down():
    mount = nominal_mount("left_palm", "LeftHand", load_skeleton("upper_body", 1.75)).joint_from_cam
    assert_allclose(mount[:3, 1], [1.0, 0.0, 0.0], atol=1e-12)
    assert mount[2, 3] > 0.02
    assert 0.03 < mount[0, 3] < 0.12


def test_bone_vectors():
    skeleton = load_skeleton("upper_body", 2.0)
    assert_allclose(bone_vector(skeleton, "LeftForeArm"), [0.292, 0.0, 0.0], atol=1e-12)
    assert_allclose(bone_vector(skeleton, "LeftHand"), [0.216, 0.0, 0.0], atol=1e-12)
    assert bone_vector(skeleton, "LeftTail") is None


def test_refusals_name_the_field():
    with pytest.raises(JobError, match="no skeleton preset 'octopus'") as caught:
        load_skeleton("octopus")
    assert caught.value.field == "skeleton"
    with pytest.raises(JobError, match="178") as caught:
        load_skeleton("upper_body", 178.0)
    assert caught.value.field == "height_m"
    with pytest.raises(JobError, match="LeftTail"):
        nominal_mount("tail", "LeftTail", load_skeleton("upper_body"))
