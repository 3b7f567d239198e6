"""The animated cameras in Blender: its own projection shows points where our pinhole camera sees them."""

from __future__ import annotations

import json
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.config.options import ExportOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import JobError
from bodycap_batch.export import ExportInputs, export_results
from bodycap_batch.formats.fbx import find_blender
from bodycap_batch.model.geometry import invert, transform_points
from bodycap_batch.model.pinhole import pinhole_of
from tests.blender.test_imports import clean
from tests.unit.export.test_cameras import SIZE, body_inputs, lenses, points_before

pytestmark = pytest.mark.blender
LOOK = Path(__file__).with_name("look_at_cameras.py")
FORMATS = ("glb", "usd", "fbx", "abc")
INSTANTS = (0, 13, 29, 44, 59)
NTSC = 30000 / 1001


@pytest.fixture(scope="module")
def blender() -> Path:
    try:
        return find_blender()
    except JobError as error:
        pytest.skip(f"{error.message}; {error.hint}")


@pytest.fixture(scope="module", params=[30.0, NTSC], ids=["30", "29.97"])
def exported(
    blender: Path, request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> ExportInputs:
    inputs = body_inputs(tmp_path_factory.mktemp("results"), fps=request.param)
    export_results(inputs, ExportOptions(formats=FORMATS), StageContext(work_dir=inputs.out_dir))
    return inputs


@pytest.mark.parametrize("name", FORMATS)
def test_blender_shows_points_within_half_a_pixel(blender: Path, exported: ExportInputs, name: str) -> None:
    merge, folder = exported.merge, exported.out_dir
    assert merge is not None
    paths = {path.camera: path for path in merge.trajectories if path.camera in lenses()}
    points = np.concatenate(
        [points_before(path.gauge_from_cam[tick]) for path in paths.values() for tick in INSTANTS]
    )
    (folder / "points.json").write_text(json.dumps(points.tolist()))
    rate = "30" if merge.fps == 30.0 else "30000/1001"
    files = sorted((folder / "cameras").glob("*.abc")) if name == "abc" else [folder / f"cameras.{name}"]
    seen, room = {}, []
    for file in files:
        arguments = [folder / "report.json", file, rate, "60", folder / "points.json", *SIZE]
        done = subprocess.run(
            [str(blender), str(LOOK), *map(str, arguments)],
            capture_output=True, text=True, check=False, timeout=300, env=clean(),
        )  # fmt: skip
        assert done.returncode == 0, done.stderr[-2000:]
        report = json.loads((folder / "report.json").read_text())
        seen |= report["seen"]
        room += report["room"]
    assert sorted(seen) == sorted(paths)
    for camera, path in paths.items():
        pinhole = pinhole_of(lenses()[camera], *SIZE)
        for tick in INSTANTS:
            x_in_cam = transform_points(invert(path.gauge_from_cam[tick]), points)
            ours = pinhole.project(x_in_cam)
            shown = (x_in_cam[:, 2] > 0.3) & ((ours > 0.0) & (ours < np.array(SIZE))).all(axis=1)
            assert shown.sum() >= 30
            found = np.array(seen[camera][tick])[:, :2]
            assert np.abs(found - ours)[shown].max() < 0.5
    assert bool(room) == (name in ("glb", "usd"))


def test_cameras_are_the_same_twice(exported: ExportInputs, tmp_path: Path) -> None:
    again = replace(exported, out_dir=tmp_path)
    export_results(again, ExportOptions(formats=("fbx", "abc")), StageContext(work_dir=tmp_path))
    for name in ("cameras.fbx", "cameras/torso.abc", "cameras/left_palm.abc"):
        assert (tmp_path / name).read_bytes() == (exported.out_dir / name).read_bytes()
