"""A video whose metadata say that it is equirectangular."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from bodycap_batch.cli import main

pytestmark = pytest.mark.data


def test_a_360_degree_video_is_refused_with_what_to_export(
    data_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    video = data_root.parent / "cases" / "equirectangular" / "torso.mp4"
    if not video.is_file():
        pytest.skip(f"no such case: {video}")
    shutil.copy(video, tmp_path)
    assert main(["check", str(tmp_path)]) == 3
    output = " ".join(capsys.readouterr().out.split())
    assert "a 360° picture (equirectangular in its metadata)" in output
    assert "export a flat view first" in output
    assert "ready to run" not in output
