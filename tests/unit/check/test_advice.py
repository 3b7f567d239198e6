"""Advice of `check`: it follows from the files, and there is none without a reason."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.check import check_path
from bodycap_batch.config.job import Overrides
from tests.videos import write_video

LENS = {"model": "PINHOLE", "params": [300, 300, 160, 120], "width": 320, "height": 240}


def room(seed: int, *, brightness: float = 1.0, texture: bool = True) -> np.ndarray:
    """Return a picture with hundreds of corners, or of a wall without texture."""
    rng = np.random.default_rng(seed)
    coarse = (
        rng.integers(60, 220, (24, 32)) if texture else np.full((24, 32), 120) + rng.integers(0, 9, (24, 32))
    )
    return np.kron(brightness * coarse, np.ones((10, 10))).astype(np.uint8)


def walk(
    folder: Path, pictures: Callable[[int], np.ndarray] = room, *, frames: int = 75, fps: int = 30
) -> Path:
    write_video(folder / "torso.mp4", [room(index // 25) for index in range(75)], gop=5)
    write_video(folder / "head.mp4", [pictures(7 + index // 25) for index in range(frames)], gop=5, fps=fps)
    (folder / "calib.json").write_text(json.dumps(LENS))
    return folder


def advice(folder: Path, height_m: float | None = None) -> str:
    report = check_path(folder, Overrides(height_m=height_m))
    assert report.ready
    return "\n".join(report.advice)


def test_a_good_capture_needs_no_advice(tmp_path: Path) -> None:
    assert advice(walk(tmp_path)) == ""


def test_a_guessed_lens_gives_advice_and_a_height_gives_none(tmp_path: Path) -> None:
    walk(tmp_path)
    assert "board" not in advice(tmp_path)
    (tmp_path / "calib.json").unlink()
    assert "estimates the lens of head and torso" in advice(tmp_path)
    assert "--skeleton" not in advice(tmp_path, height_m=1.75), "a height alone needs no advice"


def test_a_camera_that_ends_early_or_runs_slowly_is_named(tmp_path: Path) -> None:
    walk(tmp_path, frames=30, fps=15)
    assert "head records 15 frames per second" in advice(tmp_path)
    write_video(tmp_path / "torso.mp4", [room(index // 25) for index in range(180)], gop=5)
    assert "ends" not in advice(tmp_path), "the clocks are unknown"
    (tmp_path / "job.yaml").write_text("capture: {clocks: common}\n")
    assert "head ends 4.0 s before the others" in advice(tmp_path)


def test_the_duration_of_a_long_capture_is_estimated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bodycap_batch.check.recording_advice._LONG_CAPTURE_S", 4.0)
    assert "the videos last 5 s in all: expect a run time of 1 to 1 minutes" in advice(walk(tmp_path))


@pytest.mark.parametrize(
    ("pictures", "expected"),
    [
        (lambda seed: room(seed, texture=False), "show hardly any texture"),
        (lambda seed: room(seed, brightness=0.25), "the pictures are dark (median grey value 3"),
    ],
)
def test_untextured_and_dark_pictures_are_reported_for_that_camera_only(
    tmp_path: Path, pictures: Callable[[int], np.ndarray], expected: str
) -> None:
    head, torso = check_path(walk(tmp_path, pictures)).cameras
    assert expected in "\n".join(head.notes)
    assert "texture" not in "\n".join(torso.notes)
    assert "dark" not in "\n".join(torso.notes)


def test_advice_is_wrapped_and_numbered_and_in_the_json(tmp_path: Path) -> None:
    (walk(tmp_path, fps=15) / "calib.json").unlink()
    report = check_path(tmp_path)
    lines = report.lines()
    assert any(line.startswith("advice 1: ") for line in lines)
    assert any(line.startswith("advice 2: ") for line in lines)
    assert report.to_dict()["advice"] == list(report.advice)
    (tmp_path / "head.mp4").write_bytes(b"")
    assert check_path(tmp_path).advice == (), "errors are fixed before advice is given"
