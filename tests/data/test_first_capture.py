"""What a beginner's folder gives: three videos without sound, and no word about which camera was where."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from bodycap_batch.cli import main
from bodycap_batch.formats.tum import read_tum

pytestmark = pytest.mark.data
PLACES = {"a": "left_palm", "b": "torso", "c": "right_palm"}


def test_clocks_and_places_are_found_together(
    data_root: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    films, out = tmp_path / "films", tmp_path / "out"
    films.mkdir()
    for name, place in PLACES.items():
        shutil.copy(data_root / "walk12" / f"{place}.mp4", films / f"{name}.mp4")
    lens = json.loads((data_root / "walk12" / "calib.json").read_text())
    del lens["offsets_s"]
    (films / "calib.json").write_text(json.dumps(lens))
    arguments = [str(films), "--height", "1.75", "--places", "torso,left_palm,right_palm"]
    assert main(["check", *arguments]) == 0
    assert "If the motion does not show it, the places of the cameras are not found" in capfd.readouterr().out
    assert main(["run", *arguments, "--out", str(out), "--threads", "2"]) == 0
    assert (out / "motion.bvh").is_file()
    cameras = yaml.safe_load((out / "job.yaml").read_text())["capture"]["cameras"]
    assert {camera["name"]: camera["mount"] for camera in cameras} == PLACES
    clocks = json.loads((out / "metrics.json").read_text())["clocks"]
    # The videos were exposed together. One frame at 30 fps, as for offsets that a clap gives.
    assert max(abs(clock["offset_s"]) for clock in clocks.values()) < 1.0 / 30.0


def test_a_camera_that_nobody_wears_has_its_path_in_the_scene_of_the_body(
    data_root: Path, tmp_path: Path
) -> None:
    capture, out = data_root / "walk12", tmp_path / "out"
    cameras = [
        {"name": "torso", "video": str(capture / "torso.mp4")},
        {"name": "left_palm", "video": str(capture / "left_palm.mp4")},
        {"name": "witness", "video": str(capture / "right_palm.mp4"), "mount": "none"},
    ]
    lens = json.loads((capture / "calib.json").read_text())
    block = {key: lens[key] for key in ("width", "height", "model", "params")}
    capture_block = {"clocks": "common", "calibration": block, "cameras": cameras}
    job = {"capture": capture_block, "export": {"preview": False}}
    (tmp_path / "job.yaml").write_text(yaml.safe_dump(job))
    assert main(["run", str(tmp_path / "job.yaml"), "--out", str(out), "--threads", "2"]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["cameras"]["witness"]["frame"] == "world"
    assert set(metrics["merge"]["mounts"]) == {"torso", "left_palm"}
    assert metrics["merge"]["unused_cameras"] == {}
    paths = {name: read_tum(out / "trajectories" / f"{name}.tum") for name in ("torso", "witness")}
    truth = {name: read_tum(capture / "gt" / f"{name}.tum") for name in ("torso", "right_palm")}
    count = len(paths["witness"].times_ns)
    assert count > 100
    distance = [
        np.linalg.norm(one.world_from_cam[:count, :3, 3] - other.world_from_cam[:count, :3, 3], axis=1).mean()
        for one, other in ((paths["torso"], paths["witness"]), (truth["torso"], truth["right_palm"]))
    ]
    # The scale of a body of unknown height is known to 5 %, of which this is three sigmas.
    assert distance[0] == pytest.approx(distance[1], rel=0.15)
