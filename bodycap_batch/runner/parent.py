"""The parent's side: look a task's artefact up, else have it made."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bodycap_batch.core.errors import BodycapError, Cancelled, StoreError
from bodycap_batch.core.progress import Event, Listener
from bodycap_batch.runner.children import Executor, Making
from bodycap_batch.runner.task import Task
from bodycap_batch.store.artefacts import Artefact, Store

_HINT = (
    "run the job first (`bodycap run`); where it was run before, `bodycap why` tells what has changed since"
)


class NotStored(StoreError):
    """An artefact would have to be made, which was not wanted.

    Attributes:
        tasks: What would have to be run.
    """

    def __init__(self, tasks: Sequence[Task], path: Path) -> None:
        labels = ", ".join(task.label for task in tasks)
        super().__init__(f"{labels}: not computed yet", path=path, hint=_HINT)
        self.tasks = tuple(tasks)


def always() -> bool:
    """Forbid nothing."""
    return True


def allow(task: Task) -> None:
    """Let every task be made."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rules:
    """What a runner may do, and when it asks.

    Attributes:
        cancelled: Asked several times a second whether to stop.
        may_commit: Asked before an artefact is committed; False stops the work.
        before: Called before a task is made; may raise to forbid it.
        compute: False: only what is stored is given, `NotStored` raised for the rest.
        redo: Stages that are made anew although they are stored.
    """

    cancelled: Callable[[], bool]
    may_commit: Callable[[], bool] = always
    before: Callable[[Task], None] = allow
    compute: bool = True
    redo: frozenset[str] = frozenset()


class Runner:
    """Finds or makes the artefacts of one job; safe to be used from several threads.

    Args:
        store: Where artefacts are kept.
        executor: Makes what is not there.
        logs: Folder for one log file and one task file per task.
        listener: Told what happens.
        rules: What may be done.
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
        """The runner itself."""
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the children that wait for work."""
        self._executor.close(self._logs)

    def run(self, task: Task, meanwhile: Sequence[Sequence[str]] = ()) -> tuple[Artefact, bool]:
        """Return the task's artefact and whether it had to be made.

        Args:
            task: What to make.
            meanwhile: If it has to be made, what other children load at the same time (see `Making`).

        Raises:
            BodycapError: What the child reported, `StoreError` for the disk, `Cancelled` when stopped,
                `NotStored` where nothing may be computed.
        """
        again = task.key.stage in self._rules.redo
        if not again and (found := self.store.find(task.key)) is not None:
            self._tell(task, "reused")
            return found, False
        if not self._rules.compute:
            raise NotStored([task], self.store.root)
        self._rules.before(task)
        self._tell(task, "started")
        try:
            artefact = self._make(task, meanwhile)
        except BodycapError as error:
            self.store.sweep()
            self._tell(task, "stopped" if isinstance(error, Cancelled) else "failed")
            raise
        self._tell(task, "finished", seconds=float(artefact.made["seconds"]))
        return artefact, True

    def _make(self, task: Task, meanwhile: Sequence[Sequence[str]]) -> Artefact:
        making = Making(
            store=self.store,
            logs=self._logs,
            progress=lambda done, total, what: self._tell(
                task, "progress", done=done, total=total, what=what
            ),
            cancelled=self._rules.cancelled,
            may_commit=self._rules.may_commit,
            meanwhile=meanwhile,
        )
        self._executor.make(replace(task, replaces=task.key.stage in self._rules.redo), making)
        if (artefact := self.store.find(task.key)) is None:
            raise StoreError(f"{task.label}: its result is gone", path=self.store.root, hint="run it again")
        return artefact

    def _tell(self, task: Task, kind: Any, **values: Any) -> None:
        self._listener(Event(kind=kind, stage=task.key.stage, camera=task.camera, round=task.round, **values))
