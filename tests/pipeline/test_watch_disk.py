"""A watched folder with a failing disk: the watcher waits, reports it once, and loses nothing."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from bodycap_batch.cli import main
from bodycap_batch.core.errors import DiskAway, StoreError
from bodycap_batch.core.progress import Event
from bodycap_batch.store.artefacts import Store
from bodycap_batch.watch import Watcher, active_watcher, inbox_claim, job_rows, job_worker
from bodycap_batch.watch.job_status import JobStatusFile, read_status
from bodycap_batch.watch.job_worker import JobWorker
from bodycap_batch.watch.spool import JobDir
from bodycap_batch.watch.watcher import AccessFailures
from bodycap_batch.watch.watcher_status import WatcherStatusFile
from tests.pipeline.spools import SpoolFixture, wait_for


@contextmanager
def running(watcher: Watcher) -> Iterator[Watcher]:
    thread = threading.Thread(target=watcher.run)
    thread.start()
    try:
        yield watcher
    finally:
        watcher.stop()
        thread.join(60)
    assert not thread.is_alive()


def failing(times: int, function: Callable[..., Any], number: int = errno.EIO) -> Callable[..., Any]:
    """Return the function, which raises a disk error for the first `times` calls."""
    left = [times]

    def fail(*arguments: Any, **values: Any) -> Any:
        if left[0] > 0:
            left[0] -= 1
            raise OSError(number, os.strerror(number), "inbox")
        return function(*arguments, **values)

    return fail


@pytest.mark.slow
@pytest.mark.parametrize("name", ["entries_in", "visible_entries", "ignored_paths_in"])
def test_the_watcher_waits_for_a_folder_that_cannot_be_read(
    bench: SpoolFixture, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """`visible_entries` lists the running jobs, `entries_in` and `ignored_paths_in` list the inbox."""
    from bodycap_batch.watch import watcher as module

    bench.drop("walk")
    watcher = bench.watcher()
    monkeypatch.setattr(module, name, failing(2, getattr(module, name)))
    assert watcher.run() == 0, bench.lines
    assert bench.status("walk")["state"] == "done"
    failures = [line for line in bench.lines if "Input/output error" in line]
    assert len(failures) == 1, "reported once"
    assert any("is accessible again" in line for line in bench.lines)


def test_the_watcher_waits_for_a_missing_inbox_and_does_not_create_it(bench: SpoolFixture) -> None:
    away = bench.folder / "unmounted"
    with running(bench.watcher(once=False)) as watcher:
        bench.spool.inbox.rename(away)
        wait_for(lambda: "the inbox no longer exists" in watcher.access_failures.text)
        assert not bench.spool.inbox.exists()
        away.rename(bench.spool.inbox)
        bench.drop("walk")
        wait_for((bench.spool.done / "walk").is_dir)
    assert watcher.access_failures.text == ""
    assert sum("the inbox no longer exists" in line for line in bench.lines) == 1


def test_a_watcher_with_once_does_not_wait_for_ever(bench: SpoolFixture) -> None:
    watcher = bench.watcher(retry_s=1.0)
    bench.spool.inbox.rmdir()
    assert watcher.run() == StoreError.exit_code
    assert any("the inbox no longer exists" in line for line in bench.lines)


def test_each_cause_is_reported_once(bench: SpoolFixture) -> None:
    now = [0.0]
    failures = AccessFailures(bench.spool, bench.lines.append, lambda: now[0])
    for _ in range(9):
        failures.record(OSError(errno.EIO, "x", "a"))
    failures.record(OSError(errno.EACCES, "x", "a"))
    now[0] = 90.0
    failures.clear()
    failures.clear()
    assert len(bench.lines) == 3
    assert "after 90 s" in bench.lines[-1]
    failures.record(OSError(errno.EIO, "x", "a"))
    assert len(bench.lines) == 4


def test_a_failure_that_ends_while_it_is_read_does_no_harm(bench: SpoolFixture) -> None:
    failures = AccessFailures(bench.spool, bench.lines.append)
    failures.record(OSError(errno.EIO, "x", "a"))

    class EndsWhenRead(AccessFailures):
        """The disk answers again as soon as the failure has been read."""

        @property
        def current(self) -> StoreError | None:
            found, failures.current = failures.current, None
            return found

        @current.setter
        def current(self, _: StoreError | None) -> None: ...

    assert EndsWhenRead(bench.spool, bench.lines.append).text == "a: Input/output error"


def test_a_stop_at_any_moment_ends_the_wait(bench: SpoolFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    watcher = bench.watcher(once=False)
    woken, clear = watcher._woken, watcher._woken.clear
    overslept: list[bool] = []

    def stop_then_clear() -> None:
        watcher.stop()
        clear()

    monkeypatch.setattr(woken, "clear", stop_then_clear)
    monkeypatch.setattr(
        woken, "wait", lambda _: overslept.append(watcher._stop.is_set() and not woken.is_set())
    )
    watcher.run()
    assert overslept == [False]


def test_a_full_disk_while_the_store_is_cleaned_stops_no_watcher(
    bench: SpoolFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A user runs `gc` on a full disk while a finished job waits to be filed."""
    job_dir = JobDir(bench.spool.running / "walk")
    job_dir.path.mkdir()
    bench.drop("walk").rename(job_dir.input)
    JobStatusFile(job_dir).update(state="done")
    worker = JobWorker(bench.spool, bench.options(), threading.Event())
    monkeypatch.setattr(job_worker, "moving", failing(1, job_worker.moving, errno.ENOSPC))
    with (bench.spool.root / ".store" / "in-use").open("w") as cleaning:
        fcntl.flock(cleaning, fcntl.LOCK_EX)
        outcome = worker.process(job_dir)
        assert (outcome.state, outcome.exit_code) == ("stuck", StoreError.exit_code)
        assert worker.process(job_dir).state == "stopped"
    assert worker.process(job_dir).path == bench.spool.done / "walk"


def test_a_job_that_ends_while_the_store_is_cleaned_is_filed_later(bench: SpoolFixture) -> None:
    (bench.spool.inbox / "walk.yaml").write_text("capture: {}")
    entry = inbox_claim.InboxEntry(bench.spool.inbox / "walk.yaml")
    claimed = inbox_claim.claim_entry(
        bench.spool, entry, inbox_claim.take_snapshot(entry, 100), bench.options().permissions
    )
    assert claimed is not None
    worker = JobWorker(bench.spool, bench.options(), threading.Event())
    with (bench.spool.root / ".store" / "in-use").open("w") as cleaning:
        fcntl.flock(cleaning, fcntl.LOCK_EX)
        outcome = worker.process(claimed)
    assert (outcome.state, outcome.message) == (
        "stopped",
        "the job continues later: `bodycap gc` is removing artefacts from the store",
    )
    before = bench.status("walk")
    assert bench.run_once() == 2
    assert bench.job("walk").path == bench.spool.failed / "walk"
    assert bench.status("walk") == before, "the final status was written before"
    assert bench.status("walk")["error"]["path"] == str(bench.job("walk").input / "walk.yaml")


@pytest.mark.slow
@pytest.mark.parametrize("how", ["in the watcher", "in a stage"])
def test_a_job_with_a_missing_disk_continues_later(
    bench: SpoolFixture, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    bench.drop("walk")
    error = DiskAway("Stale file handle", path="videos") if how == "in a stage" else None
    run_job, left = job_worker.run_job, [1]

    def fail(*arguments: Any, **values: Any) -> Any:
        if left.pop() if left else 0:
            raise error or OSError(errno.ESTALE, os.strerror(errno.ESTALE), "videos")
        return run_job(*arguments, **values)

    monkeypatch.setattr(job_worker, "run_job", fail)
    with running(bench.watcher(once=False, retry_s=1.0)):
        wait_for((bench.spool.done / "walk").is_dir)
    (line,) = [line for line in bench.lines if line.startswith("walk: stuck")]
    assert "Stale file handle" in line
    assert "postponed" in bench.job("walk").log.read_text()
    assert bench.status("walk")["attempts"] == 2


def test_a_job_with_repeated_disk_failures_fails(
    bench: SpoolFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise DiskAway("Input/output error", path="videos", hint="is the disk mounted?")

    monkeypatch.setattr("bodycap_batch.watch.job_worker.run_job", fail)
    worker = JobWorker(bench.spool, bench.options(), threading.Event())
    snapshot = inbox_claim.take_snapshot(entry := inbox_claim.InboxEntry(bench.drop("walk")), 100)
    job_dir = inbox_claim.claim_entry(bench.spool, entry, snapshot, bench.options().permissions)
    assert job_dir is not None
    states = []
    while not states or states[-1] == "stuck":
        states.append(worker.process(job_dir).state)
    assert states == ["stuck"] * 5 + ["failed"]
    assert bench.status("walk")["error"]["message"] == "Input/output error"


@pytest.mark.parametrize("away", [True, False])
def test_a_job_waits_for_missing_videos_without_a_limit(
    bench: SpoolFixture, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], away: bool
) -> None:
    """If the disk answers, a failure counts, unless the job has finished a stage since the last one."""
    footage = bench.folder / "footage"
    footage.mkdir()
    listdir = os.listdir

    def look(path: Any) -> list[str]:
        if away and Path(path) == footage:
            raise OSError(errno.ESTALE, os.strerror(errno.ESTALE), str(path))
        return listdir(path)

    def fail(*_: Any, settings: Any, **__: Any) -> None:
        if not away:
            settings.listener(Event(kind="finished", stage="keyframes"))
        raise DiskAway("Stale file handle", path=footage / "torso.mp4", hint="is the disk mounted?")

    monkeypatch.setattr("bodycap_batch.watch.job_worker.os.listdir", look)
    monkeypatch.setattr("bodycap_batch.watch.job_worker.run_job", fail)
    worker = JobWorker(bench.spool, bench.options(), threading.Event())
    snapshot = inbox_claim.take_snapshot(entry := inbox_claim.InboxEntry(bench.drop("walk")), 100)
    job_dir = inbox_claim.claim_entry(bench.spool, entry, snapshot, bench.options().permissions)
    assert job_dir is not None
    for _ in range(20):
        assert worker.process(job_dir).state == "stuck"
    assert main(["status"]) == 0
    assert f"continues later: {footage / 'torso.mp4'}: Stale file handle" in capfd.readouterr().out
    job_dir.cancel.touch()
    assert worker.process(job_dir).path == bench.spool.failed / "walk"
    assert bench.status("walk")["state"] == "cancelled"


@pytest.mark.slow
def test_a_repeated_disk_failure_is_reported_once(
    bench: SpoolFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.drop("walk")
    monkeypatch.setattr(job_worker, "run_job", failing(2, job_worker.run_job, errno.ESTALE))
    with running(bench.watcher(once=False, retry_s=0.2)):
        wait_for((bench.spool.done / "walk").is_dir)
    assert sum("Stale file handle" in line for line in bench.lines) == 1
    assert bench.lines.count("walk: started") == 1


def test_videos_are_never_removed_because_the_disk_did_not_answer(
    bench: SpoolFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_dir = JobDir(bench.spool.running / "walk")
    job_dir.path.mkdir()
    bench.drop("walk").rename(job_dir.input)
    monkeypatch.setattr(Path, "lstat", failing(1, Path.lstat))
    with pytest.raises(OSError, match="Input/output"):
        inbox_claim.return_to_inbox(bench.spool, job_dir)
    assert (job_dir.input / "torso.mp4").is_file()
    assert inbox_claim.return_to_inbox(bench.spool, job_dir) == bench.spool.inbox / "walk"


def test_paths_left_in_the_inbox_are_reported_when_a_watcher_ends(bench: SpoolFixture) -> None:
    (bench.spool.inbox / "empty").mkdir()
    (bench.drop("copied", ready=False) / "head.mp4.part").touch()
    (bench.spool.inbox / "torso.mp4").touch()
    bench.drop("walk")
    assert bench.run_once(unchanged_s=0.5) == 0
    assert bench.status("walk")["state"] == "done"
    left = dict(line.split(" stays in the inbox: ") for line in bench.lines if "stays in the inbox" in line)
    assert left == {
        "empty": "the folder is empty (it is processed after 30 minutes without a change)",
        "copied": "head.mp4.part is not complete: the video head.mp4 itself is not there yet "
        "(it is processed after 30 minutes without a change)",
        "torso.mp4": "this is not a job, because it is neither a folder nor a YAML file",
    }
    assert (bench.spool.inbox / "copied" / "head.mp4.part").exists()


def test_an_unreadable_entry_is_reported_and_delays_no_other(
    bench: SpoolFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.drop("locked")
    bench.drop("walk")
    scandir = os.scandir

    def refuse(path: Any) -> Any:
        if str(path).endswith("locked"):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", refuse)
    assert bench.run_once() == StoreError.exit_code
    assert bench.status("walk")["state"] == "done"
    assert "locked: cannot be read: Permission denied" in bench.lines
    assert "locked stays in the inbox: Permission denied" in bench.lines


@pytest.mark.parametrize(
    "text",
    [
        "{",
        '{"attempts": "many", "notes": 3, "error": "x", "active": 1, "dropped": 5, "progress": "a"}',
    ],
)
def test_a_damaged_status_file_does_no_harm(bench: SpoolFixture, text: str) -> None:
    bench.drop("walk")
    bench.run_once()
    job = bench.job("walk")
    job.status.write_text(text)
    assert [row.name for row in job_rows(bench.spool)] == ["walk"]
    job.path.rename(bench.spool.running / "walk")
    assert [row.name for row in job_rows(bench.spool)] == ["walk"]
    assert bench.run_once() == 0
    assert json.loads(bench.job("walk").status.read_text())["attempts"] in (1, 2)
    assert read_status(bench.job("walk"))["state"] == "done"
    assert Store(bench.spool.root / ".store").root.is_dir()


def test_watchers_and_their_failures_are_listed_with_the_jobs(
    bench: SpoolFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    def reported() -> list[str]:
        capfd.readouterr()
        assert main(["status"]) == 0
        return [line for line in capfd.readouterr().out.splitlines() if "watche" in line]

    bench.drop("walk", ready=False)
    assert reported() == [
        f"no watcher runs for this folder; start a watcher with: bodycap watch {bench.spool.inbox}"
    ]
    with running(bench.watcher(once=False, unchanged_s=1000.0, retry_s=1.0)):
        wait_for(lambda: any(f"(process {os.getpid()}) since" in line for line in reported()))
        assert len(reported()) == 1
        assert main(["status", "--json"]) == 0
        (watching,) = json.loads(capfd.readouterr().out)["watchers"]
        assert (watching["pid"], watching["trouble"]) == (os.getpid(), "")
        away = bench.spool.inbox.rename(bench.folder / "unmounted")
        wait_for(
            lambda: any(
                "cannot continue" in line and "the inbox no longer exists" in line for line in reported()
            )
        )
        away.rename(bench.spool.inbox)
        wait_for(lambda: not any("cannot continue" in line for line in reported()))
    assert reported() == [
        f"no watcher runs for this folder; start a watcher with: bodycap watch {bench.spool.inbox}"
    ]
    assert list(bench.spool.running.iterdir()) == []


def test_a_killed_watcher_is_not_listed(bench: SpoolFixture) -> None:
    status_file = WatcherStatusFile(bench.spool)
    status_file.write("")
    found = active_watcher(bench.spool)
    assert found is not None
    assert found.pid == os.getpid()
    status_file._lock.close()  # as the system does at the end of a process
    assert (bench.spool.root / ".watcher.json").exists()
    assert active_watcher(bench.spool) is None


def test_a_look_at_the_list_of_jobs_keeps_no_watcher_out(bench: SpoolFixture) -> None:
    lock = (bench.spool.root / ".watcher.lock").open("ab")
    fcntl.flock(lock, fcntl.LOCK_SH)
    threading.Timer(0.15, lock.close).start()
    WatcherStatusFile(bench.spool).remove()
