"""The Python API: loading a job, its errors, and what it shares with the command."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from bodycap_batch import Event, load_job, run_job
from bodycap_batch.api import Execution, execute_job
from bodycap_batch.core.errors import Cancelled, CaptureError, EstimationError, JobError
from bodycap_batch.runner import Children
from tests.pipeline.fake_stages import ORDERS, give_orders

CHILD = (sys.executable, str(Path(__file__).with_name("fake_stages.py")))


@pytest.fixture
def walk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of two files that are no videos; stand-in stages do not read them."""
    monkeypatch.setenv(ORDERS, str(tmp_path / "orders.json"))
    give_orders(tmp_path)
    folder = tmp_path / "my_walk"
    folder.mkdir()
    for name in ("gopro1", "left_palm"):
        (folder / f"{name}.mp4").write_text(f"frames of {name}")
    return folder


def test_a_folder_is_a_job(walk: Path) -> None:
    job = load_job(str(walk), height_m=1.75, cameras={"gopro1": "torso"}, activity="walk")
    assert (job.name, job.cameras, job.out) == (
        "my_walk",
        ("gopro1", "left_palm"),
        walk.parent / "out" / "my_walk",
    )
    assert (job.options.height_m, job.options.activity) == (1.75, "walk")
    assert job.options.capture.cameras[0].mount == "torso"
    assert load_job(walk, cameras={"gopro1": "torso"}, out=walk.parent / "here").out == walk.parent / "here"


def test_a_wrong_job_names_its_field(walk: Path) -> None:
    (walk / "job.yaml").write_text("heigth_m: 1.75\n")
    with pytest.raises(JobError, match="heigth_m") as caught:
        load_job(walk)
    assert caught.value.line == 1
    with pytest.raises(JobError, match="no such file or folder"):
        load_job(walk / "nothing")


def test_a_file_that_is_no_video_is_a_capture_error(walk: Path) -> None:
    job = load_job(walk, cameras={"gopro1": "torso"})
    events: list[Event] = []
    with pytest.raises(CaptureError) as caught:
        run_job(job, out=walk.parent / "elsewhere", threads=1, progress=events.append)
    assert str(walk) in str(caught.value)
    assert ("failed", "check") in [(event.kind, event.stage) for event in events]
    assert (walk.parent / "elsewhere" / "partial" / "report.html").exists()
    assert not job.out.exists()


def test_a_run_can_be_stopped(walk: Path) -> None:
    job = load_job(walk, cameras={"gopro1": "torso"})
    with pytest.raises(Cancelled):
        run_job(job, cancelled=lambda: True)


def test_the_next_run_keeps_the_height_and_the_places(walk: Path) -> None:
    """As after a run of the command; stand-in stages compute the results."""
    job = load_job(walk, height_m=1.75, cameras={"gopro1": "torso"})
    events: list[Event] = []
    summary = execute_job(job, Execution(threads=2, progress=events.append, children=Children(CHILD)))
    record = json.loads((summary.out_dir / "run.json").read_bytes())
    assert record["command_line"]["height_m"] == 1.75
    assert {event.stage for event in events} >= {"check", "map", "export"}
    again = load_job(walk)
    assert again.options.height_m == 1.75
    assert again.options.capture.cameras[0].mount == "torso"
    assert any("as in the last run" in text for text in again.warnings)
    assert load_job(summary.out_dir).out == summary.out_dir


def test_a_job_without_a_solution_is_an_estimation_error(walk: Path) -> None:
    give_orders(walk.parent, fail="merge")
    job = load_job(walk, height_m=1.75, cameras={"gopro1": "torso"})
    with pytest.raises(EstimationError, match="merge does not work out") as caught:
        execute_job(job, Execution(threads=2, children=Children(CHILD)))
    assert str(job.out / "partial") in (caught.value.hint or "")
