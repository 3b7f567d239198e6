"""Compute a task that several jobs need only once: the second job waits, and keeps no worker busy."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bodycap_batch.core.errors import Cancelled
from bodycap_batch.runner.children import STOPPED, Executor, TaskEnvironment
from bodycap_batch.runner.task import Task

_POLL_S = 0.1
"""Time after which a waiting job checks whether it was stopped, seconds. Evidence: none."""


class Turns:
    """The artefacts that are being computed for the jobs of this process."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._under_way: set[tuple[Path, str]] = set()

    @contextmanager
    def taken(self, task: Task, environment: TaskEnvironment) -> Iterator[bool]:
        """Wait until no other job computes the task's artefact; yield True if it is stored then.

        Raises:
            Cancelled: The job was stopped while it waited.
        """
        artefact = (environment.store.root, task.key.name)
        with self._changed:
            while artefact in self._under_way:
                self._changed.wait(_POLL_S)
                if environment.cancelled():
                    raise Cancelled(STOPPED, hint="run it again to go on")
            self._under_way.add(artefact)
        try:
            yield not task.replaces and environment.store.find(task.key) is not None
        finally:
            with self._changed:
                self._under_way.remove(artefact)
                self._changed.notify_all()


class TurnTakingExecutor:
    """An executor of one job that waits for artefacts which other jobs of this process already compute.

    Args:
        executor: Runs the other tasks.
        turns: Shared by the jobs.
    """

    def __init__(self, executor: Executor, turns: Turns) -> None:
        self._executor = executor
        self._turns = turns

    def execute(self, task: Task, environment: TaskEnvironment) -> None:
        """Compute and commit the task's artefact, or wait until another job has. Raises `BodycapError`."""
        with self._turns.taken(task, environment) as is_stored:
            if not is_stored:
                self._executor.execute(task, environment)

    def close(self, logs: Path) -> None:
        """End what the job with these logs needed; the job has ended."""
        self._executor.close(logs)
