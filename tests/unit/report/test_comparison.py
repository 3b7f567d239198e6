"""Two motions side by side: equal ones differ by nothing, and a known difference is found."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.core.errors import JobError
from bodycap_batch.export.tables import write_joint_table
from bodycap_batch.formats.bvh import write_bvh
from bodycap_batch.formats.joint_positions import ROLE_BY_TRUTH_NAME
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.skeleton import Motion
from bodycap_batch.report.comparison import compare, write_comparison
from tests.steps import walking


def moved(motion: Motion, degrees: float) -> Motion:
    """Return the motion at another place of the floor, in another direction."""
    turn = so3_exp([0.0, 0.0, np.radians(degrees)])
    local = motion.local_rotation.copy()
    local[:, 0] = turn @ local[:, 0]
    place = motion.root_in_world_m @ turn.T + [3.0, -2.0, 0.0]
    return replace(motion, local_rotation=local, root_in_world_m=place)


def bvh(folder: Path, name: str, motion: Motion) -> Path:
    write_bvh(folder / f"{name}.bvh", motion)
    return folder / f"{name}.bvh"


def test_the_same_motion_elsewhere_differs_by_nothing(tmp_path: Path) -> None:
    motion, stands = walking(90)
    found = compare(bvh(tmp_path, "a", motion), bvh(tmp_path, "b", moved(motion, 70.0)))
    for each in found.figures["angles"].values():
        assert each["mean_abs_deg"] < 0.01
        assert each["correlation"] is None or each["correlation"] > 0.9999
    a, b = (take.motion.world_from_joint()[..., :3, 3] for take in found.takes)
    np.testing.assert_allclose(b, a, atol=1e-4)
    feet = found.figures["feet"]
    for name, foot in feet["A"].items():
        assert foot == pytest.approx(feet["B"][name], abs=1e-3)
    assert feet["A"]["left foot"]["stands"] == pytest.approx(stands[:, 0].mean(), abs=0.1)
    assert found.figures["motions"]["A"]["speed_m_s"] == pytest.approx(0.8, abs=0.01)


@pytest.mark.parametrize("given", ["capture", "capture/gt", "capture/gt/joints.npz"])
def test_a_truth_of_joint_positions_is_read(tmp_path: Path, given: str) -> None:
    motion, stands = walking(90)
    centres = motion.world_from_joint()[..., :3, 3]
    roles = {role: name for name, role in ROLE_BY_TRUTH_NAME.items()}
    known = [joint for joint, role in enumerate(motion.skeleton.roles) if role in roles]
    (tmp_path / "capture" / "gt").mkdir(parents=True)
    np.savez(
        tmp_path / "capture" / "gt" / "joints.npz",
        names=np.array([roles[motion.skeleton.roles[joint]] for joint in known]),
        t=np.arange(90) / motion.fps,
        world=centres[:, known],
    )
    found = compare(bvh(tmp_path, "a", motion), tmp_path / given)
    angles = found.figures["angles"]
    assert {"left elbow", "right elbow", "left knee", "right knee"} <= set(angles)
    for each in angles.values():
        assert each["mean_abs_deg"] < 0.1
    feet = found.figures["feet"]
    assert feet["B"]["left foot"]["stands"] == pytest.approx(stands[:, 0].mean(), abs=0.15)
    truth = found.takes[1].motion
    for joint, role in enumerate(truth.skeleton.roles):
        if role:
            own = truth.world_from_joint()[:, joint, :3, 3]
            at = centres[:, motion.skeleton.roles.index(role)]
            assert np.linalg.norm(own - at, axis=1).max() < 0.03


def test_a_truth_without_hips_is_refused(tmp_path: Path) -> None:
    motion, _ = walking(10)
    np.savez(
        tmp_path / "joints.npz", names=np.array(["left_knee"]), t=np.arange(10.0), world=np.zeros((10, 1, 3))
    )
    with pytest.raises(JobError, match="no hips"):
        compare(bvh(tmp_path, "a", motion), tmp_path / "joints.npz")


def test_a_bent_elbow_and_a_later_start_are_found(tmp_path: Path) -> None:
    motion, _ = walking(90)
    joint = motion.skeleton.roles.index("LeftForeArm")
    local = motion.local_rotation.copy()
    local[:, joint] = local[:, joint] @ so3_exp([0.0, 0.0, -np.radians(12.0)])
    late = replace(motion, local_rotation=local[15:], root_in_world_m=motion.root_in_world_m[15:],
                   observed=motion.observed[15:])  # fmt: skip
    found = compare(bvh(tmp_path, "a", motion), bvh(tmp_path, "b", late), shift_s=0.5)
    angles = found.figures["angles"]
    assert angles["left elbow"]["mean_deg"] == pytest.approx(-12.0, abs=0.01)
    assert angles["right elbow"]["mean_abs_deg"] < 0.01
    assert found.figures["common_s"] == pytest.approx(74 / 30, abs=1e-6)


def test_a_results_folder_tells_what_was_measured(tmp_path: Path) -> None:
    motion, _ = walking(60)
    observed = np.zeros_like(motion.observed)
    for role in ("LeftArm", "LeftForeArm", "LeftHand"):
        observed[:30, motion.skeleton.roles.index(role)] = True
    motion = replace(motion, observed=observed)
    write_bvh(tmp_path / "motion.bvh", motion)
    write_joint_table(tmp_path / "joints.csv", motion)
    joints = {
        name: {"role": role} for name, role in zip(motion.skeleton.joints, motion.skeleton.roles, strict=True)
    }
    (tmp_path / "metrics.json").write_text(
        json.dumps({"motion": {"start_s": motion.start_ns / 1e9, "joints": joints}})
    )
    found = compare(tmp_path, bvh(tmp_path, "truth", motion))
    np.testing.assert_array_equal(found.takes[0].motion.observed, observed)
    assert found.takes[1].motion.observed.all()
    assert found.figures["angles"]["left elbow"]["measured_a"] == pytest.approx(0.5)
    page = write_comparison(found, tmp_path / "page.html").read_text()
    assert page.count("not measured in A") >= 3
    assert 'class="unmeasured"' in page
    assert "http://www.w3.org/2000/svg" in page
    assert "<script" not in page


def test_what_cannot_be_compared_is_refused(tmp_path: Path) -> None:
    motion, _ = walking(30)
    a = bvh(tmp_path, "a", motion)
    with pytest.raises(JobError, match="no motion to compare"):
        compare(a, tmp_path / "nothing")
    with pytest.raises(JobError, match="no time in common") as caught:
        compare(a, a, shift_s=100.0)
    assert "--shift" in str(caught.value.hint)
    (tmp_path / "metrics.json").write_text("{")
    (tmp_path / "joints.csv").write_text("time,joint,observed\n")
    a.rename(tmp_path / "motion.bvh")
    with pytest.raises(JobError, match="figures of the motion cannot be read"):
        compare(tmp_path, tmp_path / "motion.bvh")
