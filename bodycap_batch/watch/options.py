"""What an operator sets for a watched folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from bodycap_batch.runner import CHILD_COMMAND
from bodycap_batch.watch.intake import Terms

_BEAT_S = 5.0
_BEATS = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class WatchOptions:
    """How a folder is watched; nothing here changes a result.

    Attributes:
        terms: What a job may name, and how large it may be.
        store: Where artefacts are kept; None for ``.store`` beside the folders of the spool.
        jobs: Jobs worked on side by side.
        threads: Cores to keep busy, shared by these jobs.
        settle_s: How long a drop must stay as it is before it counts as complete.
        stale_s: How long another watcher's heartbeat may stand still before its jobs are taken over.
        poll: Look for changes by polling (network disks tell none); None: find out.
        once: Leave when nothing is left to do.
        command: The children's command line.
    """

    terms: Terms = field(default_factory=Terms)
    store: Path | None = None
    jobs: int = 1
    threads: int = 1
    settle_s: float = 10.0
    stale_s: float = 60.0
    poll: bool | None = None
    once: bool = False
    command: Sequence[str] = CHILD_COMMAND

    @property
    def beat_s(self) -> float:
        """Time between two heartbeats: one that is late does not make a job look abandoned."""
        return min(_BEAT_S, self.stale_s / _BEATS)
