"""Angles of joints and contacts of the feet, from joint centres alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.model.bone_axes import align_axes_with_bones
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.joint_angles import angle_curves, foot_curves
from bodycap_batch.model.skeleton import Motion
from tests.bodies import reaching
from tests.steps import walking


def bent(role: str, vector: list[float]) -> Motion:
    """Return a body in the T-pose with one joint turned."""
    motion = reaching(3)
    local = np.tile(np.eye(3), (3, len(motion.skeleton.joints), 1, 1))
    local[:, motion.skeleton.roles.index(role)] = so3_exp(vector)
    return replace(motion, local_rotation=local)


@pytest.mark.parametrize(
    ("role", "vector", "name", "degrees"),
    [
        ("LeftForeArm", [0, 0, -np.radians(70)], "left elbow", 70.0),
        ("RightLeg", [np.radians(50), 0, 0], "right knee", 50.0),
        ("LeftArm", [0, np.radians(90), 0], "left shoulder", 0.0),
        ("RightArm", [0, 0, 0], "right shoulder", 90.0),
        ("Hips", [np.radians(30), 0, 0], "trunk lean", 30.0),
    ],
)
def test_angles(role: str, vector: list[float], name: str, degrees: float) -> None:
    motion = bent(role, vector)
    curves = {curve.name: curve for curve in angle_curves(motion)}
    # The neck is 1.5 cm behind the hips, and the shoulders are not exactly above the hips: 3°.
    assert curves[name].degrees == pytest.approx(degrees, abs=3.0)
    assert not curves[name].measured.any()
    same = {curve.name: curve for curve in angle_curves(align_axes_with_bones(motion))}
    np.testing.assert_allclose(same[name].degrees, curves[name].degrees, atol=1e-9)


def test_an_angle_is_measured_where_all_its_joints_are() -> None:
    motion = reaching(10)
    observed = np.zeros_like(motion.observed)
    for role in ("LeftArm", "LeftForeArm", "LeftHand"):
        observed[:, motion.skeleton.roles.index(role)] = True
    observed[4:, motion.skeleton.roles.index("LeftHand")] = False
    curves = {curve.name: curve for curve in angle_curves(replace(motion, observed=observed))}
    np.testing.assert_array_equal(curves["left elbow"].measured, np.arange(10) < 4)
    assert not curves["right elbow"].measured.any()


def test_planted_feet_stand_and_swinging_feet_do_not() -> None:
    motion, stands = walking(120)
    for number, foot in enumerate(foot_curves(motion)):
        assert foot.clearance_m.min() > -1e-6
        # The ends of a stance are slow as well.
        assert (foot.stands == stands[:, number]).mean() > 0.9
        assert foot.stands[stands[:, number]].mean() > 0.95


def test_missing_joints_are_left_out() -> None:
    motion = reaching(3)
    roles = tuple("" if role.startswith("Left") else role for role in motion.skeleton.roles)
    part = replace(motion, skeleton=replace(motion.skeleton, roles=roles))
    assert [curve.name for curve in angle_curves(part)] == [
        "right elbow",
        "right shoulder",
        "trunk lean",
        "right knee",
    ]
    assert [foot.name for foot in foot_curves(part)] == ["right foot"]
