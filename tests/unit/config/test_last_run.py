"""The values of the command line of the last run, which the next run of a job keeps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from bodycap_batch.config.job import load_job, load_job_with_origins, results_of_job
from bodycap_batch.config.overrides import COMMAND_LINE, NO_HEIGHT, Overrides, values_to_record
from bodycap_batch.store.checked_json import checked_json


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    """A folder of videos whose names do not say all places."""
    folder = tmp_path / "walk"
    folder.mkdir()
    for name in ("torso.mp4", "gopro1.mp4"):
        (folder / name).write_bytes(b"frames")
    return folder


def has_run(walk: Path, **values: Any) -> Path:
    """Write the record of a run with these values of the command line; return the folder of the results."""
    results = walk.parent / "out" / "walk"
    results.mkdir(parents=True, exist_ok=True)
    (results / "run.json").write_text(checked_json({"files": [], COMMAND_LINE: values}))
    return results


LAST = {"height_m": 1.62, "skeleton": "full_body", "activity": "walk", "mounts": {"gopro1": "left_palm"}}


def test_the_next_run_keeps_the_values_and_says_so(walk: Path) -> None:
    has_run(walk, **LAST)
    loaded = load_job_with_origins(walk)
    job = loaded.job
    assert (job.height_m, job.skeleton, job.activity) == (1.62, "full_body", "walk")
    assert {camera.name: camera.role for camera in job.capture.cameras}["gopro1"] == "LeftHand"
    assert loaded.origins["gopro1"].mount.text() == "left_palm (from the last run)"
    (said,) = loaded.warnings_of_run()
    for word in ("last run", "--height 1.62", "--skeleton full_body", "--camera gopro1=left_palm"):
        assert word in said


def test_the_command_line_and_the_job_file_replace_them(walk: Path) -> None:
    has_run(walk, **LAST)
    job = load_job(walk, Overrides(height_m=1.9, mounts={"gopro1": "head"}))
    assert (job.height_m, job.skeleton) == (1.9, "full_body")
    assert {camera.name: camera.role for camera in job.capture.cameras}["gopro1"] == "Head"
    cameras = "[{name: torso, video: torso.mp4}, {name: gopro1, video: gopro1.mp4, mount: right_palm}]"
    (walk / "job.yaml").write_text(f"capture: {{cameras: {cameras}}}\nheight_m: 1.7\nskeleton: none\n")
    job = load_job(walk)
    assert (job.height_m, job.skeleton, job.activity) == (1.7, "none", "walk")
    assert {camera.name: camera.role for camera in job.capture.cameras}["gopro1"] == "RightHand"
    (walk / "job.yaml").write_text("height_m: null\n")
    assert load_job(walk).height_m is None


def test_none_is_the_height_of_a_mean_adult(walk: Path) -> None:
    has_run(walk, **LAST)
    assert load_job(walk, Overrides(height_m=NO_HEIGHT)).height_m is None


def test_results_elsewhere_have_their_own_values(walk: Path, tmp_path: Path) -> None:
    has_run(walk, **LAST)
    mounts = {"gopro1": "left_palm"}
    assert load_job(walk, Overrides(out=tmp_path / "other", mounts=mounts)).height_m is None
    assert load_job(walk, Overrides(out_parent=tmp_path / "batch", mounts=mounts)).height_m is None
    assert load_job(walk, Overrides(out_parent=tmp_path / "out")).height_m == 1.62


def test_places_found_from_the_motion_are_looked_for_again(tmp_path: Path) -> None:
    walk = tmp_path / "walk"
    walk.mkdir()
    for name in "abc":
        (walk / f"{name}.mp4").write_bytes(b"frames")
    has_run(walk, places=["torso", "left_palm", "right_palm"])
    assert len(load_job(walk).capture.unplaced()) == 3


def test_a_record_of_an_earlier_version_gives_the_height_of_its_job(walk: Path) -> None:
    results = has_run(walk)
    (results / "run.json").write_text(checked_json({"files": []}))
    (results / "job.yaml").write_text("height_m: 1.81\n")
    assert load_job(walk, Overrides(mounts={"gopro1": "left_palm"})).height_m == 1.81


@pytest.mark.parametrize(
    "text", ["", "[]", '{"command_line": 3}', '{"command_line": {"height_m": "x"}}', "\xff"]
)
def test_a_damaged_record_is_no_record(walk: Path, text: str) -> None:
    (has_run(walk) / "run.json").write_text(text, encoding="latin-1")
    assert load_job(walk, Overrides(mounts={"gopro1": "left_palm"})).height_m is None


def test_a_camera_that_no_longer_exists_is_no_error(walk: Path) -> None:
    has_run(walk, mounts={"gopro1": "left_palm", "gopro7": "head"})
    assert len(load_job(walk).capture.cameras) == 2


def test_a_run_records_what_its_command_line_gave_and_what_it_kept(walk: Path) -> None:
    results = has_run(walk, **LAST)
    kept = values_to_record(load_job(walk), Overrides(), results)
    assert kept == {**LAST, "places": []}
    given = Overrides(height_m=1.9)
    assert values_to_record(load_job(walk, given), given, results)["height_m"] == 1.9
    (walk / "job.yaml").write_text("height_m: 1.7\n")
    assert "height_m" not in values_to_record(load_job(walk), Overrides(), results), "the job file has it now"
    without = Overrides(height_m=NO_HEIGHT)
    assert "height_m" not in values_to_record(load_job(walk, without), without, results)
    assert json.dumps(kept)


def test_the_place_of_the_command_line_is_called_so(walk: Path) -> None:
    loaded = load_job_with_origins(walk, Overrides(mounts={"gopro1.mp4": "left_palm"}))
    assert loaded.origins["gopro1"].mount.text() == "left_palm (from the command line)"
    assert loaded.origins["torso"].mount.text() == "torso (from the camera name)"
    cameras = "[{name: torso, video: torso.mp4}, {name: gopro1, video: gopro1.mp4, mount: right_palm}]"
    (walk / "job.yaml").write_text(f"capture: {{cameras: {cameras}}}\n")
    assert load_job_with_origins(walk).origins["gopro1"].mount.text() == "right_palm (from the job file)"


def test_the_results_of_a_job_are_known_without_its_videos(walk: Path, tmp_path: Path) -> None:
    assert results_of_job(walk) == tmp_path / "out" / "walk"
    (tmp_path / "other.yaml").write_text("name: stairs\n")
    assert results_of_job(tmp_path / "other.yaml") == tmp_path / "out" / "stairs"
    (tmp_path / "other.yaml").write_text("out: made/here\ncapture: 3\n")
    assert results_of_job(tmp_path / "other.yaml") == tmp_path / "made" / "here"


def test_places_to_be_found_replace_the_places_of_the_last_run(tmp_path: Path) -> None:
    walk = tmp_path / "walk"
    walk.mkdir()
    for name in "abc":
        (walk / f"{name}.mp4").write_bytes(b"frames")
    has_run(walk, mounts={"a": "torso", "b": "left_palm", "c": "right_palm"})
    places = ("torso", "left_palm", "right_palm")
    found = load_job(walk, Overrides(places=places)).capture
    assert found.places == places
    assert all(camera.role is None for camera in found.cameras)
    has_run(walk, places=list(places))
    stated = load_job(walk, Overrides(mounts={"a": "torso", "b": "head", "c": "hips"})).capture
    assert not stated.places
