"""Sources of the scale other than the bones, and the sentences on uncertainties."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bodycap_batch.core.errors import EstimationError, JobError
from bodycap_batch.merging.body.bones import kinematic_chain
from bodycap_batch.merging.body_calibration.known_distance import known_distance
from bodycap_batch.merging.body_calibration.skeleton_error_modes import (
    bone_length_modes,
    joint_placement_modes,
)
from bodycap_batch.merging.reporting.advice import describe_mount, describe_scale
from bodycap_batch.model.geometry import Similarity, so3_exp
from bodycap_batch.model.nominal_mounts import nominal_mount
from bodycap_batch.model.skeleton_presets import load_skeleton
from tests.stages.walker import make_inputs, make_walk, record

ONE_MAP = {"map-0": Similarity(1.0, np.eye(3), np.zeros(3))}
GAUGE = Similarity(0.25, so3_exp([0.3, 1.0, -0.2]), np.array([2.0, 0.0, 1.0]))


@pytest.fixture(scope="module")
def inputs():
    rng = np.random.default_rng(0)
    walk = make_walk(rng)
    recorded = [
        record(walk, name, rng, gauge=GAUGE, lost=(1.0, 1.2) if name == "left_palm" else None)
        for name in ("torso", "left_palm", "right_palm")
    ]
    return walk, make_inputs(walk, recorded)


def test_a_known_distance_gives_the_scale(inputs):
    walk, merged = inputs
    ends = walk.camera("torso", np.array([0.0, 80.0]) / 30.0)[:, :3, 3]
    metres = float(np.linalg.norm(ends[1] - ends[0]))
    source = known_distance(merged.trajectories, ("torso:0", "torso:80", metres), ONE_MAP)
    # 3 mm of noise an axis at both ends, the floor of 4 mm on top, over some 2.5 m.
    assert 0.003 < source.sigma_log < 0.006
    assert abs(np.log(source.scale * GAUGE.scale)) < 3.0 * source.sigma_log
    assert known_distance(merged.trajectories, None, ONE_MAP) is None


@pytest.mark.parametrize(
    ("first", "second", "error", "says"),
    [
        ("chest:0", "torso:80", JobError, "no camera 'chest'"),
        ("torso:0", "torso:8000", JobError, "no frame 8000"),
        ("torso:0", "left_palm:33", EstimationError, "not localised"),
        ("torso:5", "torso:5", EstimationError, "too close"),
    ],
)
def test_an_unusable_known_distance_is_refused_with_the_reason(inputs, first, second, error, says):
    with pytest.raises(error, match=says):
        known_distance(inputs[1].trajectories, (first, second, 1.0), ONE_MAP)


def test_a_known_distance_needs_one_map(inputs):
    trajectories = tuple(
        replace(each, gauge="map-1") if each.camera == "left_palm" else each
        for each in inputs[1].trajectories
    )
    apart = replace(inputs[1], trajectories=trajectories)
    with pytest.raises(JobError, match="have no place in common"):
        known_distance(apart.trajectories, ("torso:0", "left_palm:0", 1.0), ONE_MAP)


def test_every_mount_has_a_movement_that_reduces_its_uncertainty():
    skeleton = load_skeleton("full_body", 1.75)
    for role in filter(None, skeleton.roles):
        mount = nominal_mount("cam", role, skeleton)
        sentence = describe_mount(mount, t_pose=False)
        assert "15.0° and 2.9 cm" in sentence
        assert "to reduce this" in sentence
        assert "T-pose" in sentence
        side = "left" if role.startswith("Left") else "right"
        assert role in ("Hips", "Spine", "Spine1", "Neck", "Head") or side in sentence
        assert "T-pose" not in describe_mount(mount, t_pose=True)
        known = replace(mount, sigma_rad=0.03, sigma_m=0.01)
        assert "reduce" not in describe_mount(known, t_pose=False)


@pytest.mark.parametrize(
    ("roles", "advice"), [(("Spine1", "LeftHand"), "T-pose"), (("Spine1",) * 2, "another bone")]
)
def test_the_advice_on_the_scale_depends_on_the_bones_with_cameras(roles, advice):
    skeleton = load_skeleton("upper_body", 1.75)
    calibrated = SimpleNamespace(
        mounts=[nominal_mount(f"camera_{number}", role, skeleton) for number, role in enumerate(roles)],
        scale=SimpleNamespace(sigma_log=0.27, sources=[]),
        t_pose_ns=None,
    )
    sentence = describe_scale(calibrated)
    assert "the uncertainty of the metric scale is 27.0 % (1 sigma)" in sentence
    assert advice in sentence
    assert "merge.known_distance" in sentence


def test_another_joint_placement_leaves_its_descendants_in_place():
    """A higher chest joint leaves the shoulders at the same position relative to the hips."""
    skeleton = load_skeleton("full_body", 1.80)
    bones = kinematic_chain(skeleton, {"Hips", "LeftHand", "RightHand", "Head"})
    modes = joint_placement_modes(bones, ("torso",), 1.80)
    index = {bone.role: position for position, bone in enumerate(bones)}
    moved = np.zeros_like(modes.offsets_m)
    for position, bone in enumerate(bones):
        above = moved[bone.parent] if bone.parent >= 0 else 0.0
        moved[position] = modes.offsets_m[position] + above
    # Along the trunk 5.5 % of the stature.
    assert np.abs(moved[index["Spine1"], 2]).max() == pytest.approx(0.055 * 1.80)
    trunk = np.abs(moved[index["Spine1"]]).max(axis=0) > 0.0
    for role in ("LeftShoulder", "RightHand", "Neck", "Head"):
        np.testing.assert_allclose(moved[index[role]][:, trunk], 0.0, atol=1e-12)
    # Both arms get longer by the same length, and so do all bones of a person.
    np.testing.assert_allclose(moved[index["LeftHand"], 0], -moved[index["RightHand"], 0])
    assert np.linalg.norm(moved[index["LeftHand"], 0]) == pytest.approx(
        np.hypot(0.02, np.hypot(0.025, 0.03)) * 1.8
    )
    people = bone_length_modes(bones, ("torso",))
    assert people.offsets_m[index["LeftForeArm"]].sum() == pytest.approx(0.04 * 0.186 * 1.80)
    assert not people.mounts["torso"].any()
    assert not modes.mounts["torso"].any()
