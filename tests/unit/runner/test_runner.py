"""Tasks in child processes: results, failures, crashes, cancelling, kill -9, full disks."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from bodycap_batch.core.errors import (
    BodycapError,
    Cancelled,
    CaptureError,
    DiskAway,
    EstimationError,
    StoreError,
)
from bodycap_batch.core.progress import Event
from bodycap_batch.runner import Children, NotStored, Rules, Runner, Task, TaskEnvironment
from bodycap_batch.runner.child_main import DiskFailures
from bodycap_batch.runner.child_pool import CHILDREN_LOG, Preload
from bodycap_batch.store.artefacts import ArtefactKey, Store
from tests.processes import gone

ROOT = Path(__file__).parents[3]
FAKE = (sys.executable, str(ROOT / "tests" / "pipeline" / "fake_child.py"))


def a_task(stage: str, value: int = 1, **arguments: Any) -> Task:
    key = ArtefactKey(stage=stage, algorithm="1", options={"value": value}, inputs={}, libraries={})
    return Task(key=key, arguments={"value": value, **arguments}, camera="torso", threads=2)


class Bench:
    """A runner on an empty store that writes down what it hears."""

    def __init__(self, folder: Path) -> None:
        self.store = Store(folder / "store")
        self.logs = folder / "logs"
        self.events: list[Event] = []
        self.stop = threading.Event()
        self.children = Children(FAKE)
        self.runner = self.with_rules()

    def with_rules(self, **rules: Any) -> Runner:
        return Runner(
            self.store,
            self.children,
            logs=self.logs,
            listener=self.events.append,
            rules=Rules(cancelled=self.stop.is_set, **rules),
        )

    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(tmp_path)
    with bench.runner:
        yield bench


def wait_for(condition: Callable[[], bool], seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never happened"
        time.sleep(0.02)


def test_the_task_file_of_another_run_does_no_harm(bench: Bench) -> None:
    task = a_task("work")
    bench.logs.mkdir()
    # What is written to this file is lost, as if another run had overwritten it at once.
    (bench.logs / f"{task.file_stem}.task.json").symlink_to(os.devnull)
    assert bench.runner.run(task)[1]


def test_two_runs_of_a_job_remove_their_empty_log(tmp_path: Path) -> None:
    children = Children(FAKE)

    def run() -> None:
        for _ in range(2000):
            (tmp_path / CHILDREN_LOG).touch()
            children.close(tmp_path)

    with ThreadPoolExecutor(2) as pool:
        runs = [pool.submit(run) for _ in range(2)]
    assert [error for each in runs if (error := each.exception())] == []


def test_a_task_makes_its_artefact_once(bench: Bench) -> None:
    made, executed = bench.runner.run(a_task("work", say="hello"))
    assert executed
    assert (made.path / "result.txt").read_text() == "1 hello"
    again, executed = bench.runner.run(a_task("work", say="something else"))
    assert not executed
    assert again == made
    assert bench.kinds()[0] == "started"
    assert bench.kinds()[-2:] == ["finished", "reused"]


def test_the_libraries_own_pools_are_off_before_they_load(bench: Bench) -> None:
    made, _ = bench.runner.run(a_task("work"))
    threads, omp, *_ = (made.path / "process.txt").read_text().split()
    assert (threads, omp) == ("2", "1")


def pid_of(bench: Bench, stage: str, value: int = 1) -> int:
    made, _ = bench.runner.run(a_task(stage, value))
    return int((made.path / "process.txt").read_text().split()[2])


def test_a_child_does_one_task_after_another_and_ends_with_its_runner(bench: Bench) -> None:
    first = pid_of(bench, "work", 1)
    assert pid_of(bench, "work", 2) == first
    with pytest.raises(EstimationError):
        bench.runner.run(a_task("refuse"))
    assert pid_of(bench, "work", 3) == first
    assert not gone(first)
    bench.runner.close()
    assert gone(first)
    assert not (bench.logs / "children.log").exists(), "it had nothing to say"


@pytest.mark.parametrize("stage", ["bug", "crash"])
def test_a_child_that_failed_unexpectedly_is_not_used_again(bench: Bench, stage: str) -> None:
    first = pid_of(bench, "work", 1)
    with pytest.raises(BodycapError):
        bench.runner.run(a_task(stage))
    assert gone(first)
    assert pid_of(bench, "work", 2) != first


def test_idle_children_that_died_are_replaced_silently(bench: Bench) -> None:
    bench.children.prepare(bench.logs, [["wave"]])
    first = pid_of(bench, "work", 1)  # the one that waits
    bench.children.prepare(bench.logs, [["wave"], ["colorsys"]])  # it, and another
    waiting = [child._process.pid for child in bench.children._idle]
    assert len(waiting) == 2
    assert first in waiting
    for pid in waiting:
        os.kill(pid, signal.SIGKILL)
        wait_for(lambda pid=pid: gone(pid))  # type: ignore[misc]
    assert pid_of(bench, "work", 2) not in waiting
    assert set(bench.kinds()) == {"started", "progress", "finished"}


def test_a_child_ends_with_its_task_if_the_listener_fails(bench: Bench) -> None:
    first = pid_of(bench, "work", 1)

    def tell(event: Event) -> None:
        if event.kind == "progress":
            raise OSError("the pipe is closed")

    rules = Rules(cancelled=bench.stop.is_set)
    runner = Runner(bench.store, bench.children, logs=bench.logs, listener=tell, rules=rules)
    with pytest.raises(OSError, match="pipe"):
        runner.run(a_task("work", 2))
    assert gone(first)
    assert pid_of(bench, "work", 3) != first


def test_each_task_has_a_log_of_its_own_though_they_share_a_child(bench: Bench) -> None:
    bench.runner.run(a_task("noisy", 1))
    bench.runner.run(a_task("work", 2))
    assert "a native library prints" in (bench.logs / "noisy_torso.log").read_text()
    assert (bench.logs / "work_torso.log").read_text() == ""


def test_libraries_load_ahead_in_the_child_that_will_need_them(bench: Bench) -> None:
    bench.children.prepare(bench.logs, [["wave"], ["colorsys"]])
    made, _ = bench.runner.run(replace(a_task("work"), modules=("colorsys",)))
    loaded = (made.path / "process.txt").read_text().split()[3:]
    assert loaded == ["colorsys"]


@pytest.mark.parametrize(("step", "children"), [("", 2), ("steps", 2), ("no such step", 1)])
def test_idle_children_begin_to_load_at_a_step_of_the_task(bench: Bench, step: str, children: int) -> None:
    calls: list[str] = []
    bench.runner.run(a_task("work"), Preload(modules=[["wave"]], step=step, then=lambda: calls.append(step)))
    assert len(bench.children._idle) == children
    assert calls == [step][: children - 1], "the step has several reports"
    made, _ = bench.runner.run(replace(a_task("work", 2), modules=("wave",)))
    assert (made.path / "process.txt").read_text().split()[3:] == ["wave"][: children - 1]


def test_a_child_that_starts_ahead_runs_the_first_task(bench: Bench) -> None:
    bench.children.start_ahead(["wave"])
    (ahead,) = bench.children._idle
    made, _ = bench.runner.run(a_task("work"))
    process = (made.path / "process.txt").read_text().split()
    assert process[2:] == [str(ahead._process.pid), "wave"]
    bench.runner.close()
    assert gone(ahead._process.pid)


def test_a_child_that_starts_ahead_and_dies_is_replaced(bench: Bench) -> None:
    bench.children.start_ahead(["no_such_module_anywhere"])
    (ahead,) = bench.children._idle
    os.kill(ahead._process.pid, signal.SIGKILL)
    wait_for(lambda: gone(ahead._process.pid))
    assert pid_of(bench, "work") != ahead._process.pid
    assert not bench.logs.joinpath(CHILDREN_LOG).read_text(), "what it printed is not kept"


def test_modules_that_cannot_be_loaded_ahead_are_left_to_the_stage(bench: Bench) -> None:
    bench.children.prepare(bench.logs, [["no_such_module_anywhere"]])
    assert bench.runner.run(a_task("work"))[1]
    assert "no_such_module_anywhere" in (bench.logs / "children.log").read_text()


def test_progress_arrives_with_stage_and_camera(bench: Bench) -> None:
    bench.runner.run(a_task("work"))
    progress = [event for event in bench.events if event.kind == "progress"]
    assert (progress[-1].done, progress[-1].total, progress[-1].what) == (3, 3, "steps")
    assert {(event.stage, event.camera) for event in bench.events} == {("work", "torso")}


def test_cost_is_recorded_outside_the_content(bench: Bench) -> None:
    made, _ = bench.runner.run(a_task("work"))
    assert made.made["peak_memory_mb"] > 1
    assert made.made["seconds"] >= 0
    assert made.made["cpu_seconds"] > 0
    assert "manifest.json" not in made.files


def test_prints_of_libraries_go_to_the_log(bench: Bench) -> None:
    bench.runner.run(a_task("noisy"))
    log = (bench.logs / "noisy_torso.log").read_text()
    for line in ("a native library prints", "so does Python", "and this is a log line"):
        assert line in log


def test_a_typed_error_reaches_the_parent_completely(bench: Bench) -> None:
    with pytest.raises(EstimationError) as caught:
        bench.runner.run(a_task("refuse"))
    error = caught.value
    assert (error.message, error.path, error.hint) == ("only 3 of 50 frames", "video.mp4", "film more")
    assert bench.kinds()[-1] == "failed"
    assert bench.store.find(a_task("refuse").key) is None


def test_a_bug_is_reported_with_its_stage_and_traceback(bench: Bench) -> None:
    with pytest.raises(BodycapError, match="bug torso: KeyError") as caught:
        bench.runner.run(a_task("bug"))
    assert caught.value.exit_code == 70
    assert "bug_torso.log" in str(caught.value.hint)
    assert 'File "' in "".join(caught.value.__notes__)
    assert "Traceback" in (bench.logs / "bug_torso.log").read_text()


def test_a_native_crash_is_reported_with_its_signal_and_log(bench: Bench) -> None:
    with pytest.raises(BodycapError, match="SIGSEGV") as caught:
        bench.runner.run(a_task("crash"))
    assert caught.value.exit_code == 70
    assert str(caught.value.path).endswith("crash_torso.log")
    assert bench.runner.run(a_task("work"))[1]


@pytest.mark.parametrize("stage", ["hang", "polite"])
def test_cancelling_stops_the_child_and_cleans_up(bench: Bench, tmp_path: Path, stage: str) -> None:
    started = tmp_path / "started"
    failures: list[BaseException] = []

    def run() -> None:
        try:
            bench.runner.run(a_task(stage, started=str(started)))
        except Cancelled as error:
            failures.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    wait_for(lambda: started.exists() and " " in started.read_text())
    bench.stop.set()
    thread.join(20)
    pid, work = started.read_text().split(" ", 1)
    assert len(failures) == 1
    assert gone(int(pid))
    assert not Path(work).exists()
    assert bench.kinds()[-1] == "stopped"


def test_a_child_killed_with_sigkill_is_reported_and_its_task_can_run_again(
    bench: Bench, tmp_path: Path
) -> None:
    started = tmp_path / "started"
    failures: list[BaseException] = []

    def run() -> None:
        try:
            bench.runner.run(a_task("hang", started=str(started)))
        except BodycapError as error:
            failures.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    wait_for(lambda: started.exists() and " " in started.read_text())
    pid, work = started.read_text().split(" ", 1)
    os.kill(int(pid), signal.SIGKILL)
    thread.join(20)
    assert "SIGKILL" in str(failures[0])
    assert bench.store.find(a_task("hang").key) is None
    assert not Path(work).exists()
    assert bench.runner.run(a_task("work"))[1]


def test_children_do_not_outlive_a_killed_parent(tmp_path: Path) -> None:
    started = tmp_path / "started"
    script = textwrap.dedent(f"""
        from pathlib import Path
        from tests.unit.runner.test_runner import Bench, a_task
        Bench(Path({str(tmp_path)!r})).runner.run(a_task("hang", started={str(started)!r}))
    """)
    parent = subprocess.Popen([sys.executable, "-c", script], cwd=ROOT)
    wait_for(lambda: started.exists() and " " in started.read_text())
    child = int(started.read_text().split()[0])
    assert not gone(child)
    parent.kill()
    parent.wait()
    wait_for(lambda: gone(child))


def test_missing_artefacts_are_not_computed_if_that_is_forbidden(bench: Bench) -> None:
    bench.runner.run(a_task("work", 1))
    looking = bench.with_rules(compute=False)
    assert not looking.run(a_task("work", 1))[1]
    with pytest.raises(NotStored, match="have not been computed yet: work torso") as caught:
        looking.run(a_task("work", 2))
    assert caught.value.tasks == (a_task("work", 2),)
    assert "bodycap why" in str(caught.value.hint)


def test_a_stage_that_is_computed_again_replaces_the_stored_artefact(bench: Bench) -> None:
    before, _ = bench.runner.run(a_task("work", say="first"))
    again = bench.with_rules(redo=frozenset({"work"}))
    after, executed = again.run(a_task("work", say="second"))
    assert executed
    assert after.path == before.path
    assert (after.path / "result.txt").read_text() == "1 second"
    assert list((bench.store.root / "tmp").iterdir()) == []


def test_a_task_may_be_forbidden_before_it_starts(bench: Bench) -> None:
    def forbid(task: Task) -> None:
        raise StoreError("no room")

    with pytest.raises(StoreError, match="no room"):
        bench.with_rules(before=forbid).run(a_task("work"))
    assert bench.events == []


_FULL_DISK = """
import sys
from pathlib import Path
from bodycap_batch.core.errors import StoreError
from tests.unit.runner.test_runner import Bench, a_task
bench = Bench(Path(sys.argv[1]))
assert bench.runner.run(a_task("work"))[1]
try:
    bench.runner.run(a_task(sys.argv[2]))
except StoreError as error:
    assert "space" in error.message and "--store" in error.hint, error
else:
    sys.exit("the disk was not full")
assert list((bench.store.root / "tmp").iterdir()) == []
assert bench.store.find(a_task(sys.argv[2]).key) is None
assert not bench.runner.run(a_task("work"))[1]
"""


@pytest.mark.parametrize("stage", ["fill", "fill_quietly", "fill_and_die"])
def test_a_full_disk_is_a_typed_error_and_loses_nothing(tmp_path: Path, stage: str) -> None:
    mount = ["unshare", "--mount", "--propagation", "private", "sh", "-c"]
    if subprocess.run([*mount, "mount -t tmpfs none /mnt"], capture_output=True, check=False).returncode:
        pytest.skip("needs the right to mount a tmpfs in a mount namespace of its own (root)")
    command = f'mount -t tmpfs -o size=24m none "$1" && exec "$2" -c "$3" "$1" {stage}'
    done = subprocess.run(
        [*mount, command, "sh", str(tmp_path), sys.executable, _FULL_DISK],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_a_removed_store_is_a_store_error(bench: Bench) -> None:
    (bench.store.root / "tmp").rmdir()
    (bench.store.root / "tmp").write_text("in the way")
    with pytest.raises(StoreError):
        bench.runner.run(a_task("work"))


@pytest.mark.parametrize(
    ("said", "asked", "away"),
    [
        (errno.ESTALE, 0, True),
        (errno.EIO, 0, False),  # FFmpeg says so of broken files, too
        (errno.EIO, errno.EIO, True),
        (0, errno.ENOTCONN, True),  # the video seemed to end early
        (0, errno.EACCES, False),
        (0, 0, False),
    ],
)
def test_a_disk_that_does_not_answer_is_reported_instead_of_its_video(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: int, asked: int, away: bool
) -> None:
    video, store = tmp_path / "torso.mp4", Store(tmp_path / "store")
    video.write_text("frames")

    def fail(path: Path, *_: Any) -> None:
        raise OSError(asked, os.strerror(asked), str(path))

    if asked:
        monkeypatch.setattr(Path, "open", fail)
    with pytest.raises(BodycapError) as caught, DiskFailures(store):
        raise CaptureError("decoding fails", path=video) from (OSError(said, "x") if said else None)
    assert isinstance(caught.value, DiskAway if away else CaptureError)
    assert caught.value.path == str(video)


def test_only_plain_files_are_read_to_find_the_cause(tmp_path: Path) -> None:
    pipe = tmp_path / "torso.mp4"
    os.mkfifo(pipe)  # opening it would wait for somebody to write
    for path in (pipe, tmp_path, tmp_path / "none"):
        with pytest.raises(CaptureError, match="no such video"), DiskFailures(Store(tmp_path / "store")):
            raise CaptureError("no such video", path=path)


class Counting:
    """Makes an artefact slowly and counts how often."""

    def __init__(self) -> None:
        self.made = 0

    def execute(self, task: Task, environment: TaskEnvironment) -> None:
        self.made += 1
        time.sleep(0.05)
        with environment.store.draft(task.key) as draft:
            (draft.files / "made_by").write_text("somebody")
            environment.store.commit(draft, task.key, {"seconds": 0.1})

    def close(self, logs: Path) -> None:
        pass


def test_jobs_wait_for_tasks_that_other_jobs_compute(tmp_path: Path) -> None:
    store, executors = Store(tmp_path / "store"), [Counting() for _ in range(3)]
    rules = Rules(cancelled=lambda: False)
    runners = [Runner(store, own, logs=tmp_path, listener=lambda _: None, rules=rules) for own in executors]
    with ThreadPoolExecutor() as pool:
        results = list(pool.map(lambda runner: runner.run(a_task("work")), runners))
    assert sum(own.made for own in executors) == 1
    assert len({artefact.path for artefact, _ in results}) == 1
