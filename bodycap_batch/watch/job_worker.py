"""Run one claimed job, and move it to its final folder (`done` or `failed`)."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import threading
import traceback
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from bodycap_batch.core.errors import (
    BodycapError,
    Cancelled,
    DiskAway,
    StoreError,
    error_from_dict,
    one_line,
)
from bodycap_batch.pipeline import Settings, run_job
from bodycap_batch.runner import CHILD_COMMAND
from bodycap_batch.store.artefacts import Store, disk_error, store_error
from bodycap_batch.store.references import StoreBusy, moving
from bodycap_batch.watch.dropped_job import JobPermissions, make_result_paths_relative, read_job
from bodycap_batch.watch.inbox_claim import path_exists
from bodycap_batch.watch.job_status import FINAL, JobStatusFile, State, append_log, read_status, utc_text
from bodycap_batch.watch.spool import RUNNING, JobDir, Spool, move_to_free_name


@dataclass(frozen=True, slots=True, kw_only=True)
class WatchOptions:
    """Options of a watcher. The options do not change the results of a job.

    Attributes:
        permissions: Which folders a job may read, and the maximum size of a job.
        store: Folder of the artefacts; None for the folder ``.store`` beside `running`.
        jobs: Maximum number of jobs that run at the same time.
        threads: Number of processor cores that all running jobs share.
        memory_mb: Memory limit (MB) of one task; None for four fifths of the machine's memory.
        unchanged_s: Time (seconds) for which an entry must not change before it is treated as complete.
        retry_s: Time (seconds) until a job or an entry that a disk failure stopped is tried again. With
            `once`, also the maximum time for which the watcher waits for a missing disk.
        require: What the results of jobs that state no requirement must reach, such as ``good,0.9``.
        once: True: stop when nothing is left to do.
        command: Command line that starts the child process of a job.
    """

    permissions: JobPermissions = field(default_factory=JobPermissions)
    store: Path | None = None
    jobs: int = 1
    threads: int = 1
    memory_mb: int | None = None
    unchanged_s: float = 10.0
    retry_s: float = 60.0
    require: str | None = None
    once: bool = False
    command: Sequence[str] = CHILD_COMMAND


_MAX_DISK_FAILURES = 5
"""Maximum number of counted disk failures of a job. After one more failure, the job ends as failed. A failure
is counted only if the disk can still be read. In this case the cause is a file of the job and not a missing
disk. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JobOutcome:
    """How the processing of a job ended. The watcher reports the outcome to the operator.

    Attributes:
        name: Name of the job.
        state: State as in `status.json`; "deleted" if the job's folder was deleted; "stuck" if a disk failed.
        exit_code: Exit code of the error; 0 if there is no error. A bug of the program has the code 70.
        message: One line for the operator.
        path: The job's final folder; None if the job was not moved there.
    """

    name: str
    state: str
    exit_code: int = 0
    message: str = ""
    path: Path | None = None


class JobWorker:
    """Process claimed jobs. One instance processes all jobs of a watcher.

    Args:
        spool: The folders of the watcher.
        options: Options of the watcher.
        stop: Event that is set when the watcher must end.
    """

    def __init__(self, spool: Spool, options: WatchOptions, stop: threading.Event) -> None:
        self._spool = spool
        self._options = options
        self._stop = stop
        self._disk_failures: Counter[str] = Counter()
        self._store = Store(options.store or spool.root / ".store")

    def process(self, job_dir: JobDir) -> JobOutcome:
        """Run a claimed job until it is in its final folder, or until it is left for a later attempt."""
        try:
            return self._process(job_dir)
        except (BodycapError, OSError) as error:
            return self._give_up(job_dir) if self._is_deleted(job_dir) else _stuck(job_dir, error)

    def _process(self, job_dir: JobDir) -> JobOutcome:
        previous = read_status(job_dir, strict=True)
        if previous.get("state") in FINAL:
            # The job could not be read, or an earlier watcher ended before it moved the job.
            return self._file(job_dir, previous["state"], _error_from_status(previous), None)
        status = JobStatusFile(job_dir, previous)
        try:
            self._run(job_dir, status)
        except Cancelled as error:
            return self._handle_cancelled(job_dir, status, error)
        except StoreBusy as error:  # `bodycap gc` runs for a few seconds; do not count this attempt
            status.document["attempts"] = int(previous.get("attempts", 0))
            return self._leave(job_dir, status, error)
        except DiskAway as error:
            return self._postpone(job_dir, status, error)
        except BodycapError as error:
            return self._end(job_dir, status, "failed", error)
        except Exception as error:  # noqa: BLE001 - the only place that catches program bugs
            disk = disk_error(error, job_dir.path) if isinstance(error, OSError) else None
            if isinstance(disk, DiskAway):
                return self._postpone(job_dir, status, disk)
            return self._end(job_dir, status, "failed", disk or _log_bug(job_dir, error))
        return self._end(job_dir, status, "done", None)

    def _run(self, job_dir: JobDir, status: JobStatusFile) -> None:
        self._check_cancelled(job_dir)
        status.update(
            state="running",
            started_at=utc_text(),
            attempts=status.document["attempts"] + 1,
            host=socket.gethostname(),
            store=str(self._store.root),
        )
        job = read_job(job_dir, self._options.permissions)
        if job.require is None:
            job = job.model_copy(update={"require": self._options.require})
        settings = Settings(
            store=self._store,
            threads=max(1, self._options.threads // self._options.jobs),
            memory_mb=self._options.memory_mb,
            listener=status,
            cancelled=lambda: self._is_cancelled(job_dir),
            command=self._options.command,
            limits=self._options.permissions.limits,
        )
        try:
            summary = run_job(job, out_dir=job_dir.result, settings=settings)
            if summary.verdict is not None:
                status.update(verdict=summary.verdict.to_dict())
            if summary.unmet is not None:
                raise summary.unmet
        finally:
            if not self._is_deleted(job_dir):
                make_result_paths_relative(job_dir, job)

    def _is_cancelled(self, job_dir: JobDir) -> bool:
        return self._stop.is_set() or job_dir.cancel.exists() or self._is_deleted(job_dir)

    def _check_cancelled(self, job_dir: JobDir) -> None:
        if self._is_cancelled(job_dir):
            raise Cancelled("the job was stopped before it started", hint="run `bodycap retry` for this job")

    def _handle_cancelled(self, job_dir: JobDir, status: JobStatusFile, error: Cancelled) -> JobOutcome:
        """Handle a stop: a user deleted or cancelled the job, or this watcher ends."""
        if self._is_deleted(job_dir):
            return self._give_up(job_dir)
        if job_dir.cancel.exists():
            error = Cancelled(
                "the job was cancelled; the results of finished stages stay in the store",
                hint=f"run `bodycap retry {job_dir.name}` to continue the job",
            )
            return self._end(job_dir, status, "cancelled", error)
        return self._leave(job_dir, status, error)

    def _give_up(self, job_dir: JobDir) -> JobOutcome:
        """Report that a user deleted the job, and remove the files that were written after the deletion."""
        shutil.rmtree(job_dir.log.parent, ignore_errors=True)
        with contextlib.suppress(OSError):  # a folder that is not empty stays
            job_dir.status.unlink(missing_ok=True)
            job_dir.result.rmdir()
            job_dir.path.rmdir()
        message = f"its folder was deleted from {RUNNING}/"
        return JobOutcome(name=job_dir.name, state="deleted", message=message)

    def _is_deleted(self, job_dir: JobDir) -> bool:
        """Return True if someone deleted the folder of a running job.

        If the disk is gone, `running` does not exist either, or the input cannot be looked for.
        """
        try:
            return not path_exists(job_dir.input) and self._spool.running.is_dir()
        except OSError:
            return False

    def _postpone(self, job_dir: JobDir, status: JobStatusFile, error: DiskAway) -> JobOutcome:
        """Postpone a job after a disk failure, or end it after too many disk failures."""
        name = job_dir.name
        if any(not stage["reused"] for stage in status.document["finished_stages"]):
            del self._disk_failures[name]  # the job has finished a stage since the last failure
        if _is_disk_readable(Path(error.path or job_dir.path)):
            self._disk_failures[name] += 1
        if self._disk_failures[name] > _MAX_DISK_FAILURES:
            return self._end(job_dir, status, "failed", error)
        append_log(job_dir, f"postponed: {error}")
        status.update(state="stopped", active={}, error=error.to_dict())
        return _stuck(job_dir, error)

    def _leave(self, job_dir: JobDir, status: JobStatusFile, error: BodycapError) -> JobOutcome:
        """Leave the job in `running`, so that this or the next watcher can run the job again later."""
        cause = None if isinstance(error, Cancelled) else error.to_dict()
        status.update(state="stopped", active={}, error=cause)
        return _stopped(job_dir, error)

    def _end(
        self, job_dir: JobDir, status: JobStatusFile, state: State, error: BodycapError | None
    ) -> JobOutcome:
        del self._disk_failures[job_dir.name]
        if error is not None:
            append_log(job_dir, f"{state}: {error}")
        return self._file(job_dir, state, error, status)

    def _file(
        self, job_dir: JobDir, state: State, error: BodycapError | None, status: JobStatusFile | None
    ) -> JobOutcome:
        """Write the final status, and move the job to its final folder.

        If `bodycap gc` is cleaning the store, the job moves at a later attempt.
        """
        try:
            return self._move(job_dir, state, error, status)
        except StoreBusy as busy:
            if status is not None:
                status.finish(state, error, self._folder(state) / job_dir.name, self._spool.inbox)
            return _stopped(job_dir, busy)

    def _folder(self, state: State) -> Path:
        return self._spool.done if state == "done" else self._spool.failed

    def _move(
        self, job_dir: JobDir, state: State, error: BodycapError | None, status: JobStatusFile | None
    ) -> JobOutcome:
        folder = self._folder(state)
        with moving(self._store, job_dir.result, wait=False) as keep_for:
            if self._is_deleted(job_dir):
                return self._give_up(job_dir)

            def write_final_status(target: Path) -> None:
                keep_for(JobDir(target).result)
                if status is not None:
                    status.finish(state, error, target, self._spool.inbox)

            folder.mkdir(exist_ok=True)  # a user may have removed the folder with all results
            target = move_to_free_name(job_dir.path, folder, job_dir.name, write_final_status)
        JobDir(target).cancel.unlink(missing_ok=True)
        return JobOutcome(
            name=target.name,
            state=state,
            exit_code=0 if error is None else error.exit_code,
            message="" if error is None else error.message,
            path=target,
        )


def _stuck(job_dir: JobDir, error: Exception) -> JobOutcome:
    """Return the outcome of a job that a disk failure stopped. It is processed again after a while."""
    return JobOutcome(
        name=job_dir.name,
        state="stuck",
        exit_code=StoreError.exit_code,
        message=f"continues later: {one_line(error)}",
    )


def _stopped(job_dir: JobDir, error: BodycapError) -> JobOutcome:
    """Return the outcome of a job that stays in `running` and can be processed again at once."""
    message = (
        "the job continues when the watcher starts again"
        if isinstance(error, Cancelled)
        else f"the job continues later: {error.message}"
    )
    return JobOutcome(name=job_dir.name, state="stopped", exit_code=error.exit_code, message=message)


def _log_bug(job_dir: JobDir, error: Exception) -> BodycapError:
    """Write the traceback of a program bug to the job's log, and return the error for the user."""
    append_log(job_dir, "".join(traceback.format_exception(error)))
    hint = "this is a bug in bodycap; please report it with this log and the job"
    return BodycapError(f"{type(error).__name__}: {error}", path=job_dir.log, hint=hint)


def _is_disk_readable(path: Path) -> bool:
    """Return True if the disk of an unreadable file can be read. In this case the cause is the file itself.

    If the disk cannot be read either, the disk is missing. The watcher waits for a missing disk without a
    time limit.
    """
    try:
        os.statvfs(path.parent)
        os.listdir(path.parent)
    except OSError as error:
        return not isinstance(store_error(error, path), DiskAway)
    return True


def _error_from_status(document: dict[str, object]) -> BodycapError | None:
    """Return the error that is stored in the content of a status file, or None if there is no error."""
    error = document.get("error")
    if not isinstance(error, dict):
        return None
    return error_from_dict(error)
