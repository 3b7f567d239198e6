"""The options that an operator sets for a watched folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from bodycap_batch.runner import CHILD_COMMAND
from bodycap_batch.watch.dropped_job import JobPermissions


@dataclass(frozen=True, slots=True, kw_only=True)
class WatchOptions:
    """Options of a watcher. The options do not change the results of a job.

    Attributes:
        permissions: Which folders a job may read, and the maximum size of a job.
        store: Folder of the artefacts; None for the folder ``.store`` beside `running`.
        jobs: Maximum number of jobs that run at the same time.
        threads: Number of processor cores that all running jobs share.
        memory_mb: Memory limit (MB) of one task; None for four fifths of the machine's memory.
        unchanged_s: Time (seconds) for which an entry must not change before it is treated as complete.
        retry_s: Time (seconds) until a job or an entry that a disk failure stopped is tried again. With
            `once`, also the maximum time for which the watcher waits for a missing disk.
        require: What the results of jobs that state no requirement must reach, such as ``good,0.9``.
        once: True: stop when nothing is left to do.
        command: Command line that starts the child process of a job.
    """

    permissions: JobPermissions = field(default_factory=JobPermissions)
    store: Path | None = None
    jobs: int = 1
    threads: int = 1
    memory_mb: int | None = None
    unchanged_s: float = 10.0
    retry_s: float = 60.0
    require: str | None = None
    once: bool = False
    command: Sequence[str] = CHILD_COMMAND
