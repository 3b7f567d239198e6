"""A body that fits badly lowers the grade of the motion, and the limb or camera is named."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bodycap_batch.merging.body.bones import kinematic_chain
from bodycap_batch.merging.graph.motion_graph import posture_deviations
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.skeleton_presets import load_skeleton
from bodycap_batch.report.criteria import BODY_RULES, judge_rules
from bodycap_batch.report.grades import Criterion, Grade
from bodycap_batch.report.verdict import judge


def _criterion(merge: dict[str, Any], name: str) -> Criterion:
    rules = [rule for rule in BODY_RULES if rule.name == name]
    return next(judge_rules("body", rules, {"merge": merge}))


@pytest.mark.parametrize(("left", "grade"), [(0.2, Grade.GOOD), (0.6, Grade.FAIR), (1.3, Grade.POOR)])
def test_rare_postures_lower_the_grade(left: float, grade: Grade) -> None:
    sigmas = {"LeftArm": left, "LeftForeArm": left, "RightArm": 0.2, "RightForeArm": 0.2}
    found = _criterion({"posture_sigmas": sigmas}, "Postures")
    assert found.grade is grade
    assert found.finding.endswith("left arm") or grade is Grade.GOOD


@pytest.mark.parametrize(
    ("rms", "mean", "grade"),
    [(0.76, 0.49, Grade.FAIR), (0.69, 0.68, Grade.POOR), (0.92, 0.46, Grade.POOR)],
    ids=["thrown arms", "an upper arm given as a palm", "thrown arms and wrong clocks"],
)
def test_swings_about_the_rest_pose_are_doubted_less_than_a_rare_mean(
    rms: float, mean: float, grade: Grade
) -> None:
    merge = {"posture_sigmas": {"LeftArm": rms}, "mean_posture_sigmas": {"LeftArm": mean}}
    found = _criterion(merge, "Postures")
    assert found.grade is grade
    assert f"{mean:.2f} in the mean" in found.finding


@pytest.mark.parametrize(("squares", "grade"), [(3.0, Grade.GOOD), (9.0, Grade.FAIR), (20.0, Grade.POOR)])
def test_contradictory_scales_lower_the_grade(squares: float, grade: Grade) -> None:
    scale = {"chi2": squares, "degrees_of_freedom": 1}
    assert _criterion({"scale": scale}, "Sources of the scale").grade is grade


@pytest.mark.parametrize(("turn_deg", "grade"), [(25.0, Grade.GOOD), (45.0, Grade.FAIR), (85.0, Grade.POOR)])
def test_a_camera_in_an_odd_place_is_named(turn_deg: float, grade: Grade) -> None:
    mounts = {
        "torso": {"role": "Spine1", "from_usual_deg": 5.0},
        "left_palm": {"role": "LeftHand", "from_usual_deg": turn_deg},
    }
    found = _criterion({"mounts": mounts}, "Cameras in their usual places")
    assert found.grade is grade
    assert "left_palm" in found.finding


def test_without_figures_there_is_no_criterion() -> None:
    merge = {"scale": {"chi2": 0.0, "degrees_of_freedom": 0}}
    assert not [*judge_rules("body", BODY_RULES, {"merge": merge})]


@pytest.mark.parametrize(("frozen", "grade"), [(0, Grade.GOOD), (8, Grade.FAIR), (90, Grade.FAIR)])
def test_a_frozen_part_lowers_the_grade(frozen: int, grade: Grade) -> None:
    camera = {"coverage": 1.0, "frames": 300, "frames_registered": 300, "frame": "map-0", "keyframes": 90}
    metrics = {
        "frame": "map-0",
        "total": {**camera, "mean_reprojection_error_px": 0.4},
        "cameras": {"torso": dict(camera), "left_palm": {**camera, "status": {"FROZEN": frozen}}},
    }
    assert judge(metrics, None).cameras is grade


def test_the_distance_from_the_rest_pose_is_in_sigmas() -> None:
    bones = kinematic_chain(load_skeleton("upper_body", 1.75), {"Spine1", "LeftHand"})
    poses = np.tile(np.eye(4), (3, len(bones), 1, 1))
    for index, bone in enumerate(bones):
        if bone.parent >= 0:
            half = np.linalg.cholesky(bone.rotation_covariance)
            turn = half @ np.array([2.0, 0.0, 0.0]) if bone.role == "LeftArm" else np.zeros(3)
            poses[:, index, :3, :3] = poses[0, bone.parent, :3, :3] @ bone.mean_rotation @ so3_exp(turn)
    found = posture_deviations(bones, poses)
    assert found.pop("LeftArm") == pytest.approx((2.0 / np.sqrt(3.0), 2.0 / np.sqrt(3.0)))
    assert all(each == pytest.approx((0.0, 0.0), abs=1e-6) for each in found.values())


def test_a_swing_about_the_rest_pose_has_no_mean() -> None:
    bones = kinematic_chain(load_skeleton("upper_body", 1.75), {"Spine1", "LeftHand"})
    index = next(number for number, bone in enumerate(bones) if bone.role == "LeftArm")
    bone = bones[index]
    poses = np.tile(np.eye(4), (2, len(bones), 1, 1))
    for number, other in enumerate(bones):
        if other.parent >= 0:
            poses[:, number, :3, :3] = poses[:, other.parent, :3, :3] @ other.mean_rotation
    axis = np.linalg.cholesky(bone.rotation_covariance)[:, 0]
    poses[:, index, :3, :3] = poses[:, index, :3, :3] @ so3_exp(np.stack([axis, -axis]))
    assert posture_deviations(bones, poses)["LeftArm"] == pytest.approx((1.0 / np.sqrt(3.0), 0.0), abs=1e-6)
