"""Whole jobs on videos of a camera that only turns: rotations with sigmas, and no positions."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch import Result
from bodycap_batch.cli import main
from bodycap_batch.formats.gltf import read_camera_glb
from bodycap_batch.formats.tum import TimedPoses, write_tum
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import make_transform
from bodycap_batch.model.scene import FrameStatus
from tests.bench.paired.measures import rotations_alone
from tests.pipeline.hard_captures import rows_of, run
from tests.rooms import LENS, Room, look
from tests.schemas import problems
from tests.videos import write_video

pytestmark = pytest.mark.slow

FRAMES, FPS = 90, 30


def film(folder: Path, moved_m: float) -> Path:
    """Write the video of a head that turns by 12° and moves hardly or not, with lens and truth."""
    capture = folder / "capture"
    camera = Camera(model="PINHOLE", width_px=320, height_px=240, params=np.array(LENS["params"]))
    room, rng, time = Room.make(5), np.random.default_rng(1), np.arange(FRAMES) / FPS
    poses = np.stack(
        [
            make_transform(
                look(0.3 + 0.1 * np.sin(1.3 * t), 0.06 * np.sin(2.1 * t)),
                np.array([-1.2, 0.3, 0.1]) + moved_m * np.sin([1.1 * t, 1.7 * t + 1, 2.3 * t]),
            )
            for t in time
        ]
    )
    frames = [room.view(camera, pose) + rng.normal(0, 1.5, (240, 320)) for pose in poses]
    write_video(capture / "head.mp4", [np.clip(each, 0, 255).astype(np.uint8) for each in frames], fps=FPS)
    (capture / "calib.json").write_text(json.dumps({**LENS, "pixel_origin": "COLMAP"}), encoding="utf-8")
    times_ns = np.round(time * 1e9).astype(np.int64)
    write_tum(capture / "gt" / "head.tum", TimedPoses(times_ns=times_ns, world_from_cam=poses))
    return capture


@pytest.fixture(scope="module")
def turned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of a head that moves by 5 mm in a room of 5 m."""
    capture = film(tmp_path_factory.mktemp("turned"), 0.005)
    assert run(capture) == 0
    return capture.parent / "out"


def test_all_frames_have_the_right_rotation(turned: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    truth = turned.parent / "capture" / "gt"
    assert main(["evaluate", str(turned), str(truth), "--json"]) == 0
    score = json.loads(capsys.readouterr().out)["trajectories"]["cameras"]["head"]
    assert score["scored"] == FRAMES
    assert score["registered"] == 0
    assert rotations_alone(turned, truth)[0] == FRAMES
    assert (rotations_alone(turned, truth)[1] or 9.0) < 0.3
    assert score["ate_m"] is None
    assert score["rotation_deg"]["max"] < 0.3
    sigma = np.array([float(row["sigma_rotation_deg"]) for row in rows_of(turned.parent / "capture")])
    assert score["rotation_deg"]["max"] < 2.8 * sigma.mean() < 2.0  # the region of 95 % of three axes


def test_no_file_claims_a_position(turned: Path) -> None:
    rows = rows_of(turned.parent / "capture")
    assert {(row["status"], row["reason"], row["sigma_position"]) for row in rows} == {
        ("ROTATION_ONLY", "", "")
    }
    path = Result(turned).trajectories()["head"]
    assert set(path.status) == {FrameStatus.ROTATION_ONLY}
    assert np.isnan(path.centres).all()
    assert np.isfinite(path.rotations).all()
    assert len(path.poses.times_ns) == 0
    text = (turned / "trajectories" / "head.tum").read_text(encoding="utf-8")
    assert f"{FRAMES} frames have a rotation only" in text
    facts = json.loads((turned / "cameras.json").read_text(encoding="utf-8"))["cameras"]["head"]
    assert facts["rotation_only_frames"] == facts["valid_frames"] == [[0, FRAMES - 1]]
    assert set(facts["sigma_position"]) == {None}
    _, poses = read_camera_glb(turned / "cameras.glb")["head"]
    assert np.allclose(poses[:, :3, 3], 0.0)
    assert not (turned / "map.ply").exists()


def test_the_verdict_counts_rotations_beside_the_coverage(turned: Path) -> None:
    verdict = json.loads((turned / "verdict.json").read_text(encoding="utf-8"))
    metrics = json.loads((turned / "metrics.json").read_text(encoding="utf-8"))
    assert problems("verdict", verdict) == []
    assert problems("metrics", metrics) == []
    assert verdict["grade"] == "usable with care"
    assert [each["name"] for each in verdict["cameras"]["criteria"]] == ["Rotation alone"]
    assert verdict["coverage"]["share"] == 0.0
    assert verdict["coverage"]["frames_rotation_only"] == FRAMES
    assert "the rotation alone of 100.0 %" in verdict["headline"]
    assert metrics["cameras"]["head"]["status"] == {"ROTATION_ONLY": FRAMES}
    assert metrics["total"]["frames_registered"] == 0
    assert "rotation alone" in (turned / "report.html").read_text(encoding="utf-8")


def test_without_a_map_the_pictures_have_no_lens(turned: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert main(["evaluate", str(turned), "--video", str(turned.parent / "capture")]) == 2
    assert "rotations without a map" in capsys.readouterr().err


def test_a_film_of_noise_has_neither_a_map_nor_rotations(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each frame shows another picture of noise, so nothing can be followed."""
    capture, rng = tmp_path / "capture", np.random.default_rng(2)
    frames = [rng.integers(0, 255, (240, 320), dtype=np.uint8) for _ in range(40)]
    write_video(capture / "head.mp4", frames, fps=FPS)
    (capture / "calib.json").write_text(json.dumps({**LENS, "pixel_origin": "COLMAP"}), encoding="utf-8")
    assert run(capture) == 4
    assert "keyframes" in capsys.readouterr().err
    assert not (tmp_path / "out" / "frames.csv").exists()
