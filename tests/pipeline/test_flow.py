"""How the tasks of a job share the cores, and which modules load while a core is idle."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from bodycap_batch.config.models import Job
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.pipeline import Settings, run_job
from bodycap_batch.pipeline.exporting import export_for
from bodycap_batch.pipeline.flow import _read_ahead
from bodycap_batch.pipeline.job_facts import JobFacts
from bodycap_batch.pipeline.stage_runner import StageRunner
from bodycap_batch.runner import Children, Task, TaskEnvironment
from bodycap_batch.runner.child_pool import do_nothing
from bodycap_batch.store.artefacts import Store
from bodycap_batch.store.code_version import Program
from bodycap_batch.tasks.stages import STAGES
from tests.pipeline.test_run import CAMERAS, CHILD, FOUND, Bench, bench, unplaced_job

__all__ = ["bench"]


@pytest.mark.parametrize(
    ("cameras", "threads", "expected"),
    [
        (1, 2, [2]),
        (2, 2, [1, 1]),
        (3, 2, [1, 1, 2]),  # the third runs when the others are done
        (5, 2, [1, 1, 1, 1, 2]),
        (3, 8, [2, 2, 2]),
        (3, 1, [1, 1, 1]),
    ],
)
def test_the_last_cameras_share_all_threads(
    tmp_path: Path, cameras: int, threads: int, expected: list[int]
) -> None:
    names = [f"camera {number}" for number in range(cameras)]
    blocks = [{"name": name, "video": [f"/{name}.mp4"]} for name in names]
    job = Job.model_validate({"capture": {"cameras": blocks}, "name": "walk", "skeleton": "none"})
    settings = Settings(
        store=Store(tmp_path), threads=threads, listener=lambda _: None, cancelled=lambda: False
    )
    runner = StageRunner.of(job, settings, tmp_path / "out")
    assert runner.threads_per_camera() == expected


class Watched(Children):
    """Children that record the modules that others were to load, by stage."""

    def __init__(self) -> None:
        super().__init__(CHILD)
        self.preload: dict[str, set[str]] = {}
        self.steps: dict[str, str] = {}
        self.with_reading: list[str] = []
        self.arguments: dict[str, Mapping[str, Any]] = {}

    def execute(self, task: Task, environment: TaskEnvironment) -> None:
        preload = environment.preload
        self.preload[task.key.stage] = {name for modules in preload.modules for name in modules}
        self.steps[task.key.stage] = preload.step
        if preload.then is not do_nothing:
            self.with_reading.append(task.key.stage)
        self.arguments[task.key.stage] = task.arguments
        super().execute(task, environment)


@pytest.mark.parametrize(("threads", "skeleton"), [(2, "upper_body"), (2, "none"), (1, "upper_body")])
def test_modules_of_later_stages_load_while_a_core_is_idle(bench: Bench, threads: int, skeleton: str) -> None:
    children = Watched()
    settings = Settings(
        store=Store(bench.folder / "store"),
        threads=threads,
        listener=bench.events.append,
        cancelled=bench.stop.is_set,
        executor=children,
    )
    run_job(bench.job(skeleton=skeleton), out_dir=bench.out, settings=settings)
    later = {"registration", "clocks", "links", "export", "report"} | (
        {"merge", "fill"} if skeleton != "none" else set()
    )
    wanted = {name for stage in later for name in STAGES[stage].modules}
    assert children.preload["map"] == (wanted if threads > 1 else set())
    assert children.steps["map"] == ("reconstruction" if threads > 1 else ""), "before it, no core is idle"
    reading = ["map"] if skeleton == "none" else ["map", "merge"]
    assert children.with_reading == (reading if threads > 1 else [])
    if skeleton != "none":
        assert children.preload["merge"] == (set(STAGES["preview"].modules) if threads > 1 else set())


def test_the_code_of_later_stages_is_read_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[str] = []
    monkeypatch.setattr(Program, "versions", lambda program: read.append(program.module))
    _read_ahead(["merge", "export"])
    assert read == ["tasks.merge", "tasks.export"]
    assert "scipy.special" in sys.modules


@pytest.mark.parametrize("board", [None, {"square_m": 0.1, "columns": 7, "rows": 5}])
def test_a_board_is_searched_for_in_the_stored_frames_of_keyframes(bench: Bench, board: Any) -> None:
    children = Watched()
    settings = Settings(
        store=Store(bench.folder / "store"),
        threads=1,
        listener=bench.events.append,
        cancelled=bench.stop.is_set,
        executor=children,
    )
    run_job(bench.job(merge={"marker_board": board}), out_dir=bench.out, settings=settings)
    footage, mapped = children.arguments["merge"]["footage"], children.arguments["map"]
    assert footage == (None if board is None else {name: mapped[name] for name in ("capture", "keyframes")})


def stages_of(bench: Bench, **changes: Any) -> Counter[str]:
    """Run a job, and return how often each stage ran or was reused."""
    return Counter(stage.stage for stage in bench.run(**changes).stages)


def test_cameras_without_positions_have_their_rotations_measured(bench: Bench) -> None:
    bench.order(unposed=True)
    ran = stages_of(bench, skeleton="none")
    assert ran["rotations"] == len(CAMERAS)
    assert ran["links"] == 2 * len(CAMERAS), "the paths of rotations are compared again"


def test_cameras_with_positions_keep_them(bench: Bench) -> None:
    assert "rotations" not in stages_of(bench, skeleton="none")


def test_a_camera_that_moves_keeps_its_path(bench: Bench) -> None:
    bench.order(unposed=True, moves=True)
    ran = stages_of(bench, skeleton="none")
    assert (ran["rotations"], ran["links"]) == (len(CAMERAS), len(CAMERAS))


def test_a_body_keeps_the_positions_of_its_cameras(bench: Bench) -> None:
    bench.order(unposed=True)
    assert "rotations" not in stages_of(bench)


NO_MAP = {"message": "no map works out", "hint": "move the cameras"}


def test_without_a_map_the_rotations_are_the_result(bench: Bench) -> None:
    bench.order(no_map=NO_MAP, unposed=True, lost={"torso": 90})
    ran = stages_of(bench, skeleton="none")
    assert ran["rotations"] == len(CAMERAS)
    assert "further_maps" not in ran, "there is nothing to which further maps could be compared"
    assert (bench.out / "report.html").exists()


def test_without_a_map_and_rotations_the_job_ends_with_the_reason_of_the_map(bench: Bench) -> None:
    bench.order(no_map=NO_MAP, unposed=True, moves=True)
    with pytest.raises(EstimationError, match="no map works out") as caught:
        bench.run(skeleton="none")
    assert "move the cameras" in str(caught.value.hint)
    page = (bench.out / "partial" / "report.html").read_text(encoding="utf-8")
    assert page.startswith("map: no map works out; keyframes")
    assert "registrations" not in page


def test_only_a_job_without_a_body_may_have_an_empty_map(bench: Bench) -> None:
    for skeleton, may_be_empty in (("none", True), ("upper_body", False)):
        children = Watched()
        settings = replace(bench.settings(), executor=children)
        run_job(bench.job(skeleton=skeleton), out_dir=bench.out, settings=settings)
        assert children.arguments["map"]["may_be_empty"] is may_be_empty


def test_a_run_until_the_map_names_its_failure(bench: Bench) -> None:
    bench.order(no_map=NO_MAP)
    with pytest.raises(EstimationError, match="no map works out"):
        run_job(
            bench.job(skeleton="none"), out_dir=bench.out, settings=replace(bench.settings(), until="map")
        )


LENS = {"model": "PINHOLE", "width": 64, "height": 48, "params": [50.0, 50.0, 32.0, 24.0]}
GIVEN = {"left_palm": {"calibration": {**LENS, "pixel_origin": "COLMAP"}}}


def lenses_of(bench: Bench, **changes: Any) -> tuple[Counter[str], str]:
    """Run a job with a given lens of the left palm; return the stages, and the lens of the results."""
    ran = stages_of(bench, **GIVEN, **changes)
    job = yaml.safe_load((bench.out / "job.yaml").read_text(encoding="utf-8"))
    cameras = {camera["name"]: camera["calibration"] for camera in job["capture"]["cameras"]}
    assert cameras["torso"] == "auto"
    return ran, "auto" if cameras["left_palm"] == "auto" else "given"


@pytest.mark.parametrize("skeleton", ["upper_body", "none"])
def test_a_given_lens_that_the_video_contradicts_gives_way_to_one_that_it_confirms(
    bench: Bench, skeleton: str
) -> None:
    bench.order(wrong={"given": 4})
    ran, lens = lenses_of(bench, skeleton=skeleton)
    assert lens == "auto"
    assert ran["map"] == 2
    assert ran["keyframes"] == 2 * len(CAMERAS)
    notes = [event.what for event in bench.events if event.kind == "note"]
    assert sum("left_palm" in note and "lens" in note for note in notes) == 2, (
        "before and after the second time"
    )


def test_a_given_lens_stays_if_the_path_is_confirmed(bench: Bench) -> None:
    bench.order(wrong={"given": 1, "auto": 0})
    ran, lens = lenses_of(bench)
    assert (ran["map"], lens) == (1, "given")


@pytest.mark.parametrize("wrong", [{"given": 4, "auto": 4}, {"given": 4, "auto": 9}])
def test_a_given_lens_stays_if_none_is_better(bench: Bench, wrong: dict[str, int]) -> None:
    bench.order(wrong=wrong)
    ran, lens = lenses_of(bench)
    assert (ran["map"], lens) == (2, "given")


def test_a_given_lens_stays_if_the_tracks_show_none(bench: Bench) -> None:
    bench.order(wrong={"given": 4}, tracks_show_lenses=False)
    ran, lens = lenses_of(bench)
    assert (ran["map"], lens) == (1, "given")


def test_unknown_lenses_are_not_freed(bench: Bench) -> None:
    bench.order(wrong={"auto": 9})
    assert stages_of(bench, skeleton="none")["map"] == 1


def test_the_files_state_the_lens_that_was_given(bench: Bench) -> None:
    bench.order(wrong={"given": 4})
    children = Watched()
    run_job(
        bench.job(**GIVEN, skeleton="none"),
        out_dir=bench.out,
        settings=replace(bench.settings(), executor=children),
    )
    assert children.arguments["export"]["freed"] == {"left_palm": pytest.approx(50.0 / 64.0)}


def test_an_export_for_a_program_uses_the_lens_of_the_run(bench: Bench) -> None:
    bench.order(wrong={"given": 4})
    job = bench.job(**GIVEN)
    run_job(job, out_dir=bench.out, settings=bench.settings())
    children = Watched()
    settings = replace(bench.settings(), executor=children)
    # The stand-in for the export writes files of other names.
    with pytest.raises(EstimationError, match="was not written"):
        export_for(job, "blender", out_dir=bench.out, folder=bench.out / "b", fps=None, settings=settings)
    assert children.arguments.keys() == {"export"}
    assert children.arguments["export"]["freed"] == {"left_palm": pytest.approx(50.0 / 64.0)}


def test_places_from_the_motion_keep_the_clocks_that_are_known_from_the_sound(bench: Bench) -> None:
    job = unplaced_job(bench)
    cameras = tuple(
        camera.model_copy(update={"offset_s": 0.5 + number})
        for number, camera in enumerate(job.capture.cameras)
    )
    facts = replace(JobFacts.of(job), capture=job.capture.model_copy(update={"cameras": cameras}))
    placed = facts.with_places(FOUND)
    for capture in (placed.capture, placed.job.capture):
        assert {camera.name: camera.mount for camera in capture.cameras} == FOUND
    assert [camera.offset_s for camera in placed.capture.cameras] == [0.5, 1.5, 2.5][: len(cameras)]
    stated = [camera.offset_s for camera in job.capture.cameras]
    assert [camera.offset_s for camera in placed.job.capture.cameras] == stated
