"""The verdict where a job ends: at the end of a run, of a batch and of a watched job."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bodycap_batch.cli import main
from tests.pipeline.spools import SpoolFixture
from tests.pipeline.test_cli import Bench
from tests.unit.report.test_summary import joints, metrics

POOR = {**metrics(residual_m=0.05, scale=0.05), "motion": {"joints": joints("Spine1", "LeftHand")}}


@pytest.fixture
def films(tmp_path: Path) -> Bench:
    bench = Bench(tmp_path)
    bench.order(metrics=POOR)
    return bench


def test_a_run_ends_with_the_verdict_its_reasons_and_the_file_to_open(films: Bench) -> None:
    code, out, err = films.run("run", "my walk")
    assert code == 0, err
    results = films.folder / "out" / "my_walk"
    assert out.splitlines() == [
        "verdict: poor. The cameras are good (100.0 % of the frames), but the motion is poor. Sizes are "
        "known to about ± 8 cm of body height (5.0 %): put a board of printed squares on the floor, or "
        "measure how far the person walks, or stand in a T-pose for two seconds first.",
        "  poor: Distance between cameras and body: 5.0 cm for camera torso (95th percentile)",
        "measured: chest, left hand",
        "not measured: hips, head, both arms, right hand, both legs, both feet",
        f"open first: {results / 'report.html'}",
        f"results: {results}",
    ]


def test_programs_get_the_verdict_as_json(films: Bench) -> None:
    _, out, _ = films.run("run", "my walk", "--json-progress")
    done = json.loads(out.splitlines()[-1])
    assert done["verdict"]["grade"] == "poor"
    assert len(done["verdict"]["doubts"]) == 2
    _, out, _ = films.run("batch", "my walk", "--json")
    assert json.loads(out.splitlines()[-1])["verdict"] == done["verdict"]


def test_a_batch_ends_with_the_verdict_of_each_job(films: Bench) -> None:
    _, out, _ = films.run("batch", "my walk")
    assert "verdict: poor" in out.splitlines()[-2]


def test_the_status_of_a_watched_job_has_the_verdict(
    bench: SpoolFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    bench.order(metrics=POOR)
    bench.drop("walk")
    assert bench.run_once() == 0, bench.lines
    assert bench.status("walk")["verdict"]["grade"] == "poor"
    assert main(["status"]) == 0
    (line,) = [line for line in capfd.readouterr().out.splitlines() if line.startswith("walk")]
    assert "poor     The cameras are good (100.0 % of the frames), but the motion is poor." in line
