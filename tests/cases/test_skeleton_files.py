"""Skeleton files of other programs: axes, units, names, and lengths in the position channels."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.cli import main
from bodycap_batch.formats.bvh import ROLES, read_bvh, read_rig

pytestmark = pytest.mark.data

ARM = {"LShoulder": "Shoulder", "LUArm": "Arm", "LFArm": "ForeArm", "LHand": "Hand"}


def case(data_root: Path, name: str) -> Path:
    folder = data_root.parent / "cases" / name
    if not folder.is_dir():
        pytest.skip(f"no case in {folder}")
    return folder


@pytest.mark.parametrize("file", ["base_inch.bvh", "w_inch.bvh"])
@pytest.mark.parametrize("height", [[], ["--height", "1.75"]])
def test_inches_are_refused(
    data_root: Path, capfd: pytest.CaptureFixture[str], file: str, height: list[str]
) -> None:
    path = case(data_root, "skeleton_inches") / file
    assert main(["check", str(data_root / "walk12"), "--skeleton", str(path), *height]) == 2
    out = capfd.readouterr().out
    assert f"the skeleton is 0.{'69' if 'base' in file else '56'} m tall" in out
    assert "its lengths fit inches" in out


def test_all_roles_are_found(data_root: Path) -> None:
    for path in sorted(case(data_root, "skeleton_names").glob("*.bvh")):
        assert {*read_rig(path)[0].roles} >= {*ROLES}, path.name


def test_names_of_optitrack(data_root: Path) -> None:
    rig, _ = read_rig(case(data_root, "skeleton_optitrack_names") / "w_opti.bvh")
    found = dict(zip(rig.joints, rig.roles, strict=True))
    for name, part in ARM.items():
        assert found[name] == f"Left{part}"
        assert found["R" + name[1:]] == f"Right{part}"


def test_lengths_from_position_channels(data_root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = case(data_root, "skeleton_positions_not_offsets") / "zero_jitter.bvh"
    assert main(["skeleton", str(path)]) == 0
    assert "1.74 m from top to bottom" in capsys.readouterr().out


def test_turned_skeletons_give_the_same_motion(
    data_root: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The heading and the vertical of the zero pose change nothing: all joints are within 1 mm."""
    own = data_root / "walk12" / "skeleton.bvh"
    files = [own, *sorted(case(data_root, "skeleton_turned").glob("*.bvh"))]
    videos = tmp_path / "walk"
    videos.mkdir()
    for path in data_root.joinpath("walk12").iterdir():
        if path.suffix in (".mp4", ".json"):
            (videos / path.name).symlink_to(path)
    (videos / "job.yaml").write_text("export: {preview: false}\n")
    results = []
    for path in files:
        out = tmp_path / path.stem
        store = ["--store", str(tmp_path / "store"), "--out", str(out)]
        assert main(["run", str(videos), "--skeleton", str(path), *store]) == 0
        skeleton, motion = read_bvh(out / "motion.bvh")
        assert motion is not None
        places = motion.world_from_joint()[..., :3, 3]
        by_role = {role: places[:, joint] for joint, role in enumerate(skeleton.roles) if role}
        metrics = json.loads((out / "metrics.json").read_text())
        results.append((metrics["merge"]["scale"]["metres_per_map_unit"], by_role))
        if path != own:
            assert "turned upright" in capfd.readouterr().err
            assert "turned upright" in (out / "report.html").read_text(encoding="utf-8")
    for scale, by_role in results[1:]:
        assert scale == pytest.approx(results[0][0], rel=1e-3)
        for role, places in by_role.items():
            np.testing.assert_allclose(places, results[0][1][role], atol=1e-3)
