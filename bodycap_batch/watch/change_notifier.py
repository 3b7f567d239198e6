"""Wake the watcher when something changes in the inbox."""

from __future__ import annotations

import sys
import threading
from pathlib import Path

_NETWORK_FILE_SYSTEMS = (
    "nfs",
    "cifs",
    "smb",
    "9p",
    "fuse",
    "afs",
    "ceph",
    "gluster",
    "lustre",
    "vboxsf",
    "virtiofs",
    "drvfs",
)
"""Prefixes of the kernel's names of network file systems. These file systems do not report changes that
another machine makes."""
_POLL_MS = 1000
"""Time (milliseconds) between two scans of a folder that is polled. Evidence: none."""
_STOP_CHECK_MS = 2000
"""Time (milliseconds) between two checks whether the thread must stop. After an error, the thread waits for
this time before the next attempt. Evidence: none."""


class ChangeNotifier:
    """Set an event when a folder changes. This is a context manager.

    The event only shortens the watcher's wait. The watcher also scans the folder at regular intervals, so it
    finds every change even if the event is missed.

    Args:
        folder: Folder to watch.
        woken: Event that is set on every change.
        poll: True: poll the folder. False: wait for change reports of the system. None: poll the folder only
            if the folder is on a network disk, because such a disk does not report all changes.
    """

    def __init__(self, folder: Path, woken: threading.Event, *, poll: bool | None) -> None:
        self._folder = folder
        self._woken = woken
        self.polling = is_on_network_disk(folder) if poll is None else poll
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="changes", daemon=True)

    def __enter__(self) -> ChangeNotifier:
        """Start the thread that watches the folder."""
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _watch(self) -> None:
        import watchfiles

        while not self._stop.is_set():
            try:
                for _ in watchfiles.watch(
                    self._folder,
                    watch_filter=None,
                    stop_event=self._stop,
                    rust_timeout=_STOP_CHECK_MS,
                    raise_interrupt=False,
                    force_polling=self.polling,
                    poll_delay_ms=_POLL_MS,
                    ignore_permission_denied=True,
                ):
                    self._woken.set()
            except (OSError, RuntimeError) as error:
                # The system has no free inotify watches, or the folder is gone. Poll the folder instead.
                if not self.polling:
                    sys.stderr.write(
                        f"note: the watcher reads {self._folder} regularly from now on, because the system "
                        f"reports no changes of this folder: {error}\n"
                    )
                self.polling = True
                self._stop.wait(_STOP_CHECK_MS / 1000)


def is_on_network_disk(folder: Path, mounts: Path = Path("/proc/self/mounts")) -> bool:
    """Return True if a folder is on a disk of another machine, or on a disk of this virtual machine's host.

    Args:
        folder: Folder to look up.
        mounts: Path of the kernel's table of mounts.
    """
    try:
        rows = [line.split() for line in mounts.read_text(encoding="utf-8").splitlines()]
    except OSError:
        return False
    full = folder.resolve()
    mount_points = [(Path(_without_octal_escapes(row[1])), row[2]) for row in rows if len(row) > 2]
    containing = [(len(place.parts), kind) for place, kind in mount_points if full.is_relative_to(place)]
    return bool(containing) and max(containing, key=lambda each: each[0])[1].startswith(_NETWORK_FILE_SYSTEMS)


def _without_octal_escapes(text: str) -> str:
    """Return a mount point with each octal code replaced by its character.

    In its table of mounts, the kernel writes octal codes in place of spaces and some other characters.
    """
    return text.encode("latin-1", "backslashreplace").decode("unicode_escape") if "\\" in text else text
