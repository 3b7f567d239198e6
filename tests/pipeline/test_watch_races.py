"""Commands on a spool while a watcher, `gc` or another user works on the same job."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from bodycap_batch.cli import main
from bodycap_batch.core.errors import JobError
from bodycap_batch.store.artefacts import Store
from bodycap_batch.store.garbage_collection import collect_garbage
from bodycap_batch.watch import cancel_job, commands, inbox_claim, retry_job
from bodycap_batch.watch.inbox_entries import InboxEntry, take_snapshot
from bodycap_batch.watch.spool import RETRY_PREFIX, JobDir
from tests.pipeline.spools import SpoolFixture, wait_for


def keeps_all_artefacts(bench: SpoolFixture) -> bool:
    """Return True if `gc --delete` removes no finished stage now."""
    return collect_garbage(Store(bench.spool.root / ".store"), delete=True).artefacts == ()


def preceded_by(function: Callable[..., Any], action: Callable[[], None]) -> Callable[..., Any]:
    """Return the function, preceded by an action."""

    def both(*arguments: Any, **values: Any) -> Any:
        action()
        return function(*arguments, **values)

    return both


@pytest.mark.slow
def test_finished_stages_of_a_retried_job_are_kept_until_it_has_run_again(bench: SpoolFixture) -> None:
    bench.order(fail="merge")
    bench.drop("walk")
    bench.run_once()
    for _ in range(2):
        retry_job(bench.spool, "walk")
        assert keeps_all_artefacts(bench)
        job_dir = cancel_job(bench.spool, "walk")  # the stages are also kept after a cancellation
        assert job_dir is not None
        assert keeps_all_artefacts(bench)
    retry_job(bench.spool, "walk")
    bench.order()
    entry = InboxEntry(bench.spool.inbox / "walk")
    assert inbox_claim.claim_entry(bench.spool, entry, take_snapshot(entry, 100), bench.options().permissions)
    assert keeps_all_artefacts(bench), "claimed, but not yet running"
    assert bench.run_once() == 0
    fresh = {
        stage["stage"].split()[0] for stage in bench.status("walk")["finished_stages"] if not stage["reused"]
    }
    assert fresh.isdisjoint({"check", "keyframes", "map", "registration"})


def test_the_store_is_not_cleaned_in_the_middle_of_a_retry(
    bench: SpoolFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.order(fail="merge")
    bench.drop("walk")
    bench.run_once()
    exit_codes = []
    store = str(bench.spool.root / ".store")
    for name in ("os.rename", "return_to_inbox"):
        *_, last = name.split(".")
        module = commands.os if name.startswith("os") else commands  # type: ignore[attr-defined]
        action = preceded_by(
            getattr(module, last), lambda: exit_codes.append(main(["gc", store, "--delete"]))
        )
        monkeypatch.setattr(module, last, action)
    retry_job(bench.spool, "walk")
    monkeypatch.undo()
    assert set(exit_codes) == {5}, "gc must wait"
    assert keeps_all_artefacts(bench)


def test_the_second_of_two_retries_is_an_error(bench: SpoolFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    (bench.spool.inbox / "walk.yaml").write_text("capture: {}")
    assert bench.run_once() == 2
    rename = commands.os.rename  # type: ignore[attr-defined]
    first: list[Path] = []

    def other() -> None:
        monkeypatch.setattr(commands.os, "rename", rename)  # type: ignore[attr-defined]
        first.append(retry_job(bench.spool, "walk"))

    monkeypatch.setattr(commands.os, "rename", preceded_by(rename, other))  # type: ignore[attr-defined]
    with pytest.raises(JobError, match="already retries job"):
        retry_job(bench.spool, "walk")
    assert first == [bench.spool.inbox / "walk.yaml"]
    assert first[0].read_text() == "capture: {}"


def test_a_watcher_finishes_a_killed_retry(bench: SpoolFixture) -> None:
    (bench.spool.inbox / "walk.yaml").write_text("capture: {}")
    assert bench.run_once() == 2
    bench.job("walk").path.rename(bench.spool.failed / f"{RETRY_PREFIX}walk")
    inbox_claim.finish_interrupted_retries(bench.spool)
    assert [path.name for path in bench.spool.inbox.iterdir()] == ["walk.yaml"]
    assert list(bench.spool.failed.iterdir()) == []


def test_a_watcher_may_finish_a_retry_that_is_still_at_work(
    bench: SpoolFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    (bench.spool.inbox / "walk.yaml").write_text("capture: {}")
    assert bench.run_once() == 2
    finish = preceded_by(
        commands.return_to_inbox, lambda: inbox_claim.finish_interrupted_retries(bench.spool)
    )
    monkeypatch.setattr(commands, "return_to_inbox", finish)
    assert retry_job(bench.spool, "walk") == bench.spool.inbox / "walk.yaml"
    assert (bench.spool.inbox / "walk.yaml").read_text() == "capture: {}"
    assert list(bench.spool.failed.iterdir()) == []


@pytest.mark.slow
def test_a_running_watcher_finishes_a_killed_retry(
    bench: SpoolFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    (bench.spool.inbox / "walk.yaml").write_text("capture: {}")
    watcher = bench.watcher(once=False)
    thread = threading.Thread(target=watcher.run)
    thread.start()
    try:
        wait_for((bench.spool.failed / "walk" / "status.json").is_file)
        (bench.spool.failed / "walk").rename(bench.spool.failed / f"{RETRY_PREFIX}walk")
        wait_for((bench.spool.failed / "walk" / "status.json").is_file)  # the job has run again
    finally:
        watcher.stop()
        thread.join()
    assert sum(line.startswith("walk: failed") for line in bench.lines) == 2


def test_a_job_that_is_claimed_during_the_cancellation_is_cancelled(
    bench: SpoolFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The job waits when it is searched, and is gone when it is moved."""
    entry = InboxEntry(bench.drop("walk"))
    snapshot, permissions = take_snapshot(entry, 100), bench.options().permissions

    def claim() -> None:
        monkeypatch.undo()
        monkeypatch.chdir(bench.folder)
        assert inbox_claim.claim_entry(bench.spool, entry, snapshot, permissions) is not None

    rename = commands.os.rename  # type: ignore[attr-defined]
    monkeypatch.setattr(commands.os, "rename", preceded_by(rename, claim))  # type: ignore[attr-defined]
    assert cancel_job(bench.spool, "walk", wait_s=0.2) is None, "no watcher has reacted yet"
    (path,) = bench.spool.running.iterdir()
    assert JobDir(path).cancel.exists()
    assert list(bench.spool.failed.iterdir()) == []


def test_a_job_that_ends_during_the_cancellation_is_done(
    bench: SpoolFixture, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    bench.drop("walk")
    bench.run_once()
    job = bench.job("walk")
    left = job.path.rename(bench.spool.running / "walk")
    touch = Path.touch

    def end(path: Path, **values: Any) -> None:
        touch(path, **values)
        left.rename(job.path)

    monkeypatch.setattr(Path, "touch", end)
    assert main(["cancel", "walk"]) == 0
    assert "the job ended before it could be cancelled; its state is done" in capfd.readouterr().out
