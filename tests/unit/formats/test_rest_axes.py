"""A skeleton whose rest pose is turned, or is a frame, means the same body as the upright one."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.cli import main
from bodycap_batch.config.options import ExportOptions
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import JobError
from bodycap_batch.export import ExportInputs, export_results
from bodycap_batch.formats.bvh import RigOptions, read_bvh, read_rig, write_bvh
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.nominal_mounts import camera_reach, nominal_mount
from bodycap_batch.model.skeleton import (
    Motion,
    SkeletonModel,
    rest_pose,
    with_tpose_as_zero_pose,
    without_outer_joints,
)
from bodycap_batch.model.skeleton_presets import load_skeleton
from bodycap_batch.synthetic.clip import load_clip
from tests.bodies import CAMERAS, merged, reaching

RIGHT_ANGLES = [
    np.array([first, second, np.cross(first, second)])
    for first, second in itertools.permutations(np.concatenate([np.eye(3), -np.eye(3)]), 2)
    if first @ second == 0.0
]
ODD_ANGLES = [
    so3_exp(np.radians(turn))
    for turn in ([0, 0, 30], [0, 0, -45], [0, 0, 4], [30, 0, 0], [0, 50, 0], [33, -71, 128], [-20, 15, 100])
]
CHANNELS = ("Zrotation", "Xrotation", "Yrotation")


def plain() -> SkeletonModel:
    """Return a body whose left and right sides differ, with spread legs, as recorded bodies have them."""
    body = load_skeleton("full_body", 1.75)
    offsets = np.array(body.offsets_m)
    spread = so3_exp([0.0, -0.3, 0.0])
    for joint, role in enumerate(body.roles):
        if role.endswith(("Leg", "Foot")) and "UpLeg" not in role:
            turn = spread if role.startswith("Left") else spread.T
            offsets[joint] = turn @ offsets[joint] * (1.03 if role.startswith("Left") else 1.0)
    offsets[0] = 0.0
    body = replace(body, offsets_m=offsets, bvh_channels=(CHANNELS,) * len(body.joints))
    offsets[0] = rest_pose(body)[0, :3, 3]
    return replace(body, offsets_m=offsets)


def with_wrappers(body: SkeletonModel) -> SkeletonModel:
    """Return the body below an armature and a root on the floor, with a prop beside the hips."""
    count = len(body.joints)
    return replace(
        body,
        joints=("Armature", "Root", *body.joints, "Prop"),
        parents=np.array([-1, 0, 1, *(body.parents[1:] + 2), 1]),
        offsets_m=np.concatenate(
            [np.zeros((1, 3)), [[0, 0.1, 0]], body.offsets_m[:1], body.offsets_m[1:], [[1.0, 0, -0.3]]]
        ),
        end_offsets_m=np.concatenate([np.full((2, 3), np.nan), body.end_offsets_m, [[0.0, 0.0, 0.1]]]),
        roles=("", "", *body.roles, ""),
        bvh_channels=(CHANNELS,) * (count + 3),
    )


def turned(body: SkeletonModel, turn: FloatArray) -> SkeletonModel:
    return replace(body, offsets_m=body.offsets_m @ turn.T, end_offsets_m=body.end_offsets_m @ turn.T)


def still(body: SkeletonModel) -> Motion:
    count = len(body.joints)
    return Motion(
        skeleton=body,
        fps=30.0,
        start_ns=0,
        root_in_world_m=np.zeros((1, 3)),
        local_rotation=np.tile(np.eye(3), (1, count, 1, 1)),
        observed=np.ones((1, count), dtype=bool),
    )


def body_of(path: Path) -> SkeletonModel:
    """Return the skeleton that the merge solves."""
    return without_outer_joints(with_tpose_as_zero_pose(read_rig(path)[0]))


@pytest.mark.parametrize("wrapped", [False, True])
@pytest.mark.parametrize("turn", RIGHT_ANGLES + ODD_ANGLES)
def test_a_turned_rest_pose_is_the_same_body(tmp_path: Path, turn: FloatArray, wrapped: bool) -> None:
    """Roles, joints, mounts, reach and standing height are those of the upright skeleton, to 0.1 mm."""
    upright = plain()
    rig = with_wrappers(upright) if wrapped else upright
    write_bvh(tmp_path / "own.bvh", still(upright))
    write_bvh(tmp_path / "rig.bvh", still(turned(rig, turn)))
    own, found = body_of(tmp_path / "own.bvh"), body_of(tmp_path / "rig.bvh")
    assert found.joints == own.joints
    assert found.roles == own.roles == upright.roles
    np.testing.assert_allclose(found.offsets_m[1:], own.offsets_m[1:], atol=1e-4)
    np.testing.assert_allclose(rest_pose(found), rest_pose(own), atol=1e-4)
    first, second = (
        [nominal_mount(camera, role, each) for camera, role in CAMERAS.items()] for each in (own, found)
    )
    for one, other in zip(first, second, strict=True):
        np.testing.assert_allclose(other.joint_from_cam, one.joint_from_cam, atol=1e-4)
    assert camera_reach(found, second) == camera_reach(own, first)


@pytest.mark.parametrize("turn", [RIGHT_ANGLES[7], *ODD_ANGLES[:1], ODD_ANGLES[5]])
def test_results_fit_the_rig_of_the_file(tmp_path: Path, turn: FloatArray) -> None:
    """The exported file has the hierarchy of the rig, also above the hips, and the solved joints."""
    write_bvh(tmp_path / "rig.bvh", still(turned(with_wrappers(plain()), turn)))
    body = body_of(tmp_path / "rig.bvh")
    solved, clocks = merged(reaching(20, body), projected=False)
    inputs = ExportInputs(
        out_dir=tmp_path, maps=(), trajectories=solved.trajectories, clocks=clocks, merge=solved
    )
    options = ExportOptions(formats=("bvh", "glb", "csv", "npz"), tpose=True)
    export_results(inputs, options, StageContext(work_dir=tmp_path))
    first, second = (
        (tmp_path / name).read_text().partition("MOTION")[0] for name in ("rig.bvh", "motion.bvh")
    )
    assert [line.split()[:2] for line in first.splitlines()] == [
        line.split()[:2] for line in second.splitlines()
    ]
    rig, back = read_bvh(tmp_path / "motion.bvh")
    original, _ = read_bvh(tmp_path / "rig.bvh")
    np.testing.assert_allclose(rig.offsets_m[1:], original.offsets_m[1:], atol=1e-6)
    assert back is not None
    kept = [rig.joints.index(name) for name in body.joints]
    places = back.world_from_joint()[:, kept][..., :3, 3]
    np.testing.assert_allclose(places[1:], solved.motion.world_from_joint()[..., :3, 3], atol=1e-5)
    # the T-pose stands on the floor, and joints above the hips keep their orientation
    stands = rest_pose(body)[:, :3, 3]
    np.testing.assert_allclose(places[0, :, 2], stands[:, 2], atol=1e-4)
    np.testing.assert_allclose(places[0] - places[0, 0], stands - stands[0], atol=1e-4)
    roots = back.world_from_joint()[1:, :2, :3, :3]
    np.testing.assert_allclose(roots, np.broadcast_to(roots[0, 0], roots.shape), atol=1e-6)
    # a root on the floor replaces the joints above the hips
    export_results(inputs, ExportOptions(formats=("bvh",), root="ground"), StageContext(work_dir=tmp_path))
    rig, back = read_bvh(tmp_path / "motion.bvh")
    assert rig.joints[:2] == ("Reference", "Hips")
    assert back is not None
    kept = [rig.joints.index(name) for name in body.joints]
    places = back.world_from_joint()[:, kept][..., :3, 3]
    np.testing.assert_allclose(places, solved.motion.world_from_joint()[..., :3, 3], atol=1e-5)


def test_a_motion_to_render_may_have_a_turned_zero_pose(tmp_path: Path) -> None:
    """The cameras of a synthetic capture are mounted on the body, whatever the axes of its zero pose are."""
    motion, turn = reaching(20, plain()), ODD_ANGLES[5]
    local = turn @ motion.local_rotation @ turn.T
    local[:, 0] = motion.local_rotation[:, 0] @ turn.T
    other = replace(motion, skeleton=turned(motion.skeleton, turn), local_rotation=local)
    cameras = []
    for name, each in (("own", motion), ("turned", other)):
        write_bvh(tmp_path / f"{name}.bvh", each)
        skeleton = load_clip(tmp_path / f"{name}.bvh", 0.0, 0.5).skeleton
        joint = skeleton.roles.index("LeftHand")
        mount = nominal_mount("left_palm", "LeftHand", skeleton)
        cameras.append(each.world_from_joint()[:, joint] @ mount.joint_from_cam)
    np.testing.assert_allclose(cameras[1], cameras[0], atol=1e-4)


def along_one_axis(frames: dict[int, FloatArray], count: int = 4) -> Motion:
    """Return a rig whose bones lie along +Z in the zero pose.

    Args:
        frames: By number of a frame, rotations (J,3,3) in the world of the joints of the upright body.
        count: Number of frames; the others show the zero pose.
    """
    body = plain()
    joints, parents = len(body.joints), body.parents.tolist()
    axes = np.tile(np.eye(3), (joints, 1, 1))
    for joint in range(1, joints):
        children = [child for child, parent in enumerate(parents) if parent == joint]
        bone = body.offsets_m[children[0]] if children else body.end_offsets_m[joint]
        unit = bone / np.linalg.norm(bone)
        side = np.cross(unit, [0.36, 0.48, 0.8])
        side /= np.linalg.norm(side)
        axes[joint] = np.stack([side, np.cross(unit, side), unit], axis=1)
    above = np.stack([np.eye(3) if parent < 0 else axes[parent] for parent in parents])
    rig = replace(
        body,
        offsets_m=np.einsum("jba,jb->ja", above, body.offsets_m),
        end_offsets_m=np.einsum("jba,jb->ja", axes, body.end_offsets_m),
    )
    local = np.tile(np.eye(3), (count, joints, 1, 1))
    for frame, world in frames.items():
        own = world @ axes
        local[frame] = [own[j] if p < 0 else own[p].T @ own[j] for j, p in enumerate(parents)]
    return replace(
        still(rig),
        root_in_world_m=np.zeros((count, 3)),
        local_rotation=local,
        observed=np.ones((count, joints), dtype=bool),
    )


def arms_lowered(degrees: float) -> FloatArray:
    """Return the orientations (J,3,3) of the upright body with lowered arms."""
    body = plain()
    out = np.tile(np.eye(3), (len(body.joints), 1, 1))
    for joint, role in enumerate(body.roles):
        if role.endswith(("Arm", "ForeArm", "Hand")) and role not in ("LeftShoulder", "RightShoulder"):
            out[joint] = so3_exp([0.0, np.radians(degrees) * (1.0 if role.startswith("Left") else -1.0), 0.0])
    return out


@pytest.mark.parametrize("turn", [np.eye(3), ODD_ANGLES[0], RIGHT_ANGLES[9], ODD_ANGLES[5]])
def test_a_frame_replaces_a_zero_pose_that_is_no_pose(tmp_path: Path, turn: FloatArray) -> None:
    """The T-pose is found in any frame, with any heading and any axes, before an A-pose."""
    frames = {1: arms_lowered(45.0), 2: turn @ arms_lowered(0.0)}
    write_bvh(tmp_path / "rig.bvh", along_one_axis(frames))
    write_bvh(tmp_path / "own.bvh", still(plain()))
    rig, _ = read_rig(tmp_path / "rig.bvh")
    assert "frame 2 is nearest to a T-pose" in rig.notes[0]
    own, found = body_of(tmp_path / "own.bvh"), body_of(tmp_path / "rig.bvh")
    assert found.roles == own.roles
    np.testing.assert_allclose(found.offsets_m[1:], own.offsets_m[1:], atol=1e-4)
    stated, _ = read_rig(tmp_path / "rig.bvh", RigOptions(tpose_frame=2))
    np.testing.assert_allclose(rest_pose(stated), rest_pose(rig), atol=1e-6)


def test_an_a_pose_is_near_enough(tmp_path: Path) -> None:
    write_bvh(tmp_path / "rig.bvh", along_one_axis({3: arms_lowered(45.0)}))
    assert "frame 3" in read_rig(tmp_path / "rig.bvh")[0].notes[0]


def test_without_a_t_pose_the_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_bvh(tmp_path / "rig.bvh", along_one_axis({}))
    with pytest.raises(JobError, match="no pose of a body") as raised:
        read_rig(tmp_path / "rig.bvh")
    assert raised.value.field == "tpose_frame"
    assert "tpose_frame: 0" in str(raised.value.hint)
    write_bvh(tmp_path / "rig.bvh", along_one_axis({2: arms_lowered(75.0)}))
    with pytest.raises(JobError) as raised:
        read_rig(tmp_path / "rig.bvh")
    assert "tpose_frame: 2" in str(raised.value.hint)
    rig, _ = read_rig(tmp_path / "rig.bvh", RigOptions(tpose_frame=2))
    assert rig.tpose_rotation is not None
    with pytest.raises(JobError, match="frame 1 is no pose"):
        read_rig(tmp_path / "rig.bvh", RigOptions(tpose_frame=1))
    assert main(["skeleton", str(tmp_path / "rig.bvh"), "--json"]) == 2
    shown = capsys.readouterr()
    assert {joint["role"] for joint in json.loads(shown.out)["joints"]} >= {"LeftHand", "RightFoot"}
    assert "tpose_frame: 2" in shown.err


def test_toes_that_point_back_are_named(tmp_path: Path) -> None:
    """The names of left and right are exchanged, or the file is mirrored."""
    mirrored = replace(plain(), offsets_m=plain().offsets_m * [-1.0, 1.0, 1.0])
    write_bvh(tmp_path / "rig.bvh", still(mirrored))
    (warning,) = read_rig(tmp_path / "rig.bvh")[0].warnings
    assert "mirrored" in warning


UNITS = {"inches": 2.54, "feet": 30.48, "millimetres": 0.1, "decimetres": 10.0, "CMU": 5.644}


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("height_m", [None, 1.75, 1.6])
def test_another_unit_is_named(tmp_path: Path, unit: str, height_m: float | None) -> None:
    small = turned(plain(), np.eye(3) / UNITS[unit])
    write_bvh(tmp_path / "rig.bvh", still(small))
    with pytest.raises(JobError, match="m tall") as raised:
        read_rig(tmp_path / "rig.bvh", RigOptions(height_m=height_m))
    assert f"fit {unit}" in str(raised.value.hint).replace("the unit of CMU recordings", "CMU")
    assert f"multiply all lengths by {UNITS[unit]:g}" in str(raised.value.hint)


@pytest.mark.parametrize(
    ("height_m", "agrees"), [(1.75, True), (1.6, True), (2.0, True), (1.4, False), (2.15, False)]
)
def test_a_height_that_contradicts(tmp_path: Path, height_m: float, agrees: bool) -> None:
    write_bvh(tmp_path / "rig.bvh", still(plain()))
    options = RigOptions(height_m=height_m)
    if agrees:
        read_rig(tmp_path / "rig.bvh", options)
        return
    with pytest.raises(JobError, match=f"stated height is {height_m}") as raised:
        read_rig(tmp_path / "rig.bvh", options)
    assert "correct the height" in str(raised.value.hint)


def test_a_small_child_is_a_person_if_its_height_is_stated(tmp_path: Path) -> None:
    write_bvh(tmp_path / "rig.bvh", still(turned(plain(), 0.4 * np.eye(3))))
    with pytest.raises(JobError, match="no person has this height"):
        read_rig(tmp_path / "rig.bvh")
    assert read_rig(tmp_path / "rig.bvh", RigOptions(height_m=0.72))[0].roles == plain().roles


@pytest.mark.parametrize("noise_m", [0.0, 2e-4, 2e-3])
def test_lengths_from_position_channels(tmp_path: Path, noise_m: float) -> None:
    """OFFSETs of zero, and bones in position channels with noise: the mean is the length."""
    body, frames = plain(), 200
    channels = (*("Xposition", "Yposition", "Zposition"), *CHANNELS)
    names = (channels,) * len(body.joints)
    write_bvh(tmp_path / "own.bvh", still(replace(body, bvh_channels=names)))
    head, _, row = (tmp_path / "own.bvh").read_text().rpartition("Frame Time")
    lines = [
        "OFFSET 0 0 0".join(line.partition("OFFSET")[::2]).partition("0 0 0")[0] + "0 0 0"
        if "OFFSET" in line and "\t\tOFFSET" in line and "End" not in previous
        else line
        for previous, line in itertools.pairwise(["", "", *head.splitlines()][1:])
    ]
    text = "\n".join(lines).replace("Frames: 1", f"Frames: {frames}")
    values = np.array([float(word) for word in row.split("\n")[1].split()])
    rng = np.random.default_rng(1)
    is_position = np.tile([True] * 3 + [False] * 3, len(body.joints))
    rows = values + 100.0 * noise_m * rng.normal(size=(frames, len(values))) * is_position
    text += "\nFrame Time: 0.0333333\n" + "\n".join(" ".join(f"{v:.6f}" for v in line) for line in rows)
    (tmp_path / "rig.bvh").write_text(text + "\n")
    found, own = body_of(tmp_path / "rig.bvh"), body_of(tmp_path / "own.bvh")
    # The mean of 200 values has a fourteenth of their noise; 4 sigma.
    np.testing.assert_allclose(found.offsets_m[1:], own.offsets_m[1:], atol=1e-5 + 4.0 * noise_m / 14.0)
    assert "position channels" in found.notes[0]
