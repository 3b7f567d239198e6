"""What a stage may use besides its inputs; no part of any result's identity."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from bodycap_batch.core.errors import Cancelled

THREADS_VARIABLE = "BODYCAP_TASK_THREADS"
"""Environment: the threads of the task that this process does, for what sees no `StageContext`."""


def _no_progress(done: int, total: int, what: str = "") -> None:
    """Ignore progress."""


def _not_cancelled() -> bool:
    return False


@dataclass(frozen=True, slots=True, kw_only=True)
class StageContext:
    """Surroundings of one stage.

    Attributes:
        work_dir: Scratch folder of this stage alone.
        threads: Threads the stage may keep busy.
        progress: Called as ``progress(done, total, what)``.
        cancelled: True once the work should stop.
    """

    work_dir: Path
    threads: int = 1
    progress: Callable[[int, int, str], None] = field(default=_no_progress)
    cancelled: Callable[[], bool] = field(default=_not_cancelled)

    def check_cancelled(self) -> None:
        """Raise `Cancelled` once the work should stop."""
        if self.cancelled():
            raise Cancelled("stopped on request")
