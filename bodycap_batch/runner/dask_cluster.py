"""Tasks on many machines: Dask workers that start the same child processes.

A worker gets paths, digests and options; videos and artefacts lie on a disk that all machines share. The
scheduler hands a dead worker's task to another one.

Source: the Dask distributed documentation (resources, priorities, allowed failures).
"""

from __future__ import annotations

import math
import os
import threading
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bodycap_batch.core.errors import BodycapError, Cancelled, JobError, error_from_dict
from bodycap_batch.runner import CHILD, Making, Task
from bodycap_batch.runner.children import STOPPED
from bodycap_batch.runner.remote import order_of, perform
from bodycap_batch.runner.turns import Turns

if TYPE_CHECKING:
    from distributed import Client

SCHEMES = ("tcp://", "tls://")
QUEUES = ("slurm", "pbs")
MEMORY = "memory"
"""Name of the resource (MB) by which a worker says what tasks may use together."""
_POLL_S = 0.2
_TELL_EVERY_S = 1.0
"""A line of progress passes through worker, scheduler and client: a few milliseconds of each."""
_ASK_AGAIN_S = 2.0
"""Workers come and go; asking the scheduler for each task takes longer than handing it over."""
_LEFT = ("closing", "closed")
_ENDING = ("closing", "closed", "failed")
_ALLOWED_FAILURES = 1
"""A task whose worker dies is done once more elsewhere; one that kills two workers is given up."""


class Cluster:
    """Makes the tasks of several jobs on Dask workers. A context manager.

    Args:
        address: The scheduler, ``tcp://host:8786`` or ``tls://host:8786``.
        command: The children's command line, on the workers.

    Raises:
        BodycapError: The scheduler does not answer, or the extra is not installed.
    """

    def __init__(self, address: str, command: Sequence[str] = CHILD) -> None:
        self._client = _connect(address)
        self._command = tuple(command)
        self._topic = f"bodycap-{uuid.uuid4().hex}"
        self._progress: dict[str, Callable[[int, int, str], None]] = {}
        self._lock = threading.Lock()
        self._turns = Turns()
        # Not the lock above: Dask's own thread waits for that one in `_hear`, and has to answer meanwhile.
        self._asking = threading.Lock()
        self._largest: float | None = None
        self._asked = -math.inf
        self._client.subscribe_topic(self._topic, self._hear)
        self._client.run_on_scheduler(_allow_failures, _ALLOWED_FAILURES)

    def __enter__(self) -> Cluster:
        """The cluster itself."""
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()

    def workers(self) -> dict[str, Mapping[str, float]]:
        """Address of every worker and the resources it declares."""
        known = self._client.scheduler_info()["workers"]
        return {str(name): dict(info.get("resources") or {}) for name, info in known.items()}

    def make(self, task: Task, making: Making) -> None:
        """Make and commit the task's artefact on some worker.

        Raises:
            BodycapError: What the child reported; `Cancelled` when stopped; the scheduler was lost.
        """
        with self._turns.taken(task, making) as made:
            if not made:
                self._hand_over(task, making)

    def _hand_over(self, task: Task, making: Making) -> None:
        if not making.may_commit():
            raise Cancelled("the job was stopped or taken over; finished stages are kept")
        key = f"{task.file_stem}-{uuid.uuid4().hex}"
        with self._lock:
            self._progress[key] = making.progress
        try:
            future = self._client.submit(
                _on_worker,
                order_of(task, making, self._command),
                self._topic,
                key=key,
                pure=False,
                priority=task.priority,
                resources=self._resources(task, making),
            )
            _raise_error_in(self._wait(future, task, making))
        finally:
            with self._lock:
                del self._progress[key]

    def close(self, logs: Path) -> None:
        """A job has ended; the workers' children wait for those of other jobs."""

    def _resources(self, task: Task, making: Making) -> dict[str, float] | None:
        """What a task takes of a worker; one that wants more than any worker has takes all of one.

        Waits for the first worker: what is handed over before knows no limits, and large tasks would meet.
        """
        while (largest := self._largest_worker(task)) is None:
            if making.cancelled():
                raise Cancelled(STOPPED, hint="run it again to go on")
            making.progress(0, 0, "waiting for a worker")
            time.sleep(_POLL_S)
        return {MEMORY: min(float(task.memory_mb), largest)} if largest else None

    def _largest_worker(self, task: Task) -> float | None:
        """Memory (MB) that the largest worker declares, 0 where none does; None while there is no worker."""
        with self._asking:
            if self._largest is None or time.monotonic() - self._asked > _ASK_AGAIN_S:
                if self._client.status in _LEFT:
                    raise _lost(task)
                try:
                    known = self.workers()
                except OSError as error:
                    raise _lost(task) from error
                self._largest = max((found.get(MEMORY, 0.0) for found in known.values()), default=None)
                self._asked = time.monotonic()
            return self._largest

    def _wait(self, future: Any, task: Task, making: Making) -> dict[str, Any]:
        ended = threading.Event()
        future.add_done_callback(lambda _: ended.set())
        while not ended.wait(_POLL_S):
            if making.cancelled():
                future.cancel()
                raise Cancelled(STOPPED, hint="run it again to go on")
            if self._client.status in _LEFT:
                raise _lost(task)
        if future.status == "finished":
            try:
                return dict(future.result())
            except (
                OSError
            ) as error:  # the task's own errors come as answers: this is the way to the scheduler
                raise _lost(task) from error
        if future.status == "error":
            raise _explained(future.exception(), task, making)
        raise _lost(task)

    def _hear(self, event: Any) -> None:
        message = event[1]
        with self._lock:
            progress = self._progress.get(str(message["key"]))
        if progress is not None:
            progress(int(message["done"]), int(message["total"]), str(message["what"]))


def start_queue(kind: str, workers: int, cores: int, memory_mb: int) -> Any:
    """Start workers through a machine room's queue.

    Args:
        kind: ``slurm`` or ``pbs``. Queue, account and times come from Dask's configuration
            (``~/.config/dask/jobqueue.yaml``).
        workers: How many.
        cores: Threads of each task, and so of each worker.
        memory_mb: Memory of each worker.

    Returns:
        A Dask cluster; a context manager with ``scheduler_address``.

    Raises:
        BodycapError: The extra is not installed, or the queue refuses.
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
        hint = "describe the queue in ~/.config/dask/jobqueue.yaml (see the Dask-Jobqueue documentation)"
        raise JobError(f"{kind}: {error}", field="--executor", hint=hint) from error
    cluster.scale(n=workers)
    return cluster


def _connect(address: str) -> Client:
    try:
        from distributed import Client
    except ImportError as error:
        raise _not_installed() from error
    try:
        # TLS certificates come from Dask's configuration, as does the time to wait for an answer (30 s).
        return Client(address, set_as_default=False)
    except TypeError as error:  # Dask has no SSL context to give
        raise JobError(
            f"no certificates to talk to {address} with",
            field="--executor",
            hint="name them below distributed.comm.tls in ~/.config/dask/distributed.yaml",
        ) from error
    except (OSError, TimeoutError, ValueError) as error:
        raise JobError(
            f"no scheduler answers at {address}",
            field="--executor",
            hint="start one: dask scheduler; and on each machine: dask worker tcp://HOST:8786 --nthreads 1",
        ) from error


def _not_installed() -> JobError:
    hint = "install the extra: pip install 'bodycap_batch[cluster]' (make extras)"
    return JobError("this executor needs Dask, which is not installed", field="--executor", hint=hint)


def _allow_failures(count: int, dask_scheduler: Any = None) -> None:
    """Run on the scheduler."""
    dask_scheduler.allowed_failures = count


def _on_worker(order: Mapping[str, Any], topic: str) -> dict[str, Any]:
    """Run in a thread of a worker."""
    from distributed import get_worker

    worker = get_worker()
    key = worker.get_current_task()

    told = [-math.inf]

    def progress(done: int, total: int, what: str) -> None:
        if (now := time.monotonic()) - told[0] >= _TELL_EVERY_S:
            told[0] = now
            worker.log_event(topic, {"key": key, "done": done, "total": total, "what": what})

    def cancelled() -> bool:
        # A task nobody waits for any more: its client is gone or has cancelled it, or the scheduler is gone.
        known = worker.state.tasks.get(key)
        return known is None or known.state == "cancelled" or worker.status.name in _ENDING

    # Threads of all tasks of this worker together: no more than it has cores.
    threads = min(order["task"]["threads"], max(1, (os.cpu_count() or 1) // worker.state.nthreads))
    return perform({**order, "task": {**order["task"], "threads": threads}}, progress, cancelled)


def _raise_error_in(answer: Mapping[str, Any]) -> None:
    if "error" in answer:
        error = error_from_dict(answer["error"])
        for note in answer.get("notes", []):
            error.add_note(note)
        raise error


def _explained(failure: BaseException, task: Task, making: Making) -> BodycapError:
    """What Dask itself has to say of a task; what the task says comes as an answer."""
    from distributed import KilledWorker

    log = making.logs / f"{task.file_stem}.log"
    if isinstance(failure, KilledWorker):
        return BodycapError(
            f"{task.label}: {_ALLOWED_FAILURES + 1} workers died while they worked on it",
            path=log,
            hint="probably out of memory: give workers more, or lower work_px in the job",
        )
    hint = "install the same bodycap_batch on the scheduler and all workers"
    return BodycapError(f"{task.label}: {type(failure).__name__}: {failure}", path=log, hint=hint)


def _lost(task: Task) -> BodycapError:
    return BodycapError(
        f"{task.label}: the scheduler was lost",
        hint="start it again, and the same batch: finished stages are kept",
    )
