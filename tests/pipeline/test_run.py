"""`run_job` with stand-in stages: order, reuse, resume, extension of the map, partial results."""

from __future__ import annotations

import json
import os
import shutil
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from bodycap_batch.config.models import Job
from bodycap_batch.config.sample_files import samples_beside
from bodycap_batch.core.errors import BodycapError, Cancelled, CaptureError, EstimationError
from bodycap_batch.core.progress import Event
from bodycap_batch.pipeline import RunSummary, Settings, run_job
from bodycap_batch.store.artefacts import Store
from tests.pipeline.fake_stages import ORDERS, give_orders
from tests.pipeline.spools import wait_for
from tests.results import results_of

CHILD = (sys.executable, str(Path(__file__).with_name("fake_stages.py")))
CAMERAS = ("torso", "left_palm")


class Bench:
    """A capture of two small files, a store, and a job on them."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder = folder
        self.out = folder / "out" / "walk"
        self.stop = threading.Event()
        self.events: list[Event] = []
        for name in CAMERAS:
            (folder / f"{name}.mp4").write_text(f"frames of {name}")
        monkeypatch.setenv(ORDERS, str(folder / "orders.json"))
        self.order()

    def order(self, **orders: Any) -> None:
        give_orders(self.folder, **orders)

    def job(self, **changes: Any) -> Job:
        cameras = [
            {
                "name": name,
                "video": [str(self.folder / f"{name}.mp4")],
                "samples": samples_beside([self.folder / f"{name}.mp4"], name),
                "calibration": "auto",
                "offset_s": 0.0,
                "rolling_shutter_s": 0.0,
                **changes.pop(name, {}),
            }
            for name in CAMERAS
        ]
        return Job.model_validate(
            {
                "capture": {"cameras": cameras, **changes.pop("capture", {})},
                "name": "walk",
                "skeleton": "upper_body",
                **changes,
            }
        )

    def settings(self) -> Settings:
        return Settings(
            store=Store(self.folder / "store"),
            threads=2,
            listener=self.events.append,
            cancelled=self.stop.is_set,
            command=CHILD,
        )

    def run(self, **changes: Any) -> RunSummary:
        return run_job(self.job(**changes), out_dir=self.out, settings=self.settings())

    def executed(self, **changes: Any) -> list[str]:
        """Run, and return the tasks that were computed."""
        summary = self.run(**changes)
        return sorted(f"{s.stage} {s.camera}".strip() for s in summary.stages if not s.reused)

    def results(self) -> dict[str, bytes]:
        return results_of(self.out)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    """A bench on which nothing has run yet."""
    return Bench(tmp_path, monkeypatch)


@pytest.fixture(scope="module")
def done_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("done")
    with pytest.MonkeyPatch.context() as monkeypatch:
        Bench(folder, monkeypatch).run()
    return folder


@pytest.fixture
def done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, done_once: Path) -> Bench:
    """A bench on which the job has run with its default options."""
    shutil.copytree(done_once / "store", tmp_path / "store")
    shutil.copytree(done_once / "out", tmp_path / "out")
    return Bench(tmp_path, monkeypatch)


PER_CAMERA = ["keyframes left_palm", "keyframes torso"]
LINKED = ["links left_palm", "links torso"]
REGISTERED = ["registration left_palm", "registration torso", *LINKED]
LAST = ["export", "fill", "merge", "preview", "report"]
"""The stages after the clocks."""
CLOCKED = ["clocks", *LAST]
ALL = sorted(["check", "sound", *PER_CAMERA, "map", *REGISTERED, *CLOCKED])


def test_all_stages_run_and_the_results_are_there(bench: Bench) -> None:
    assert bench.executed() == ALL
    names = set(bench.results())
    assert {"metrics.json", "result.ply", "result.bvh", "trajectories/torso.tum", "preview.mp4"} <= names
    resolved = Job.model_validate(yaml.safe_load((bench.out / "job.yaml").read_text()))
    assert resolved == bench.job()
    record = json.loads((bench.out / "run.json").read_text())
    assert sorted(record["files"]) == sorted(names)
    assert {stage["stage"] for stage in record["stages"]} == {name.split()[0] for name in ALL}
    assert all(stage["peak_memory_mb"] > 0 for stage in record["stages"])
    assert all(stage["cpu_seconds"] > 0 for stage in record["stages"])


def test_a_finished_job_executes_nothing(done: Bench) -> None:
    before = done.results()
    assert done.executed() == []
    assert done.results() == before
    assert json.loads((done.out / "run.json").read_text())["seconds"] >= 0


def test_touching_a_video_executes_nothing(done: Bench) -> None:
    os.utime(done.folder / "torso.mp4", (1e9, 1e9))
    assert done.executed() == []


def test_moving_the_capture_executes_nothing(done: Bench) -> None:
    moved = done.folder / "elsewhere"
    moved.mkdir()
    for name in CAMERAS:
        (done.folder / f"{name}.mp4").rename(moved / f"{name}.mp4")
    assert (
        done.executed(
            torso={"video": [str(moved / "torso.mp4")]}, left_palm={"video": [str(moved / "left_palm.mp4")]}
        )
        == []
    )


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"export": {"units": "m"}}, ["export", "report"]),
        ({"export": {"preview": False}}, []),
        ({"merge": {"max_gap_s": 0.5}}, ["export", "fill", "merge", "preview", "report"]),
        ({"fill": "rest"}, ["export", "fill", "preview", "report"]),
        ({"height_m": 1.8}, ["check", "export", "fill", "merge", "preview", "report"]),
        ({"activity": "walk"}, ["check", "export", "fill", "merge", "preview", "report"]),
        ({"torso": {"sigma_deg": 3.0}}, ["check", "export", "fill", "merge", "preview", "report"]),
        ({"registration": {"min_inliers": 20}}, [*CLOCKED, *REGISTERED]),
        ({"registration": {"rounds": 1}}, []),
        ({"map": {"features": 1024}}, ["map", *CLOCKED, *REGISTERED]),
        ({"keyframes": {"parallax_px": 50.0}}, sorted(set(ALL) - {"check", "sound"})),
        ({"torso": {"offset_s": 0.1}}, ["check", *CLOCKED]),
        ({"torso": {"drift_ppm": 10.0}}, ["check", *CLOCKED]),
        ({"capture": {"clocks": "common"}}, CLOCKED),
        ({"capture": {"work_px": 640}}, ALL),
        ({"name": "other", "out": "/elsewhere"}, ["export", "report"]),
    ],
    ids=lambda value: str(value)[:40],
)
def test_a_changed_option_reruns_exactly_what_depends_on_it(
    done: Bench, changes: dict[str, Any], expected: list[str]
) -> None:
    assert done.executed(**changes) == sorted(expected)


def test_a_changed_video_reruns_its_stages(done: Bench) -> None:
    (done.folder / "torso.mp4").write_text("other frames")
    assert done.executed() == sorted(set(ALL) - {"keyframes left_palm"})


def test_going_back_to_earlier_options_finds_the_earlier_results(done: Bench) -> None:
    before = done.results()
    done.run(map={"features": 1024})
    assert done.results() != before
    assert done.executed() == []
    assert done.results() == before


def test_results_of_the_last_run_that_are_no_longer_made_vanish_and_other_files_stay(done: Bench) -> None:
    (done.out / "my notes.txt").write_text("mine")
    done.run(export={"formats": ["ply"]})
    assert (done.out / "result.ply").exists()
    assert not (done.out / "result.bvh").exists()
    assert (done.out / "my notes.txt").read_text() == "mine"


@pytest.mark.parametrize(
    "stage", ["check", "keyframes", "map", "registration", "merge", "fill", "export", "report"]
)
def test_a_corrupt_artefact_is_rebuilt(done: Bench, stage: str) -> None:
    before = done.results()
    folder = sorted((done.folder / "store" / "artefacts" / stage).iterdir())[0]
    victim = next(path for path in sorted(folder.rglob("*")) if path.is_file() and path.stat().st_size)
    data = bytearray(victim.read_bytes())
    data[len(data) // 2] ^= 1
    victim.unlink()
    victim.write_bytes(data)
    assert [name.split()[0] for name in done.executed()] == [stage]
    assert done.results() == before
    assert len(list((done.folder / "store" / "corrupt").iterdir())) == 1


def test_a_result_edited_by_the_user_is_restored(done: Bench) -> None:
    before = done.results()
    (done.out / "metrics.json").write_text("{}")
    done.run()
    assert done.results() == before


def test_no_skeleton_no_merge(bench: Bench) -> None:
    assert bench.executed(skeleton="none") == sorted(set(ALL) - {"merge", "fill"})


def test_a_failed_stage_leaves_earlier_results_intact(done: Bench) -> None:
    before = done.results()
    done.order(fail="map")
    with pytest.raises(EstimationError, match="map does not work out"):
        done.run(map={"features": 1024})
    told = done.results()
    report = told.pop("partial/report.html")
    assert told == before
    assert report == b"map: map does not work out; keyframes"


@pytest.mark.parametrize("stage", ["keyframes", "registration"])
def test_the_failure_of_one_camera_is_in_the_report(bench: Bench, stage: str) -> None:
    bench.order(fail=stage, on="left_palm")
    with pytest.raises(EstimationError, match="does not work out") as caught:
        bench.run()
    assert not getattr(caught.value, "__notes__", [])
    report = (bench.out / "partial" / "report.html").read_text()
    assert report.startswith(f"{stage}: {stage} does not work out; ")


def test_a_missing_video_is_in_the_report(bench: Bench) -> None:
    (bench.folder / "torso.mp4").unlink()
    with pytest.raises(CaptureError, match="no such video file") as caught:
        bench.run()
    report = bench.out / "partial" / "report.html"
    assert str(report) in str(caught.value.hint)
    assert report.read_text() == "check: there is no such video file; "


@pytest.mark.parametrize("stage", ["report", "preview"])
def test_results_are_there_although_their_report_or_video_failed(bench: Bench, stage: str) -> None:
    bench.order(fail=stage)
    with pytest.raises(EstimationError, match=f"{stage} does not work out") as caught:
        bench.run()
    assert {"metrics.json", "result.bvh"} <= set(bench.results())
    assert caught.value.hint == f"film more; see {bench.out} for the other results"
    assert set(json.loads((bench.out / "run.json").read_text())["files"]) == set(bench.results())


def test_without_a_skeleton_the_rest_is_kept_and_called_partial(done: Bench) -> None:
    complete = done.results()
    done.order(fail="merge")
    with pytest.raises(EstimationError, match="merge does not work out") as caught:
        done.run(merge={"max_gap_s": 0.5})
    assert caught.value.exit_code == 4
    partial = done.out / "partial"
    assert str(partial) in str(caught.value.hint)
    assert json.loads((partial / "metrics.json").read_text()) == {"partial": True}
    told = "merge: merge does not work out; keyframes map registrations export"
    assert (partial / "report.html").read_text() == told
    assert (partial / "result.ply").exists()
    assert {name: data for name, data in done.results().items() if "partial" not in name} == complete
    done.order()
    done.run(merge={"max_gap_s": 0.5})
    assert not partial.exists()
    assert json.loads((done.out / "metrics.json").read_text()) == {"partial": False}


def test_two_failures_are_both_reported(bench: Bench) -> None:
    bench.order(fail=["merge", "preview"])
    with pytest.raises(EstimationError, match="merge does not work out") as caught:
        bench.run()
    assert "besides: preview does not work out" in str(caught.value.hint)
    assert str(bench.out / "partial") in str(caught.value.hint)


def test_a_failure_of_the_machine_precedes_a_missing_skeleton(bench: Bench) -> None:
    bench.order(fail="merge", crash="preview")
    with pytest.raises(BodycapError, match="SIGSEGV") as caught:
        bench.run()
    assert "besides: merge does not work out" in str(caught.value.hint)


def test_the_map_is_extended_until_no_keyframe_is_wanted(bench: Bench) -> None:
    bench.order(wanted=[[5], [7]], localised=[5, 8, 9])
    executed = bench.executed()
    assert executed.count("extend") == 2
    assert executed.count("registration torso") == 3
    assert bench.executed() == []


@pytest.mark.parametrize(("last", "rounds_used"), [(7, 1), (8, 2)])
def test_the_map_is_not_extended_further_if_no_frame_is_gained(
    bench: Bench, last: int, rounds_used: int
) -> None:
    """A round that loses frames is not used; one that gains none is: keyframes may have new poses."""
    bench.order(wanted=[[5], [7], [9]], localised=[5, 8, last])
    summary = bench.run()
    assert max(stage.round for stage in summary.stages) == 2
    used = json.loads((bench.out / "result.ply").read_text())["registrations"]["torso"]
    passes = 0
    while used is not None:
        used = json.loads(used)[2]["previous"]
        passes += 1
    assert passes == rounds_used + 1


def test_the_earlier_map_is_kept_if_its_extension_fails(bench: Bench) -> None:
    bench.order(wanted=[[5]], localised=[5], fail="extend")
    executed = bench.executed()
    assert executed.count("registration torso") == 1
    notes = [event.what for event in bench.events if event.kind == "note"]
    assert sum("could not be extended" in note and "extend does not work out" in note for note in notes) == 1
    assert (bench.out / "result.ply").exists()


@pytest.mark.parametrize(("contradicted", "extensions_used"), [(0, 0), (3, 1)])
def test_a_round_that_withdraws_wrong_poses_loses_no_frames(
    bench: Bench, contradicted: int, extensions_used: int
) -> None:
    bench.order(wanted=[[5]], localised=[10, 7], contradicted=[0, contradicted])
    bench.executed()
    used = json.loads(json.loads((bench.out / "result.ply").read_text())["registrations"]["torso"])
    assert (used[2]["previous"] is not None) == bool(extensions_used)


@pytest.mark.parametrize("further", [0, 2])
def test_lost_parts_get_maps_of_their_own(bench: Bench, further: int) -> None:
    """With further maps, all later stages use them, and the registrations that name their frames."""
    bench.order(lost={"torso": 12}, further=further)
    executed = bench.executed()
    assert "further_maps" in executed
    poses = {"further_poses torso", "further_poses left_palm"}
    assert poses & set(executed) == (poses if further else set())
    used = json.loads((bench.out / "result.ply").read_text())
    assert json.loads(used["map"])[0] == ("further_maps" if further else "map")
    assert json.loads(used["registrations"]["left_palm"])[0] == (
        "further_poses" if further else "registration"
    )


def test_few_lost_frames_need_no_further_map(bench: Bench) -> None:
    bench.order(lost={"torso": 9})
    assert not {name for name in bench.executed() if name.startswith("further")}


@pytest.mark.parametrize("name", ["torso.imu.csv", "torso.gcsv"])
def test_sensors_are_used_where_there_are_samples(bench: Bench, name: str) -> None:
    (bench.folder / name).write_text("samples")
    after = {"telemetry": {"tracking": False}}
    assert set(bench.executed(**after)) == {*ALL, "inertial torso"}
    used = json.loads((bench.out / "result.ply").read_text())["registrations"]
    assert {camera: json.loads(content)[0] for camera, content in used.items()} == {
        "torso": "inertial",
        "left_palm": "registration",
    }
    (bench.folder / name).write_text("other samples")
    assert bench.executed(**after) == ["inertial torso"]
    (bench.folder / name).unlink()
    assert bench.executed(**after) == sorted(["links torso", *LAST])
    assert "inertial" not in {
        stage["stage"] for stage in json.loads((bench.out / "run.json").read_text())["stages"]
    }


def test_sensors_are_used_where_the_video_has_telemetry(bench: Bench) -> None:
    bench.order(telemetry=["left_palm"])
    assert "inertial left_palm" in bench.executed()


def test_the_sensors_of_all_cameras_help_each_other(bench: Bench) -> None:
    bench.order(telemetry=["torso", "left_palm"])
    after = {"telemetry": {"tracking": False}}
    assert {"inertial torso", "inertial left_palm"} <= set(bench.executed(**after))
    (bench.folder / "torso.imu.csv").write_text("samples")
    assert {"inertial torso", "inertial left_palm"} <= set(bench.executed(**after))


def test_samples_are_an_input_of_the_keyframes_of_their_camera(bench: Bench) -> None:
    bench.run()
    (bench.folder / "torso.imu.csv").write_text("samples")
    executed = bench.executed()
    assert "keyframes torso" in executed
    assert "keyframes left_palm" not in executed


def test_telemetry_that_is_switched_off_changes_nothing(bench: Bench) -> None:
    bench.run()
    before = {name: data for name, data in bench.results().items() if name != "job.yaml"}
    (bench.folder / "torso.imu.csv").write_text("samples")
    assert (
        bench.executed(telemetry=dict.fromkeys(("gravity", "tracking", "gps", "smoothing", "gaps"), False))
        == []
    )
    assert {name: data for name, data in bench.results().items() if name != "job.yaml"} == before


def test_stabilised_cameras_are_turned_back_if_all_sensors_are_switched_off(bench: Bench) -> None:
    off = {"telemetry": dict.fromkeys(("gravity", "tracking", "gps", "smoothing", "gaps"), False)}
    bench.order(telemetry=["torso", "left_palm"], stabilised=["left_palm"])
    assert [name for name in bench.executed(**off) if name.startswith("inertial")] == ["inertial left_palm"]


def test_rounds_limit_the_extensions(bench: Bench) -> None:
    bench.order(wanted=[[5]] * 5, localised=[1, 2, 3, 4, 5, 6])
    assert bench.executed(registration={"rounds": 1}).count("extend") == 1


@pytest.mark.parametrize(
    "order", [{}, {"wanted": [[5], [7]], "localised": [38, 37]}, {"rolling": True}], ids=str
)
@pytest.mark.parametrize("rounds", [0, 1])
def test_lost_frames_are_recovered_once_against_the_final_map(
    bench: Bench, order: dict[str, Any], rounds: int
) -> None:
    bench.order(lost={"torso": 3, "left_palm": 2}, **{"localised": [40, 40], **order})
    executed = bench.executed(registration={"rounds": rounds})
    assert [name for name in executed if name.startswith("recover")] == ["recover torso"]
    used = json.loads((bench.out / "result.ply").read_text())["registrations"]
    stages = {camera: json.loads(content)[0] for camera, content in used.items()}
    assert stages == {"torso": "recover", "left_palm": "registration"}
    kept = json.loads(used["torso"])[2]
    # The other camera's as the results have it.
    assert used["left_palm"] == kept["registrations"]["left_palm"]
    assert kept["cameras"] == ["torso", "left_palm"]
    assert bench.executed(registration={"rounds": rounds}) == []


def test_nothing_is_recovered_if_too_few_frames_have_a_pose(bench: Bench) -> None:
    bench.order(lost={"torso": 9}, localised=[19])
    assert "recover torso" not in bench.executed()


def test_a_rolling_shutter_refines_the_map_and_solves_every_frame_again(bench: Bench) -> None:
    bench.order(rolling=True)
    executed = bench.executed()
    assert executed.count("refine") == 1
    assert executed.count("registration torso") == 2
    used = json.loads(json.loads((bench.out / "result.ply").read_text())["registrations"]["torso"])
    assert used[2]["previous"] is not None, "the tracks of the first pass are kept"
    assert bench.executed() == []


def test_poses_are_kept_if_no_rolling_shutter_is_found(bench: Bench) -> None:
    bench.order(rolling=True, corrected=[[], []])
    executed = bench.executed()
    assert executed.count("refine") == 1
    assert executed.count("registration torso") == 1
    assert json.loads((bench.out / "result.ply").read_text())["registrations"]["torso"]
    assert bench.executed() == []


def test_poses_that_were_solved_with_readouts_are_solved_again_without_them(bench: Bench) -> None:
    bench.order(rolling=True, corrected=[["torso"], []])
    executed = bench.executed()
    assert (executed.count("refine"), executed.count("registration torso")) == (1, 2)


def stopped_at_the_order(bench: Bench, meanwhile: Callable[[], None] = lambda: None) -> list[Cancelled]:
    """Run in a thread until a stage hangs, as ordered, then stop it; returns how the run ended."""
    failures: list[Cancelled] = []

    def run() -> None:
        try:
            bench.run()
        except Cancelled as error:
            failures.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        wait_for((bench.folder / "started").exists)
        meanwhile()
    finally:
        bench.stop.set()
        thread.join(30)
    bench.stop.clear()
    bench.order()
    return failures


@pytest.mark.parametrize("stage", ["keyframes", "map", "merge", "export"])
def test_a_stopped_run_goes_on_where_it_was(bench: Bench, stage: str) -> None:
    bench.order(hang=stage)
    failures = stopped_at_the_order(bench)
    assert len(failures) == 1
    assert bench.results() == {}
    executed = bench.executed()
    assert "check" not in executed
    assert any(name.startswith(stage) for name in executed)
    assert [name for name in ALL if not name.startswith(stage)] != executed
    assert "metrics.json" in bench.results()


def test_results_are_published_before_their_video(done: Bench) -> None:
    shutil.rmtree(done.folder / "store")
    (done.out / "result.bvh").write_text("of an earlier run")
    done.order(hang="preview")
    names = set(done.results())

    def said() -> set[str]:
        return set(json.loads((done.out / "run.json").read_text())["files"])

    assert len(stopped_at_the_order(done, lambda: wait_for(lambda: "preview.mp4" not in said()))) == 1
    assert set(done.results()) == said() == names - {"preview.mp4"}
    assert done.results()["result.bvh"] != b"of an earlier run"
    assert done.executed() == ["preview"]
    assert set(done.results()) == said() == names


@pytest.mark.parametrize("failed", ["", "merge"])
def test_the_folder_of_results_is_reported_before_their_video_is_ready(bench: Bench, failed: str) -> None:
    told: list[Path] = []

    def stop(folder: Path) -> None:
        told.append(folder)
        bench.stop.set()

    bench.order(hang="preview", fail=failed)
    with pytest.raises(Cancelled):
        run_job(bench.job(), out_dir=bench.out, settings=replace(bench.settings(), results_ready=stop))
    assert told == [bench.out / "partial" if failed else bench.out]
    assert (told[0] / "metrics.json").is_file()


def test_a_bug_in_a_stage_is_not_an_estimation_error(bench: Bench) -> None:
    (bench.folder / "orders.json").write_text("no JSON")
    with pytest.raises(BodycapError, match="check: JSONDecodeError") as caught:
        bench.run()
    assert caught.value.exit_code == 70


def test_a_missing_video_is_named_before_anything_is_computed(bench: Bench) -> None:
    (bench.folder / "torso.mp4").unlink()
    with pytest.raises(BodycapError, match="no such video file") as caught:
        bench.run()
    assert caught.value.exit_code == 3
    assert str(caught.value.path).endswith("torso.mp4")
    told = [(event.stage, event.kind) for event in bench.events if event.kind != "progress"]
    assert told[0] == ("check", "failed")
    assert {stage for stage, _ in told[1:]} <= {"report"}


def test_events_report_every_stage(bench: Bench) -> None:
    bench.run()
    finished = sorted(event.label for event in bench.events if event.kind == "finished")
    assert finished == ALL
    assert "note: a note" in [event.what for event in bench.events if event.kind == "note"]


FOUND = {"a": "left_palm", "b": "torso", "c": "right_palm"}


def unplaced_job(bench: Bench) -> Job:
    for name in "abc":
        (bench.folder / f"{name}.mp4").write_text(f"frames of {name}")
    cameras = [{"name": name, "video": [str(bench.folder / f"{name}.mp4")]} for name in "abc"]
    capture = {"cameras": cameras, "places": list(FOUND.values())}
    return Job.model_validate({"capture": capture, "name": "walk", "skeleton": "auto"})


def test_places_found_from_the_motion_are_used_and_written_into_the_job_file(bench: Bench) -> None:
    bench.order(places=FOUND)
    job = unplaced_job(bench)
    run_job(job, out_dir=bench.out, settings=bench.settings())
    written = yaml.safe_load((bench.out / "job.yaml").read_text())["capture"]["cameras"]
    assert {each["name"]: (each["mount"], each["mount_source"]) for each in written} == {
        name: (place, "motion") for name, place in FOUND.items()
    }
    again = Job.model_validate(yaml.safe_load((bench.out / "job.yaml").read_text()))
    summary = run_job(again, out_dir=bench.out, settings=bench.settings())
    computed = {stage.stage for stage in summary.stages if not stage.reused}
    assert computed == set(), "a job with the found places gives the same results"


def test_without_clocks_each_camera_is_taken_for_the_one_on_the_trunk(bench: Bench) -> None:
    bench.order(places=FOUND)
    known = run_job(unplaced_job(bench), out_dir=bench.out, settings=bench.settings())
    assert sum(stage.stage == "clocks" for stage in known.stages) == 2, "before and after the places"
    shutil.rmtree(bench.folder / "store")
    bench.order(places=FOUND, unknown_clocks=["b"])
    summary = run_job(unplaced_job(bench), out_dir=bench.out, settings=bench.settings())
    assert sum(stage.stage == "clocks" for stage in summary.stages) == 2 + len(FOUND)
    (places,) = (bench.folder / "store").glob("artefacts/places/*/made_of.txt")
    clocks = json.loads(places.read_text())[2]["clocks"]
    assert set(clocks) == set(FOUND)
    assert len(set(clocks.values())) == len(FOUND)


def test_what_is_missing_without_a_clock_is_said_before_the_map(bench: Bench) -> None:
    bench.run(left_palm={"offset_s": None})
    texts = [(event.kind, event.what) for event in bench.events]
    (said,) = [index for index, (_, text) in enumerate(texts) if "there is no motion of the body" in text]
    assert said < next(index for index, event in enumerate(bench.events) if event.stage == "map")
    bench.events.clear()
    bench.run()
    assert not any("there is no motion of the body" in event.what for event in bench.events)


def test_places_that_the_motion_does_not_show_are_asked_for(bench: Bench) -> None:
    job = unplaced_job(bench)
    with pytest.raises(EstimationError, match="the arms do not move") as caught:
        run_job(job, out_dir=bench.out, settings=bench.settings())
    assert "--camera a=PLACE --camera b=PLACE" in str(caught.value.hint)
    partial = bench.out / "partial"
    assert {"metrics.json", "result.ply", "report.html", "preview.mp4"} <= set(os.listdir(partial))
    assert "the arms do not move" in (partial / "report.html").read_text()
    cameras = [each.model_copy(update={"mount": FOUND[each.name]}) for each in job.capture.cameras]
    capture = job.capture.model_copy(update={"cameras": tuple(cameras), "places": ()})
    summary = run_job(
        job.model_copy(update={"capture": capture}), out_dir=bench.out, settings=bench.settings()
    )
    reused = {stage.stage for stage in summary.stages if stage.reused}
    assert {"keyframes", "map", "registration"} <= reused


def test_a_mechanism_that_is_switched_off_is_part_of_every_key(
    done: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("BODYCAP_WITHOUT", "skeletal_set")
    assert done.executed() == ALL
    monkeypatch.delenv("BODYCAP_WITHOUT")
    assert done.executed() == []
