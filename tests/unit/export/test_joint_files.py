"""USD, C3D, TRC and tables: round trips, and errors for missing libraries."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bodycap_batch.config.options import ExportOptions
from bodycap_batch.core.errors import JobError, StoreError
from bodycap_batch.export.layout import apply_layout
from bodycap_batch.export.motion_files import motion_difference, points_from_motion
from bodycap_batch.export.tables import write_joint_arrays, write_joint_table
from bodycap_batch.formats import optional_libraries, usd
from bodycap_batch.formats.c3d import LabelledPoints, read_c3d, write_c3d
from bodycap_batch.formats.fbx import blender_process
from bodycap_batch.formats.trc import write_trc
from bodycap_batch.model.geometry import rotation_from_quat_xyzw
from tests.bodies import reaching
from tests.figures import skinned


@pytest.mark.parametrize("options", [{}, {"names": "unreal", "root": "ground"}, {"names": "mixamo"}], ids=str)
def test_usd_round_trip_and_validation(tmp_path: Path, options: dict[str, Any]) -> None:
    from pxr import Usd, UsdGeom, UsdSkel, UsdValidation

    motion = apply_layout(reaching(12), ExportOptions.model_validate(options))
    usd.write_usd(tmp_path / "a.usd", motion)
    usd.write_usd(tmp_path / "b.usd", motion)
    assert (tmp_path / "a.usd").read_bytes() == (tmp_path / "b.usd").read_bytes()
    back = usd.read_usd(tmp_path / "a.usd")
    assert back.skeleton.joints == motion.skeleton.joints
    # single precision at 2 m from the origin, along nine joints
    assert motion_difference(back, motion)[0] < 9 * 2 * 6e-8 + 1e-9
    stage = Usd.Stage.Open(str(tmp_path / "a.usd"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert (stage.GetTimeCodesPerSecond(), stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (30, 0, 11)
    (animation,) = [prim for prim in stage.Traverse() if prim.IsA(UsdSkel.Animation)]
    for name in ("translations", "rotations", "scales"):
        assert animation.GetAttribute(name).GetTimeSamples() == [float(frame) for frame in range(12)]
    registry = UsdValidation.ValidationRegistry()
    context = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators())
    assert [error.GetErrorAsString() for error in context.Validate(stage)] == []


def test_usd_skinning_moves_the_mannequin(tmp_path: Path) -> None:
    """With USD's own skinning, the vertices move as the joints and the weights say."""
    from pxr import Usd, UsdSkel

    motion = reaching(12)
    usd.write_usd(tmp_path / "a.usd", motion)
    stage = Usd.Stage.Open(str(tmp_path / "a.usd"))
    root = UsdSkel.Root(stage.GetDefaultPrim())
    cache = UsdSkel.Cache()
    cache.Populate(root, Usd.PrimDefaultPredicate)
    (binding,) = cache.ComputeSkelBindings(root, Usd.PrimDefaultPredicate)
    query = cache.GetSkelQuery(binding.GetSkeleton())
    (skinning,) = binding.GetSkinningTargets()
    matrices = query.ComputeSkinningTransforms(11.0)
    points = skinning.GetPrim().GetAttribute("points").Get()
    assert skinning.ComputeSkinnedPoints(matrices, points, 11.0)
    np.testing.assert_allclose(np.array(points), skinned(motion, 11), atol=1e-5)


def test_odd_joint_names_become_unique_tokens(tmp_path: Path) -> None:
    motion = reaching(2)
    names = ("Bip01 Pelvis", "9 lives", "a:b", "Spine.x", *motion.skeleton.joints[4:])
    odd = replace(motion, skeleton=replace(motion.skeleton, joints=names))
    assert usd.read_usd(usd.write_usd(tmp_path / "a.usd", odd)).skeleton.joints == names


def test_c3d_is_in_millimetres_z_up(tmp_path: Path) -> None:
    import ezc3d

    motion = reaching(25)
    write_c3d(tmp_path / "a.c3d", points_from_motion(motion))
    raw = ezc3d.c3d(str(tmp_path / "a.c3d"))
    head = raw["parameters"]["POINT"]["LABELS"]["value"].index("Head")
    assert raw["parameters"]["POINT"]["UNITS"]["value"] == ["mm"]
    assert raw["parameters"]["POINT"]["RATE"]["value"] == [30.0]
    assert 1500 < raw["data"]["points"][2, head, 0] < 1650
    back = read_c3d(tmp_path / "a.c3d")
    assert back.names == motion.skeleton.joints
    np.testing.assert_allclose(back.x_in_world_m, motion.world_from_joint()[..., :3, 3], atol=1e-6)


def test_c3d_refuses_points_that_lose_precision(tmp_path: Path) -> None:
    far = LabelledPoints(names=("a",), fps=30.0, x_in_world_m=np.full((3, 1, 3), 123456.789))
    with pytest.raises(StoreError, match="in the written file differ"):
        write_c3d(tmp_path / "a.c3d", far)
    assert not (tmp_path / "a.c3d").exists()


def test_trc_is_in_millimetres_x_forward_y_up(tmp_path: Path) -> None:
    motion = reaching(20)
    write_trc(tmp_path / "a.trc", points_from_motion(motion))
    rows = [line.split("\t") for line in (tmp_path / "a.trc").read_text().splitlines()]
    assert rows[2][:5] == ["30", "30", "20", "21", "mm"]
    names = [name for name in rows[3][2:] if name]
    assert names == list(motion.skeleton.joints)
    assert all(len(row) == 2 + 3 * 21 for row in (rows[3], *rows[6:]))
    table = np.array(rows[6:], dtype=float)
    np.testing.assert_allclose(table[:, 1], np.arange(20) / 30.0, atol=1e-6)
    at = {name: table[:, 2 + 3 * index : 5 + 3 * index] for index, name in enumerate(names)}
    # walks forward along +X, stands along +Y, the right hand is on +Z
    assert at["Hips"][-1, 0] == pytest.approx(1100.0 * 19 / 30, abs=0.001)
    assert at["Head"][0, 1] - at["Hips"][0, 1] > 500
    assert at["RightHand"][0, 2] > 200 > -200 > at["LeftHand"][0, 2]


def test_tables_have_all_joints_and_ticks(tmp_path: Path) -> None:
    motion = reaching(3)
    sigma = np.full((3, 21), np.nan)
    sigma[1, 4] = 0.0125
    write_joint_table(tmp_path / "joints.csv", motion, sigma)
    write_joint_arrays(tmp_path / "joints.npz", motion, sigma)
    with open(tmp_path / "joints.csv", newline="") as handle:
        rows = list(csv.DictReader(handle))
    assert len(rows) == 3 * 21
    assert (rows[0]["time"], rows[0]["joint"], rows[0]["sigma_m"]) == ("5.000000000", "Hips", "")
    assert (rows[25]["joint"], rows[25]["sigma_m"], rows[25]["observed"]) == ("Head", "0.012500", "0")
    arrays = np.load(tmp_path / "joints.npz", allow_pickle=False)
    poses = motion.world_from_joint()
    np.testing.assert_array_equal(arrays["world"], poses[..., :3, 3])
    np.testing.assert_allclose(
        rotation_from_quat_xyzw(arrays["world_quat_xyzw"]), poses[..., :3, :3], atol=1e-12
    )
    np.testing.assert_array_equal(arrays["sigma_m"], sigma)
    assert arrays["names"].tolist() == list(motion.skeleton.joints)
    numbers = [[float(row[key]) for key in ("x_m", "y_m", "z_m")] for row in rows]
    np.testing.assert_allclose(np.reshape(numbers, (3, 21, 3)), poses[..., :3, 3], atol=6e-7)


def test_the_error_for_a_missing_library_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    optional_libraries.require_libraries(("bvh", "glb", "trc", "fbx"))
    monkeypatch.setattr(optional_libraries, "find_spec", lambda name: None)
    for name in ("usd", "c3d"):
        with pytest.raises(JobError, match=name.upper()) as caught:
            optional_libraries.require_libraries(("bvh", name))
        assert "bodycap_batch[formats]" in str(caught.value.hint)
        assert caught.value.field == "export.formats"


def test_blender_is_not_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("BODYCAP_BLENDER", str(tmp_path / "nothing"))
    with pytest.raises(JobError, match="is not the path of a program"):
        blender_process.find_blender()
    monkeypatch.delenv("BODYCAP_BLENDER")
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(blender_process, "__file__", str(tmp_path / "a" / "b" / "c" / "blender.py"))
    monkeypatch.setattr(blender_process.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(JobError, match="was not found") as caught:
        blender_process.find_blender()
    assert "make blender" in str(caught.value.hint)


def test_blender_does_not_start(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    program = tmp_path / "blender"
    program.write_text("#!/bin/sh\necho 'libX11.so.6: not found' >&2\nexit 127\n")
    program.chmod(0o755)
    monkeypatch.setenv("BODYCAP_BLENDER", str(program))
    with pytest.raises(JobError, match=r"cannot be used: libX11"):
        blender_process.require_blender()


def test_joint_names_are_quoted_in_the_table(tmp_path: Path) -> None:
    motion = reaching(1)
    odd = ('Hips "A", low', *motion.skeleton.joints[1:])
    write_joint_table(tmp_path / "joints.csv", replace(motion, skeleton=replace(motion.skeleton, joints=odd)))
    with (tmp_path / "joints.csv").open(newline="") as stream:
        assert tuple(row["joint"] for row in csv.DictReader(stream)) == odd
