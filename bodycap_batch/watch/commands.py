"""List the jobs of a spool, retry a job, and cancel a job."""

from __future__ import annotations

import os
import shutil
import time
import unicodedata
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from bodycap_batch.core.errors import Cancelled, JobError
from bodycap_batch.store.artefacts import Store, disk_errors
from bodycap_batch.store.references import moving
from bodycap_batch.watch.inbox_claim import (
    dropped_name,
    input_path,
    path_exists,
    return_to_inbox,
)
from bodycap_batch.watch.inbox_entries import (
    NOT_A_JOB,
    InboxEntry,
    entries_in,
    ignored_paths_in,
    latest_change,
    reason_to_wait,
    take_snapshot,
)
from bodycap_batch.watch.job_status import FINAL, JobStatusFile, read_status, utc_text
from bodycap_batch.watch.spool import (
    DONE,
    FAILED,
    RETRY_PREFIX,
    JobDir,
    Spool,
    folder_name_from_text,
    move_to_free_name,
    visible_entries,
)
from bodycap_batch.watch.watcher_status import active_watcher

_MAX_SNAPSHOT_FILES = 1000
"""Maximum number of files of a waiting entry that are inspected for the list of jobs. Evidence: none."""
_STATE_BY_FOLDER = {DONE: "done", FAILED: "failed"}
"""State of a job with a damaged status file, by the name of the folder that holds the job."""
_POLL_S = 0.1
"""Time (seconds) between two checks of a job that is being cancelled. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JobRow:
    """One job as a row of the table that `bodycap status` and the live page show.

    Attributes:
        name: Name of the job.
        state: State of the job: waiting (in the inbox), ignored (not a job), claimed, running, interrupted
            (the watcher is gone), stopped, done, failed or cancelled.
        stage: Name of the current stage, and of the camera that the stage processes.
        progress: Completed fraction of the stage; None if the fraction is unknown.
        since: Time at which the state started, UTC.
        age_s: Time (seconds) since `since`; None if `since` is unknown.
        duration_s: Time (seconds) from the start of a job to its end; None if it has not ended.
        cause: What the job waits for, or why the job failed.
        hint: What the user can do.
        path: Path of the job.
        verdict: Grade of the results in words; "" if there are no results, or if it was not recorded.
        headline: The verdict in one sentence.
    """

    name: str
    state: str
    stage: str = ""
    progress: float | None = None
    since: str = ""
    age_s: float | None = None
    duration_s: float | None = None
    cause: str = ""
    hint: str = ""
    path: str = ""
    verdict: str = ""
    headline: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return the row as plain JSON values."""
        return asdict(self)


def job_rows(spool: Spool) -> list[JobRow]:
    """Return a row for every job of a spool (waiting, running, done, failed) and every ignored path."""
    is_watched = active_watcher(spool) is not None
    claimed = [job_row(JobDir(path), is_watched) for path in visible_entries(spool.running) if path.is_dir()]
    ended = [
        job_row(JobDir(path)) for folder in (spool.done, spool.failed) for path in visible_entries(folder)
    ]
    return [*inbox_rows(spool), *claimed, *ended]


def inbox_rows(spool: Spool) -> list[JobRow]:
    """Return a row for each waiting entry of the inbox and for each path that is ignored."""
    waiting = [_waiting_row(entry) for entry in entries_in(spool.inbox)]
    ignored = [
        JobRow(
            name=path.name,
            state="ignored",
            cause=NOT_A_JOB,
            hint="put the videos into a folder, and put this folder into the inbox",
            path=str(path),
        )
        for path in ignored_paths_in(spool.inbox)
    ]
    return [*waiting, *ignored]


def retry_job(spool: Spool, name: str) -> Path:
    """Move a failed or cancelled job back to the inbox. The results of its finished stages stay in the store.

    Returns:
        The new path of the job's input.

    Raises:
        JobError: The job does not exist, it has not failed, its input is gone, or another process already
            retries it.
    """
    job = spool.find(name)
    if job is None or job.path.parent != spool.failed:
        raise _unknown_job(
            spool,
            name,
            "cannot be retried, because it has not failed",
            [path.name for path in visible_entries(spool.failed)],
        )
    with disk_errors(job.path):
        if not path_exists(input_path(job)):
            raise JobError(
                "the videos of the job no longer exist",
                path=job.path,
                hint="put the videos into the inbox again",
            )
        dropped, hidden = dropped_name(job), JobDir(spool.failed / f"{RETRY_PREFIX}{job.name}")
        with _keep_artefacts(job, hidden, spool) as keep_for:
            keep_for(spool.inbox / dropped)
            try:
                os.rename(job.path, hidden.path)
            except FileNotFoundError:
                hint = "run `bodycap status` to list all jobs"
                raise JobError(
                    f"another command already retries job {name!r}", path=job.path, hint=hint
                ) from None
            target = return_to_inbox(spool, hidden, keep_for)
    return target or spool.inbox / dropped


@contextmanager
def _keep_artefacts(job: JobDir, hidden: JobDir, spool: Spool) -> Iterator[Callable[[Path], None]]:
    """Keep a job's artefacts in the store until the job runs again.

    Yields:
        A function. The caller must call it with the path to which the job will be moved.
    """
    store = read_status(job).get("store")
    if not store or not (Path(store) / "artefacts").is_dir():
        yield lambda _: None  # no stage has started, so the store holds no artefacts
        return
    with moving(Store(Path(store)), job.result) as keep_for:

        def keep_for_target(target: Path) -> None:
            names = {job.name, folder_name_from_text(target.name), folder_name_from_text(target.stem)}
            later = [folder / name for folder in (spool.running, spool.failed) for name in sorted(names)]
            keep_for(target, hidden.path, *later)

        yield keep_for_target


def cancel_job(spool: Spool, name: str, wait_s: float = 5.0) -> JobDir | None:
    """Cancel a waiting or running job. The results of its finished stages stay in the store.

    Returns:
        The job's folder, or None if no watcher has reacted within `wait_s` seconds. If the result is None,
        the next watcher that runs cancels the job. If the result is a folder, the job may have ended before
        it could be cancelled. `read_status` returns the final state of the job.

    Raises:
        JobError: The job does not exist, or it has ended.
    """
    end = time.monotonic() + wait_s
    with disk_errors(spool.root):
        while (asked := _request_cancel(spool, name)) is None:
            if time.monotonic() > end:
                return None
            time.sleep(_POLL_S)
    if asked.path.parent != spool.running:
        return asked
    while asked.path.exists() and time.monotonic() < end:
        time.sleep(_POLL_S)
    return None if asked.path.exists() else spool.find(name)


def _request_cancel(spool: Spool, name: str) -> JobDir | None:
    """Cancel a waiting job, or mark a running job so that its watcher cancels it.

    Return None if the job was moved meanwhile, so that it must be looked for again.
    """
    waiting = [entry for entry in entries_in(spool.inbox) if _is_same_name(entry.name, name)]
    job = spool.find(name)
    try:
        if job is not None and job.path.parent == spool.running:
            job.cancel.touch()
            return job
        if waiting:
            return _cancel_waiting(spool, waiting[0])
    except FileNotFoundError:  # a watcher has claimed the job, or moved it to its final folder
        return None
    raise _unknown_job(
        spool,
        name,
        "cannot be cancelled, because it is not waiting or running",
        [entry.name for entry in entries_in(spool.inbox)],
    )


def _cancel_waiting(spool: Spool, entry: InboxEntry) -> JobDir:
    """Move a waiting entry to `failed`. If this process is killed, a watcher moves it back.

    Raise `FileNotFoundError` if a watcher has claimed the entry.
    """
    job_dir = JobDir(spool.failed / f"{RETRY_PREFIX}{uuid.uuid4().hex}")
    job_dir.path.mkdir()
    status = JobStatusFile(job_dir)
    status.update(kind="file" if entry.is_file else "folder", dropped=entry.path.name)
    if entry.is_file:
        job_dir.input.mkdir()
    try:
        os.rename(entry.path, input_path(job_dir))
    except FileNotFoundError:
        shutil.rmtree(job_dir.path, ignore_errors=True)
        raise
    name = spool.free_name(folder_name_from_text(entry.name))
    error = Cancelled(
        "the job was cancelled before it started", hint=f"run `bodycap retry {name}` to start the job"
    )
    target = move_to_free_name(
        job_dir.path, spool.failed, name, lambda path: status.finish("cancelled", error, path, spool.inbox)
    )
    return JobDir(target)


def _waiting_row(entry: InboxEntry) -> JobRow:
    """Return the row of a waiting entry of the inbox."""
    try:
        snapshot = take_snapshot(entry, _MAX_SNAPSHOT_FILES)
        waits_for = reason_to_wait(entry, snapshot, _MAX_SNAPSHOT_FILES) or latest_change(snapshot)
        changed = entry.path.stat().st_mtime
    except OSError as error:
        return JobRow(name=entry.name, state="waiting", cause=str(error), path=str(entry.path))
    return JobRow(
        name=entry.name,
        state="waiting",
        since=utc_text(changed),
        age_s=_seconds_between(utc_text(changed), utc_text()),
        cause=waits_for,
        path=str(entry.path),
    )


def job_row(job: JobDir, is_watched: bool = True) -> JobRow:
    """Return the row of a claimed job. The row is read from the job's files.

    Args:
        job: The job's folder.
        is_watched: True if a watcher runs.
    """
    status = read_status(job)
    state = str(status.get("state") or _STATE_BY_FOLDER.get(job.path.parent.name, "claimed"))
    if state == "running" and not is_watched:
        state = "interrupted"
    error = status.get("error") or {}
    since = (
        status.get("finished_at") if state in FINAL else status.get("started_at") or status.get("claimed_at")
    )
    running = state == "running"
    cause = str(error.get("message", ""))
    if state == "stopped" and cause:  # the job waits for a disk or for `bodycap gc`
        where = error.get("path")
        cause = f"the job continues later: {f'{where}: ' if where else ''}{cause}"
    verdict = (status.get("verdict") or {}) if state == "done" else {}
    if state == "interrupted":
        cause = "the watcher of this job has ended; the job continues when a watcher starts"
    return JobRow(
        name=job.name,
        state=state,
        stage=f"{status.get('stage', '')} {status.get('camera', '')}".strip() if state != "done" else "",
        progress=status.get("progress") if running else None,
        since=str(since or ""),
        age_s=_seconds_between(since, utc_text()),
        duration_s=_seconds_between(status.get("started_at"), status.get("finished_at")),
        cause=cause,
        hint=str(error.get("hint") or ""),
        path=str(job.path),
        verdict=str(verdict.get("grade", "")),
        headline=str(verdict.get("headline", "")),
    )


def _seconds_between(start: object, end: object) -> float | None:
    """Return the time (seconds) between two moments that are given as text; None if a text is not a time."""
    try:
        first, last = (datetime.fromisoformat(str(moment)) for moment in (start, end))
        return round((last - first).total_seconds(), 1)
    except (ValueError, TypeError):
        return None


def _is_same_name(one: str, other: str) -> bool:
    """Return True if two names are equal regardless of their Unicode normal form."""
    return unicodedata.normalize("NFC", one) == unicodedata.normalize("NFC", other)


def _unknown_job(spool: Spool, name: str, why: str, names: list[str]) -> JobError:
    """Return the error for a job that does not exist or has the wrong state."""
    import difflib

    known = spool.find(name)
    if known is not None:
        state = read_status(known).get("state", known.path.parent.name)
        return JobError(
            f"job {name!r} {why}; its state is {state}",
            path=known.path,
            hint="run `bodycap status` to list all jobs",
        )
    near = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean {near[0]!r}?" if near else "run `bodycap status` to list all jobs"
    return JobError(f"there is no job with the name {name!r}", path=spool.root, hint=hint)
