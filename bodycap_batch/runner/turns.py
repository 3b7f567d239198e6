"""What several jobs need is made once: whoever comes second waits for it, and keeps no worker busy."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bodycap_batch.core.errors import Cancelled
from bodycap_batch.runner.children import STOPPED, Executor, Making
from bodycap_batch.runner.task import Task

_POLL_S = 0.1


class Turns:
    """The artefacts that are being made for the jobs of this process."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._under_way: set[tuple[Path, str]] = set()

    @contextmanager
    def taken(self, task: Task, making: Making) -> Iterator[bool]:
        """Wait until no other job makes the task's artefact; yields whether one has.

        Raises:
            Cancelled: The job was stopped while it waited.
        """
        place = (making.store.root, task.key.name)
        with self._changed:
            while place in self._under_way:
                self._changed.wait(_POLL_S)
                if making.cancelled():
                    raise Cancelled(STOPPED, hint="run it again to go on")
            self._under_way.add(place)
        try:
            yield not task.replaces and making.store.find(task.key) is not None
        finally:
            with self._changed:
                self._under_way.remove(place)
                self._changed.notify_all()


class TakingTurns:
    """An executor of one job that leaves to others of this process what they are making already.

    Args:
        executor: Makes what nobody else does.
        turns: Shared by the jobs.
    """

    def __init__(self, executor: Executor, turns: Turns) -> None:
        self._executor = executor
        self._turns = turns

    def make(self, task: Task, making: Making) -> None:
        """Make and commit the task's artefact, or wait until another job has. Raises `BodycapError`."""
        with self._turns.taken(task, making) as made:
            if not made:
                self._executor.make(task, making)

    def close(self, logs: Path) -> None:
        """The job with these logs has ended."""
        self._executor.close(logs)
