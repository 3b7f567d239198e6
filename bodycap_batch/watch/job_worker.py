"""Run one claimed job, and move it to its final folder (`done` or `failed`)."""

from __future__ import annotations

import os
import shutil
import socket
import threading
import traceback
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from bodycap_batch.core.errors import (
    BodycapError,
    Cancelled,
    DiskAway,
    JobError,
    StoreError,
    error_from_dict,
    one_line,
)
from bodycap_batch.pipeline import Settings, run_job
from bodycap_batch.runner.turns import Turns
from bodycap_batch.store.artefacts import Store, disk_error, store_error
from bodycap_batch.store.references import StoreBusy, moving
from bodycap_batch.watch.claim import Claim, remove_claim_files
from bodycap_batch.watch.dropped_job import make_result_paths_relative, read_job
from bodycap_batch.watch.job_status import FINAL, JobStatusFile, State, append_log, read_status, utc_text
from bodycap_batch.watch.spool import RUNNING, JobDir, Spool, move_to_free_name
from bodycap_batch.watch.watch_options import WatchOptions

_MAX_DISK_FAILURES = 5
"""Maximum number of counted disk failures of a job. After one more failure, the job ends as failed. A failure
is counted only if the disk can still be read. In this case the cause is a file of the job and not a missing
disk. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JobOutcome:
    """How the processing of a job ended. The watcher reports the outcome to the operator.

    Attributes:
        name: Name of the job.
        state: State as in `status.json`; "lost" if another watcher has taken the job over; "deleted" if the
            job's folder was deleted; "stuck" if a disk failed.
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
        self._stage_turns = Turns()
        self._store = Store(options.store or spool.root / ".store")

    def process(self, claim: Claim, read_error: BodycapError | None = None) -> JobOutcome:
        """Run a claimed job until it is in its final folder, or until it is left for a later attempt.

        Args:
            claim: The claim on the job.
            read_error: The error that was found when the job was read, or None.
        """
        try:
            return self._process(claim, read_error)
        except (BodycapError, OSError) as error:
            return self._give_up(claim) if self._is_deleted(claim) else self._stuck(claim, error)

    def _process(self, claim: Claim, read_error: BodycapError | None) -> JobOutcome:
        previous = read_status(claim.job, strict=True)
        if previous.get("state") in FINAL:  # an earlier watcher ended before it moved the job
            return self._file(claim, previous["state"], _error_from_status(previous), None)
        status = JobStatusFile(claim.job, previous, claim.ownership.is_held)
        try:
            if read_error is not None:
                raise read_error
            self._run(claim, status)
        except Cancelled as error:
            return self._handle_cancelled(claim, status, error)
        except StoreBusy as error:  # `bodycap gc` runs for a few seconds; do not count this attempt
            status.document["attempts"] = int(previous.get("attempts", 0))
            return self._leave(claim, status, error)
        except DiskAway as error:
            return self._postpone(claim, status, error)
        except BodycapError as error:
            return self._end(claim, status, "failed", error)
        except Exception as error:  # noqa: BLE001 - the only place that catches program bugs
            disk = disk_error(error, claim.job.path) if isinstance(error, OSError) else None
            if isinstance(disk, DiskAway):
                return self._postpone(claim, status, disk)
            return self._end(claim, status, "failed", disk or _log_bug(claim, error))
        return self._end(claim, status, "done", None)

    def _run(self, claim: Claim, status: JobStatusFile) -> None:
        job_dir = claim.job
        self._check_cancelled(claim)
        status.update(
            state="running",
            started_at=utc_text(),
            attempts=status.document["attempts"] + 1,
            host=socket.gethostname(),
            generation=claim.generation,
            store=str(self._store.root),
        )
        if not job_dir.job.is_file():  # an earlier watcher ended before it wrote the job
            raise JobError(
                "the job was not read, because the watcher ended too early",
                path=job_dir.input,
                hint="run `bodycap retry` for this job",
            )
        job = read_job(job_dir, self._options.permissions)
        settings = Settings(
            store=self._store,
            threads=max(1, self._options.threads // self._options.jobs),
            memory_mb=self._options.memory_mb,
            listener=status,
            cancelled=lambda: self._is_cancelled(claim),
            command=self._options.command,
            may_commit=claim.ownership.is_held,
            limits=self._options.permissions.limits,
            turns=self._stage_turns,
        )
        try:
            summary = run_job(job, out_dir=job_dir.result, settings=settings)
            if summary.verdict is not None:
                status.update(verdict=summary.verdict.to_dict())
        finally:
            if claim.ownership.is_held():
                make_result_paths_relative(job_dir, job)

    def _is_cancelled(self, claim: Claim) -> bool:
        return self._stop.is_set() or claim.lost.is_set() or claim.job.cancel.exists()

    def _check_cancelled(self, claim: Claim) -> None:
        if self._is_cancelled(claim):
            raise Cancelled("the job was stopped before it started", hint="run `bodycap retry` for this job")

    def _handle_cancelled(self, claim: Claim, status: JobStatusFile, error: Cancelled) -> JobOutcome:
        """Handle a stop: a user cancelled the job, this watcher ends, or another watcher has the job."""
        name = claim.job.name
        if not claim.ownership.is_held():
            return self._give_up(claim)
        if claim.job.cancel.exists():
            error = Cancelled(
                "the job was cancelled; the results of finished stages stay in the store",
                hint=f"run `bodycap retry {name}` to continue the job",
            )
            return self._end(claim, status, "cancelled", error)
        return self._leave(claim, status, error)

    def _give_up(self, claim: Claim) -> JobOutcome:
        """Stop working on a job that this watcher no longer owns, and return an outcome with the reason."""
        claim.lost.set()
        name = claim.job.name
        if not self._is_deleted(claim):
            return JobOutcome(name=name, state="lost", message="another watcher runs this job now")
        if not claim.job.input.exists():  # remove log files that were written after the deletion
            shutil.rmtree(claim.job.path, ignore_errors=True)
        return JobOutcome(name=name, state="deleted", message=f"its folder was deleted from {RUNNING}/")

    def _is_deleted(self, claim: Claim) -> bool:
        """Return True if someone deleted the folder of a running job.

        If another watcher has taken the job over, the files of the claims still exist. If it has also filed
        the job, the job is in another folder of the spool. If the disk is gone, `running` does not exist.
        """
        if claim.ownership.has_claim() or not self._spool.running.is_dir():
            return False
        found = self._spool.find(claim.job.name)
        return found is None or found.path == claim.job.path

    def _postpone(self, claim: Claim, status: JobStatusFile, error: DiskAway) -> JobOutcome:
        """Postpone a job after a disk failure, or end it after too many disk failures.

        The heartbeat of a postponed job stops. After `stale_s` seconds without a heartbeat, a watcher takes
        the job over and starts it again.
        """
        name = claim.job.name
        if any(not stage["reused"] for stage in status.document["finished_stages"]):
            del self._disk_failures[name]  # the job has finished a stage since the last failure
        if _is_disk_readable(Path(error.path or claim.job.path)):
            self._disk_failures[name] += 1
        if self._disk_failures[name] > _MAX_DISK_FAILURES:
            return self._end(claim, status, "failed", error)
        claim.stop_heartbeat()
        append_log(claim.job, f"postponed: {error}")
        status.update(state="stopped", active={}, error=error.to_dict())
        return self._stuck(claim, error)

    def _stuck(self, claim: Claim, error: Exception) -> JobOutcome:
        """Stop the heartbeat after a disk failure, and return an outcome that reports the failure.

        After `stale_s` seconds without a heartbeat, a watcher takes the job over and processes it again.
        """
        claim.stop_heartbeat()
        code, name = StoreError.exit_code, claim.job.name
        message = f"continues later: {one_line(error)}"
        return JobOutcome(name=name, state="stuck", exit_code=code, message=message)

    def _leave(self, claim: Claim, status: JobStatusFile, error: BodycapError) -> JobOutcome:
        """Leave the job in `running`, so that this or another watcher can run the job again later."""
        cause = None if isinstance(error, Cancelled) else error.to_dict()
        status.update(state="stopped", active={}, error=cause)
        return self._release(claim, error)

    def _release(self, claim: Claim, error: BodycapError) -> JobOutcome:
        claim.release()
        message = (
            "the job continues when the watcher starts again"
            if isinstance(error, Cancelled)
            else f"the job continues later: {error.message}"
        )
        return JobOutcome(name=claim.job.name, state="stopped", exit_code=error.exit_code, message=message)

    def _end(
        self, claim: Claim, status: JobStatusFile, state: State, error: BodycapError | None
    ) -> JobOutcome:
        del self._disk_failures[claim.job.name]
        if error is not None:
            append_log(claim.job, f"{state}: {error}")
        return self._file(claim, state, error, status)

    def _file(
        self, claim: Claim, state: State, error: BodycapError | None, status: JobStatusFile | None
    ) -> JobOutcome:
        """Write the final status, and move the job to its final folder.

        If `bodycap gc` is cleaning the store, the job moves at a later attempt.
        """
        try:
            return self._move(claim, state, error, status)
        except StoreBusy as busy:
            if status is not None:
                status.finish(state, error, self._folder(state) / claim.job.name, self._spool.inbox)
            return self._release(claim, busy)

    def _folder(self, state: State) -> Path:
        return self._spool.done if state == "done" else self._spool.failed

    def _move(
        self, claim: Claim, state: State, error: BodycapError | None, status: JobStatusFile | None
    ) -> JobOutcome:
        folder = self._folder(state)
        with moving(self._store, claim.job.result, wait=False) as keep_for:
            claim.stop_heartbeat()
            if not claim.ownership.is_held():
                return self._give_up(claim)

            def write_final_status(target: Path) -> None:
                keep_for(JobDir(target).result)
                if status is not None:
                    status.finish(state, error, target, self._spool.inbox)

            folder.mkdir(exist_ok=True)  # a user may have removed the folder with all results
            target = move_to_free_name(claim.job.path, folder, claim.job.name, write_final_status)
        remove_claim_files(JobDir(target))
        return JobOutcome(
            name=target.name,
            state=state,
            exit_code=0 if error is None else error.exit_code,
            message="" if error is None else error.message,
            path=target,
        )


def _log_bug(claim: Claim, error: Exception) -> BodycapError:
    """Write the traceback of a program bug to the job's log, and return the error for the user."""
    append_log(claim.job, "".join(traceback.format_exception(error)))
    hint = "this is a bug in bodycap; please report it with this log and the job"
    return BodycapError(f"{type(error).__name__}: {error}", path=claim.job.log, hint=hint)


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
