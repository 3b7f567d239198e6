"""Compute an artefact only once if several jobs of this process need it: one computes, the others wait."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bodycap_batch.runner.child_pool import TaskEnvironment, stopped
from bodycap_batch.runner.child_process import POLL_S
from bodycap_batch.runner.task import Task

_changed = threading.Condition()
_under_way: set[tuple[Path, str]] = set()
"""The store and the key of each artefact that a job of this process computes."""


@contextmanager
def turn(task: Task, environment: TaskEnvironment) -> Iterator[bool]:
    """Wait until no other job computes the task's artefact; then yield whether the artefact is stored.

    If the task must replace its stored artefact, False is yielded although the artefact is stored.

    Raises:
        Cancelled: The job was stopped while it waited.
    """
    artefact = (environment.store.root, task.key.name)
    with _changed:
        while artefact in _under_way:
            _changed.wait(POLL_S)
            if environment.cancelled():
                raise stopped()
        _under_way.add(artefact)
    try:
        yield not task.replaces and environment.store.find(task.key) is not None
    finally:
        with _changed:
            _under_way.remove(artefact)
            _changed.notify_all()
