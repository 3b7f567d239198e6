"""The child processes of one machine, which several jobs share.

The machine's cores and memory limit the tasks that run at the same time.
"""

from __future__ import annotations

import heapq
import itertools
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from bodycap_batch.runner.child_pool import NOTHING_TO_LOAD, Children, TaskEnvironment, stopped
from bodycap_batch.runner.child_process import CHILD_COMMAND, POLL_S
from bodycap_batch.runner.memory_limit import default_limit_mb
from bodycap_batch.runner.task import Task


class Slots:
    """Cores and memory of one machine. Tasks reserve both in the order of their priority.

    If a task needs more than the machine has, the task reserves everything and therefore runs alone.

    Args:
        cores: Maximum number of threads of all running tasks.
        memory_mb: Maximum memory (MB) of all running tasks, as declared by the tasks.
    """

    def __init__(self, cores: int, memory_mb: int) -> None:
        self.cores = cores
        self.memory_mb = memory_mb
        self._free = (cores, memory_mb)
        self._changed = threading.Condition()
        self._waiting: list[tuple[int, int]] = []
        self._count = itertools.count()

    @contextmanager
    def taken(self, task: Task, cancelled: Callable[[], bool]) -> Iterator[None]:
        """Reserve a task's cores and memory when they are free. Raises `Cancelled` if the task is stopped."""
        need = (min(max(1, task.threads), self.cores), min(task.memory_mb, self.memory_mb))
        self._take(need, task.priority, cancelled)
        try:
            yield
        finally:
            with self._changed:
                self._free = (self._free[0] + need[0], self._free[1] + need[1])
                self._changed.notify_all()

    def _take(self, need: tuple[int, int], priority: int, cancelled: Callable[[], bool]) -> None:
        position = (-priority, next(self._count))
        with self._changed:
            heapq.heappush(self._waiting, position)
            try:
                # Only the first task in the order may start: otherwise small tasks could overtake a large
                # task again and again.
                while self._waiting[0] != position or not self._fits(need):
                    self._changed.wait(POLL_S)
                    if cancelled():
                        raise stopped()
                self._free = (self._free[0] - need[0], self._free[1] - need[1])
            finally:
                self._waiting.remove(position)
                heapq.heapify(self._waiting)
                self._changed.notify_all()

    def _fits(self, need: tuple[int, int]) -> bool:
        return need[0] <= self._free[0] and need[1] <= self._free[1]


class LocalPool:
    """Runs the tasks of several jobs in child processes of this machine.

    Args:
        cores: Maximum number of threads of all running tasks.
        memory_mb: Maximum memory (MB) of all running tasks, as declared by the tasks. None to use four fifths
            of the machine's memory.
        command: Command line of the child processes.
    """

    def __init__(
        self, cores: int, memory_mb: int | None = None, command: Sequence[str] = CHILD_COMMAND
    ) -> None:
        self.slots = Slots(cores, memory_mb or default_limit_mb())
        self._children = Children(command)
        self._logs: set[Path] = set()

    def execute(self, task: Task, environment: TaskEnvironment) -> None:
        """Wait for cores and memory; compute and commit the task's artefact. Raises `BodycapError`."""
        with self.slots.taken(task, environment.cancelled):
            self._logs.add(environment.logs)
            self._children.execute(task, replace(environment, preload=NOTHING_TO_LOAD))

    def close(self, logs: Path) -> None:
        """Do nothing: the child processes are kept for other jobs."""

    def shutdown(self) -> None:
        """End all child processes."""
        for logs in self._logs or {Path()}:
            self._children.close(logs)
