"""Joints that no camera measured: marked in the files, listed in ``fill.json``, left out where not wanted."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bodycap_batch.config.options import ExportOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.export import ExportInputs, export_results
from bodycap_batch.fill import fill_motion
from bodycap_batch.fill.standing_height import HeightSigmas
from bodycap_batch.formats.bvh import read_bvh
from bodycap_batch.formats.c3d import read_c3d
from bodycap_batch.model.fill_data import FillMode
from bodycap_batch.model.merge_data import MergeResult
from bodycap_batch.model.skeleton import with_file_zero_pose
from tests.bodies import merged, reaching


def filled(mode: FillMode = "plausible") -> tuple[MergeResult, dict[str, Any]]:
    result, clocks = merged(reaching(90))
    found = fill_motion(
        result.motion,
        result.solved,
        heights=HeightSigmas(0.01, 0.06),
        mode=mode,
        context=StageContext(work_dir=Path()),
    )
    return replace(result, motion=found.motion, fill=found.report), dict(clocks)


def export(folder: Path, result: MergeResult, clocks: dict[str, Any], **options: Any) -> Path:
    inputs = ExportInputs(
        out_dir=folder, maps=(), trajectories=result.trajectories, clocks=clocks, merge=result
    )
    export_results(inputs, ExportOptions(**options), StageContext(work_dir=folder))
    return folder


def test_measured_joints_are_the_same_in_the_files_of_each_mode(tmp_path: Path) -> None:
    centres = {}
    for mode in ("plausible", "rest"):
        result, clocks = filled(mode)
        folder = export(tmp_path / mode, result, clocks, formats=["bvh", "npz", "c3d"])
        arrays = np.load(folder / "joints.npz")
        solved = [
            list(arrays["names"]).index(name) for name in np.array(result.skeleton.joints)[result.solved]
        ]
        _, motion = read_bvh(folder / "motion.bvh")
        assert motion is not None
        order = [motion.skeleton.joints.index(str(name)) for name in arrays["names"][solved]]
        centres[mode] = (arrays["world"][:, solved], motion.world_from_joint()[:, order, :3, 3])
        assert not arrays["observed"][:, ~result.solved].any()
        expected = with_file_zero_pose(result.motion).world_from_joint()[..., :3, 3]
        np.testing.assert_allclose(arrays["world"], expected, atol=1e-9)
    for first, second in zip(centres["plausible"], centres["rest"], strict=True):
        np.testing.assert_allclose(first, second, atol=1e-5)


def test_c3d_marks_unmeasured_joints_as_invalid(tmp_path: Path) -> None:
    result, clocks = filled()
    back = read_c3d(export(tmp_path, result, clocks, formats=["c3d"]) / "joints.c3d")
    assert back.measured is not None
    np.testing.assert_array_equal(back.measured, result.solved)


@pytest.mark.parametrize("wanted", [False, True])
def test_trc_leaves_unmeasured_joints_out_unless_asked(tmp_path: Path, *, wanted: bool) -> None:
    from trc import TRCData

    result, clocks = filled()
    folder = export(tmp_path, result, clocks, formats=["trc"], filled_markers=wanted)
    other = TRCData()
    other.load(str(folder / "joints.trc"))
    kept = np.flatnonzero(result.solved | wanted)
    assert other["Markers"] == [result.skeleton.joints[joint] for joint in kept]
    # A reader that splits rows at white space finds each joint at its own place.
    found = np.array([other[name] for name in other["Markers"]])
    world = 1000.0 * with_file_zero_pose(result.motion).world_from_joint()[..., :3, 3][:, kept]
    expected = np.stack([-world[..., 1], world[..., 2], -world[..., 0]], axis=-1)
    np.testing.assert_allclose(found.swapaxes(0, 1), expected, atol=1e-3)


def test_glb_and_usd_name_the_unmeasured_joints(tmp_path: Path) -> None:
    import pygltflib
    from pxr import Usd

    result, clocks = filled()
    folder = export(tmp_path, result, clocks, formats=["glb", "usd"])
    document = pygltflib.GLTF2().load(str(folder / "motion.glb"))
    marked = {node.name for node in document.nodes if (node.extras or {}).get("observed") is False}
    expected = {
        name
        for name, seen in zip(result.skeleton.joints, np.any(result.observed, axis=0), strict=True)
        if not seen
    }
    assert marked == expected
    stage = Usd.Stage.Open(str(folder / "motion.usd"))
    (listed,) = [
        list(prim.GetCustomDataByKey("unobservedJoints"))
        for prim in stage.Traverse()
        if prim.GetCustomDataByKey("unobservedJoints")
    ]
    assert set(listed) == expected
    sources = {name: "filled" if name in expected else "measured" for name in result.skeleton.joints}
    properties = {node.name: (node.extras or {}).get("motion_source") for node in document.nodes}
    assert {name: properties[name] for name in sources} == sources
    (values,) = [
        list(prim.GetAttribute("primvars:motionSource").Get())
        for prim in stage.Traverse()
        if prim.HasAttribute("primvars:motionSource")
    ]
    assert values == [sources[name] for name in result.skeleton.joints]


def test_fill_json_lists_joints_and_steps(tmp_path: Path) -> None:
    result, clocks = filled()
    content = json.loads((export(tmp_path, result, clocks, formats=["bvh"]) / "fill.json").read_text())
    assert result.fill is not None
    assert content["mode"] == "plausible"
    names = np.array(result.skeleton.joints)
    assert content["measured_joints"] == names[result.solved].tolist()
    assert content["rest_joints"] == ["LeftShoulder", "RightShoulder"]
    others = set(names[~result.solved]) - {"LeftShoulder", "RightShoulder"}
    assert set(content["filled_joints"]) == others
    assert len(content["footsteps"]) == len(result.fill.footsteps.side) > 0
    assert {step["foot"] for step in content["footsteps"]} == {"left", "right"}
    floor = content["floor"]
    assert floor["source"] == "measured"
    # The floor takes up its share of what the standing legs measure, less than its sigma of 1 cm.
    assert abs(floor["height_m"]) < floor["sigma_m"] <= 0.01


def test_without_a_pose_unmeasured_joints_are_left_out(tmp_path: Path) -> None:
    result, clocks = filled("none")
    folder = export(tmp_path, result, clocks, formats=["bvh"])
    skeleton, _ = read_bvh(folder / "motion.bvh")
    assert "LeftFoot" not in skeleton.joints
    assert "LeftHand" in skeleton.joints
    assert json.loads((folder / "fill.json").read_text())["filled_joints"] == []
