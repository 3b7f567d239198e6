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
from bodycap_batch.watch.spool import Spool

_LOCK, _STATUS = ".watcher.lock", ".watcher.json"
"""Names of the lock file and of the status file in the parent folder of `running`."""
_LOCK_ATTEMPTS, _LOCK_PAUSE_S = 5, 0.1
"""Number of attempts to lock the folder, and time (seconds) between two of them. `active_watcher` holds the
lock for less than a millisecond to test it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WatcherStatus:
    """The status of a running watcher, as other processes can read it.

    Attributes:
        host: Name of the watcher's machine.
        pid: Process number of the watcher on its machine.
        since: Start time of the watcher, UTC.
        trouble: Why the watcher cannot access its folders; "" if it can access them.
    """

    host: str
    pid: int
    since: str
    trouble: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return the watcher as plain JSON values."""
        return asdict(self)

    def __str__(self) -> str:
        trouble = f", cannot continue: {self.trouble}" if self.trouble else ""
        return f"watched by {self.host} (process {self.pid}) since {self.since}{trouble}"


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
        with disk_errors(spool.root):
            self._lock = (spool.root / _LOCK).open("ab")
            if not any(self._try_lock(attempt) for attempt in range(_LOCK_ATTEMPTS)):
                self._lock.close()
                found = active_watcher(spool)
                raise StoreError(
                    "another watcher works on this folder" if found is None else f"this folder is {found}",
                    path=spool.root,
                    hint="stop that watcher, or watch another folder; one watcher can run several jobs "
                    "(`--jobs`), and `bodycap batch` can use several machines",
                )

    def _try_lock(self, attempt: int) -> bool:
        time.sleep(_LOCK_PAUSE_S if attempt else 0.0)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True

    def write(self, trouble: str) -> None:
        """Record that the watcher runs, and why it cannot access its folders ("" if it can access them).

        Write errors are ignored. Their cause may be the disk failure that the file should report.
        """
        if self._written == trouble:
            return
        status = WatcherStatus(host=socket.gethostname(), pid=os.getpid(), since=self._since, trouble=trouble)
        with contextlib.suppress(OSError):
            write_atomically(self._path, checked_json(status.to_dict()).encode())
            self._written = trouble

    def remove(self) -> None:
        """Remove the status file, and release the lock."""
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)
        self._lock.close()


def active_watcher(spool: Spool) -> WatcherStatus | None:
    """Return the running watcher of a spool; None if there is none, or if its file is damaged."""
    try:
        with (spool.root / _LOCK).open("rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:  # a watcher holds the lock
        with contextlib.suppress(OSError, ValueError, TypeError):
            return WatcherStatus(**parse_checked_json((spool.root / _STATUS).read_bytes()))
    except OSError:  # no watcher has run here
        return None
    return None
