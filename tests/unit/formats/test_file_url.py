"""Names that look like addresses are names of files, wherever FFmpeg gets them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.capture import open_camera
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.formats.mp4_writer import Sound, VideoWriter
from tests.sounds import write_sound

NAMES = ("2024-03-05T10:11:12.mp4", "http:torso.mp4", "concat:a.mp4|b.mp4", "torso%03d.mp4", "pipe:0.mp4")


@pytest.mark.parametrize("name", NAMES)
def test_a_relative_path_with_a_colon_is_written_and_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    path = Path(name)
    sound = Sound(samples=np.zeros(16_000), rate_hz=16_000)
    with VideoWriter(path, 25.0, (64, 48), "small", sound=sound) as writer:
        for level in range(25):
            writer.add(np.full((48, 64, 3), 8 * level, dtype=np.uint8))
    assert [found.name for found in tmp_path.iterdir()] == [name]
    config = CameraConfig(name="torso", video=(path,), calibration="auto", offset_s=0.0)
    camera = open_camera(CaptureConfig(cameras=(config,)), config)
    assert [index for index, _ in camera.grey_frames()] == list(range(25))


def test_a_sound_file_with_a_colon_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_sound(Path("10:11:12.m4a"), np.zeros(1600), 16_000)
    assert (tmp_path / "10:11:12.m4a").stat().st_size > 0
