"""The resources and callbacks that a stage may use in addition to its inputs and options.

These resources and callbacks never affect a result. Therefore the key of a stored result does not contain
them.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from bodycap_batch.core.errors import Cancelled


def _no_progress(done: int, total: int, what: str = "") -> None:
    """Do nothing. This is the progress callback of a stage whose progress is not shown."""


def _not_cancelled() -> bool:
    return False


@dataclass(frozen=True, slots=True, kw_only=True)
class StageContext:
    """What a stage may use while it runs: a temporary folder, threads, and callbacks.

    Attributes:
        work_dir: Folder for temporary files. Only this run uses the folder.
        threads: Maximum number of threads that the stage may use.
        progress: Callback ``progress(done, total, what)``. `done` and `total` are numbers of units, and
            `what` is the name of the unit, for example ``frames``.
        cancelled: Callback that returns True if the stage should stop.
    """

    work_dir: Path
    threads: int = 1
    progress: Callable[[int, int, str], None] = field(default=_no_progress)
    cancelled: Callable[[], bool] = field(default=_not_cancelled)

    def check_cancelled(self) -> None:
        """Raise `Cancelled` if the stage should stop. Long loops call this method at every step."""
        if self.cancelled():
            raise Cancelled("stopped on request")


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
