"""Run tasks on many machines: on each machine, a Dask worker starts the same child processes as a local run.

A worker receives paths, digests and options. Videos and artefacts are stored on a disk that all machines
share. If a worker dies, the scheduler gives the task to another worker.

Source: the Dask distributed documentation (resources, priorities, allowed failures).
"""

from __future__ import annotations

import math
import os
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bodycap_batch.core.errors import BodycapError, JobError, StoreError, error_from_dict
from bodycap_batch.runner import CHILD_COMMAND, Task, TaskEnvironment
from bodycap_batch.runner.child_pool import stopped
from bodycap_batch.runner.child_process import POLL_S
from bodycap_batch.runner.remote import remote_order, run_order

if TYPE_CHECKING:
    from distributed import Client

SCHEMES = ("tcp://", "tls://")
QUEUES = ("slurm", "pbs")
MEMORY = "memory"
"""Name of the Dask resource with which a worker declares its memory (MB). Tasks reserve parts of this memory
while they run on the worker."""
_PROGRESS_PERIOD_S = 1.0
"""Minimum time (seconds) between two reports of a task's progress. Each report takes a few milliseconds on
the worker, on the scheduler and on the client. Evidence: none."""
_CLIENT_LEFT = ("closing", "closed")
_WORKER_ENDS = ("closing", "closed", "failed")
_ALLOWED_FAILURES = 1
"""Maximum number of times that a task is repeated because its worker died. After the second death of its
worker, the task fails. Evidence: none."""


class Cluster:
    """Runs the tasks of several jobs on Dask workers; a context manager.

    Args:
        address: Address of the scheduler: ``tcp://host:8786`` or ``tls://host:8786``.
        command: Command line of the children on the workers.

    Raises:
        BodycapError: The scheduler does not answer, or Dask is not installed (the extra `cluster`).
    """

    def __init__(self, address: str, command: Sequence[str] = CHILD_COMMAND) -> None:
        self._client = _connect(address)
        self._command = tuple(command)
        self._topic = f"bodycap-{uuid.uuid4().hex}"
        self._progress: dict[str, Callable[[int, int, str], None]] = {}
        self._lock = threading.Lock()
        with _lost_connection():
            self._client.subscribe_topic(self._topic, self._receive_progress)
            self._client.run_on_scheduler(_allow_failures, _ALLOWED_FAILURES)

    def __enter__(self) -> Cluster:
        """Return the cluster itself."""
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()

    def workers(self) -> dict[str, Mapping[str, float]]:
        """Return the resources that each worker declares, by the worker's address."""
        with _lost_connection():
            workers = self._client.scheduler_info()["workers"]
        return {str(name): dict(info.get("resources") or {}) for name, info in workers.items()}

    def execute(self, task: Task, environment: TaskEnvironment) -> None:
        """Compute and commit the task's artefact on a worker that the scheduler chooses.

        Raises:
            BodycapError: The task failed, or the scheduler was lost; `Cancelled` if the task was stopped.
        """
        key = f"{task.file_stem}-{uuid.uuid4().hex}"
        with self._lock:
            self._progress[key] = environment.progress
        try:
            resources = self._resources(task, environment)
            with _lost_connection():
                future = self._client.submit(
                    _on_worker,
                    remote_order(task, environment, self._command),
                    self._topic,
                    key=key,
                    pure=False,
                    priority=task.priority,
                    resources=resources,
                )
            _raise_error_in(self._wait(future, task, environment))
        finally:
            with self._lock:
                del self._progress[key]

    def close(self, logs: Path) -> None:
        """Do nothing: the child processes of the workers are kept for other jobs."""

    def _resources(self, task: Task, environment: TaskEnvironment) -> dict[str, float] | None:
        """Return the resources that a task reserves; None if no worker declares its memory.

        If a task needs more memory than any worker has, the task reserves all memory of the largest worker.
        Without this reservation, the task could run at the same time as other large tasks. The largest memory
        is known only after a worker has connected, so this method waits for the first worker.
        """
        while (largest := self._largest_worker()) is None:
            if environment.cancelled():
                raise stopped()
            environment.progress(0, 0, "waiting for a worker")
            time.sleep(POLL_S)
        return {MEMORY: min(float(task.memory_mb), largest)} if largest else None

    def _largest_worker(self) -> float | None:
        """Return the largest memory (MB) that a worker declares.

        Returns:
            The memory; 0 if no worker declares its memory; None if there is no worker.
        """
        if self._client.status in _CLIENT_LEFT:
            raise _lost()
        return max((declared.get(MEMORY, 0.0) for declared in self.workers().values()), default=None)

    def _wait(self, future: Any, task: Task, environment: TaskEnvironment) -> dict[str, Any]:
        ended = threading.Event()
        future.add_done_callback(lambda _: ended.set())
        while not ended.wait(POLL_S):
            if environment.cancelled():
                future.cancel()
                raise stopped()
            if self._client.status in _CLIENT_LEFT:
                raise _lost()
        if future.status == "finished":
            with _lost_connection():  # errors of the task are in the answer
                return dict(future.result())
        if future.status == "error":
            raise _dask_error(future.exception(), task, environment)
        raise _lost()

    def _receive_progress(self, event: Any) -> None:
        message = event[1]
        with self._lock:
            progress = self._progress.get(str(message["key"]))
        if progress is not None:
            progress(int(message["done"]), int(message["total"]), str(message["what"]))


def start_queue(kind: str, workers: int, cores: int, memory_mb: int) -> Any:
    """Start workers through the job queue of a computing centre.

    Args:
        kind: Kind of the job queue: ``slurm``, ``pbs``, or ``local`` for tests without a queue. The name of
            the queue, the account and the time limits come from Dask's configuration
            (``~/.config/dask/jobqueue.yaml``).
        workers: Number of workers.
        cores: Number of threads of each task. Each worker gets this number of cores, because a worker runs
            one task at a time.
        memory_mb: Memory (MB) of each worker.

    Returns:
        A Dask cluster: a context manager with the attribute ``scheduler_address``.

    Raises:
        BodycapError: Dask-Jobqueue is not installed (the extra `cluster`), or the queue refuses the request.
    """
    try:
        import dask_jobqueue
        from dask_jobqueue.local import LocalCluster
    except ImportError as error:
        raise _not_installed() from error
    classes = {
        "slurm": dask_jobqueue.SLURMCluster,
        "pbs": dask_jobqueue.PBSCluster,
        "local": LocalCluster,
    }
    try:
        cluster = classes[kind](
            cores=cores,
            processes=1,
            memory=f"{memory_mb}MB",
            worker_extra_args=["--nthreads", "1", "--resources", f"{MEMORY}={memory_mb}"],
        )
    except (ValueError, OSError, RuntimeError) as error:
        hint = "describe the queue in ~/.config/dask/jobqueue.yaml (see the documentation of Dask-Jobqueue)"
        raise JobError(f"{kind}: {error}", field="--executor", hint=hint) from error
    cluster.scale(n=workers)
    return cluster


def _connect(address: str) -> Client:
    """Connect to a scheduler and return the client. Raises `JobError`."""
    try:
        from distributed import Client
    except ImportError as error:
        raise _not_installed() from error
    try:
        # Dask's configuration sets the TLS certificates and the time to wait for an answer (30 s).
        return Client(address, set_as_default=False)
    except TypeError as error:  # Dask has no TLS certificates
        raise JobError(
            f"the connection to {address} needs certificates, but none are given",
            field="--executor",
            hint="give the paths of the certificates below distributed.comm.tls in "
            "~/.config/dask/distributed.yaml",
        ) from error
    except (OSError, TimeoutError, ValueError) as error:
        raise JobError(
            f"no scheduler answers at {address}",
            field="--executor",
            hint="start a scheduler (dask scheduler), and start a worker on each machine (dask worker "
            "tcp://HOST:8786 --nthreads 1)",
        ) from error


def _not_installed() -> JobError:
    hint = "install Dask: pip install 'bodycap_batch[cluster]' (or make extras)"
    return JobError("this executor needs Dask, which is not installed", field="--executor", hint=hint)


def _allow_failures(count: int, dask_scheduler: Any = None) -> None:
    """Set the number of allowed failures of a task. This function runs on the scheduler."""
    dask_scheduler.allowed_failures = count


def _on_worker(order: Mapping[str, Any], topic: str) -> dict[str, Any]:
    """Run an order and return its answer. This function runs in a thread of a worker."""
    from distributed import get_worker

    worker = get_worker()
    key = worker.get_current_task()
    last_report = -math.inf

    def progress(done: int, total: int, what: str) -> None:
        nonlocal last_report
        if (now := time.monotonic()) - last_report >= _PROGRESS_PERIOD_S or done >= total:
            last_report = now
            worker.log_event(topic, {"key": key, "done": done, "total": total, "what": what})

    def cancelled() -> bool:
        # True if the client has ended, if it has cancelled the task, or if the worker or scheduler ends.
        state = worker.state.tasks.get(key)
        return state is None or state.state == "cancelled" or worker.status.name in _WORKER_ENDS

    # All tasks of this worker together must not use more threads than the machine has cores.
    threads = min(order["task"]["threads"], max(1, (os.cpu_count() or 1) // worker.state.nthreads))
    limits = (order["memory_mb"], worker.state.total_resources.get(MEMORY))
    memory_mb = min((int(limit) for limit in limits if limit), default=None)
    task = {**order["task"], "threads": threads}
    return run_order({**order, "task": task, "memory_mb": memory_mb}, progress, cancelled)


def _raise_error_in(answer: Mapping[str, Any]) -> None:
    """Raise the error that a worker's answer holds; do nothing if the answer holds no error."""
    if "error" in answer:
        error = error_from_dict(answer["error"])
        for note in answer.get("notes", []):
            error.add_note(note)
        raise error


def _dask_error(failure: BaseException, task: Task, environment: TaskEnvironment) -> BodycapError:
    """Return the error for a failure of Dask itself. Errors of the task are part of the worker's answer."""
    from distributed import KilledWorker

    log = environment.logs / f"{task.file_stem}.log"
    if isinstance(failure, KilledWorker):
        return BodycapError(
            f"{task.label}: {_ALLOWED_FAILURES + 1} workers ended unexpectedly while they ran this stage",
            path=log,
            hint="give the workers more memory, or lower work_px in the job: the workers probably had too "
            "little memory",
        )
    hint = "install the same bodycap_batch on the scheduler and all workers"
    return BodycapError(f"{task.label}: {type(failure).__name__}: {failure}", path=log, hint=hint)


@contextmanager
def _lost_connection() -> Iterator[None]:
    """Convert errors of the connection to the scheduler into `StoreError`."""
    try:
        yield
    except OSError as error:
        raise _lost() from error


def _lost() -> StoreError:
    """Return the error for the case that the scheduler can no longer be reached."""
    return StoreError(
        "the connection to the scheduler was lost",
        hint="start the scheduler and the same batch again; the results of finished stages stay in the store",
    )
