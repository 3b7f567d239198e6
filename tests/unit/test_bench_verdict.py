"""`python -m tests.bench verdict`: stored results, their grades, and what is right."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.bench import verdict
from tests.unit.report.test_summary import metrics


def stored(folder: Path, name: str, *, error_px: float, wrong: int, path: str) -> Path:
    """Write a folder with results, and an evaluation by pictures beside them."""
    results = folder / name / "out"
    (results / "trajectories").mkdir(parents=True)
    (results / "trajectories" / "torso.tum").write_text(path)
    values = {key: value for key, value in metrics().items() if key not in ("merge", "motion")}
    values |= {"models": [], "mapping": {}}
    values["total"]["mean_reprojection_error_px"] = error_px  # type: ignore[index]
    (results / "metrics.json").write_text(json.dumps(values))
    found = {"torso": {"right": 10 - wrong, "wrong": wrong, "delivered": 10}}
    (folder / name / "ev.json").write_text(json.dumps(found))
    return folder / name


def test_grades_are_counted_against_what_is_right(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folders = [
        stored(tmp_path, "a_walk", error_px=0.5, wrong=0, path="1 0 0 0 0 0 0 1\n"),
        stored(tmp_path, "b_walk", error_px=0.5, wrong=0, path="1 0 0 0 0 0 0 1\n"),
        stored(tmp_path, "c_walk", error_px=0.5, wrong=5, path="1 1 0 0 0 0 0 1\n"),
        stored(tmp_path, "d_walk", error_px=1.5, wrong=1, path="1 2 0 0 0 0 0 1\n"),
    ]
    assert verdict.main([*map(str, folders)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert not any(line.startswith("b_walk") for line in lines), "equal paths count once"
    counts = {line[:20].strip(): line[20:].split() for line in lines[-4:]}
    assert counts["good"] == ["1", "1", "0", "50%"]
    assert counts["usable with care"] == ["0", "1", "0", "0%"]
    assert counts["poor"] == ["0", "0", "0", "-"]
    assert any("Map error 1.5" in line for line in lines if line.startswith("d_walk"))


def test_an_evaluation_of_another_folder_replaces_that_beside_the_results(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = stored(tmp_path, "a_walk", error_px=0.5, wrong=5, path="1 0 0 0 0 0 0 1\n")
    (tmp_path / "again").mkdir()
    again = {"torso": {"right": 10, "wrong": 0, "delivered": 10}}
    (tmp_path / "again" / "a_walk.json").write_text(json.dumps(again))
    verdict.main([str(folder), "--evaluated", str(tmp_path / "again")])
    assert capsys.readouterr().out.splitlines()[-4].split()[:3] == ["good", "1", "0"]
