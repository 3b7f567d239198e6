"""Axes along the bones: no joint moves, every bone points along its joint's up axis, hinges turn about X."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.config.options import ExportOptions
from bodycap_batch.export.layout import apply_layout
from bodycap_batch.model.bone_axes import align_axes_with_bones, bone_ends_m, main_children
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.skeleton import Motion, rest_pose
from tests.bodies import reaching


def hanging(ticks: int = 12) -> Motion:
    """Return a motion of a skeleton whose arms hang in the zero pose."""
    motion = reaching(ticks)
    tpose = np.tile(np.eye(3), (len(motion.skeleton.joints), 1, 1))
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        tpose[motion.skeleton.roles.index(f"{side}Arm")] = so3_exp([0.1, -sign * 1.4, 0.2])
    return replace(motion, skeleton=replace(motion.skeleton, tpose_rotation=tpose))


def unreal(ticks: int = 12) -> Motion:
    return apply_layout(reaching(ticks), ExportOptions(target="unreal"))


@pytest.mark.parametrize("motion", [reaching(12), hanging(), unreal()], ids=["T", "hanging", "unreal"])
def test_no_joint_moves(motion: Motion) -> None:
    aligned = align_axes_with_bones(motion)
    ours, theirs = motion.world_from_joint()[..., :3, 3], aligned.world_from_joint()[..., :3, 3]
    np.testing.assert_allclose(theirs, ours, atol=1e-12)
    np.testing.assert_allclose(
        rest_pose(aligned.skeleton)[:, :3, 3], rest_pose(motion.skeleton)[:, :3, 3], atol=1e-12
    )
    np.testing.assert_allclose(bone_ends_m(aligned.skeleton), bone_ends_m(motion.skeleton), atol=1e-12)


@pytest.mark.parametrize("motion", [reaching(2), hanging(2), unreal(2)], ids=["T", "hanging", "unreal"])
def test_bones_point_along_the_up_axis_of_their_joints(motion: Motion) -> None:
    aligned = align_axes_with_bones(motion).skeleton
    rest = rest_pose(aligned)
    for joint, child in enumerate(main_children(aligned)):
        if child is None or (joint == 0 and aligned.roles[:2] == ("", "Hips")):
            continue
        bone = rest[joint, :3, :3].T @ (rest[child, :3, 3] - rest[joint, :3, 3])
        np.testing.assert_allclose(bone / np.linalg.norm(bone), [0.0, 0.0, 1.0], atol=1e-9)


def test_knees_and_elbows_turn_about_the_x_axis() -> None:
    motion = reaching(3)
    body = motion.skeleton
    local = np.tile(np.eye(3), (3, len(body.joints), 1, 1))
    bends = {"LeftLeg": [1.0, 0, 0], "RightLeg": [1.0, 0, 0], "LeftForeArm": [0, 0, -1.0]}
    for role, turn in bends.items():
        local[:, body.roles.index(role)] = so3_exp(turn)
    aligned = align_axes_with_bones(replace(motion, local_rotation=local))
    rest = aligned.skeleton.tpose_rotation
    assert rest is not None
    for role in bends:
        joint = body.roles.index(role)
        turned = rest[joint].T @ aligned.local_rotation[0, joint]
        np.testing.assert_allclose(np.abs(turned[:, 0]), [1.0, 0.0, 0.0], atol=1e-9)


def test_the_trunk_leads_to_the_head() -> None:
    body = reaching(1).skeleton
    children = main_children(body)
    for role, expected in (("Hips", "Spine"), ("Spine1", "Neck"), ("Neck", "Head")):
        child = children[body.roles.index(role)]
        assert child is not None
        assert body.roles[child] == expected
    assert children[body.roles.index("Head")] is None
