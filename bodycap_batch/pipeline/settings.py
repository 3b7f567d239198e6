"""How a job is run, and what a run tells of each stage."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from bodycap_batch.config.limits import Limits
from bodycap_batch.core.errors import Cancelled
from bodycap_batch.core.progress import Listener
from bodycap_batch.runner import CHILD, Children, Executor, Rules, Runner, Task
from bodycap_batch.runner.parent import allow, always
from bodycap_batch.runner.turns import TakingTurns, Turns
from bodycap_batch.store.artefacts import Store


def _no() -> bool:
    return False


def _tell_nobody(_: Path) -> None:
    """Whoever asked for the results waits for all of them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """How a job is run; nothing here changes a result.

    Attributes:
        store: Where artefacts are kept.
        threads: Cores the job may keep busy; with an `executor`, those of each of its tasks.
        listener: Told what happens.
        cancelled: Asked several times a second whether to stop.
        may_commit: Asked before each artefact is committed and before results are published; False stops
            the job (it belongs to another process now).
        command: The children's command line.
        executor: Makes the tasks of several jobs, here or elsewhere; default: this job's own children.
        compute: False: only what is stored is used, `NotStored` raised where something is not.
        redo: Stages that are computed anew although they are stored.
        until: Last stage to run; no results are written before the last. "" runs all.
        priority: Higher goes first where several jobs wait.
        results_ready: Called with the folder of the results where they are there before their video.
        limits: How large the videos may be; None where they are the user's own.
        turns: What other jobs of this process are making; None where there are none.
    """

    store: Store
    threads: int
    listener: Listener
    cancelled: Callable[[], bool]
    may_commit: Callable[[], bool] = always
    command: Sequence[str] = CHILD
    executor: Executor | None = None
    compute: bool = True
    redo: frozenset[str] = frozenset()
    until: str = ""
    priority: int = 0
    results_ready: Callable[[Path], None] = _tell_nobody
    limits: Limits | None = None
    turns: Turns | None = None

    def runner(
        self, logs: Path, also: Callable[[], bool] = _no, before: Callable[[Task], None] = allow
    ) -> Runner:
        """A runner that stops when the user asks for it, or when `also` says so.

        Args:
            logs: Folder of the children's logs.
            also: Another reason to stop.
            before: Called before a task is made; may raise to forbid it.
        """
        executor = self.executor or Children(self.command)
        return Runner(
            self.store,
            executor if self.turns is None else TakingTurns(executor, self.turns),
            logs=logs,
            listener=self.listener,
            rules=Rules(
                cancelled=lambda: self.cancelled() or also(),
                may_commit=self.may_commit,
                before=before,
                compute=self.compute,
                redo=self.redo,
            ),
        )

    def require_owner(self) -> None:
        """Raise `Cancelled` where the job belongs to another process now."""
        if not self.may_commit():
            raise Cancelled("the job was stopped or taken over; finished stages are kept")


@dataclass(frozen=True, slots=True, kw_only=True)
class StageRecord:
    """One stage of a run: what it cost when it was computed, and whether that was now.

    Attributes:
        cpu_seconds: Processor seconds of all its threads; None where an earlier version did not count them.
        artefact: Its folder in the store, relative to the store.
    """

    stage: str
    camera: str
    round: int
    reused: bool
    seconds: float
    cpu_seconds: float | None
    peak_memory_mb: float
    artefact: str
