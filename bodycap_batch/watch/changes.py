"""Being woken when something happens in the inbox."""

from __future__ import annotations

import sys
import threading
from pathlib import Path

_NETWORK = (
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
_POLL_MS = 1000
_WAKE_MS = 2000


class Changes:
    """Sets an event when a folder changes; a context manager.

    The event only shortens waiting: whoever waits for it looks at the folder itself, now and then also
    without it. So a lost event loses nothing.

    Args:
        folder: What to watch.
        woken: Set on every change.
        poll: Look by polling; None: where the folder lies on a network disk, which tells no changes.
    """

    def __init__(self, folder: Path, woken: threading.Event, *, poll: bool | None) -> None:
        self._folder = folder
        self._woken = woken
        self.polling = on_network_disk(folder) if poll is None else poll
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="changes", daemon=True)

    def __enter__(self) -> Changes:
        """Start watching."""
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
                    rust_timeout=_WAKE_MS,
                    raise_interrupt=False,
                    force_polling=self.polling,
                    poll_delay_ms=_POLL_MS,
                    ignore_permission_denied=True,
                ):
                    self._woken.set()
            except (OSError, RuntimeError) as error:
                # No inotify watches left, a folder that vanished: the regular look goes on meanwhile.
                if not self.polling:
                    sys.stderr.write(f"note: {self._folder} is polled from now on: {error}\n")
                self.polling = True
                self._stop.wait(_WAKE_MS / 1000)


def on_network_disk(folder: Path, mounts: Path = Path("/proc/self/mounts")) -> bool:
    """True where a folder lies on a disk of another machine (or of the host of this virtual one)."""
    try:
        rows = [line.split() for line in mounts.read_text(encoding="utf-8").splitlines()]
    except OSError:
        return False
    full = folder.resolve()
    places = [(Path(_unescaped(row[1])), row[2]) for row in rows if len(row) > 2]
    found = [(len(place.parts), kind) for place, kind in places if full.is_relative_to(place)]
    return bool(found) and max(found, key=lambda each: each[0])[1].startswith(_NETWORK)


def _unescaped(text: str) -> str:
    """A mount point as it is called: the kernel writes a space as its octal code."""
    return text.encode("latin-1", "backslashreplace").decode("unicode_escape") if "\\" in text else text
