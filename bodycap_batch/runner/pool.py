"""The children of one machine, shared by several jobs: as many tasks at once as it has cores and memory."""

from __future__ import annotations

import heapq
import itertools
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from bodycap_batch.core.errors import Cancelled
from bodycap_batch.runner.children import STOPPED, Children, Making
from bodycap_batch.runner.process import CHILD
from bodycap_batch.runner.task import Task
from bodycap_batch.runner.turns import Turns

_POLL_S = 0.1


class Slots:
    """Cores and memory that tasks take and give back; the task of highest priority first.

    A task that wants more than there is gets all there is, and so runs alone.

    Args:
        cores: Threads that may be busy at once.
        memory_mb: Memory that tasks may declare at once.
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
        """Hold what a task needs; waits for it. Raises `Cancelled` when stopped while waiting."""
        need = (min(max(1, task.threads), self.cores), min(task.memory_mb, self.memory_mb))
        self._take(need, task.priority, cancelled)
        try:
            yield
        finally:
            with self._changed:
                self._free = (self._free[0] + need[0], self._free[1] + need[1])
                self._changed.notify_all()

    def _take(self, need: tuple[int, int], priority: int, cancelled: Callable[[], bool]) -> None:
        place = (-priority, next(self._count))
        with self._changed:
            heapq.heappush(self._waiting, place)
            try:
                # Strictly in order: a large task that waits is not passed by small ones for ever.
                while self._waiting[0] != place or not self._fits(need):
                    self._changed.wait(_POLL_S)
                    if cancelled():
                        raise Cancelled(STOPPED, hint="run it again to go on")
                self._free = (self._free[0] - need[0], self._free[1] - need[1])
            finally:
                self._waiting.remove(place)
                heapq.heapify(self._waiting)
                self._changed.notify_all()

    def _fits(self, need: tuple[int, int]) -> bool:
        return need[0] <= self._free[0] and need[1] <= self._free[1]


class LocalPool:
    """Makes the tasks of several jobs in children of this machine.

    Args:
        cores: Threads that may be busy at once.
        memory_mb: Memory the tasks may declare together; default: four fifths of the machine's.
        command: The children's command line.
    """

    def __init__(self, cores: int, memory_mb: int | None = None, command: Sequence[str] = CHILD) -> None:
        self.slots = Slots(cores, memory_mb or machine_memory_mb() * 4 // 5)
        self._children = Children(command)
        self._logs: set[Path] = set()
        self._turns = Turns()

    def make(self, task: Task, making: Making) -> None:
        """Make and commit the task's artefact when there is room for it. Raises `BodycapError`."""
        with self._turns.taken(task, making) as made:
            if made:
                return
            with self.slots.taken(task, making.cancelled):
                self._logs.add(making.logs)
                self._children.make(task, replace(making, meanwhile=()))

    def close(self, logs: Path) -> None:
        """A job has ended; its children wait for those of other jobs."""

    def shutdown(self) -> None:
        """End all children."""
        for logs in self._logs or {Path()}:
            self._children.close(logs)


def machine_memory_mb() -> int:
    """Memory of this machine."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") >> 20
