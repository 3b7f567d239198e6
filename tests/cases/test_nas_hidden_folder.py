"""Folders that a network storage and a sync program have put files of their own into."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from bodycap_batch.cli import main
from bodycap_batch.watch.job_status import read_status
from bodycap_batch.watch.spool import JobDir

pytestmark = pytest.mark.data


@pytest.mark.parametrize("name", ["walk", "walk2"])
def test_the_job_starts_after_the_time_to_settle(
    data_root: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str
) -> None:
    case = data_root.parent / "cases" / "nas_hidden_folder"
    if not case.is_dir():
        pytest.skip(f"no case in {case}")
    shutil.copytree(case / name, tmp_path / "inbox" / name)
    for path in (tmp_path / "inbox").rglob("*"):
        path.chmod(0o755 if path.is_dir() else 0o644)
    main(["watch", str(tmp_path / "inbox"), "--once", "--settle", "1"])
    lines = capfd.readouterr().err
    assert f"{name}: started" in lines
    assert "stays in the inbox" not in lines
    # Two seconds of two cameras do not give a body, but both cameras were used.
    status = read_status(JobDir(tmp_path / "failed" / name))
    assert status["stage"] == "merge"
    assert "torso" in status["error"]["message"]
    assert "left_palm" in status["error"]["message"]
