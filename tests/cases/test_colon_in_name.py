"""A file whose name is a time of day: no address of a network."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bodycap_batch.cli import main

pytestmark = pytest.mark.data


def test_a_video_with_colons_in_its_name_is_read(
    data_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = data_root.parent / "cases" / "colon_in_name"
    if not case.is_dir():
        pytest.skip(f"no case in {case}")
    monkeypatch.chdir(case)
    out = tmp_path / "calib.json"
    assert main(["calibrate", "2024-03-05T10:11:12.mp4", "--chessboard", "11x7", "--out", str(out)]) == 0
    focal_px = json.loads(out.read_text())["params"][0]
    assert focal_px == pytest.approx(519.8, abs=0.5)  # the sigma of the calibration is 0.4 px
