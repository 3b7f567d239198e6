"""A whole job on a video whose two parts show rooms without a common view: each part gets a map."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch import Result
from bodycap_batch.cli import main
from bodycap_batch.formats.tum import TimedPoses, read_tum, write_tum
from bodycap_batch.model.camera import Camera
from tests.evaluation import evaluate_trajectories
from tests.pipeline.hard_captures import MAX_ATE_M, MIN_ATE_M, MIN_COVERAGE, rows_of, run
from tests.rooms import LENS, Room, stroll
from tests.videos import write_video

pytestmark = pytest.mark.slow

LENGTHS = (130, 110)
"""Number of frames in each room. The longer part gives the map of the path."""
FPS = 30


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished capture; its results are in ``out`` beside it."""
    capture = tmp_path_factory.mktemp("rooms") / "capture"
    rng = np.random.default_rng(3)
    camera = Camera(model="PINHOLE", width_px=320, height_px=240, params=np.array(LENS["params"]))
    frames, start = [], 0
    for seed, length in enumerate(LENGTHS):
        room, poses = Room.make(seed), stroll(length)["torso"]
        frames += [room.view(camera, pose) + rng.normal(0, 1.5, (240, 320)) for pose in poses]
        times_ns = np.round((start + np.arange(length)) * 1e9 / FPS).astype(np.int64)
        write_tum(capture / "gt" / f"{seed}.tum", TimedPoses(times_ns=times_ns, world_from_cam=poses), [])
        start += length
    write_video(capture / "torso.mp4", [np.clip(frame, 0, 255).astype(np.uint8) for frame in frames], fps=FPS)
    lens = json.dumps({**LENS, "pixel_origin": "COLMAP"})
    (capture / "calib.json").write_text(lens, encoding="utf-8")
    assert run(capture) == 0
    return capture


def test_each_part_is_right_in_its_own_map(results: Path) -> None:
    folder = results.parent / "out" / "trajectories"
    for seed, path in enumerate((folder / "torso.tum", folder / "map_1" / "torso.tum")):
        truth = results / "gt" / f"{seed}.tum"
        report = evaluate_trajectories({"torso": path}, {"torso": truth}, frames={"torso": LENGTHS[seed]})
        assert report.total.coverage is not None
        assert report.total.ate_m is not None
        assert report.total.coverage >= MIN_COVERAGE
        assert MIN_ATE_M < report.total.ate_m.rmse < MAX_ATE_M
        assert "arbitrary" in path.read_text(encoding="utf-8")  # no scale, no axes of the room
    assert (results.parent / "out" / "map_1.ply").exists()


def test_the_frame_table_names_the_map_of_each_frame(results: Path) -> None:
    rows = rows_of(results)
    found = [read_tum(path) for path in sorted((results.parent / "out" / "trajectories").rglob("*.tum"))]
    assert sum(len(path.times_ns) for path in found) == sum(row["map"] != "" for row in rows)
    for index, row in enumerate(rows):
        number = int(index >= LENGTHS[0])
        assert row["map"] in ("", str(number))
        # A frame whose pose is in another map is lost in the map of the camera's path.
        assert (row["reason"] == "OTHER_MAP") == (row["map"] == "1")
        assert (row["status"] == "LOST") == (row["map"] != "0")
    camera = json.loads((results.parent / "out" / "metrics.json").read_text())["cameras"]["torso"]
    assert camera["frames_in_other_maps"] == sum(row["map"] == "1" for row in rows)
    assert camera["frames_registered"] == sum(row["map"] == "0" for row in rows)
    result = Result(results.parent / "out")
    assert len(result.other_trajectories()[1]["torso"].times_ns) == camera["frames_in_other_maps"]
    assert result.verdict()["coverage"]["frames_in_other_maps"] == camera["frames_in_other_maps"]


def test_the_pictures_are_compared_with_the_frames_of_both_maps(
    results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert main(["evaluate", str(results.parent / "out"), "--video", str(results), "--json"]) == 0
    outcome = json.loads(capsys.readouterr().out)["torso"]
    assert outcome["delivered"] == sum(row["map"] != "" for row in rows_of(results))
    # Frames of different maps are not compared with each other. Each map alone has its rotations confirmed.
    assert outcome["rotations"]["wrong"] == outcome["positions"]["wrong"] == 0
    assert outcome["rotations"]["right"] > 2 * max(LENGTHS)


def test_the_tracks_of_the_video_are_compared_with_both_maps(results: Path) -> None:
    metrics = json.loads((results.parent / "out" / "metrics.json").read_text())
    links = metrics["mapping"]["links"]["torso"]
    assert [each["frame"] for each in links] == [each["frame"] for each in metrics["models"]]
    for each, length in zip(links, LENGTHS, strict=True):
        # Every second frame has stored points.
        assert 0.4 * length < each["compared"] <= 0.5 * length + 1
        assert each["contradicted"] == 0
