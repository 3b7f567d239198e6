"""Files for one program, from the stored results of a job."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from bodycap_batch.core.errors import JobError, StoreError
from bodycap_batch.pipeline import exporting
from bodycap_batch.pipeline.exporting import GUIDE_FILE, export_for
from bodycap_batch.store.artefacts import Store
from tests.pipeline.test_run import Bench


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    monkeypatch.setattr(exporting, "_has_blender", lambda: False)
    return Bench(tmp_path, monkeypatch)


def test_only_the_export_is_computed_and_the_results_stay(bench: Bench) -> None:
    bench.run()
    before = bench.results()
    bench.events.clear()
    folder = bench.out / "blender"
    written = export_for(
        bench.job(), "blender", out_dir=bench.out, folder=folder, fps=None, settings=bench.settings()
    )
    started = {event.stage for event in bench.events if event.kind == "started"}
    assert started == {"export"}
    names = {str(path.relative_to(folder)) for path in written}
    formats = ("bvh", "glb", "ply", "tum", "blender")
    assert names == {*(f"result.{kind}" for kind in formats), "trajectories/torso.tum", GUIDE_FILE}
    assert all(path.is_file() for path in written)
    guide = (folder / GUIDE_FILE).read_text()
    assert "made for Blender" in guide
    assert "1. " in guide
    for path in written:
        path.unlink()
    assert bench.results() == before


def test_an_empty_store_is_reported(bench: Bench) -> None:
    bench.run()
    other = replace(bench.settings(), store=Store(bench.folder / "nothing"))
    with pytest.raises(StoreError, match="have not been computed yet"):
        export_for(
            bench.job(), "blender", out_dir=bench.out, folder=bench.out / "b", fps=None, settings=other
        )
    assert not (bench.out / "b").exists()


def test_a_job_without_a_body_has_no_motion_to_export(bench: Bench) -> None:
    job = bench.job(skeleton="none")
    with pytest.raises(JobError, match="no body") as caught:
        export_for(
            job, "blender", out_dir=bench.out, folder=bench.out / "b", fps=None, settings=bench.settings()
        )
    assert caught.value.exit_code == 2


def test_the_videos_are_in_the_record_of_the_run(bench: Bench) -> None:

    bench.run()
    record = json.loads((bench.out / "run.json").read_text())
    assert record["videos"]["torso"] == [str(bench.folder / "torso.mp4")]
