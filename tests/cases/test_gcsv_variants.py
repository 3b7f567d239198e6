"""Gyroflow files as loggers write them: without a time scale, cut off, and with a line twice."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bodycap_batch.cli import main

pytestmark = pytest.mark.data


@pytest.fixture
def case(data_root: Path) -> Path:
    """Return the folder of the case, or skip."""
    folder = data_root.parent / "cases" / "gcsv_variants"
    if not folder.is_dir():
        pytest.skip(f"no case in {folder}")
    return folder


@pytest.mark.parametrize(
    "right", [("notscale", 223, []), ("cutline", 222, ["line 231"]), ("dup", 221, ["not later"])], ids=str
)
@pytest.mark.parametrize("is_linked", [False, True])
def test_all_right_lines_are_used(
    case: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    right: tuple[str, int, list[str]],
    is_linked: bool,
) -> None:
    name, samples, notes = right
    video = tmp_path / "torso.mp4"
    if is_linked:
        video.symlink_to(case / "torso.mp4")
    else:
        video.write_bytes((case / "torso.mp4").read_bytes())
    (tmp_path / "torso.gcsv").write_bytes((case / f"{name}.gcsv").read_bytes())
    assert main(["telemetry", str(video), "--json"]) == 0
    found = json.loads(capfd.readouterr().out)
    assert found["streams"]["GYRO"]["samples"] == found["streams"]["ACCL"]["samples"] == samples
    assert found["streams"]["GYRO"]["rate_hz"] == pytest.approx(200.0, rel=1e-3)
    assert len(found["notes"]) == len(notes)
    assert all(text in note for text, note in zip(notes, found["notes"], strict=True))
    assert main(["check", str(tmp_path)]) == 0
    lines = capfd.readouterr().out.splitlines()
    assert "  inertial samples: torso.gcsv (from the sidecar file)" in lines
    assert not [line for line in lines if line.startswith("not used")]
