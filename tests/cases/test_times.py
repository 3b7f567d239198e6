"""Files that state a time in another unit, at another rate, from another start, or for copied pictures."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from bodycap_batch.cli import main

pytestmark = pytest.mark.data


def case(data_root: Path, name: str) -> Path:
    folder = data_root.parent / "cases" / name
    if not folder.is_dir():
        pytest.skip(f"no case in {folder}")
    return folder


def check(folder: Path, capfd: pytest.CaptureFixture[str]) -> dict[str, str]:
    """Return what `bodycap check` prints about each camera; the job must be ready."""
    assert main(["check", str(folder)]) == 0
    out = capfd.readouterr().out
    assert "ready to run" in out
    parts = out.replace("\n  ", "|").split("\n")
    return {part.split(":")[0]: part for part in parts if " -> " in part}


def walk12_with(data_root: Path, folder: Path, *files: Path) -> Path:
    """Copy the capture walk12, and replace the videos with the names of these files."""
    folder.mkdir()
    for path in [*(data_root / "walk12").glob("*.mp4"), data_root / "walk12" / "calib.json"]:
        if path.stem not in {file.stem for file in files}:
            shutil.copy(path, folder)
    for file in files:
        shutil.copy(file, folder)
    return folder


def test_milliseconds(data_root: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    sidecars = sorted(case(data_root, "timestamps_in_ms").glob("*.timestamps.txt"))
    cameras = check(walk12_with(data_root, tmp_path / "walk", *sidecars), capfd)
    assert len(cameras) == 3
    for text in cameras.values():
        assert "3.9 s, 0.00 to 3.90 s" in text
        assert "span 3900.000, where the video lasts 3.90 s: they are read as milliseconds" in text


def test_the_start_of_a_transport_stream(
    data_root: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    video = case(data_root, "common_start_mts") / "right_palm.mts"
    cameras = check(walk12_with(data_root, tmp_path / "walk", video), capfd)
    assert all("3.9 s, 0.00 to 3.90 s" in text for text in cameras.values())


def test_slow_motion(data_root: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    video = case(data_root, "slow_motion_tag") / "right_palm.mp4"
    text = check(walk12_with(data_root, tmp_path / "walk", video), capfd)["right_palm"]
    assert "3.9 s, 0.00 to 3.90 s" in text
    assert "its times are divided by 4" in text


def test_copies(data_root: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    video = case(data_root, "duplicated_frames") / "torso.mp4"
    text = check(walk12_with(data_root, tmp_path / "walk", video), capfd)["torso"]
    # Every fifth frame, and so the last one, is a copy.
    assert "24 of 118 frames are copies of the frame before" in text


@pytest.mark.slow
def test_a_run_leaves_copies_out(data_root: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    video = case(data_root, "duplicated_frames") / "torso.mp4"
    folder, out = walk12_with(data_root, tmp_path / "walk", video), tmp_path / "out"
    (folder / "job.yaml").write_text("export: {preview: false}\n")
    assert main(["run", str(folder), "--skeleton", "none", "--out", str(out)]) == 0
    assert "24 of 118 frames are copies" in capfd.readouterr().err
    assert main(["evaluate", str(out), str(data_root / "walk12" / "gt"), "--json"]) == 0
    torso = json.loads(capfd.readouterr().out)["trajectories"]["cameras"]["torso"]
    assert torso["frames"] == torso["registered"] == 94
    # 1.08 cm with the copies. The pictures have a quarter of the pixels of the capture and are strongly
    # compressed, so that 0.3 cm are not reached.
    assert 0.002 < torso["ate_m"]["rmse"] < 0.007
