"""`bodycap batch` on this machine with stand-in stages."""

from __future__ import annotations

import json
import signal
import time
from pathlib import Path

import pytest

from bodycap_batch.cli import main
from tests.pipeline.test_cli import Bench as Command
from tests.processes import gone
from tests.results import results_of

NAMES = ("monday", "tuesday")


class Bench(Command):
    """A folder with several captures to run `bodycap batch` on."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        for name in NAMES:
            (folder / name).mkdir()
            for camera in ("torso", "left_palm"):
                (folder / name / f"{camera}.mp4").write_text(f"frames of {camera} on {name}")

    def results(self, out: str = "out") -> dict[str, bytes]:
        return results_of(self.folder / out)


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


@pytest.mark.slow
def test_all_jobs_are_done_and_the_same_as_one_by_one(bench: Bench) -> None:
    code, out, err = bench.run("batch", *NAMES)
    assert code == 0, err
    assert out.splitlines()[-1] == "2 of 2 jobs done"
    assert "tuesday  done in" in out
    for name in NAMES:
        assert bench.run("run", name, "--out", f"single/{name}")[0] == 0
    assert bench.results() == bench.results("single")
    code, out, _ = bench.run("batch", *NAMES)
    assert code == 0
    assert out.count("nothing to do") == 2


@pytest.mark.parametrize("how", ["fail", "crash"])
def test_a_broken_job_does_not_stop_the_others_and_the_worst_code_counts(bench: Bench, how: str) -> None:
    (bench.folder / "broken.yaml").write_text("capture: [")
    bench.order(**{how: "map", "on": "tuesday"})
    code, out, err = bench.run("batch", *NAMES, "broken.yaml")
    assert code == (4 if how == "fail" else 70)
    rows = {line.split()[0]: line for line in out.splitlines()}
    assert "done in" in rows["monday"]
    assert ("does not work out" if how == "fail" else "SIGSEGV") in rows["tuesday"]
    assert "failed (2)" in rows["broken.yaml"]
    assert out.splitlines()[-1] == "1 of 3 jobs done"
    assert "broken.yaml" in err
    assert (bench.folder / "out" / "monday" / "metrics.json").is_file()


def test_two_jobs_of_one_folder_of_results_are_refused(bench: Bench) -> None:
    other = bench.folder / "again" / "monday"
    other.parent.mkdir()
    (bench.folder / "monday").rename(bench.folder / "kept")
    (bench.folder / "kept").rename(other)
    (bench.folder / "monday").mkdir()
    for camera in ("torso", "left_palm"):
        (bench.folder / "monday" / f"{camera}.mp4").write_text("other frames")
    code, out, err = bench.run("batch", "monday", "again/monday", "--max-jobs", "1", "--out", "out")
    assert code == 2
    assert out.splitlines()[-1] == "1 of 2 jobs done"
    assert "give the jobs different names" in err


def test_jobs_of_high_priority_go_first(bench: Bench) -> None:
    code, out, _ = bench.run(
        "batch", *NAMES, "--max-jobs", "1", "--priority", "tuesday=2", "--priority", "monday=-1", "--json"
    )
    assert code == 0
    lines = [json.loads(line) for line in out.splitlines()]
    ended = [line["job"] for line in lines if line["kind"] == "job"]
    assert ended == ["tuesday", "monday"]
    assert {line["job"] for line in lines if line["kind"] == "finished"} == set(NAMES)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--priority", "nobody=1"], "does not have the form JOB=NUMBER"),
        (["--priority", "monday=x"], "does not have the form JOB=NUMBER"),
        (["--priority", "monday=--5"], "does not have the form JOB=NUMBER"),
        (["--priority", "monday=²"], "does not have the form JOB=NUMBER"),
        (["--executor", "moon"], "there is no executor 'moon'"),
    ],
)
def test_wrong_options_are_reported(
    bench: Bench,
    arguments: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(bench.folder)
    assert main(["batch", "monday", *arguments]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_a_stopped_batch_ends_its_children_and_goes_on_later(bench: Bench) -> None:
    bench.order(hang="map")
    process = bench.start("batch", *NAMES)
    child = bench.wait_until_started()
    started_s = time.monotonic()
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=30)
    assert time.monotonic() - started_s < 20
    assert process.returncode == 143, err
    assert gone(child)
    assert "Traceback" not in err
    bench.order()
    code, _, err = bench.run("batch", *NAMES)
    assert code == 0, err
    assert "keyframes torso: already done" in err
