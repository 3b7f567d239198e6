"""Which results and which store a path means, also from another folder and of an earlier version."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from bodycap_batch.job_places import find_job, find_store
from tests.pipeline.test_cli import Bench


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    folder = tmp_path / "films"
    folder.mkdir()
    return Bench(folder)


def steps(bench: Bench, path: str, *more: str) -> list[str]:
    code, out, err = bench.run("why", path, *more)
    assert code == 0, err
    return out.splitlines()


def test_the_working_folder_does_not_matter(bench: Bench, tmp_path: Path) -> None:
    assert bench.run("run", "my walk")[0] == 0
    capture, results = bench.capture, bench.folder / "out" / "my_walk"
    (tmp_path / "elsewhere").mkdir()
    bench.folder = tmp_path / "elsewhere"
    for path in (capture, results):
        assert steps(bench, str(path))[-1] == "nothing to do", path
    assert "nothing to do" in bench.run("run", str(capture))[1]
    assert "nothing to do" in bench.run("run", str(results))[1]
    assert list((tmp_path / "elsewhere").iterdir()) == []


def test_results_name_their_store(bench: Bench) -> None:
    assert bench.run("run", "my walk", "--store", "kept", "--out", "delivered/walk")[0] == 0
    results = bench.folder / "delivered" / "walk"
    assert json.loads((results / "run.json").read_text())["store"] == "../../kept"
    assert [path.name for path in results.iterdir() if path.name.startswith(".")] == []
    assert steps(bench, "delivered/walk")[-1] == "nothing to do"
    code, out, err = bench.run("gc", "delivered/walk")
    assert code == 0, err
    assert "would remove 0 of" in out


def test_results_of_an_earlier_version_keep_the_store_inside_them(bench: Bench) -> None:
    """Before, `--out DIR` put the store into DIR, and `run.json` did not name it."""
    results = bench.folder / "delivered"
    assert bench.run("run", "my walk", "--out", "delivered", "--store", "delivered/.store")[0] == 0
    record = json.loads((results / "run.json").read_text())
    del record["store"], record["checksum"]
    (results / "run.json").write_text(json.dumps(record))
    assert find_store(results) == results / ".store"
    assert steps(bench, "delivered")[-1] == "nothing to do"
    assert "nothing to do" in bench.run("run", "my walk", "--out", "delivered")[1]


def test_results_and_store_can_be_moved_together(bench: Bench) -> None:
    assert bench.run("run", "my walk")[0] == 0
    (bench.folder / "out").rename(bench.folder / "moved")
    assert find_store(bench.folder / "moved" / "my_walk") == bench.folder / "moved" / ".store"


def test_a_store_elsewhere_is_named_by_its_whole_path(bench: Bench, tmp_path: Path) -> None:
    elsewhere = tmp_path / "cache" / "store"
    assert bench.run("run", "my walk", "--store", str(elsewhere))[0] == 0
    assert find_store(bench.folder / "out" / "my_walk") == elsewhere


def test_a_store_that_no_longer_exists_is_made_beside_the_results(bench: Bench) -> None:
    assert bench.run("run", "my walk", "--store", "kept")[0] == 0
    shutil.rmtree(bench.folder / "kept")
    assert bench.run("run", "my walk")[0] == 0
    assert (bench.folder / "out" / ".store" / "artefacts").is_dir()
    assert not (bench.folder / "kept").exists()


def test_results_of_a_job_that_stopped_early_are_found(tmp_path: Path) -> None:
    partial = tmp_path / "out" / "partial"
    partial.mkdir(parents=True)
    for name in ("run.json", "job.yaml"):
        (partial / name).write_text("{}")
    for path in (tmp_path / "out", partial):
        assert find_job(path).file == partial / "job.yaml"
        assert find_job(path).results == tmp_path / "out"
    (tmp_path / "out" / "torso.mp4").touch()  # a folder of videos
    assert find_job(tmp_path / "out").results is None


def test_a_job_of_a_watched_folder_is_found_by_its_folder(tmp_path: Path) -> None:
    result = tmp_path / "done" / "walk" / "result"
    result.mkdir(parents=True)
    for path in (result / "run.json", result / "job.yaml", result.parent / "status.json"):
        path.write_text("{}")
    assert find_job(result.parent).results == result


def test_a_batch_leaves_out_the_folder_with_the_results_of_the_others(bench: Bench) -> None:
    assert bench.run("batch", "my walk")[0] == 0
    code, out, err = bench.run("batch", "my walk", "out")
    assert (code, out.splitlines()[-1]) == (0, "1 of 1 jobs done"), err
    assert "out is left out, because it contains results and no videos" in err


def test_the_report_is_opened_by_job_by_videos_and_by_results(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    code, _, err = bench.run("open", "my walk")
    assert (code, "the folder contains no report" in err) == (2, True)
    assert bench.run("run", "my walk", "--height", "1,80")[0] == 0
    report = bench.folder / "out" / "my_walk" / "report.html"
    for path in ("my walk", "out/my_walk"):
        code, out, err = bench.run("open", path)
        assert (code, out) == (0, f"report: {report}\n"), err
    assert opened == 2 * [report.as_uri()]
