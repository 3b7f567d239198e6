"""How a job runs, and the record of each of its tasks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from bodycap_batch.config.limits import Limits
from bodycap_batch.core.errors import Cancelled
from bodycap_batch.core.progress import Listener
from bodycap_batch.runner import CHILD_COMMAND, Children, Executor, Rules, Runner, Task
from bodycap_batch.runner.parent import allow, always
from bodycap_batch.runner.turns import Turns, TurnTakingExecutor
from bodycap_batch.store.artefacts import Store


def _never() -> bool:
    return False


def _ignore(_: Path) -> None:
    """Ignore early results: the caller waits for all of them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """How a job runs; nothing here changes a result.

    Attributes:
        store: Where artefacts are stored.
        threads: Number of cores that the job may keep busy; with an `executor`, each of its tasks.
        listener: Receives the events of the job.
        cancelled: Called several times a second; True stops the job.
        may_commit: Called before each artefact is committed and before results are published. False stops the
            job, because it belongs to another process now.
        command: Command line of the children.
        executor: Runs the tasks of several jobs, here or elsewhere; default: this job's own children.
        compute: If False, only stored artefacts are used, and `NotStored` is raised for others.
        redo: Stages that are computed again although they are stored.
        until: Last stage to run; results are written only after the last stage of all. "" runs all stages.
        priority: Of waiting jobs, those of a higher priority come first.
        results_ready: Called with the folder of results that are published before their video.
        limits: How large the videos may be; None for the user's own videos.
        turns: Artefacts that other jobs of this process are computing; None if there are no other jobs.
    """

    store: Store
    threads: int
    listener: Listener
    cancelled: Callable[[], bool]
    may_commit: Callable[[], bool] = always
    command: Sequence[str] = CHILD_COMMAND
    executor: Executor | None = None
    compute: bool = True
    redo: frozenset[str] = frozenset()
    until: str = ""
    priority: int = 0
    results_ready: Callable[[Path], None] = _ignore
    limits: Limits | None = None
    turns: Turns | None = None

    def runner(
        self, logs: Path, stop_also: Callable[[], bool] = _never, before: Callable[[Task], None] = allow
    ) -> Runner:
        """Return a runner that stops if the user asks for it, or if `stop_also` returns True.

        Args:
            logs: Folder of the children's logs.
            stop_also: Another reason to stop.
            before: Called before a task runs; may raise to forbid it.
        """
        executor = self.executor or Children(self.command)
        return Runner(
            self.store,
            executor if self.turns is None else TurnTakingExecutor(executor, self.turns),
            logs=logs,
            listener=self.listener,
            rules=Rules(
                cancelled=lambda: self.cancelled() or stop_also(),
                may_commit=self.may_commit,
                before=before,
                compute=self.compute,
                redo=self.redo,
            ),
        )

    def require_owner(self) -> None:
        """Raise `Cancelled` if the job belongs to another process now."""
        if not self.may_commit():
            raise Cancelled("the job was stopped or taken over; finished stages are kept")


@dataclass(frozen=True, slots=True, kw_only=True)
class StageRecord:
    """One task of a run, and what it cost when it was computed.

    Attributes:
        stage: Stage name.
        camera: Camera name, or "".
        round: Round of the map, from 0.
        reused: True if it was computed in an earlier run.
        seconds: Its duration.
        cpu_seconds: Processor time of all its threads; None if it was computed by a version without it.
        peak_memory_mb: Peak memory of its process.
        artefact: Folder of its artefact, relative to the store.
    """

    stage: str
    camera: str
    round: int
    reused: bool
    seconds: float
    cpu_seconds: float | None
    peak_memory_mb: float
    artefact: str
