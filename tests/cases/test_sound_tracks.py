"""Cameras whose good sound is in the second track, or whose channels cancel each other in a mono mix."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bodycap_batch.cli import main

pytestmark = pytest.mark.data
TOLERANCE_S = 0.003
"""The way of sound reaches the microphones up to 3 ms late."""


@pytest.mark.parametrize(
    ("variant", "channel"),
    [("two", "channel 1 of sound track 2"), ("phase", "channel 1 of sound track 1")],
)
def test_the_clock_comes_from_one_channel(
    data_root: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], variant: str, channel: str
) -> None:
    case = data_root.parent / "cases" / "sound_tracks"
    if not case.is_dir():
        pytest.skip(f"no case in {case}")
    for name in ("torso", "left_palm"):
        (tmp_path / f"{name}.mp4").symlink_to(case / f"{name}.mp4")
    (tmp_path / "right_palm.mp4").symlink_to(case / f"right_palm_{variant}.mp4")
    true_s = json.loads((data_root / "roll131" / "gt" / "clocks.json").read_text())["offsets_s"]
    assert main(["sync", str(tmp_path), "--json"]) == 0
    found = json.loads(capfd.readouterr().out)
    for name in ("left_palm", "right_palm"):
        assert found["clocks"][name]["source"] == "sound"
        assert found["clocks"][name]["offset_s"] == pytest.approx(true_s[name], abs=TOLERANCE_S)
    assert any(channel in reason for reason in found["reasons"]["right_palm"])
