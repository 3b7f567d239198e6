"""`--from`, `--until`, `--force`, `why`, `gc`, and the disk space of a job whose check is stored."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from bodycap_batch.core.errors import Cancelled, StoreError
from bodycap_batch.pipeline import Settings, explain_job, run_job
from bodycap_batch.pipeline.why import _position, _reason
from bodycap_batch.runner import Task
from bodycap_batch.runner.task_runner import Runner
from bodycap_batch.store.artefacts import ArtefactKey, Store
from bodycap_batch.store.digests import _entry_text
from bodycap_batch.store.garbage_collection import collect_garbage
from bodycap_batch.store.references import References, in_use, moving
from bodycap_batch.tasks.order import StageName
from bodycap_batch.tasks.stages import stages_from
from tests.pipeline.test_run import ALL, CHILD, CLOCKED, PER_CAMERA, REGISTERED, Bench, bench, done, done_once

__all__ = ["bench", "done", "done_once"]


def settings(bench: Bench, **values: Any) -> Settings:
    return Settings(
        store=Store(bench.folder / "store"),
        threads=2,
        listener=bench.events.append,
        cancelled=bench.stop.is_set,
        command=CHILD,
        **values,
    )


def executed(bench: Bench, changes: dict[str, Any] | None = None, **values: Any) -> list[str]:
    job = bench.job(**(changes or {}))
    summary = run_job(job, out_dir=bench.out, settings=settings(bench, **values))
    return sorted(f"{s.stage} {s.camera}".strip() for s in summary.stages if not s.reused)


def steps(bench: Bench, *, threads: int = 2, **changes: Any) -> dict[str, str]:
    """What `why` says of each stage: "" where it is stored."""
    asked = replace(settings(bench), threads=threads)
    found = explain_job(bench.job(**changes), out_dir=bench.out, settings=asked)
    return {step.stage: step.reason for step in found}


def artefacts(bench: Bench) -> set[str]:
    root = bench.folder / "store" / "artefacts"
    return {path.relative_to(root).as_posix() for path in root.glob("*/*")}


@pytest.mark.parametrize(
    ("stage", "expected"),
    [
        ("check", ALL),
        ("keyframes", sorted(set(ALL) - {"check"})),
        ("registration", [*CLOCKED, *REGISTERED]),
        ("export", ["export", "preview", "report"]),
        ("preview", ["preview"]),
    ],
)
def test_from_a_stage_it_and_all_after_it_are_done_again(
    done: Bench, stage: StageName, expected: list[str]
) -> None:
    before, kept = done.results(), artefacts(done)
    assert executed(done, redo=stages_from(stage)) == sorted(expected)
    assert done.results() == before
    assert artefacts(done) == kept
    assert done.executed() == []


def test_until_a_stage_nothing_after_it_is_done_and_no_result_is_written(bench: Bench) -> None:
    assert executed(bench, until="map") == sorted(["check", "sound", *PER_CAMERA, "map"])
    assert bench.results() == {}
    assert bench.executed() == sorted([*CLOCKED, *REGISTERED])


@pytest.mark.parametrize("stage", ["export", "report"])
def test_until_a_stage_before_the_last_no_result_is_touched(done: Bench, stage: str) -> None:
    before = done.results()
    options = {"map": {"features": 1024}}
    summary = run_job(done.job(**options), out_dir=done.out, settings=settings(done, until=stage))
    assert (summary.files, summary.stages[-1].stage) == ((), stage)
    assert done.results() == before
    done.run(**options)
    assert done.results() != before


def test_why_a_finished_job_would_do_nothing(done: Bench) -> None:
    assert steps(done) == dict.fromkeys(ALL, "")


@pytest.mark.parametrize(
    ("changes", "stage", "reason", "later"),
    [
        (
            {"map": {"features": 1024}},
            "map",
            "features: 512 -> 1024",
            ["registration", "merge", "fill", "export", "report", "preview"],
        ),
        ({"height_m": 1.8}, "check", "the body: height_m changed", None),
        ({"export": {"units": "m"}}, "export", 'units: "cm" -> "m"', ["report"]),
        (
            {"torso": {"offset_s": 0.1}},
            "check",
            "the clock of torso",
            None,
        ),
    ],
)
def test_why_names_the_change_and_what_follows(
    done: Bench, changes: dict[str, Any], stage: str, reason: str, later: list[str] | None
) -> None:
    found = steps(done, **changes)
    assert reason in found[stage]
    if later is not None:
        assert [name for name, why in found.items() if why.startswith("after ")] == later
    assert done.executed() == [], "asking computes nothing"


@pytest.mark.parametrize(
    ("before", "now", "expected"),
    [
        (
            {"body": {"height_m": 1.7, "mounts": []}},
            {"body": None},
            "the body was used before, but is not used now",
        ),
        (
            {"body": None},
            {"body": {"height_m": 1.7, "mounts": []}},
            "the body is used now, but was not used before",
        ),
        ({"merge": None}, {"merge": "a"}, "the motion is used now, but was not used before"),
        ({"body": {"height_m": 1.7}}, {"body": {"height_m": 1.8}}, "the body: height_m changed"),
        ({"map": "a"}, {"map": "b"}, "the map changed"),
        ({"previous": "a"}, {"previous": "b"}, "the result of the previous round changed"),
        ({"keyframes": {"torso": "a"}}, {"keyframes": {"torso": "b"}}, "the keyframes of torso changed"),
        ({"keyframes": {}}, {"keyframes": {"torso": "b"}}, "the keyframes of torso changed"),
    ],
)
def test_why_describes_a_changed_input(
    tmp_path: Path, before: dict[str, Any], now: dict[str, Any], expected: str
) -> None:
    store = Store(tmp_path)
    keys = [
        ArtefactKey(stage="export", algorithm="1", options={}, inputs=inputs, libraries={})
        for inputs in (before, now)
    ]
    with store.draft(keys[0]) as draft:
        store.commit(draft, keys[0], {})
    assert _reason(Task(key=keys[1]), store) == expected


@pytest.mark.parametrize("threads", [1, 2])
def test_why_lists_the_sound_that_runs_beside_the_keyframes(done: Bench, threads: int) -> None:
    shutil.rmtree(done.folder / "store" / "artefacts" / "sound")
    found = steps(done, threads=threads, map={"features": 1024})
    assert found["keyframes torso"] == ""
    assert found["map"] == "features: 512 -> 1024"
    assert found["sound"] == "this stage has not been computed before"
    assert found["registration"] == "after map"
    assert not (done.folder / "store" / "artefacts" / "sound").exists(), "asking computes nothing"


def test_the_sound_runs_beside_the_keyframes() -> None:
    assert _position("sound") == _position("keyframes") < _position("map")
    assert _position("recover") == _position("registration")


def test_why_lists_the_preview_that_runs_beside_the_export(done: Bench) -> None:
    shutil.rmtree(done.folder / "store" / "artefacts" / "preview")
    assert steps(done)["preview"] == "this stage has not been computed before"
    found = steps(done, export={"units": "m"})
    assert [name for name, why in found.items() if why] == ["export", "preview", "report"]
    assert not (done.folder / "store" / "artefacts" / "preview").exists(), "asking computes nothing"


def test_why_of_a_job_never_run_and_of_a_damaged_artefact(bench: Bench) -> None:
    assert steps(bench) == {
        "check": "this stage has not been computed before",
        **dict.fromkeys(
            ("keyframes", "map", "registration", "merge", "fill", "export", "preview", "report"),
            "after check",
        ),
    }
    bench.run()
    victim = next((bench.folder / "store" / "artefacts" / "merge").glob("*/made_of.txt"))
    victim.write_text("something else")
    assert steps(bench)["merge"] == "the stored result of this stage was damaged"


def test_why_says_that_the_program_has_changed(done: Bench) -> None:
    path = next((done.folder / "store" / "artefacts" / "keyframes").glob("*"))
    manifest = json.loads((path / "manifest.json").read_text())
    manifest["key"]["algorithm"] = manifest["key"]["libraries"]["numpy"] = "1"
    for other in path.parent.iterdir():
        shutil.rmtree(other)
    other = path.with_name("0" * 32)
    other.mkdir()
    (other / "manifest.json").write_text(json.dumps(manifest))
    reasons = [why for name, why in steps(done).items() if name.startswith("keyframes")]
    assert len(reasons) == 2
    assert all("the program has changed" in why and 'numpy "1" -> "' in why for why in reasons)


@pytest.fixture
def alone(done: Bench) -> Bench:
    """The job has been run, and no other job refers to its store."""
    shutil.rmtree(done.folder / "store" / "references")
    done.run()
    return done


def test_garbage_is_what_no_finished_job_used(alone: Bench) -> None:
    kept = artefacts(alone)
    alone.run(map={"features": 1024})
    store = Store(alone.folder / "store")
    dry = collect_garbage(store, delete=False)
    assert {name.split("/")[1] for name in dry.artefacts} == {
        "map",
        "registration",
        "clocks",
        "links",
        "merge",
        "fill",
        "export",
        "preview",
        "report",
    }
    assert dry.freed_bytes > 0
    assert artefacts(alone) > kept, "a dry run removes nothing"
    assert collect_garbage(store, delete=True) == dry
    assert alone.executed(map={"features": 1024}) == []
    assert "map" in alone.executed()


def test_what_an_unfinished_job_has_done_is_no_garbage(bench: Bench) -> None:
    bench.order(fail="map")
    with pytest.raises(Exception, match="does not work out"):
        bench.run()
    assert collect_garbage(Store(bench.folder / "store"), delete=True).artefacts == ()
    bench.order()
    assert "keyframes torso" not in bench.executed()


def test_what_a_task_has_stored_when_it_is_stopped_is_no_garbage(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Runner.run

    def stopped_after_the_map(self: Runner, task: Task, *rest: Any) -> Any:
        out = run(self, task, *rest)
        if task.key.stage == "map":
            raise Cancelled("stopped on request")
        return out

    monkeypatch.setattr(Runner, "run", stopped_after_the_map)
    with pytest.raises(Cancelled):
        bench.run()
    assert collect_garbage(Store(bench.folder / "store"), delete=True).artefacts == ()
    monkeypatch.undo()
    assert "map" not in bench.executed()


def test_a_removed_folder_of_results_claims_nothing(alone: Bench) -> None:
    shutil.rmtree(alone.out)
    garbage = collect_garbage(Store(alone.folder / "store"), delete=True)
    assert (garbage.kept, len(garbage.gone)) == (0, 1)
    assert artefacts(alone) == set()


def test_no_garbage_is_collected_under_a_running_job(done: Bench) -> None:
    store = Store(done.folder / "store")
    with in_use(store), pytest.raises(StoreError, match="a job that uses this store is running"):
        collect_garbage(store, delete=True)


def space(free: int) -> Callable[[object], SimpleNamespace]:
    return lambda path: SimpleNamespace(total=10**9, used=10**9 - free, free=free)


def test_a_stored_check_does_not_answer_for_the_disk(done: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", space(20_000_000))
    assert done.executed() == [], "what is finished needs no room"
    with pytest.raises(StoreError, match="20 MB of free space, but the job needs about") as caught:
        done.run(map={"features": 1024})
    assert caught.value.hint
    monkeypatch.setattr(shutil, "disk_usage", space(10**9))
    assert "map" in done.executed(map={"features": 1024})


def test_results_on_another_disk_are_copied(done: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(source: object, target: object) -> None:
        raise OSError(18, "Invalid cross-device link")

    before = done.results()
    shutil.rmtree(done.out)
    monkeypatch.setattr(os, "link", refuse)
    assert done.executed() == []
    assert done.results() == before
    assert (done.out / "metrics.json").stat().st_nlink == 1


def test_results_are_hard_links(done: Bench) -> None:
    shutil.rmtree(done.out)
    done.run()
    assert (done.out / "metrics.json").stat().st_nlink == 2


def test_damage_that_the_file_system_does_not_tell_is_found_when_the_artefact_is_read(done: Bench) -> None:
    """A failing disk changes bytes and no time; here the remembered digest is made to lie."""
    before = done.results()
    victim = next((done.folder / "store" / "artefacts" / "map").glob("*/made_of.txt"))
    manifest = json.loads(victim.with_name("manifest.json").read_text())
    victim.write_text(victim.read_text() + " " * (2 << 20))
    os.utime(victim, (1e9, 1e9))
    store = Store(done.folder / "store")
    stat = victim.stat()
    identity = (stat.st_dev, stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns)
    name = hashlib.sha256(json.dumps(identity).encode()).hexdigest()
    (store.root / "digests").mkdir(exist_ok=True)
    (store.root / "digests" / name).write_bytes(_entry_text(name, manifest["files"]["made_of.txt"]))
    assert done.executed() == [], "looked up, it seems sound"
    with pytest.raises(StoreError, match="damaged") as caught:
        done.run(merge={"max_gap_s": 0.5})
    assert caught.value.hint
    assert "map" in done.executed(merge={"max_gap_s": 0.5})
    assert done.executed() == []
    assert done.results() == before


def test_no_store_no_garbage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from bodycap_batch.cli import main

    assert main(["gc", str(tmp_path)]) == 5
    assert "there is no store in this folder" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_what_a_folder_is_made_from_is_kept_while_it_is_moved(tmp_path: Path) -> None:
    """At each moment, and also if the process that moves it is killed there."""
    store = Store(tmp_path / "store")
    key = ArtefactKey(stage="map", algorithm="1", options={}, inputs={}, libraries={})
    with store.draft(key) as draft:
        (draft.files / "a.txt").write_text("long work")
        made = store.commit(draft, key, {})
    here, there, taken = tmp_path / "running", tmp_path / "done", tmp_path / "taken"
    here.mkdir()
    References(store, here).add(made.path)

    def unused() -> tuple[str, ...]:
        return collect_garbage(Store(tmp_path / "store"), delete=False).artefacts

    moves = moving(store, here)
    keep_for = moves.__enter__()
    with pytest.raises(StoreError, match="a job that uses this store is running"):
        unused()
    keep_for(taken)  # a name that somebody else takes first
    keep_for(there)
    moves.gen.close()  # type: ignore[attr-defined] - killed before the move
    assert unused() == ()
    here.rename(there)  # or killed just after it
    assert unused() == ()
    with moving(store, there) as keep_for:
        keep_for(here)
        there.rename(here)
    assert unused() == ()
    here.rmdir()
    assert len(unused()) == 1
    assert len(collect_garbage(store, delete=True).gone) == 2
    assert list((store.root / "references").iterdir()) == []
