"""A watched folder with stand-in stages: claims, results, refusals, continuation, cancellation."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
import signal
import socket
import threading
import time
from pathlib import Path

import pytest
import yaml

from bodycap_batch.cli import main
from bodycap_batch.config.limits import Limits
from bodycap_batch.core.errors import CaptureError, JobError, StoreError
from bodycap_batch.store.artefacts import Store
from bodycap_batch.store.garbage_collection import collect_garbage
from bodycap_batch.watch import (
    JobPermissions,
    cancel_job,
    inbox_claim,
    inbox_entries,
    job_rows,
    job_worker,
    retry_job,
)
from bodycap_batch.watch.commands import job_row
from bodycap_batch.watch.inbox_entries import EntrySnapshot, InboxEntry, take_snapshot
from tests.pipeline.spools import SpoolFixture, remove_in_use, wait_for
from tests.pipeline.test_watch_disk import running
from tests.processes import gone
from tests.videos import textured_frame, unopened, write_video


def leftovers(bench: SpoolFixture) -> list[str]:
    """Return the names in `running`, including hidden folders."""
    return sorted(path.name for path in bench.spool.running.iterdir())


def test_a_dropped_folder_ends_in_done_with_results_videos_and_a_status(bench: SpoolFixture) -> None:
    bench.drop("küchen gang 1")
    assert bench.run_once() == 0, bench.lines
    job = bench.job("küchen gang 1")
    assert job.path.parent == bench.spool.done
    assert (job.result / "metrics.json").is_file()
    assert (job.result / "result.bvh").is_file()
    assert b"frames of torso in k" in (job.input / "torso.mp4").read_bytes()
    assert "map: finished" in job.log.read_text()
    status = bench.status("küchen gang 1")
    assert (status["state"], status["exit_code"], status["error"]) == ("done", 0, None)
    assert {"preview": False, "report": False}.items() <= {
        stage["stage"]: stage["reused"] for stage in status["finished_stages"]
    }.items()
    assert status["claimed_at"] <= status["started_at"] <= status["finished_at"]
    assert leftovers(bench) == []
    assert sorted(path.name for path in job.path.iterdir()) == ["input", "job.yaml", "result", "status.json"]


@pytest.mark.slow
def test_the_job_file_of_the_results_can_be_run_again(bench: SpoolFixture) -> None:
    bench.drop("walk")
    bench.run_once()
    for file in (bench.job("walk").result / "job.yaml", bench.job("walk").job):
        videos = [camera["video"] for camera in yaml.safe_load(file.read_text())["capture"]["cameras"]]
        assert all((file.parent / path).is_file() for paths in videos for path in paths)
        assert main(["check", str(file), "--json"]) in (0, 3)  # the stand-in videos cannot be decoded
    process = bench.start("run", "jobs/done/walk/result/job.yaml", "--store", "jobs/.store")
    out, err = process.communicate(timeout=60)
    assert "map: already done" in err
    assert "export: already done" in err
    assert "results:" in out


def test_a_job_file_in_the_folder_is_used_and_resolved_in_the_inbox(bench: SpoolFixture) -> None:
    dropped = bench.spool.inbox / "walk"
    torso, palm = "{name: torso, video: torso.mp4}", f"{{name: left_palm, video: {dropped}/left_palm.mp4}}"
    job = (
        "height_m: 1.7\nout: somewhere/else\nskeleton: none\ncapture:\n  cameras:\n"
        f"    - {torso}\n    - {palm}\n"
    )
    bench.drop("walk", job)
    assert bench.run_once() == 0, bench.lines
    resolved = yaml.safe_load(bench.job("walk").job.read_text())
    assert resolved["name"] == "walk"
    assert resolved["height_m"] == 1.7
    assert [camera["video"] for camera in resolved["capture"]["cameras"]] == [
        ["input/torso.mp4"],
        ["input/left_palm.mp4"],
    ]
    assert not (bench.folder / "somewhere").exists()


def test_a_single_job_file_may_name_videos_below_a_permitted_folder(bench: SpoolFixture) -> None:
    footage = bench.drop("walk").rename(bench.folder / "footage")
    text = f"capture: {{cameras: [{{name: torso, video: {footage}/torso.mp4}}]}}"
    (bench.spool.inbox / "evening.yaml").write_text(text)
    assert bench.run_once(roots=(footage,)) == 0, bench.lines
    job = bench.job("evening")
    assert [path.name for path in job.input.iterdir()] == ["evening.yaml"]
    assert (footage / "torso.mp4").is_file()
    (bench.spool.inbox / "evening.yaml").write_text(text)
    assert bench.run_once() == 2
    error = bench.status("evening-2")["error"]
    assert str(footage / "torso.mp4") in error["message"]
    assert "--root" in error["hint"]


ONE = "capture: {{cameras: [{{name: torso, video: {}}}]}}"


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (ONE.format("../secret.mp4"), "may lead out"),
        (ONE.format("torso/../../secret.mp4"), "may lead out"),
        (ONE.format("/etc/passwd"), "outside"),
        (ONE.format("link.mp4"), "link"),
        (ONE.format("torso.mp4, calibration: /etc/passwd"), "outside"),
        (ONE.format("torso.mp4, mask: link.mp4"), "outside"),
        (ONE.format("torso.mp4, timestamps: link.mp4"), "outside"),
        (ONE.format("loop.mp4"), ""),
        (
            "skeleton: ../secret.bvh\n" + ONE.format("torso.mp4}, {name: head, video: left_palm.mp4"),
            "may lead out",
        ),
        (
            "skeleton: /etc/secret.bvh\n" + ONE.format("torso.mp4}, {name: head, video: left_palm.mp4"),
            "outside",
        ),
        (ONE.format("torso.mp4") + "\nnope: 1", "nope"),
        ("a: " + "[" * 30 + "]" * 30, "nested"),
        ("# " + "x" * (2 << 20), "large"),
        ("capture: {cameras: [{name: torso, video: !!python/name:os.system torso.mp4}]}", "tag"),
    ],
    ids=lambda value: value[:60],
)
def test_a_job_with_a_path_that_is_not_permitted_is_refused(
    bench: SpoolFixture, make: str, words: str
) -> None:
    (bench.folder / "secret.mp4").write_text("not yours")
    dropped = bench.drop("walk", make)
    (dropped / "link.mp4").symlink_to(bench.folder / "secret.mp4")
    (dropped / "loop.mp4").symlink_to("loop.mp4")
    assert bench.run_once() in (2, 3)
    job = bench.job("walk")
    assert job.path.parent == bench.spool.failed
    error = bench.status("walk")["error"]
    assert words in error["message"], error
    assert error["hint"]
    assert "not yours" not in job.status.read_text()
    if error["path"] is not None and error["path"].startswith(str(bench.folder)):
        assert os.path.lexists(error["path"])
    assert (job.input / "torso.mp4").is_file()


def test_a_video_that_is_a_link_outside_is_refused_in_a_folder_without_a_job(bench: SpoolFixture) -> None:
    (bench.folder / "secret.mp4").write_text("not yours")
    (bench.drop("walk") / "head.mp4").symlink_to(bench.folder / "secret.mp4")
    assert bench.run_once() == 2
    assert "secret.mp4, which is outside" in bench.status("walk")["error"]["message"]


@pytest.mark.slow
def test_a_link_to_a_permitted_folder_is_processed(bench: SpoolFixture) -> None:
    footage = bench.drop("walk").rename(bench.folder / "footage")
    (bench.spool.inbox / "linked").symlink_to(Path("../../footage"))
    assert bench.run_once(roots=(bench.folder / "footage",)) == 0, bench.lines
    assert (footage / "torso.mp4").is_file()
    (bench.spool.inbox / "linked").symlink_to(Path("../../footage"))
    assert bench.run_once() == 2
    assert bench.job("linked-2").path.parent == bench.spool.failed


def test_jobs_beyond_the_limits_are_refused(bench: SpoolFixture) -> None:
    (bench.drop("large") / "head.mp4").write_bytes(bytes(3000))
    many = bench.drop("many")
    for number in range(20):
        (many / f"{number}.txt").touch()
    (bench.drop("odd") / "pipe.mp4").unlink(missing_ok=True)
    os.mkfifo(bench.spool.inbox / "odd" / "pipe.mp4")
    assert bench.run_once(limits=Limits(video_gb=2e-6, files=10)) == 3
    assert "the limit is 2e-06" in bench.status("large")["error"]["message"]
    assert "more than 10 files" in bench.status("many")["error"]["message"]
    assert "pipe.mp4 is neither" in bench.status("odd")["error"]["message"]


def test_repeated_names_get_a_number_and_no_job_is_lost(bench: SpoolFixture) -> None:
    for _ in range(3):
        bench.drop("walk")
        bench.run_once()
    (bench.spool.inbox / "walk.yaml").write_text("capture: {}")
    bench.run_once()
    assert sorted(job.name for job in bench.spool.jobs()) == ["walk", "walk-2", "walk-3", "walk-4"]
    assert bench.job("walk-4").path.parent == bench.spool.failed


@pytest.mark.parametrize("name", ["a\nb", "-rf", "n" * 250, "ü" * 120, "e\u0301te", " lead"])
def test_jobs_with_unusual_names_are_processed(
    bench: SpoolFixture, name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    capture = bench.drop("walk").rename(bench.spool.inbox / name)
    assert bench.run_once() == 0, bench.lines
    assert not capture.exists()
    (job,) = bench.spool.jobs()
    assert job.path.parent == bench.spool.done
    job.name.encode()
    assert main(["status", "jobs"]) == 0
    assert "done" in capfd.readouterr().out


def test_names_that_are_not_utf8_are_refused(bench: SpoolFixture) -> None:
    bench.drop("walk").rename(bench.spool.inbox / os.fsdecode(b"walk \xff"))
    torso = bench.drop("other") / "torso.mp4"
    torso.rename(torso.with_name(os.fsdecode(b"torso \xfe.mp4")))
    assert bench.run_once() == 2
    assert "walk \\udcff is not UTF-8 text" in bench.status("walk _")["error"]["message"]
    assert "torso \\udcfe.mp4 is not UTF-8 text" in bench.status("other")["error"]["message"]
    assert main(["status"]) == 0
    assert os.path.lexists(retry_job(bench.spool, "walk _"))


def test_a_job_waits_while_the_store_is_cleaned(bench: SpoolFixture) -> None:
    bench.drop("walk")
    watcher = bench.watcher(once=False)
    thread = threading.Thread(target=watcher.run)
    try:
        with (bench.spool.root / ".store" / "in-use").open("w") as cleaning:
            fcntl.flock(cleaning, fcntl.LOCK_EX)
            thread.start()
            wait_for(lambda: any("continues later" in line for line in bench.lines))
            cause = (
                f"the job continues later: {bench.spool.root / '.store'}: "
                "`bodycap gc` is removing artefacts from the store"
            )
            wait_for(lambda: job_row(bench.job("walk")).cause == cause)
        wait_for((bench.spool.done / "walk").is_dir)
    finally:
        watcher.stop()
        thread.join()
    assert bench.status("walk")["attempts"] == 1
    message = "walk: stopped: the job continues later: `bodycap gc` is removing artefacts from the store"
    assert bench.lines == ["walk: started", message, f"walk: done -> {bench.spool.done / 'walk'}"]


@pytest.mark.slow
def test_waiting_for_gc_is_reported_once(bench: SpoolFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.drop("walk")
    watcher = bench.watcher(once=False)
    thread = threading.Thread(target=watcher.run)
    attempts: list[object] = []
    process = job_worker.JobWorker.process

    def counted(*arguments: object) -> object:
        attempts.append(arguments)
        return process(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(job_worker.JobWorker, "process", counted)
    with (bench.spool.root / ".store" / "in-use").open("w") as cleaning:
        fcntl.flock(cleaning, fcntl.LOCK_EX)
        thread.start()
        try:
            wait_for(lambda: len(attempts) > 2)
            lines = list(bench.lines)
        finally:
            watcher.stop()
            thread.join()
    assert [line.partition(": the job continues")[0] for line in lines] == ["walk: started", "walk: stopped"]


@pytest.mark.slow
def test_a_watcher_with_once_leaves_no_job_behind(bench: SpoolFixture) -> None:
    for name in ("one", "two"):  # left by a watcher with two job slots
        bench.drop(name)
    bench.run_once()
    for name in ("one", "two"):
        shutil.move(bench.job(name).path, bench.spool.running / name)
    bench.drop("walk")
    with (bench.spool.root / ".store" / "in-use").open("w") as cleaning:
        fcntl.flock(cleaning, fcntl.LOCK_EX)
        watcher = bench.watcher()
        thread = threading.Thread(target=watcher.run)
        thread.start()
        wait_for(lambda: any("continues later" in line for line in bench.lines))
    thread.join(30)
    assert not thread.is_alive()
    assert sorted(path.name for path in bench.spool.done.iterdir()) == ["one", "two", "walk"]
    assert leftovers(bench) == []


def test_removed_folders_are_created_again(bench: SpoolFixture) -> None:
    watcher = bench.watcher()
    shutil.rmtree(bench.spool.done)
    shutil.rmtree(bench.spool.running)
    bench.drop("walk")
    assert watcher.run() == 0, bench.lines
    assert bench.job("walk").path == bench.spool.done / "walk"


@pytest.mark.slow
def test_a_job_that_cannot_be_filed_is_reported_and_filed_later(bench: SpoolFixture) -> None:
    bench.drop("walk")
    watcher = bench.watcher(retry_s=1.0, once=False)
    bench.spool.done.rmdir()
    bench.spool.done.write_text("a file where a folder should be")
    thread = threading.Thread(target=watcher.run)
    thread.start()
    try:
        wait_for(lambda: any(line.startswith("walk: stuck") for line in bench.lines))
        assert (bench.spool.running / "walk" / "result" / "metrics.json").is_file()
        bench.spool.done.unlink()
        wait_for((bench.spool.done / "walk" / "status.json").is_file)
    finally:
        watcher.stop()
        thread.join()


def test_an_entry_that_cannot_be_moved_is_reported_once_and_tried_again(bench: SpoolFixture) -> None:
    bench.drop("walk")
    watcher = bench.watcher(retry_s=1.0, once=False)
    shutil.rmtree(bench.spool.running)
    bench.spool.running.write_text("a file where a folder should be")
    thread = threading.Thread(target=watcher.run)
    thread.start()
    try:
        wait_for(lambda: len(bench.lines) > 0)
        assert "cannot be moved" in bench.lines[0]
        bench.spool.running.unlink()
        wait_for((bench.spool.done / "walk").is_dir)
        assert sum("cannot be moved" in line for line in bench.lines) == 1
    finally:
        watcher.stop()
        thread.join()


def test_an_entry_is_returned_if_it_cannot_be_read_any_more(
    bench: SpoolFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {path.name: path.read_bytes() for path in bench.drop("walk").iterdir()}

    def fail(*_: object) -> EntrySnapshot:  # as if a copying program renames a file
        raise FileNotFoundError(errno.ENOENT, "gone", "head.mp4")

    permissions = JobPermissions()
    entry = InboxEntry(bench.spool.inbox / "walk")
    snapshot = take_snapshot(entry, 100)
    monkeypatch.setattr(inbox_claim, "take_snapshot", fail)
    with pytest.raises(StoreError):
        inbox_claim.claim_entry(bench.spool, entry, snapshot, permissions)
    assert {path.name: path.read_bytes() for path in entry.path.iterdir()} == before
    assert leftovers(bench) == []


def test_a_claim_that_was_killed_loses_no_job(bench: SpoolFixture) -> None:
    entry = InboxEntry(bench.drop("walk"))
    claimed = inbox_claim.claim_entry(bench.spool, entry, take_snapshot(entry, 100), JobPermissions())
    assert claimed is not None
    claimed.input.rename(entry.path)  # as before the move
    (bench.spool.running / "at the start").mkdir()
    assert bench.run_once() == 0
    assert [job.path for job in bench.spool.jobs()] == [bench.spool.done / "walk"]
    assert leftovers(bench) == []


def test_a_job_whose_file_was_removed_is_read_again_by_a_retry(bench: SpoolFixture) -> None:
    entry = InboxEntry(bench.drop("walk"))
    claimed = inbox_claim.claim_entry(bench.spool, entry, take_snapshot(entry, 100), JobPermissions())
    assert claimed is not None
    claimed.job.unlink()
    assert bench.run_once() == JobError.exit_code
    assert bench.status("walk")["error"]["message"] == "the file of the job no longer exists"
    retry_job(bench.spool, "walk")
    assert bench.run_once() == 0


def test_a_move_that_cannot_be_completed_stops_no_watcher(
    bench: SpoolFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.drop("walk")

    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("bodycap_batch.watch.watcher.finish_interrupted_retries", fail)
    assert bench.run_once() == StoreError.exit_code
    assert bench.status("walk")["state"] == "done"
    start = f"an interrupted move in {bench.spool.failed} cannot be completed: "
    assert sum(line.startswith(start) for line in bench.lines) == 1


def test_only_one_watcher_works_on_a_folder(bench: SpoolFixture) -> None:
    watcher = bench.watcher(once=False)
    with running(watcher):
        wait_for((bench.spool.root / ".watcher.json").is_file)
        process = bench.start("watch", "jobs/inbox", "--once")
        _, err = process.communicate(timeout=30)
    assert process.returncode == StoreError.exit_code
    assert f"this folder is watched by {socket.gethostname()} (process {os.getpid()})" in err
    assert "hint: stop that watcher" in err
    assert bench.run_once() == 0, "the first watcher has ended"


def test_a_folder_in_running_that_is_not_a_job_keeps_its_files(bench: SpoolFixture) -> None:
    own = bench.spool.running / "mine"
    own.mkdir()
    (own / "notes.txt").write_text("keep")
    bench.drop("walk")
    assert bench.run_once() == 0
    assert (own / "notes.txt").read_text() == "keep"
    assert sum(line.startswith("mine stays in") for line in bench.lines) == 1


def test_paths_that_are_not_jobs_stay_in_the_inbox_and_are_listed(bench: SpoolFixture) -> None:
    (bench.spool.inbox / "torso.mp4").write_text("a video without a folder")
    (bench.spool.inbox / ".hidden").mkdir()
    (bench.spool.inbox / "copying.part").mkdir()
    assert bench.run_once() == 0
    states = {row.name: row.state for row in job_rows(bench.spool)}
    assert states == {"torso.mp4": "ignored", "copying.part": "ignored"}


def test_a_failed_job_keeps_partial_results_and_can_be_retried(bench: SpoolFixture) -> None:
    bench.order(fail="merge")
    bench.drop("walk")
    assert bench.run_once() == 4
    job = bench.job("walk")
    assert job.path.parent == bench.spool.failed
    status = bench.status("walk")
    assert (status["state"], status["exit_code"]) == ("failed", 4)
    assert status["error"]["message"] == "merge does not work out"
    assert str(job.path / "result" / "partial") in status["error"]["hint"]
    partial = yaml.safe_load((job.result / "partial" / "job.yaml").read_text())
    video = job.result / "partial" / partial["capture"]["cameras"][0]["video"][0]
    assert video.is_file()
    bench.order()
    assert retry_job(bench.spool, "walk") == bench.spool.inbox / "walk"
    assert bench.run_once() == 0
    status = bench.status("walk")
    fresh = {stage["stage"].split()[0] for stage in status["finished_stages"] if not stage["reused"]}
    assert {"merge", "export"} <= fresh
    assert fresh.isdisjoint({"check", "keyframes", "map", "registration"})


def test_a_retried_job_file_is_a_file_again(bench: SpoolFixture) -> None:
    (bench.spool.inbox / "walk.yaml").write_text("capture: {}")
    assert bench.run_once() == 2
    assert retry_job(bench.spool, "walk") == bench.spool.inbox / "walk.yaml"
    assert (bench.spool.inbox / "walk.yaml").read_text() == "capture: {}"
    assert list(bench.spool.jobs()) == []


def test_a_bug_fails_only_its_job(bench: SpoolFixture) -> None:
    bench.orders.write_text("no JSON")
    bench.drop("first")
    assert bench.run_once() == 70
    assert "Traceback" in "".join(path.read_text() for path in bench.job("first").result.glob("logs/*.log"))
    bench.order()
    bench.drop("second")
    assert bench.run_once() == 0


def test_a_copy_in_progress_stays_in_the_inbox_until_it_is_complete(bench: SpoolFixture) -> None:
    dropped = bench.drop("walk", ready=False)
    (dropped / "head.mp4.part").write_bytes(unopened("frames of the head"))
    watcher = bench.watcher(once=False)
    thread = threading.Thread(target=watcher.run)
    thread.start()
    try:
        wait_for(lambda: job_rows(bench.spool)[0].cause.startswith("head.mp4.part is not complete"))
        time.sleep(0.3)
        assert dropped.is_dir()
        (dropped / "head.mp4.part").rename(dropped / "head.mp4")
        wait_for(lambda: bench.spool.find("walk") is not None)
    finally:
        watcher.stop()
        thread.join(30)
    assert not thread.is_alive()


def test_a_folder_that_lacks_a_camera_fails_after_the_limit_and_never_runs(
    bench: SpoolFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inbox_entries, "_MAX_STALL_S", 1.0)
    dropped = bench.drop("walk", ready=False)
    (dropped / "head.mp4.crdownload").write_bytes(unopened("frames of the head")[:-1])
    watcher = bench.watcher(once=False)
    thread = threading.Thread(target=watcher.run)
    thread.start()
    try:
        wait_for((bench.spool.failed / "walk" / "status.json").is_file)
    finally:
        watcher.stop()
        thread.join(30)
    assert any(line.startswith("walk waits: head.mp4.crdownload is not complete") for line in bench.lines)
    assert not any("started" in line for line in bench.lines)
    status = bench.status("walk")
    assert (status["state"], status["exit_code"], status["attempts"], status["started_at"]) == (
        "failed",
        3,
        0,
        None,
    )
    assert status["error"]["path"] == str(bench.spool.failed / "walk" / "input" / "head.mp4.crdownload")
    assert not list(bench.spool.running.glob("[!.]*"))
    (bench.spool.failed / "walk" / "input" / "head.mp4.crdownload").unlink()
    assert main(["retry", "walk"]) == 0
    assert bench.run_once() == 0
    assert bench.status("walk")["state"] == "done"


def test_a_stalled_copy_is_left_with_its_reason(
    bench: SpoolFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    dropped = bench.drop("walk", ready=False)
    video = write_video(dropped / "head.mp4", [textured_frame(0)] * 9)
    whole = video.read_bytes()
    video.write_bytes(whole[:-100])
    assert bench.run_once() == 0
    assert any("head.mp4 is not complete" in line for line in bench.lines)
    assert main(["status", str(bench.spool.root)]) == 0
    count = f"{len(whole) - 100:,} of {len(whole):,} bytes are there"
    assert f"head.mp4 is not complete: its end is missing: {count}" in capfd.readouterr().out
    video.write_bytes(whole)
    assert bench.run_once() == 0
    assert bench.status("walk")["state"] == "done"


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGTERM, 143), pytest.param(signal.SIGINT, 130, marks=pytest.mark.slow)]
)
def test_the_next_watcher_continues_the_job_of_a_stopped_one(
    bench: SpoolFixture, number: signal.Signals, code: int
) -> None:
    bench.drop("walk")
    bench.order(hang="map")
    process = bench.start("watch", "jobs/inbox", "--threads", "1")
    child = bench.wait_until_hanging()
    process.send_signal(number)
    _, err = process.communicate(timeout=30)
    assert process.returncode == code, err
    assert "Traceback" not in err
    assert gone(child)
    job = bench.job("walk")
    assert job.path.parent == bench.spool.running
    assert bench.status("walk")["state"] == "stopped"
    bench.order()
    assert bench.run_once() == 0
    status = bench.status("walk")
    assert status["attempts"] == 2
    reused = [stage["stage"] for stage in status["finished_stages"] if stage["reused"]]
    assert sorted(reused) == ["check", "keyframes left_palm", "keyframes torso", "sound"]


@pytest.mark.slow
def test_a_killed_watcher_is_replaced_at_once(bench: SpoolFixture) -> None:
    bench.drop("walk")
    bench.order(hang="map")
    process = bench.start("watch", "jobs/inbox", "--threads", "1")
    bench.wait_until_hanging()
    process.kill()
    process.wait()
    (row,) = job_rows(bench.spool)
    assert row.state == "interrupted"
    bench.order()
    assert bench.run_once(retry_s=1000.0) == 0
    assert bench.job("walk").path.parent == bench.spool.done


@pytest.mark.slow
def test_a_job_is_cancelled_within_five_seconds_and_continues_when_retried(bench: SpoolFixture) -> None:
    bench.drop("walk")
    bench.order(hang="map")
    process = bench.start("watch", "jobs/inbox", "--threads", "1")
    child = bench.wait_until_hanging()
    assert cancel_job(bench.spool, "walk", wait_s=5.0) is not None
    assert gone(child)
    assert bench.status("walk")["state"] == "cancelled"
    assert process.poll() is None
    bench.order()
    retry_job(bench.spool, "walk")
    wait_for((bench.spool.done / "walk").is_dir)
    process.terminate()
    assert process.wait(30) == 143
    assert {"stage": "check", "reused": True}.items() <= bench.status("walk")["finished_stages"][0].items()


def test_artefacts_of_done_and_failed_jobs_are_not_garbage(bench: SpoolFixture) -> None:
    bench.drop("good")
    bench.run_once()
    bench.order(fail="merge")
    bench.drop("bad")
    bench.run_once()
    store = Store(bench.spool.root / ".store")
    assert collect_garbage(store, delete=True).artefacts == ()
    shutil.rmtree(bench.job("bad").path)
    unused = {name.split("/")[1] for name in collect_garbage(store, delete=False).artefacts}
    assert {"keyframes", "map", "registration", "export"} <= unused


def test_a_waiting_job_can_be_cancelled(bench: SpoolFixture) -> None:
    bench.drop("walk")
    job = cancel_job(bench.spool, "walk")
    assert job is not None
    assert job.path == bench.spool.failed / "walk"
    assert bench.status("walk")["state"] == "cancelled"
    assert retry_job(bench.spool, "walk") == bench.spool.inbox / "walk"
    assert bench.run_once() == 0
    for action in (retry_job, cancel_job):
        with pytest.raises(JobError, match="done"):
            action(bench.spool, "walk")


@pytest.mark.parametrize("how", ["all", "all but the logs"])
def test_a_deleted_running_job_is_reported_as_deleted(bench: SpoolFixture, how: str) -> None:
    bench.drop("walk")
    bench.order(hang="map")
    with running(bench.watcher(once=False, retry_s=1.0)):
        bench.wait_until_hanging()
        remove_in_use(bench.spool.running / "walk")
        if how == "all but the logs":  # as the start of the next stage does
            (bench.spool.running / "walk" / "result" / "logs").mkdir(parents=True)
        wait_for(lambda: any("walk: deleted" in line for line in bench.lines))
    assert bench.lines.count("walk: deleted: its folder was deleted from running/") == 1
    assert leftovers(bench) == []
    assert [row.name for row in job_rows(bench.spool)] == []


@pytest.mark.parametrize("when", ["videos", "error"])
def test_a_job_that_fails_because_it_was_deleted_is_deleted(
    bench: SpoolFixture, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    def run(job: object, *, out_dir: Path, settings: object) -> None:
        shutil.rmtree(out_dir.parent)
        if when == "videos":
            raise CaptureError("no such video", path=out_dir)
        raise FileNotFoundError(errno.ENOENT, "gone", str(out_dir))

    monkeypatch.setattr("bodycap_batch.watch.job_worker.run_job", run)
    bench.drop("walk")
    assert bench.run_once() == 0
    assert "walk: deleted: its folder was deleted from running/" in bench.lines


def test_a_job_on_a_missing_disk_is_not_taken_for_deleted(
    bench: SpoolFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(job: object, *, out_dir: Path, settings: object) -> None:
        bench.spool.running.rename(bench.folder / "away")
        raise FileNotFoundError(errno.ENOENT, "gone", str(out_dir))

    monkeypatch.setattr("bodycap_batch.watch.job_worker.run_job", run)
    bench.drop("walk")
    bench.run_once()
    assert not any("deleted" in line for line in bench.lines)
    assert (bench.folder / "away" / "walk" / "input" / "torso.mp4").is_file()


def test_a_job_with_a_final_status_is_filed_by_the_next_watcher(
    bench: SpoolFixture,
) -> None:
    bench.drop("walk")
    bench.run_once()
    job = bench.job("walk")
    metrics = (job.result / "metrics.json").stat().st_mtime_ns
    shutil.move(job.path, bench.spool.running / "walk")
    assert bench.run_once() == 0
    assert (bench.job("walk").result / "metrics.json").stat().st_mtime_ns == metrics
    assert bench.job("walk").path.parent == bench.spool.done


def test_folders_on_different_disks_are_refused_with_a_remedy(
    bench: SpoolFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = Path("/dev/shm") / f"bodycap-{os.getpid()}"  # noqa: S108
    if not other.parent.is_dir() or other.parent.stat().st_dev == bench.folder.stat().st_dev:
        pytest.skip("needs a second file system at /dev/shm")
    other.mkdir()
    try:
        shutil.rmtree(bench.spool.done)
        bench.spool.done.symlink_to(other)
        process = bench.start("watch", "jobs/inbox", "--once")
        _, err = process.communicate(timeout=30)
        assert process.returncode == 5
        assert "different file systems" in err
        assert "hint:" in err
        assert [path.name for path in bench.spool.running.iterdir()] == []
    finally:
        shutil.rmtree(other)


def test_jobs_are_listed_as_a_table_and_as_json(
    bench: SpoolFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    bench.drop("good")
    bench.run_once()
    bench.order(fail="map")
    bench.drop("bad")
    bench.run_once()
    bench.drop("next")
    (bench.spool.inbox / "empty").mkdir()
    for folder in ("jobs", "jobs/inbox"):
        assert main(["status", folder]) == 0
        lines = capfd.readouterr().out.splitlines()
        words = {line.split()[0]: line for line in lines}
        assert words["good"].split()[1] == "done"
        assert "map does not work out" in words["bad"]
        assert words["next"].split()[1] == "waiting"
        assert "the folder is empty" in words["empty"]
    assert main(["status", "--json"]) == 0
    found = json.loads(capfd.readouterr().out)
    rows = {row["name"]: row for row in found["jobs"]}
    assert found["watchers"] == []
    assert rows["bad"]["hint"].startswith("film more")
    assert rows["good"]["path"] == str(bench.spool.done / "good")
    assert main(["retry", "bda"]) == 2
    assert "did you mean 'bad'" in capfd.readouterr().err
    assert main(["cancel", "next"]) == 0
    assert main(["cancel", "good"]) == 2
    assert main(["status", "nowhere"]) == 2
