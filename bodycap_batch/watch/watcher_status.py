"""Let one watcher at a time work on a spool, and show other processes that it runs.

The watcher holds a lock, which the system releases if the watcher is killed. It also writes a small file, so
that `bodycap status` can show since when it runs and whether it can access its folders.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import time
from dataclasses import asdict, dataclass
from typing import Any

from bodycap_batch.core.errors import StoreError
from bodycap_batch.store.artefacts import disk_errors
from bodycap_batch.store.checked_json import checked_json, parse_checked_json
from bodycap_batch.store.digests import write_atomically
from bodycap_batch.watch.job_status import utc_text
from bodycap_batch.watch.process_identity import is_from_this_machine, is_process_running, process_tag
from bodycap_batch.watch.spool import Spool

_LOCK, _STATUS = ".watcher.lock", ".watcher.json"
"""Names of the lock file and of the status file in the parent folder of `running`."""
_WRITE_PERIOD_S = 5.0
"""Time (seconds) between two writes of the status file while nothing changes. Evidence: none."""
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
    """Hold the lock of a spool for this watcher, and write the watcher's status file.

    Args:
        spool: The folders of the watcher.

    Raises:
        StoreError: Another watcher works on the spool.
    """

    def __init__(self, spool: Spool) -> None:
        self._path = spool.root / _STATUS
        self._since = utc_text()
        self._written: str | None = None
        self._write_again_at = 0.0
        with disk_errors(spool.root):
            self._lock = (spool.root / _LOCK).open("ab")
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                self._lock.close()
                found = active_watcher(spool)
                raise StoreError(
                    "another watcher works on this folder" if found is None else f"this folder is {found}",
                    path=spool.root,
                    hint="stop that watcher, or watch another folder; one watcher can run several jobs "
                    "(`--jobs`), and `bodycap batch` can use several machines",
                ) from None

    def write(self, trouble: str) -> None:
        """Record that the watcher runs, and why it cannot access its folders ("" if it can access them).

        Write errors are ignored. Their cause may be the disk failure that the file should report.
        """
        now = time.monotonic()
        if self._written == trouble and now < self._write_again_at:
            return
        document = {
            "host": socket.gethostname(),
            "pid": os.getpid(),
            "process": process_tag(),
            "since": self._since,
            "seen": utc_text(),
            "trouble": trouble,
        }
        with contextlib.suppress(OSError):
            write_atomically(self._path, checked_json(document).encode())
            self._written, self._write_again_at = trouble, now + _WRITE_PERIOD_S

    def remove(self) -> None:
        """Remove the status file, and release the lock."""
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)
        self._lock.close()


def active_watcher(spool: Spool) -> WatcherStatus | None:
    """Return the running watcher of a spool; None if there is none, or if its file is damaged.

    A watcher of another machine is treated as running if its file was updated within the last
    `_MAX_SILENCE_S` seconds.
    """
    path = spool.root / _STATUS
    try:
        found = parse_checked_json(path.read_bytes())
        process = str(found["process"])
        here = is_from_this_machine(process)
        age_s = time.time() - path.stat().st_mtime
        status = WatcherStatus(
            host=str(found["host"]),
            pid=int(found["pid"]),
            since=str(found["since"]),
            seen="" if here else str(found["seen"]),
            trouble=str(found["trouble"]),
        )
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return status if (is_process_running(process) if here else age_s <= _MAX_SILENCE_S) else None
