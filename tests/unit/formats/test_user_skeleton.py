"""A user's own skeleton: its roles, roles set by the user, and a T-pose that is not its zero pose."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.cli import main
from bodycap_batch.core.errors import JobError
from bodycap_batch.formats.bvh import RigOptions, missing_roles, read_bvh, read_rig, write_bvh
from bodycap_batch.formats.bvh.skeleton_description import describe_direction, describe_joints
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.nominal_mounts import nominal_mount
from bodycap_batch.model.skeleton import (
    Motion,
    SkeletonModel,
    rest_pose,
    with_file_zero_pose,
    with_tpose_as_zero_pose,
)
from bodycap_batch.model.skeleton_presets import bone_vector, load_skeleton, segment_axes
from tests.bodies import reaching


def folded(turn_rad: float = 0.9) -> Motion:
    """Return a motion of a skeleton with a meaningless zero pose; frame 1 has a T-pose with any heading."""
    motion = reaching(3)
    body = motion.skeleton
    zero = so3_exp(np.random.default_rng(4).normal(size=(len(body.joints), 3)))
    offsets, ends = np.array(body.offsets_m), np.array(body.end_offsets_m)
    for joint, parent in enumerate(body.parents.tolist()):
        if parent >= 0:
            offsets[joint] = zero[parent] @ offsets[joint]
        ends[joint] = zero[joint] @ ends[joint]
    local = np.tile(np.eye(3), (3, len(body.joints), 1, 1))
    world = np.swapaxes(zero, -1, -2)
    for joint, parent in enumerate(body.parents.tolist()):
        local[1, joint] = world[joint] if parent < 0 else world[parent].T @ world[joint]
    local[1, 0] = so3_exp([0.0, 0.0, turn_rad]) @ local[1, 0]
    channels = ("Zrotation", "Xrotation", "Yrotation")
    rig = replace(body, offsets_m=offsets, end_offsets_m=ends, bvh_channels=(channels,) * len(body.joints))
    return replace(motion, skeleton=rig, local_rotation=local)


def test_the_t_pose_comes_from_a_frame_and_faces_the_front(tmp_path: Path) -> None:
    write_bvh(tmp_path / "rig.bvh", folded())
    rig, _ = read_rig(tmp_path / "rig.bvh", RigOptions(tpose_frame=1))
    plain = load_skeleton("upper_body", 1.75)
    expected = rest_pose(plain)
    found = rest_pose(rig)
    order = [rig.roles.index(role) for role in plain.roles]
    off = found[order, :3, 3] - expected[:, :3, 3]
    np.testing.assert_allclose(off, np.broadcast_to(off[0], off.shape), atol=1e-6)
    assert not rig.warnings
    itself, _ = read_rig(tmp_path / "rig.bvh")
    np.testing.assert_allclose(rest_pose(itself), found, atol=1e-6)
    assert "frame 1 is nearest to a T-pose" in itself.notes[0]


@pytest.mark.parametrize("factor", [0.1772, 10.0])
def test_a_body_in_another_unit_of_length_is_refused(tmp_path: Path, factor: float) -> None:
    """Recordings of CMU have units of 5.644 cm; other files have millimetres."""
    motion = reaching(3)
    body = motion.skeleton
    small = replace(body, offsets_m=factor * body.offsets_m, end_offsets_m=factor * body.end_offsets_m)
    write_bvh(tmp_path / "rig.bvh", replace(motion, skeleton=small))
    with pytest.raises(JobError, match="tall") as raised:
        read_rig(tmp_path / "rig.bvh")
    assert raised.value.field == "skeleton"


@pytest.mark.parametrize("role", ["LeftForeArm", "RightHand", "LeftLeg", "RightFoot", "Spine1", "Head"])
def test_limb_axes_are_those_of_the_t_pose(tmp_path: Path, role: str) -> None:
    """The nominal mount on the body does not depend on the zero pose of the skeleton."""
    write_bvh(tmp_path / "rig.bvh", folded())
    rig, _ = read_rig(tmp_path / "rig.bvh", RigOptions(tpose_frame=1))
    plain = load_skeleton("upper_body", 1.75)
    joint = rig.roles.index(role)
    turn = rest_pose(rig)[joint, :3, :3]
    np.testing.assert_allclose(turn @ segment_axes(rig, role), segment_axes(plain, role), atol=1e-6)
    vector, expected = bone_vector(rig, role), bone_vector(plain, role)
    if role in ("LeftForeArm", "LeftLeg"):
        assert vector is not None
        assert expected is not None
        np.testing.assert_allclose(turn @ vector, expected, atol=1e-6)
    mount, usual = nominal_mount("camera", role, rig), nominal_mount("camera", role, plain)
    np.testing.assert_allclose(turn @ mount.joint_from_cam[:3, :3], usual.joint_from_cam[:3, :3], atol=1e-6)


def test_overrides_move_roles(tmp_path: Path) -> None:
    write_bvh(tmp_path / "rig.bvh", reaching(2))
    rig, _ = read_rig(tmp_path / "rig.bvh", RigOptions(roles={"Neck": "Spine1", "LeftToeBase": "none"}))
    at = dict(zip(rig.joints, rig.roles, strict=True))
    assert (at["Neck"], at["Spine1"], at["LeftToeBase"]) == ("Spine1", "", "")
    assert missing_roles(rig) == ("Neck", "LeftToeBase")


@pytest.mark.parametrize(
    ("options", "message", "hint"),
    [
        (RigOptions(roles={"Nek": "Neck"}), "no joint 'Nek'", "did you mean 'Neck'"),
        (RigOptions(roles={"Neck": "Tentacle"}), "no role 'Tentacle'", "one of"),
        (RigOptions(roles={"Neck": "Head", "Spine": "Head"}), "two joints", "one joint"),
        (RigOptions(tpose_frame=2), "no frame 2", "the file has 2"),
        (RigOptions(tpose_frame=-1), "no frame -1", "the first frame is 0"),
    ],
)
def test_what_does_not_exist_is_named(tmp_path: Path, options: RigOptions, message: str, hint: str) -> None:
    write_bvh(tmp_path / "rig.bvh", reaching(2))
    with pytest.raises(JobError, match=message) as caught:
        read_rig(tmp_path / "rig.bvh", options)
    assert hint in str(caught.value.hint)
    assert caught.value.path is not None


def test_the_description_of_the_joints() -> None:
    body: SkeletonModel = load_skeleton("full_body", 1.75)
    lines = {line.role: line for line in describe_joints(body)}
    assert (lines["LeftForeArm"].points, lines["RightLeg"].points) == ("left", "down")
    assert lines["LeftForeArm"].bone_m == pytest.approx(1.75 * 0.146)
    assert lines["LeftFoot"].points.startswith("forward, ")
    assert describe_direction(np.array([0.0, -1.0, -1.0])) in ("forward, 45° down", "down, 45° forward")


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_bvh(tmp_path / "rig.bvh", folded())
    assert main(["skeleton", str(tmp_path / "rig.bvh"), "--tpose-frame", "1", "--map", "Neck=none"]) == 0
    out = capsys.readouterr().out
    assert "arms stretched out to the sides (T-pose)" in out
    assert "roles without a joint: Neck" in out
    assert 'skeleton_map: {"Neck": none}' in out
    assert "tpose_frame: 1" in out
    assert main(["skeleton", str(tmp_path / "rig.bvh"), "--json"]) == 0
    joints = json.loads(capsys.readouterr().out)["joints"]
    assert [joint["name"] for joint in joints] == list(read_bvh(tmp_path / "rig.bvh")[0].joints)
    assert main(["skeleton", str(tmp_path / "rig.bvh"), "--map", "Neck"]) == 2
    assert "JOINT=ROLE" in capsys.readouterr().err


def test_a_skeleton_with_a_t_pose_keeps_the_layout_of_its_file(tmp_path: Path) -> None:
    motion = folded()
    write_bvh(tmp_path / "rig.bvh", motion)
    rig, moving = read_rig(tmp_path / "rig.bvh", RigOptions(tpose_frame=1))
    assert moving is not None
    write_bvh(tmp_path / "again.bvh", moving)
    first, second = (
        (tmp_path / name).read_text().partition("MOTION")[0] for name in ("rig.bvh", "again.bvh")
    )
    assert first == second
    assert rig.tpose_rotation is not None


def test_a_motion_solved_in_the_t_pose_goes_back_into_the_file(tmp_path: Path) -> None:
    """The motion is solved with the T-pose as zero pose and written with the zero pose of the file."""
    write_bvh(tmp_path / "rig.bvh", folded())
    rig, _ = read_rig(tmp_path / "rig.bvh", RigOptions(tpose_frame=1))
    body = with_tpose_as_zero_pose(rig)
    plain = load_skeleton("upper_body", 1.75)
    np.testing.assert_allclose(body.offsets_m[1:], plain.offsets_m[1:], atol=1e-6)
    np.testing.assert_allclose(rest_pose(body)[:, :3, :3], np.broadcast_to(np.eye(3), (21, 3, 3)))
    solved = replace(reaching(20), skeleton=body)
    back = with_file_zero_pose(solved)
    np.testing.assert_allclose(back.skeleton.offsets_m, rig.offsets_m, atol=1e-12)
    assert back.skeleton.file_rotation is None
    ours, theirs = solved.world_from_joint(), back.world_from_joint()
    np.testing.assert_allclose(theirs[..., :3, 3], ours[..., :3, 3], atol=1e-9)
    # joints that were not solved are in the T-pose
    assert rig.tpose_rotation is not None
    leg = rig.roles.index("LeftLeg")
    np.testing.assert_allclose(
        back.local_rotation[:, leg], np.tile(rig.tpose_rotation[leg], (20, 1, 1)), atol=1e-9
    )
    write_bvh(tmp_path / "out.bvh", back)
    first, second = ((tmp_path / name).read_text().partition("MOTION")[0] for name in ("rig.bvh", "out.bvh"))
    assert first == second
