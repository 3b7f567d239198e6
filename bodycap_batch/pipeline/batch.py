"""Run many jobs at once. Each job has a thread that only waits; an executor runs the tasks of all jobs."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bodycap_batch.config.job import load_job_with_origins
from bodycap_batch.config.overrides import Overrides
from bodycap_batch.core.errors import EXIT_BUG, BodycapError, Cancelled, JobError
from bodycap_batch.core.progress import Event
from bodycap_batch.pipeline.run import RunSummary, run_job
from bodycap_batch.pipeline.sample import prepare_capture
from bodycap_batch.pipeline.settings import Settings
from bodycap_batch.store.artefacts import disk_error


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchJob:
    """One job of a batch.

    Attributes:
        path: Path of a job file or of a folder of videos.
        priority: Priority of the job; jobs with a higher number run first.
        out: Folder for the results, if the job is given by its results; else None.
    """

    path: Path
    priority: int = 0
    out: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """How a job of a batch ended.

    Attributes:
        job: The job.
        seconds: Time (seconds) from the job's start to its end.
        summary: Summary of the job's results; None if the job failed.
        error: The error that made the job fail, or that the results do not reach what is required; None if
            the job succeeded.
    """

    job: BatchJob
    seconds: float
    summary: RunSummary | None = None
    error: BodycapError | None = None

    @property
    def exit_code(self) -> int:
        """Exit code of the job: 0 if it succeeded, else the exit code of its error."""
        return 0 if self.error is None else self.error.exit_code

    def to_dict(self) -> dict[str, Any]:
        """Return the outcome as plain JSON values."""
        verdict = None if self.summary is None else self.summary.verdict
        return {
            "job": str(self.job.path),
            "exit_code": self.exit_code,
            "seconds": round(self.seconds, 3),
            "out_dir": None if self.summary is None else str(self.summary.out_dir),
            "executed": None if self.summary is None else self.summary.executed,
            "verdict": None if verdict is None else verdict.to_dict(),
            "error": None if self.error is None else self.error.to_dict(),
        }


class Batch:
    """Jobs that run at the same time; a failed job does not stop the other jobs.

    Args:
        settings: Function that returns the settings of a job. Its arguments are the job and the folder of the
            job's results. The settings of all jobs must share one executor.
        overrides: Values of the command line for all jobs.
        max_jobs: Maximum number of jobs that run at the same time.
        cancelled: Function that returns True if no further job may start.
    """

    def __init__(
        self,
        settings: Callable[[BatchJob, Path], Settings],
        overrides: Overrides,
        max_jobs: int,
        cancelled: Callable[[], bool],
    ) -> None:
        self._settings = settings
        self._cancelled = cancelled
        self._overrides = overrides
        self._max_jobs = max_jobs
        self._owners: dict[Path, Path] = {}
        """For each folder of results, the path of the job that writes into this folder."""
        self._lock = threading.Lock()

    def run(self, jobs: Sequence[BatchJob]) -> Iterator[Outcome]:
        """Run the jobs, the highest priority first; yield the outcome of each job when the job ends."""
        ordered = sorted(jobs, key=lambda job: -job.priority)
        started: dict[BatchJob, float] = {}

        def run(job: BatchJob) -> RunSummary:
            started[job] = time.monotonic()
            return self._run_one(job)

        with ThreadPoolExecutor(max_workers=self._max_jobs) as pool:
            waiting = {pool.submit(run, job): job for job in ordered}
            while waiting:
                for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                    job = waiting.pop(future)
                    yield _outcome(job, future, time.monotonic() - started[job])

    def _run_one(self, job: BatchJob) -> RunSummary:
        if self._cancelled():
            raise Cancelled("the job was stopped before it started", hint="run the batch again to continue")

        def prepare(options: Mapping[str, Any], folder: Path, out_dir: Path) -> None:
            prepare_capture(options, folder, self._settings(job, out_dir))

        overrides = replace(self._overrides, out=job.out)
        loaded = load_job_with_origins(job.path, overrides, prepare=prepare)
        out_dir = loaded.job.out
        assert out_dir is not None  # every loaded job has a folder for its results
        self._claim_folder(out_dir, job.path)
        for text in loaded.warnings_of_run():
            self._settings(job, out_dir).listener(Event(kind="note", stage="", what=text))
        settings = replace(self._settings(job, out_dir), overrides=overrides)
        return run_job(loaded.job, out_dir=out_dir, settings=settings)

    def _claim_folder(self, out_dir: Path, path: Path) -> None:
        """Refuse a job if another job of the batch already writes its results into the same folder."""
        with self._lock:
            other = self._owners.setdefault(out_dir.resolve(), path)
        if other != path:
            raise JobError(
                f"the results of this job and the results of {other} would be written to the same folder, "
                f"{out_dir}",
                path=path,
                field="name",
                hint="give the jobs different names (`name:`) or different folders for the results (`out:`)",
            )


def _outcome(job: BatchJob, future: Future[RunSummary], seconds: float) -> Outcome:
    """Return the outcome of a job that has ended; an unexpected exception gives exit code 70."""
    failure = future.exception()
    if failure is None:
        summary = future.result()
        return Outcome(job=job, seconds=seconds, summary=summary, error=summary.unmet)
    if isinstance(failure, BodycapError):
        return Outcome(job=job, seconds=seconds, error=failure)
    disk = disk_error(failure, job.path) if isinstance(failure, OSError) else None
    if disk is not None:
        return Outcome(job=job, seconds=seconds, error=disk)
    bug = BodycapError(
        f"{type(failure).__name__}: {failure}",
        path=job.path,
        hint="this is a bug in bodycap; please report it with the job file",
    )
    bug.exit_code = EXIT_BUG
    bug.add_note("".join(traceback.format_exception(failure)))
    return Outcome(job=job, seconds=seconds, error=bug)
