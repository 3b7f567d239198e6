"""Settings for running a job, and the record of each task that the job ran."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from bodycap_batch.config.limits import Limits
from bodycap_batch.config.overrides import Overrides
from bodycap_batch.core.progress import Listener
from bodycap_batch.runner import CHILD_COMMAND, Children, Executor, Rules, Runner, Task
from bodycap_batch.runner.child_pool import stopped
from bodycap_batch.runner.task_runner import allow
from bodycap_batch.store.artefacts import Store


def _never() -> bool:
    return False


def _ignore(_: Path) -> None:
    """Ignore results that are published early: the caller waits for the end of the job."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Settings for running a job. They do not change the results.

    Attributes:
        store: The store of the artefacts.
        threads: Number of cores that all tasks of the job may use together. With an `executor`, each single
            task may use this number of cores.
        listener: Receives the events of the job.
        cancelled: Called several times a second; True stops the job.
        command: Command line of the child processes.
        executor: Runs the tasks of several jobs, on this machine or on other machines. None starts child
            processes for this job only.
        children: Child processes that were started ahead for this job; None to start them with its tasks. Not
            used with an `executor`.
        compute: If False, only stored artefacts are used; `NotStored` is raised for a missing artefact.
        redo: Names of the stages that are computed again even if their artefacts are stored.
        until: Name of the last stage to run; "" runs all stages. Results are published only if the last stage
            of the job runs.
        priority: Priority of the job's tasks; waiting tasks with a higher number run first.
        results_ready: Called with the folder of the results if the results are published before their video
            is ready.
        limits: Maximum sizes of the videos; None (no limits) for a job that the user runs directly.
        memory_mb: Memory limit (MB) of one task; None for four fifths of the machine's memory.
        overrides: Values of the command line, for the record of the run. The next run of the job keeps them.
    """

    store: Store
    threads: int
    listener: Listener
    cancelled: Callable[[], bool]
    command: Sequence[str] = CHILD_COMMAND
    executor: Executor | None = None
    children: Children | None = None
    compute: bool = True
    redo: frozenset[str] = frozenset()
    until: str = ""
    priority: int = 0
    results_ready: Callable[[Path], None] = _ignore
    limits: Limits | None = None
    memory_mb: int | None = None
    overrides: Overrides = field(default_factory=Overrides)

    def runner(
        self, logs: Path, stop_also: Callable[[], bool] = _never, before: Callable[[Task], None] = allow
    ) -> Runner:
        """Return a runner that stops when the user asks for it, or when `stop_also` returns True.

        Args:
            logs: Folder for the logs of the child processes.
            stop_also: Function that returns True if the runner must stop for another reason.
            before: Called before a task runs; may raise an error to forbid the task.
        """
        return Runner(
            self.store,
            self.executor or self.children or Children(self.command),
            logs=logs,
            listener=self.listener,
            rules=Rules(
                cancelled=lambda: self.cancelled() or stop_also(),
                before=before,
                compute=self.compute,
                redo=self.redo,
                memory_mb=self.memory_mb,
            ),
        )

    def raise_if_cancelled(self) -> None:
        """Raise `Cancelled` if the job must stop."""
        if self.cancelled():
            raise stopped()


@dataclass(frozen=True, slots=True, kw_only=True)
class StageRecord:
    """The record of one task: its identity, and the time and memory of its computation.

    Attributes:
        stage: Stage name.
        camera: Name of the camera that the task concerns; "" if it concerns no single camera.
        round: Round of the map, counted from 0.
        reused: True if the artefact was stored already and this run reused it.
        seconds: Duration (seconds) of the computation.
        cpu_seconds: Processor time (seconds) of all threads; None if the task was computed by an old program
            version that did not record this time.
        peak_memory_mb: Peak memory (MB) of the child process.
        artefact: Folder of the artefact, relative to the store.
        acted: How often each mechanism of the bench acted (`bodycap_batch.core.mechanisms`), by name.
    """

    stage: str
    camera: str
    round: int
    reused: bool
    seconds: float
    cpu_seconds: float | None
    peak_memory_mb: float
    artefact: str
    acted: Mapping[str, int] = field(default_factory=dict)
