"""`python -m tests.bench verdict`: stored results, their grades, and what is right."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
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


def counts_of(out: str, half: int) -> dict[str, list[str]]:
    """Return the counts of right, wrong and unknown results of a half of the captures, by grade."""
    lines = out.splitlines()
    start = next(number for number, line in enumerate(lines) if line.startswith(f"half {half} "))
    return {line[:20].strip(): line[20:].split() for line in lines[start + 1 : start + 5]}


def test_grades_are_counted_against_what_is_right(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folders = [
        stored(tmp_path, "a_walk", error_px=0.5, wrong=0, path="1 0 0 0 0 0 0 1\n"),
        stored(tmp_path, "b_walk", error_px=0.5, wrong=0, path="1 0 0 0 0 0 0 1\n"),
        stored(tmp_path, "c_walk", error_px=0.5, wrong=5, path="1 1 0 0 0 0 0 1\n"),
        stored(tmp_path, "d_walk", error_px=1.5, wrong=1, path="1 2 0 0 0 0 0 1\n"),
    ]
    (tmp_path / "captures" / "walk").mkdir(parents=True)
    assert verdict.main([*map(str, folders), "--captures", str(tmp_path / "captures")]) == 0
    out = capsys.readouterr().out
    lines = out.splitlines()
    assert not any(line.startswith("b_walk") for line in lines), "equal paths count once"
    half = hashlib.sha256(b"walk").digest()[0] % 2
    counts = counts_of(out, half)
    assert counts["good"] == ["1", "1", "0", "50%"]
    assert counts["usable with care"] == ["0", "1", "0", "0%"]
    assert counts["poor"] == ["0", "0", "0", "-"]
    assert any("Map error 1.5" in line for line in lines if line.startswith("d_walk"))
    assert counts_of(out, 1 - half)["good"] == ["0", "0", "0", "-"], "all are of one capture"
    assert f"{'Map error':34}{'0 of 1':>12}{'1 of 2':>12}" in lines


def test_an_evaluation_of_another_folder_replaces_that_beside_the_results(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = stored(tmp_path, "a_walk", error_px=0.5, wrong=5, path="1 0 0 0 0 0 0 1\n")
    (tmp_path / "again").mkdir()
    again = {"torso": {"right": 10, "wrong": 0, "delivered": 10}}
    (tmp_path / "again" / "a_walk.json").write_text(json.dumps(again))
    verdict.main([str(folder), "--evaluated", str(tmp_path / "again")])
    half = hashlib.sha256(b"a_walk").digest()[0] % 2
    assert counts_of(capsys.readouterr().out, half)["good"] == ["1", "0", "0", "100%"]


def test_results_that_agree_decide_what_is_right(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The check by pictures calls some right frames wrong, and some wrong ones right."""
    folders, time = [], np.arange(20)
    for name, wrong, bend, scale in (
        ("a_walk", 0, 0.0, 1.0), ("b_walk", 0, 0.01, 3.0), ("c_walk", 0, 0.0, 0.2),
        ("d_walk", 5, 0.0, 3.0), ("e_walk", 0, 1.0, 1.0),
    ):  # fmt: skip
        centres = scale * np.column_stack(
            [time**2 / 9 + bend * np.maximum(0, time - 9) ** 2, time, np.sin(time)]
        )
        text = "".join(f"{n} {x} {y} {z} 0 0 0 1\n" for n, (x, y, z) in enumerate(centres))
        folders.append(stored(tmp_path, name, error_px=0.5, wrong=wrong, path=text))
        found = {"torso": {"right": 20 - wrong, "wrong": wrong, "delivered": 20}}
        (tmp_path / name / "ev.json").write_text(json.dumps(found))
    (tmp_path / "captures" / "walk").mkdir(parents=True)
    judged, others = map(str, folders[3:]), map(str, folders[:3])
    verdict.main([*judged, "--others", *others, "--captures", str(tmp_path / "captures")])
    lines = capsys.readouterr().out.splitlines()
    truths = {line.split()[0]: line.split()[1] for line in lines[: lines.index("")]}
    assert truths == {"d_walk": "right", "e_walk": "wrong"}
