"""`bodycap batch`."""

from __future__ import annotations

import logging
import re
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bodycap_batch.cli.application import app
from bodycap_batch.cli.progress_display import print_event, text_from_event
from bodycap_batch.cli.shared_options import (
    BatchOutOption,
    HeightOption,
    MemoryOption,
    RequireOption,
    StoreOption,
    checked_requirement,
    make_overrides,
    split_pair,
)
from bodycap_batch.cli.signals import event_on_signal
from bodycap_batch.cli.terminal import print_line, print_lines, print_message, print_messages, table_lines
from bodycap_batch.core.context import cores
from bodycap_batch.core.errors import Cancelled, JobError, worst_exit_code
from bodycap_batch.core.printable import printable
from bodycap_batch.core.progress import Event
from bodycap_batch.job_places import find_job, find_store

if TYPE_CHECKING:
    from bodycap_batch.pipeline import BatchJob, Outcome, Settings
    from bodycap_batch.runner import Executor
    from bodycap_batch.runner.dask_cluster import Cluster

_MAX_CLUSTER_JOBS = 32
"""Maximum number of jobs that run at the same time on a cluster. On this machine, each job needs only a
thread that waits. The scheduler orders the tasks of all jobs by priority. Evidence: none."""


_INTEGER = re.compile(r"-?[0-9]{1,9}")

_ExecutorOption = Annotated[
    str,
    typer.Option(
        metavar="local|ADDRESS|slurm|pbs",
        help="Where the tasks run: on this machine (local), on the workers of a Dask scheduler "
        "(tcp://HOST:8786), or in a queue.",
    ),
]


@app.command()
def batch(  # noqa: PLR0913, PLR0917 - the flags a user types
    jobs: Annotated[list[Path], typer.Argument(metavar="JOBS...", help="Job files and folders of videos.")],
    executor: _ExecutorOption = "local",
    out: BatchOutOption = None,
    height: HeightOption = None,
    require: RequireOption = None,
    store: StoreOption = None,
    memory_mb: MemoryOption = None,
    max_jobs: Annotated[
        int | None, typer.Option(min=1, help="Maximum number of jobs at the same time.", show_default=False)
    ] = None,
    threads: Annotated[int, typer.Option(min=1, max=1024, help="Number of threads that each task uses.")] = 1,
    workers: Annotated[int, typer.Option(min=1, help="Number of workers to request from a queue.")] = 2,
    worker_memory: Annotated[
        int, typer.Option(min=500, metavar="MB", help="Memory of each worker in a queue.")
    ] = 4000,
    priority: Annotated[
        list[str] | None,
        typer.Option(
            metavar="JOB=NUMBER",
            help="Priority of a job; jobs with higher numbers run first. You can repeat this option.",
        ),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON line per event and per job.")
    ] = False,
) -> None:
    """Run many jobs, on one machine or on several.

    A failed job does not stop the others. Each job keeps the height and the other settings with which
    `bodycap run` computed it last; --height replaces the height of all jobs. The exit code is the highest
    exit code of all jobs, but 6 (not as required) only if no job failed. If the batch is started again, it
    continues after the finished stages. On a cluster, the jobs, their videos, the store and the results must
    be on a disk that all machines mount under the same path.

    \b
    Examples:
      bodycap batch monday/*/ tuesday/*/ --height 1.75
      bodycap batch jobs/*.yaml --priority jobs/urgent.yaml=1 --max-jobs 4
      bodycap batch jobs/*.yaml --executor tcp://scheduler:8786
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.pipeline import Batch, Settings
    from bodycap_batch.store.artefacts import Store

    batch_jobs = _batch_jobs(_without_results(list(dict.fromkeys(jobs))), priority or [])
    overrides = replace(make_overrides(height=height), out_parent=out, require=checked_requirement(require))
    reporter = _BatchReporter(as_json=as_json)
    with (
        event_on_signal() as stop,
        _executor(executor, threads, workers, worker_memory) as (shared, busy_jobs),
    ):

        def settings(job: BatchJob, out_dir: Path) -> Settings:
            return Settings(
                store=Store(store or find_store(out_dir)),
                threads=threads,
                listener=reporter.listener(job.path),
                cancelled=stop.is_set,
                executor=shared,
                priority=job.priority,
                memory_mb=memory_mb,
            )

        work = Batch(settings, overrides, max_jobs or busy_jobs, stop.is_set)
        outcomes = [reporter.report_outcome(outcome) for outcome in work.run(batch_jobs)]
        if stop.is_set():
            raise Cancelled(
                "the batch stopped on request; the results of finished stages stay in the store",
                hint="run the same command again to continue",
            )
    reporter.print_summary(batch_jobs, outcomes)
    raise typer.Exit(worst_exit_code(outcome.exit_code for outcome in outcomes))


@contextmanager
def _executor(kind: str, threads: int, workers: int, memory_mb: int) -> Iterator[tuple[Executor, int]]:
    """Yield the executor of the tasks, and the default number of jobs that run at the same time."""
    if kind == "local":
        from bodycap_batch.runner.pool import LocalPool

        pool = LocalPool(max(cores(), threads))
        try:
            yield pool, max(1, cores() // threads) + 1
        finally:
            pool.shutdown()
        return
    from bodycap_batch.runner.dask_cluster import QUEUES, SCHEMES, Cluster, start_queue

    if kind not in QUEUES and not kind.startswith(SCHEMES):
        raise JobError(
            f"there is no executor {kind!r}",
            field="--executor",
            hint="give `local`, the address of a scheduler "
            f"({' or '.join(f'{scheme}HOST:8786' for scheme in SCHEMES)}), or the name of a queue "
            f"({' or '.join(QUEUES)})",
        )
    with ExitStack() as stack:
        address = kind
        if kind in QUEUES:
            address = stack.enter_context(start_queue(kind, workers, threads, memory_mb)).scheduler_address
        yield _with_worker_note(stack.enter_context(Cluster(address))), _MAX_CLUSTER_JOBS


def _with_worker_note(cluster: Cluster) -> Cluster:
    """Print a note to the user if the cluster has no worker yet, and return the cluster.

    Dask's messages about a lost connection are switched off: they are long tracebacks, and each job reports
    the failure itself.
    """
    if not cluster.workers():
        print_message("no worker is connected yet; the batch starts when one connects")
    for name in ("distributed", "distributed.client", "distributed.core"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # after the import of Dask, which sets the levels
    return cluster


def _without_results(paths: list[Path]) -> list[Path]:
    """Return the jobs without folders that only hold folders of results.

    A pattern such as ``monday/*/`` also finds ``monday/out``, the folder with the results of the other jobs.
    """
    jobs = [path for path in paths if not _holds_only_results(path)]
    for path in (path for path in paths if path not in jobs):
        print_message(f"{path} is left out, because it contains results and no videos")
    return jobs or paths


def _holds_only_results(path: Path) -> bool:
    from bodycap_batch.config.folder import is_video, job_file_in

    try:
        entries = list(path.iterdir())
        has_results = any(find_job(entry).results is not None for entry in entries)
        return has_results and job_file_in(path) is None and not any(map(is_video, entries))
    except OSError:  # a job file, or a folder that the loader reports
        return False


def _batch_jobs(jobs: Sequence[Path], priorities: Sequence[str]) -> list[BatchJob]:
    from bodycap_batch.pipeline import BatchJob

    form = "JOB=NUMBER with a job of this batch"
    hint = "write the job as on the command line, for example --priority monday.yaml=5"
    priority_of_job: dict[Path, int] = {}
    for text in priorities:
        name, number = split_pair(text, form=form, field="--priority", hint=hint)
        if Path(name) not in jobs or not _INTEGER.fullmatch(number):
            raise JobError(f"{text!r} does not have the form {form}", field="--priority", hint=hint)
        priority_of_job[Path(name)] = int(number)
    places = {path: find_job(path) for path in jobs}
    return [
        BatchJob(path=place.file, priority=priority_of_job.get(path, 0), out=place.results)
        for path, place in places.items()
    ]


class _BatchReporter:
    """Prints the events and the outcomes of all jobs of a batch, as plain lines or as JSON lines."""

    def __init__(self, *, as_json: bool) -> None:
        self._as_json = as_json
        self._lock = threading.Lock()

    def listener(self, job: Path) -> Callable[[Event], None]:
        """Return a function that prints the events of one job."""

        def listen(event: Event) -> None:
            text = "" if event.kind == "progress" else f"{_shown_name(job)}: {text_from_event(event)}"
            self._write({"job": str(job), **event.to_dict()}, printable(text))

        return listen

    def report_outcome(self, outcome: Outcome) -> Outcome:
        """Print the outcome of a job, and return this outcome."""
        error = outcome.error
        texts = [] if error is None else [f"{_shown_name(outcome.job.path)}: {error}"]
        self._write({"kind": "job", **outcome.to_dict()}, *texts, *getattr(error, "__notes__", []))
        return outcome

    def print_summary(self, jobs: Sequence[BatchJob], outcomes: Sequence[Outcome]) -> None:
        """Print a table of all jobs and their outcomes, in the order of the command line."""
        if self._as_json:
            return
        found = {outcome.job: outcome for outcome in outcomes}
        print_lines(table_lines([(_shown_name(job.path), _outcome_text(found[job])) for job in jobs]))
        failed = sum(outcome.exit_code != 0 for outcome in outcomes)
        print_line(f"{len(jobs) - failed} of {len(jobs)} jobs done")

    def _write(self, values: dict[str, Any], *texts: str) -> None:
        """Print the values as one JSON line, or the texts that are not empty with the time of day."""
        with self._lock:
            if self._as_json:
                print_event(values)
                return
            for text in filter(None, texts):
                print_messages(f"{time.strftime('%H:%M:%S')} {text}")


def _shown_name(job: Path) -> str:
    """Return the name of a job, safe to print. For a ``job.yaml``, it includes the folder's name."""
    from bodycap_batch.config.folder import JOB_FILES

    return printable(f"{job.resolve().parent.name}/{job.name}" if job.name in JOB_FILES else job.name)


def _outcome_text(outcome: Outcome) -> str:
    if outcome.summary is None:
        message = outcome.error.message if outcome.error is not None else ""
        return f"failed ({outcome.exit_code}): {message}"
    is_new = outcome.summary.executed > 0
    work = f"done in {outcome.seconds:.0f} s" if is_new else "nothing to do"
    verdict = outcome.summary.verdict
    grade = "" if verdict is None else f"  verdict: {verdict.grade.word}"
    if outcome.error is not None:
        grade += f"  not as required ({outcome.exit_code})"
    return f"{work}{grade}  {outcome.summary.out_dir}"
