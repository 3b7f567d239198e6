"""A whole job with a synchronised rig; one camera of it sees only darkness for a while."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bodycap_batch.cli import main
from bodycap_batch.evaluate import evaluate_trajectories
from bodycap_batch.model.geometry import make_transform
from tests.rooms import look, stroll, write_capture

pytestmark = pytest.mark.slow

FRAMES = 75
DARK = range(36, 48)
FIRST_FROM_SECOND = make_transform(look(0.35, 0.1) @ look(0.0).T, [0.12, 0.03, -0.02])


def _run(folder: Path, rig: str) -> tuple[list[dict[str, str]], dict[str, Any], Any]:
    """Frames, metrics and score of a job without a body."""
    cameras = [{"name": name, "video": f"{name}.mp4"} for name in ("torso", "torso_2")]
    job = {
        "capture": {"cameras": cameras, "calibration": "calib.json", "clocks": "common", "rig": rig},
        "skeleton": "none",
        "export": {"preview": False},
    }
    (folder / f"{rig}.json").write_text(json.dumps(job))
    out = folder / rig
    assert (
        main(["run", str(folder / f"{rig}.json"), "--out", str(out), "--store", str(folder / "store")]) == 0
    )
    with (out / "frames.csv").open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(line for line in stream if not line.startswith("#")))
    paths = {path.stem: path for path in (out / "trajectories").glob("*.tum")}
    truth = {name: folder / "gt" / f"{name}.tum" for name in paths}
    metrics = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
    return rows, metrics, evaluate_trajectories(paths, truth, frames=dict.fromkeys(paths, FRAMES))


def test_a_rig_gives_poses_to_its_camera_in_the_dark(tmp_path: Path) -> None:
    body = stroll(FRAMES)["torso"]
    paths = {"torso": body, "torso_2": body @ FIRST_FROM_SECOND}
    write_capture(tmp_path, paths, black={"torso_2": DARK})
    for name, poses in paths.items():
        write_path(tmp_path / "gt" / f"{name}.tum", poses)
    alone, metrics, apart = _run(tmp_path, "free")
    dark = {row["status"] for row in alone if row["camera"] == "torso_2" and int(row["frame"]) in DARK}
    assert dark == {"LOST"}
    (relative,) = metrics["relative_poses"]
    assert relative["cameras"] == ["torso", "torso_2"]
    assert relative["instants"] <= FRAMES - len(DARK)
    rows, metrics, together = _run(tmp_path, "synced")
    dark = {row["status"] for row in rows if row["camera"] == "torso_2" and int(row["frame"]) in DARK}
    assert dark == {"RIG"}
    # How it was before the two were held to it: their own poses scatter, a little more than after the
    # second look for lost frames, which steadies the path and which a rig goes without.
    (measured,) = metrics["relative_poses"]
    assert all(measured[key] == relative[key] for key in ("cameras", "instants", "rigid"))
    assert measured["translation"] == pytest.approx(relative["translation"], rel=5e-3)
    assert measured["turn_deg"] == pytest.approx(relative["turn_deg"], abs=0.01)
    assert measured["spread"] == pytest.approx(relative["spread"], rel=0.1)
    assert measured["spread_deg"] == pytest.approx(relative["spread_deg"], rel=0.1)
    assert relative["rigid"]
    assert together.total.coverage == 1.0
    # 320 px and 210 px focal length at some 3 m: a pixel is 14 mm, a pose of its own is off by some 3 mm.
    assert together.total.ate_m.rmse < 0.012
    assert together.total.ate_m.rmse < 1.1 * apart.total.ate_m.rmse


def write_path(path: Path, poses: np.ndarray) -> None:
    """Write the true path in the format of the benchmark."""
    from bodycap_batch.synthetic.truth import write_path as write

    path.parent.mkdir(exist_ok=True)
    write(path, np.round(np.arange(len(poses)) * (1e9 / 30)).astype(np.int64), poses, "world_from_camera")
