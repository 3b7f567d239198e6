"""Export targets: one word sets names, root, units, T-pose and formats of the files for a program."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from bodycap_batch.config.export_targets import TARGETS, export_target
from bodycap_batch.config.job import load_job
from bodycap_batch.config.options import ExportOptions
from bodycap_batch.core.errors import JobError
from bodycap_batch.export.layout import apply_layout
from bodycap_batch.formats.bvh import read_bvh, write_bvh
from bodycap_batch.formats.gltf import read_glb, write_glb
from bodycap_batch.model.bone_axes import align_axes_with_bones
from bodycap_batch.model.skeleton import Motion, rest_pose
from tests.bodies import reaching

JOB = """\
export: EXPORT
capture:
  cameras:
    - {name: torso, video: torso.mp4}
    - {name: left_palm, video: left_palm.mp4}
"""


def load(tmp_path: Path, export: str) -> ExportOptions:
    path = tmp_path / "a.yaml"
    path.write_text(JOB.replace("EXPORT", export))
    return load_job(path).export


def motion_for(target: str, **options: object) -> Motion:
    return apply_layout(reaching(12), ExportOptions.model_validate({"target": target, **options}))


@pytest.mark.parametrize("target", TARGETS)
def test_a_target_sets_the_other_options(target: str) -> None:
    program = export_target(target)
    options = ExportOptions.model_validate({"target": target})
    for name, value in program.options.items():
        assert getattr(options, name) == (tuple(value) if isinstance(value, list) else value)
    assert program.steps
    # Each stated value is one that the option accepts.
    ExportOptions.model_validate(dict(program.options))


def test_a_job_names_a_target_and_keeps_what_it_states(tmp_path: Path) -> None:
    options = load(tmp_path, "{target: unreal, fps: 60, formats: [fbx, glb]}")
    assert (options.names, options.root, options.fps) == ("unreal", "ground", 60.0)
    assert options.formats == ("fbx", "glb")
    written = yaml.safe_dump(options.model_dump(mode="json", exclude_none=True), default_flow_style=True)
    assert load(tmp_path, " ".join(written.split())) == options


def test_an_unknown_target_is_refused_with_the_list(tmp_path: Path) -> None:
    with pytest.raises(JobError, match="unreel") as caught:
        load(tmp_path, "{target: unreel}")
    assert caught.value.field == "export.target"
    assert caught.value.line == 1
    assert "unreal" in f"{caught.value.hint}"
    with pytest.raises(JobError, match="there is no export target 'max'") as caught:
        export_target("max")
    assert all(name in f"{caught.value.hint}" for name in TARGETS)


@pytest.mark.parametrize(("target", "root"), [("unreal", "root"), ("unity", "Root")])
def test_game_engines_get_one_root_on_the_floor(target: str, root: str) -> None:
    motion = motion_for(target)
    assert motion.skeleton.joints[0] == root
    assert list(motion.skeleton.parents).count(-1) == 1
    np.testing.assert_allclose(motion.root_in_world_m[:, 2], 0.0)
    np.testing.assert_allclose(motion.local_rotation[:, 0, 2], np.tile([0, 0, 1.0], (12, 1)), atol=1e-12)


def test_unity_gets_its_own_bone_names() -> None:
    expected = {"Hips", "Spine", "Chest", "UpperChest", "Neck", "Head", "Root"}
    parts = ("Shoulder", "UpperArm", "LowerArm", "Hand", "UpperLeg", "LowerLeg", "Foot", "Toes")
    expected |= {side + part for side in ("Left", "Right") for part in parts}
    assert set(motion_for("unity").skeleton.joints) == expected


@pytest.mark.parametrize(("target", "tpose"), [("maya", True), ("motionbuilder", True), ("unity", False)])
def test_humanik_gets_a_t_pose_as_frame_0(target: str, tpose: bool) -> None:
    motion = motion_for(target)
    assert len(motion.root_in_world_m) == 12 + tpose
    at = motion.world_from_joint()[0, :, :3, 3]
    rest = rest_pose(motion.skeleton)[:, :3, 3]
    still = np.allclose(at - at[0], rest - rest[0], atol=1e-9)
    assert still == tpose


@pytest.mark.parametrize("target", TARGETS)
def test_glb_and_bvh_hold_the_same_joint_centres(tmp_path: Path, target: str) -> None:
    """Within 0.1 mm, with the bind pose of the GLB file in the T-pose; the BVH keeps its zero pose."""
    motion = motion_for(target)
    write_bvh(tmp_path / "a.bvh", motion)
    write_glb(tmp_path / "a.glb", align_axes_with_bones(motion))
    body, ours = read_bvh(tmp_path / "a.bvh")
    theirs = read_glb(tmp_path / "a.glb")
    assert ours is not None
    order = [theirs.skeleton.joints.index(name) for name in ours.skeleton.joints]
    found = theirs.world_from_joint()[:, order][..., :3, 3]
    np.testing.assert_allclose(found, ours.world_from_joint()[..., :3, 3], atol=1e-4)
    rest = rest_pose(theirs.skeleton)[order][:, :3, 3]
    expected = rest_pose(motion.skeleton)[:, :3, 3]
    expected = expected[[motion.skeleton.joints.index(name) for name in ours.skeleton.joints]]
    np.testing.assert_allclose(rest, expected, atol=1e-4)
    np.testing.assert_array_equal(body.offsets_m[0], 0.0)
    assert "OFFSET 0.000000 0.000000 0.000000" in (tmp_path / "a.bvh").read_text().splitlines()[3]


def test_a_skeleton_file_keeps_its_joints_and_is_renamed_for_a_program() -> None:
    motion = reaching(4)
    body = motion.skeleton
    channels = (("Xposition", "Yposition", "Zposition", "Zrotation", "Xrotation", "Yrotation"),) + (
        ("Zrotation", "Xrotation", "Yrotation"),
    ) * (len(body.joints) - 1)
    own = replace(
        body,
        joints=(*(f"j{k}" for k in range(len(body.joints) - 1)), "hand_l"),
        roles=(*body.roles[:-1], ""),
        bvh_channels=channels,
    )
    motion = replace(motion, skeleton=own)
    assert apply_layout(motion, ExportOptions()).skeleton.joints == own.joints
    renamed = apply_layout(motion, ExportOptions(target="unreal")).skeleton
    assert len(renamed.joints) == len(own.joints) + 1
    assert renamed.joints[:2] == ("root", "pelvis")
    assert renamed.joints[-1] == "hand_l_2"
    assert len(set(renamed.joints)) == len(renamed.joints)
