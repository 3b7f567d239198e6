"""What a beginner's folder gives: three videos without sound, and no word about which camera was where."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import yaml

from bodycap_batch.cli import main

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
