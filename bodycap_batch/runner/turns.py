"""Compute a task only once if several jobs need its artefact. One job computes; the other jobs wait."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bodycap_batch.runner.child_pool import Executor, TaskEnvironment, stopped
from bodycap_batch.runner.child_process import POLL_S
from bodycap_batch.runner.task import Task


class Turns:
    """Lets only one job of this process compute an artefact; other jobs that need this artefact wait."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._under_way: set[tuple[Path, str]] = set()

    @contextmanager
    def taken(self, task: Task, environment: TaskEnvironment) -> Iterator[bool]:
        """Wait until no other job computes the task's artefact; then yield whether the artefact is stored.

        If the task must replace its stored artefact, False is yielded although the artefact is stored.

        Raises:
            Cancelled: The job was stopped while it waited.
        """
        artefact = (environment.store.root, task.key.name)
        with self._changed:
            while artefact in self._under_way:
                self._changed.wait(POLL_S)
                if environment.cancelled():
                    raise stopped()
            self._under_way.add(artefact)
        try:
            yield not task.replaces and environment.store.find(task.key) is not None
        finally:
            with self._changed:
                self._under_way.remove(artefact)
                self._changed.notify_all()


class TurnTakingExecutor:
    """The executor of one job; it waits for artefacts that other jobs of this process are computing.

    Args:
        executor: The executor that computes all other artefacts.
        turns: The artefacts that are being computed; all jobs of the process share this object.
    """

    def __init__(self, executor: Executor, turns: Turns) -> None:
        self._executor = executor
        self._turns = turns

    def execute(self, task: Task, environment: TaskEnvironment) -> None:
        """Compute and commit the task's artefact, or wait for another job to do so. Raises `BodycapError`."""
        with self._turns.taken(task, environment) as is_stored:
            if not is_stored:
                self._executor.execute(task, environment)

    def close(self, logs: Path) -> None:
        """Release the resources of a job that has ended; `logs` is the job's folder of logs."""
        self._executor.close(logs)
