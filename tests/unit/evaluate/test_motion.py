"""Joint errors of a motion against the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bodycap_batch.core.errors import JobError
from bodycap_batch.evaluate import MotionOptions, evaluate_motion, score_motion
from bodycap_batch.formats.bvh import write_bvh
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.skeleton import Motion
from bodycap_batch.model.skeleton_presets import load_skeleton


def swinging(
    fps: float = 30.0, seconds: float = 2.0, *, turn_rad: float = 0.0, reach_rad: float = 0.0
) -> Motion:
    """Return a motion in a circle with swinging joints, rotated about +Z, with one elbow bent further."""
    skeleton = load_skeleton("full_body", 1.75)
    ticks = round(seconds * fps) + 1
    time = np.arange(ticks) / fps
    rng = np.random.default_rng(4)
    axes = rng.normal(size=(len(skeleton.joints), 3)) * 0.3
    local = so3_exp(np.sin(3 * time)[:, None, None] * axes)
    elbow = skeleton.index_of_role("LeftForeArm")
    assert elbow is not None
    local[:, elbow] = local[:, elbow] @ so3_exp([0.0, 0.0, reach_rad])
    about_z = so3_exp([0.0, 0.0, turn_rad])
    local[:, 0] = about_z @ local[:, 0]
    root = np.stack([np.sin(time), np.cos(time), 0.95 + 0.02 * np.sin(9 * time)], axis=1) @ about_z.T
    return Motion(
        skeleton=skeleton,
        fps=fps,
        start_ns=0,
        root_in_world_m=root,
        local_rotation=local,
        observed=np.ones(local.shape[:2], dtype=bool),
    )


def test_a_motion_has_no_error_against_itself_after_a_rigid_transform() -> None:
    moved = swinging(turn_rad=1.0)
    moved = Motion(
        skeleton=moved.skeleton,
        fps=moved.fps,
        start_ns=0,
        root_in_world_m=moved.root_in_world_m + np.array([3.0, -1.0, 0.2]),
        local_rotation=moved.local_rotation,
        observed=moved.observed,
    )
    report = score_motion(moved, swinging())
    assert report.mpjpe_m.max < 1e-9
    assert report.root_relative_m.max < 1e-9
    assert report.procrustes_m.max < 1e-9
    assert report.angle_deg is not None
    assert report.angle_deg.max < 1e-5
    raw = score_motion(moved, swinging(), MotionOptions(align="none"))
    assert raw.mpjpe_m.mean > 2.0
    # the only error is the rotation of 1 rad = 57.3°
    assert raw.angle_deg is not None
    assert raw.angle_deg.mean == pytest.approx(np.rad2deg(1.0), abs=1e-6)


def test_a_bent_elbow_shows_at_the_hand_and_nowhere_else() -> None:
    report = score_motion(swinging(reach_rad=0.2), swinging(), MotionOptions(align="none"))
    skeleton = swinging().skeleton
    hand = skeleton.index_of_role("LeftHand")
    assert hand is not None
    forearm_m = float(np.linalg.norm(skeleton.offsets_m[hand]))
    # the chord of the forearm's rotation about an axis perpendicular to it
    assert report.per_joint_m["LeftHand"] == pytest.approx(2 * forearm_m * np.sin(0.1), rel=1e-6)
    assert report.per_joint_m["LeftForeArm"] < 1e-9
    assert report.per_joint_m["RightHand"] < 1e-9
    # a constant offset of the forearm, which vanishes when the mean offset of each joint is removed
    assert report.angle_deg is not None
    assert report.angle_deg.max == pytest.approx(np.rad2deg(0.2), rel=1e-6)
    assert report.per_joint_deg["LeftForeArm"] < 1e-5


def test_other_rates_are_interpolated(tmp_path: Path) -> None:
    write_bvh(tmp_path / "a.bvh", swinging(30.0))
    write_bvh(tmp_path / "b.bvh", swinging(120.0))
    report = evaluate_motion(tmp_path / "a.bvh", tmp_path / "b.bvh")
    assert report.frames == 61
    assert report.mpjpe_m.max < 1e-5
    # interpolation between ticks of 120 Hz misses the curvature of a swing of 3 rad/s: (1/240)² / 2 · a
    shifted = evaluate_motion(tmp_path / "a.bvh", tmp_path / "b.bvh", MotionOptions(offset_s=1 / 240))
    assert 1e-6 < shifted.mpjpe_m.mean < 0.02


def test_truth_from_joint_positions(tmp_path: Path) -> None:
    motion = swinging()
    write_bvh(tmp_path / "a.bvh", motion)
    joints = motion.world_from_joint()[..., :3, 3]
    names = {"root": "Hips", "torso": "Spine1", "left_palm": "LeftHand", "right_elbow": "RightForeArm"}
    index = [motion.skeleton.index_of_role(role) for role in names.values()]
    world = joints[:, index] @ Rotation.from_euler("z", 30, degrees=True).as_matrix().T
    world[:, 2, 0] += 0.05
    np.savez(tmp_path / "joints.npz", names=list(names), t=motion.times_ns() / 1e9, world=world)
    report = evaluate_motion(tmp_path / "a.bvh", tmp_path / "joints.npz", MotionOptions())
    assert sorted(report.joints) == sorted(names.values())
    assert report.angle_deg is None
    # One joint of four has an error of 5 cm. The alignment distributes it: 5/4 cm to 5 cm at the hand.
    assert 0.0125 < report.per_joint_m["LeftHand"] < 0.0501
    assert report.mpjpe_m.mean < 0.025


def test_only_the_selected_joints_are_compared() -> None:
    options = MotionOptions(align="none", roles=("RightArm", "RightHand"))
    report = score_motion(swinging(reach_rad=0.2), swinging(), options)
    assert sorted(report.joints) == ["Hips", "RightArm", "RightHand"]
    assert report.mpjpe_m.max < 1e-9


def test_errors_name_what_cannot_be_compared(tmp_path: Path) -> None:
    write_bvh(tmp_path / "a.bvh", swinging())
    np.savez(tmp_path / "b.npz", names=["root", "tail"], t=np.arange(3), world=np.zeros((3, 2, 3)))
    with pytest.raises(JobError, match="have 1 joints in common"):
        evaluate_motion(tmp_path / "a.bvh", tmp_path / "b.npz")
    (tmp_path / "c.npz").write_bytes(b"no zip")
    with pytest.raises(JobError, match="cannot be read as a file of joint positions"):
        evaluate_motion(tmp_path / "a.bvh", tmp_path / "c.npz")
    with pytest.raises(JobError, match="have no time in common"):
        evaluate_motion(tmp_path / "a.bvh", tmp_path / "a.bvh", MotionOptions(offset_s=100.0))
