"""Options that an operator sets for a watched folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from bodycap_batch.runner import CHILD_COMMAND
from bodycap_batch.watch.dropped_job import JobPermissions

_MAX_HEARTBEAT_S = 5.0
"""Longest time between two heartbeats, seconds. Evidence: none."""
_HEARTBEATS_PER_TIMEOUT = 4
"""Heartbeats within `stale_s`, so that one late heartbeat does not make a job look abandoned. Evidence: none.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class WatchOptions:
    """How a folder is watched. No option changes a result.

    Attributes:
        permissions: What a job may name, and how large it may be.
        store: Folder of the artefacts; None for ``.store`` beside the folders of the spool.
        jobs: Number of jobs that run at the same time.
        threads: Cores to use, shared by these jobs.
        unchanged_s: Seconds for which an entry must not change before it counts as complete.
        stale_s: Seconds without a heartbeat of another watcher after which its jobs are taken over.
        poll: True to poll for changes, as network disks need; None to poll network disks only.
        once: Stop when nothing is left to do.
        command: Command line of the child processes.
    """

    permissions: JobPermissions = field(default_factory=JobPermissions)
    store: Path | None = None
    jobs: int = 1
    threads: int = 1
    unchanged_s: float = 10.0
    stale_s: float = 60.0
    poll: bool | None = None
    once: bool = False
    command: Sequence[str] = CHILD_COMMAND

    @property
    def heartbeat_period_s(self) -> float:
        """Seconds between two heartbeats."""
        return min(_MAX_HEARTBEAT_S, self.stale_s / _HEARTBEATS_PER_TIMEOUT)
