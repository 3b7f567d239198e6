"""Show which watchers run, and which of them cannot access their folders.

Each watcher writes a small file in `running`. `bodycap status` reads these files.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bodycap_batch.store.checked_json import checked_json, parse_checked_json
from bodycap_batch.store.digests import write_atomically
from bodycap_batch.watch.job_status import utc_text
from bodycap_batch.watch.process_identity import is_from_this_machine, is_process_running, process_tag
from bodycap_batch.watch.spool import Spool

_PREFIX, _SUFFIX = ".watcher-", ".json"
_MAX_SILENCE_S = 86_400.0
"""Maximum age (seconds) of the status file of a watcher on another machine: one day. A watcher with an older
file is not listed, because this machine cannot check whether that watcher still runs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WatcherStatus:
    """The status of a watcher, as other processes can read it.

    Attributes:
        host: Name of the watcher's machine.
        pid: Process number of the watcher on its machine.
        since: Start time of the watcher, UTC.
        seen: Time of the last update by the watcher's own clock, UTC. It is "" for a watcher of this machine,
            because this machine can check whether the watcher runs.
        trouble: Why the watcher cannot access its folders; "" if it can access them.
    """

    host: str
    pid: int
    since: str
    seen: str = ""
    trouble: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return the watcher as plain JSON values."""
        return asdict(self)

    def __str__(self) -> str:
        seen = f", last seen {self.seen}" if self.seen else ""
        trouble = f", cannot continue: {self.trouble}" if self.trouble else ""
        return f"watched by {self.host} (process {self.pid}) since {self.since}{seen}{trouble}"


class WatcherStatusFile:
    """Write the status file of this watcher, so that other processes can see that the watcher runs.

    Write errors are ignored. Their cause may be the disk failure that the file should report.

    Args:
        spool: The folders of the watcher.
    """

    def __init__(self, spool: Spool) -> None:
        self._path = spool.running / f"{_PREFIX}{process_tag()}-{id(self):x}{_SUFFIX}"
        self._since = utc_text()

    def write(self, trouble: str) -> None:
        """Record that the watcher runs, and why it cannot access its folders ("" if it can access them)."""
        document = {
            "host": socket.gethostname(),
            "pid": os.getpid(),
            "since": self._since,
            "seen": utc_text(),
            "trouble": trouble,
        }
        with contextlib.suppress(OSError):
            write_atomically(self._path, checked_json(document).encode())

    def remove(self) -> None:
        """Remove the file of this watcher, and the files of watchers that are no longer active."""
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)
            for path in self._path.parent.glob(f"{_PREFIX}*{_SUFFIX}"):
                if _is_abandoned(path):
                    path.unlink(missing_ok=True)


def active_watchers(spool: Spool) -> list[WatcherStatus]:
    """Return the running watchers of a spool.

    A watcher of another machine is treated as running if its file was updated within the last
    `_MAX_SILENCE_S` seconds.
    """
    paths = sorted(spool.running.glob(f"{_PREFIX}*{_SUFFIX}"))
    found = (_read_watcher_status(path) for path in paths if not _is_abandoned(path))
    return [watching for watching in found if watching is not None]


def _is_abandoned(path: Path) -> bool:
    """Return True if the watcher of a status file has ended, or has not updated the file for too long."""
    tag = path.name.removeprefix(_PREFIX)
    if is_from_this_machine(tag):
        return not is_process_running(tag)
    try:
        return time.time() - path.stat().st_mtime > _MAX_SILENCE_S
    except OSError:
        return False


def _read_watcher_status(path: Path) -> WatcherStatus | None:
    """Return the content of a watcher's file.

    If the file is damaged, return what the file's name states. Return None if the file cannot be read, or if
    its name is not that of a watcher's file.
    """
    here = is_from_this_machine(path.name.removeprefix(_PREFIX))
    try:
        data = path.read_bytes()
    except OSError:
        return None
    try:
        found = parse_checked_json(data)
        return WatcherStatus(
            host=str(found["host"]),
            pid=int(found["pid"]),
            since=str(found["since"]),
            seen="" if here else str(found["seen"]),
            trouble=str(found["trouble"]),
        )
    except (ValueError, KeyError, TypeError):
        process = "".join(path.name.removeprefix(_PREFIX).split("-")[1:2])
        host = socket.gethostname() if here else "another machine"
        known = process.isdecimal()
        return WatcherStatus(host=host, pid=int(process), since="an unknown time") if known else None
