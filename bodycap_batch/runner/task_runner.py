"""The parent process: look up a task's artefact in the store; if it is missing, have it computed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bodycap_batch.core.errors import BodycapError, Cancelled, StoreError
from bodycap_batch.core.progress import Event, Listener
from bodycap_batch.runner.child_pool import NOTHING_TO_LOAD, Executor, Preload, TaskEnvironment
from bodycap_batch.runner.task import Task
from bodycap_batch.runner.turns import turn
from bodycap_batch.store.artefacts import Artefact, Store

_HINT = (
    "run the job (`bodycap run`); if the job was run before, `bodycap why` shows what has changed since then"
)


class NotStored(StoreError):
    """Error: an artefact is not stored, and the runner's rules do not permit its computation.

    Attributes:
        tasks: The tasks that would compute the missing artefacts.
    """

    def __init__(self, tasks: Sequence[Task], path: Path) -> None:
        labels = ", ".join(task.label for task in tasks)
        super().__init__(f"these stages have not been computed yet: {labels}", path=path, hint=_HINT)
        self.tasks = tuple(tasks)


def allow(task: Task) -> None:
    """Do nothing: the default of `Rules.before`, which allows every task."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rules:
    """Rules for a runner: what it may compute, and the functions that it calls to decide.

    Attributes:
        cancelled: Called several times a second; True stops the running tasks.
        before: Called before a task runs; may raise an error to forbid the task.
        compute: If False, only stored artefacts are returned; `NotStored` is raised for a missing artefact.
        redo: Names of the stages that are computed again even if their artefacts are stored.
        memory_mb: Memory limit (MB) of one task; None for four fifths of the machine's memory.
    """

    cancelled: Callable[[], bool]
    before: Callable[[Task], None] = allow
    compute: bool = True
    redo: frozenset[str] = frozenset()
    memory_mb: int | None = None


class Runner:
    """Finds or computes the artefacts of one job. Several threads may use it at the same time.

    Args:
        store: The store of the artefacts.
        executor: Computes the artefacts that are not stored.
        logs: Folder for the log file and the task file of each task.
        listener: Receives the events of all tasks.
        rules: Rules for the runner: what it may compute, and the functions that it calls.
    """

    def __init__(
        self, store: Store, executor: Executor, *, logs: Path, listener: Listener, rules: Rules
    ) -> None:
        self.store = store
        self._executor = executor
        self._logs = logs
        self._listener = listener
        self._rules = rules

    def __enter__(self) -> Runner:
        """Return the runner itself."""
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release what the executor holds for this job."""
        self._executor.close(self._logs)

    def run(self, task: Task, preload: Preload = NOTHING_TO_LOAD) -> tuple[Artefact, bool]:
        """Return the task's artefact, and True if it was computed now or False if it was stored.

        Args:
            task: The task.
            preload: Modules that idle children load while the task runs.

        Raises:
            BodycapError: The error of the task; `StoreError` if the disk fails; `Cancelled` if the task is
                stopped; `NotStored` if the artefact is missing and may not be computed.
        """
        redo = task.key.stage in self._rules.redo
        if not redo and (found := self.store.find(task.key)) is not None:
            self._notify(task, "reused")
            return found, False
        if not self._rules.compute:
            raise NotStored([task], self.store.root)
        self._rules.before(task)
        self._notify(task, "started")
        try:
            artefact = self._compute(task, preload)
        except BodycapError as error:
            self.store.sweep()
            self._notify(task, "stopped" if isinstance(error, Cancelled) else "failed")
            raise
        self._notify(task, "finished", seconds=float(artefact.made["seconds"]))
        return artefact, True

    def _compute(self, task: Task, preload: Preload) -> Artefact:
        environment = TaskEnvironment(
            store=self.store,
            logs=self._logs,
            progress=lambda done, total, what: self._notify(
                task, "progress", done=done, total=total, what=what
            ),
            cancelled=self._rules.cancelled,
            preload=preload,
            memory_mb=self._rules.memory_mb,
        )
        task = replace(task, replaces=task.key.stage in self._rules.redo)
        with turn(task, environment) as is_stored:
            if not is_stored:
                self._executor.execute(task, environment)
        if (artefact := self.store.find(task.key)) is None:
            raise StoreError(
                f"{task.label}: the stored result of this stage is missing",
                path=self.store.root,
                hint="run the job again",
            )
        return artefact

    def _notify(self, task: Task, kind: Any, **values: Any) -> None:
        self._listener(Event(kind=kind, stage=task.key.stage, camera=task.camera, round=task.round, **values))
