"""Files for one program, from the stored results of a job. `test_commands.py` looks into the files."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from bodycap_batch.config.job import load_job
from bodycap_batch.config.models import Job
from bodycap_batch.core.errors import EstimationError, JobError, StoreError
from bodycap_batch.core.progress import Event
from bodycap_batch.pipeline import Settings
from bodycap_batch.pipeline.exporting import GUIDE_FILE, export_for
from bodycap_batch.pipeline.reporting import find_stored
from bodycap_batch.pipeline.run import run_job
from bodycap_batch.store.artefacts import Store
from tests.pipeline.test_run import FOUND, Bench, unplaced_job
from tests.pipeline.tiny_job import Place
from tests.results import results_of


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(tmp_path, monkeypatch)


def in_store(place: Place, events: list[Event]) -> Settings:
    return Settings(store=Store(place.store), threads=1, listener=events.append, cancelled=lambda: False)


@pytest.mark.slow
def test_only_the_export_is_computed_and_the_results_stay(reference: Place, tmp_path: Path) -> None:
    folder = tmp_path / "job"
    shutil.copytree(reference.folder, folder, symlinks=True)
    place, events = Place.existing(folder), list[Event]()
    before = results_of(place.out)
    job = load_job(place.out / "job.yaml")
    made = place.out / "blender"
    written = export_for(
        job, "blender", out_dir=place.out, folder=made, fps=None, settings=in_store(place, events)
    )
    assert {event.stage for event in events if event.kind == "started"} == {"export"}
    names = {"motion.bvh", "motion.glb", "map.ply", "blender_scene.py", "blender_scene.json", GUIDE_FILE}
    assert {path.relative_to(made).as_posix() for path in written} >= {*names, "trajectories/torso.tum"}
    assert all(path.stat().st_size > 0 for path in written)
    guide = (made / GUIDE_FILE).read_text()
    assert "made for Blender" in guide
    assert "1. " in guide
    shutil.rmtree(made)
    assert results_of(place.out) == before


@pytest.mark.slow
def test_an_empty_store_is_reported(reference: Place, tmp_path: Path) -> None:
    job, settings = load_job(reference.out / "job.yaml"), in_store(Place.existing(tmp_path), [])
    with pytest.raises(StoreError, match="have not been computed yet"):
        export_for(job, "blender", out_dir=tmp_path, folder=tmp_path / "b", fps=None, settings=settings)
    assert not (tmp_path / "b").exists()


def test_without_the_main_file_of_the_program_nothing_is_written(bench: Bench) -> None:
    """The stand-in for the export writes files of other names."""
    bench.run()
    made = bench.out / "b"
    with pytest.raises(EstimationError, match=r"blender_scene\.py was not written"):
        export_for(
            bench.job(), "blender", out_dir=bench.out, folder=made, fps=None, settings=bench.settings()
        )
    assert not made.exists()


def test_a_job_without_a_body_has_no_motion_to_export(bench: Bench) -> None:
    job = bench.job(skeleton="none")
    with pytest.raises(JobError, match="no body") as caught:
        export_for(
            job, "blender", out_dir=bench.out, folder=bench.out / "b", fps=None, settings=bench.settings()
        )
    assert caught.value.exit_code == 2


def stages_of_last_run(bench: Bench) -> dict[str, str]:
    """Return the last artefact of each stage that the record of the run names."""
    record = json.loads((bench.out / "run.json").read_text())
    return {stage["stage"]: stage["artefact"] for stage in record["stages"]}


def found_again(bench: Bench, job: Job) -> dict[str, str]:
    results, stopped_by = find_stored(job, bench.out, bench.settings(), last="fill")
    assert stopped_by is None
    found = {"map": results.map, "clocks": results.clocks, "merge": results.merged, "fill": results.filled}
    return {
        name: artefact.path.relative_to(bench.folder / "store").as_posix()
        for name, artefact in found.items()
        if artefact is not None
    }


def test_the_stored_results_are_those_of_the_last_run(bench: Bench) -> None:
    bench.run()
    last = stages_of_last_run(bench)
    assert found_again(bench, bench.job()) == {
        name: last[name] for name in ("map", "clocks", "merge", "fill")
    }


def test_the_results_of_a_job_whose_places_were_found_are_stored_for_both_jobs(bench: Bench) -> None:
    bench.order(places=FOUND)
    job = unplaced_job(bench)
    run_job(job, out_dir=bench.out, settings=bench.settings())
    last = stages_of_last_run(bench)
    with_places = Job.model_validate(yaml.safe_load((bench.out / "job.yaml").read_text()))
    for asked in (job, with_places):
        assert found_again(bench, asked)["fill"] == last["fill"]
    results, _ = find_stored(job, bench.out, bench.settings(), last="fill")
    assert {camera.name: camera.mount for camera in results.facts.job.capture.cameras} == FOUND


def test_the_videos_are_in_the_record_of_the_run(bench: Bench) -> None:
    bench.run()
    assert videos_of_torso(bench) == [str(bench.folder / "torso.mp4")]


def test_videos_beside_the_results_are_found_after_both_were_moved(bench: Bench) -> None:
    """The folder of a watched job moves from running/ to done/."""
    bench.out = bench.folder / "result"
    run_job(bench.job(), out_dir=bench.out, settings=replace(bench.settings()))
    assert videos_of_torso(bench) == ["../torso.mp4"]


def videos_of_torso(bench: Bench) -> list[str]:
    return list(json.loads((bench.out / "run.json").read_text())["videos"]["torso"])
