"""That a watcher is at work, and what holds it up: a small file in `running`, for `bodycap status`."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bodycap_batch.store.digests import write_atomically
from bodycap_batch.watch.claim import is_at_work, is_of_this_machine, process_mark
from bodycap_batch.watch.spool import Spool
from bodycap_batch.watch.status import time_text

_PREFIX, _SUFFIX = ".watcher-", ".json"
_FORGOTTEN_S = 86_400.0
"""A watcher of another machine that was killed cannot be told from a silent one; after a day nobody asks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Watching:
    """A watcher as others see it.

    Attributes:
        host: Its machine.
        pid: Its process there.
        since: When it was started, UTC.
        seen: Its last sign of life by its own clock, UTC; "" for a process of this machine: it is running.
        trouble: What keeps it from its folders; "" where nothing does.
    """

    host: str
    pid: int
    since: str
    seen: str = ""
    trouble: str = ""

    def to_dict(self) -> dict[str, Any]:
        """The watcher as plain JSON values."""
        return asdict(self)

    def __str__(self) -> str:
        sign = f", last sign {self.seen}" if self.seen else ""
        held_up = f", held up: {self.trouble}" if self.trouble else ""
        return f"watched by {self.host} (process {self.pid}) since {self.since}{sign}{held_up}"


class Presence:
    """This watcher's file; what cannot be written is not: the disk may be the trouble.

    Args:
        spool: The folders it watches.
    """

    def __init__(self, spool: Spool) -> None:
        self._path = spool.running / f"{_PREFIX}{process_mark()}-{id(self):x}{_SUFFIX}"
        self._since = time_text()

    def tell(self, trouble: str) -> None:
        """Say that it is at work, and what is wrong."""
        document = {
            "host": socket.gethostname(),
            "pid": os.getpid(),
            "since": self._since,
            "seen": time_text(),
            "trouble": trouble,
        }
        with contextlib.suppress(OSError):
            write_atomically(self._path, (json.dumps(document, indent=1) + "\n").encode())

    def end(self) -> None:
        """It is at work no more; what killed watchers of this machine left goes with it."""
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)
            for path in self._path.parent.glob(f"{_PREFIX}*{_SUFFIX}"):
                if _is_left_over(path):
                    path.unlink(missing_ok=True)


def watchers_of(spool: Spool) -> list[Watching]:
    """The watchers of a spool that are at work, as far as can be told from here."""
    paths = sorted(spool.running.glob(f"{_PREFIX}*{_SUFFIX}"))
    found = (_read(path) for path in paths if not _is_left_over(path))
    return [watching for watching in found if watching is not None]


def _is_left_over(path: Path) -> bool:
    marked = path.name.removeprefix(_PREFIX)
    if is_of_this_machine(marked):
        return not is_at_work(marked)
    try:
        return time.time() - path.stat().st_mtime > _FORGOTTEN_S
    except OSError:
        return False


def _read(path: Path) -> Watching | None:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        here = is_of_this_machine(path.name.removeprefix(_PREFIX))
        seen = "" if here else str(found["seen"])
        return Watching(
            host=str(found["host"]),
            pid=int(found["pid"]),
            since=str(found["since"]),
            seen=seen,
            trouble=str(found["trouble"]),
        )
    except (OSError, ValueError, KeyError, TypeError):
        return None
