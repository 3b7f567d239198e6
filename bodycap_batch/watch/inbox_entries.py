"""List the entries of the inbox, and determine whether they have been copied completely."""

from __future__ import annotations

import hashlib
import os
import stat
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from bodycap_batch.watch.spool import visible_entries

READY = "READY"
NOT_A_JOB = "not a job: neither a folder nor a YAML file"
"""Reason to ignore a path in the inbox."""
YAML_SUFFIXES = (".yaml", ".yml")
_PARTIAL_SUFFIX = ".part"
_FILE_MANAGER_FILES = (
    ".DS_Store",
    ".localized",
    ".directory",
    ".Spotlight-V100",
    ".Trashes",
    ".fseventsd",
    ".nomedia",
)
"""Files that file managers leave in every folder. Resource forks (``._name``) are treated in the same way."""


@dataclass(frozen=True, slots=True)
class InboxEntry:
    """A folder or a job file in the inbox."""

    path: Path

    @property
    def is_file(self) -> bool:
        """True for a job file, False for a folder."""
        return not self.path.is_dir()

    @property
    def name(self) -> str:
        """Name of the job."""
        return self.path.stem if self.is_file else self.path.name


@dataclass(frozen=True, slots=True, kw_only=True)
class EntrySnapshot:
    """The files of an entry at one moment.

    Attributes:
        digest: Changes if a file is added, removed or renamed, or if its size or time changes.
        files: Number of files.
        ready: True if a file named READY states that the entry is complete.
        unfinished: A file that is still being copied, relative to the entry; "" if there is none.
        special: A path that is neither a file nor a folder (a pipe, a device); "" if there is none.
        undecodable: A name that is not UTF-8 text; "" if there is none.
    """

    digest: str
    files: int
    ready: bool
    unfinished: str
    special: str
    undecodable: str

    @property
    def incomplete_reason(self) -> str:
        """Why the entry cannot be complete yet; "" if there is no reason."""
        if self.ready:
            return ""
        if self.unfinished:
            return f"{self.unfinished} is being copied"
        return "" if self.files else "the folder is empty"


def entries_in(inbox: Path) -> list[InboxEntry]:
    """Return the folders and job files of the inbox."""
    return [InboxEntry(path) for path in visible_entries(inbox) if _is_job_entry(path)]


def ignored_paths_in(inbox: Path) -> list[Path]:
    """Return the paths in the inbox that are not jobs: single videos and other files."""
    return [path for path in visible_entries(inbox) if not _is_job_entry(path)]


def take_snapshot(entry: InboxEntry, max_files: int) -> EntrySnapshot:
    """Record names, sizes and times of an entry's files. No file is opened.

    Args:
        entry: Entry to record.
        max_files: The count of files ends after this number.
    """
    digest, count = hashlib.sha256(), 0
    ready, unfinished, special = False, "", ""
    undecodable = "" if _is_utf8(entry.path.name) else entry.path.name
    for path, name in _files_below(entry.path):
        try:
            found = path.stat()
        except OSError:  # a broken link, which is reported when the job is read
            found = path.lstat()
        count += 1
        digest.update(repr((name, found.st_size, found.st_mtime_ns, found.st_ino)).encode())
        ready = ready or name == READY
        undecodable = undecodable if _is_utf8(name) else name
        if not unfinished and any(map(_is_partial_or_hidden, Path(name).parts)):
            unfinished = name
        if not stat.S_ISREG(found.st_mode) and not stat.S_ISDIR(found.st_mode) and not path.is_symlink():
            special = name
        if count > max_files:
            break
    return EntrySnapshot(
        digest=digest.hexdigest(),
        files=count,
        ready=ready,
        unfinished=unfinished,
        special=special,
        undecodable=undecodable,
    )


class CompletionTracker:
    """Follow entries until they are complete.

    Args:
        unchanged_s: Seconds for which names, sizes and times must stay the same.
        max_files: Number of files of an entry that are inspected.
        clock: This process's own clock, seconds.

    Attributes:
        incomplete: Reasons of entries that are unchanged for that long, but are not complete: an interrupted
            copy, or no file.
        unreadable: The errors of those entries that cannot be read at all.
    """

    def __init__(
        self, unchanged_s: float, max_files: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._unchanged_s = unchanged_s
        self._most = max_files
        self._clock = clock
        self._seen: dict[Path, tuple[str, float]] = {}
        self.incomplete: dict[Path, str] = {}
        self.unreadable: dict[Path, str] = {}

    def complete_entries(self, entries: list[InboxEntry]) -> list[tuple[InboxEntry, EntrySnapshot]]:
        """Return the entries that are complete now; those that were unchanged for longest come first."""
        now = self._clock()
        found: list[tuple[float, InboxEntry, EntrySnapshot]] = []
        previous, self._seen = self._seen, {}
        self.incomplete, self.unreadable = {}, {}
        for entry in entries:
            snapshot, error = _try_snapshot(entry, self._most)
            state = error if snapshot is None else snapshot.digest
            last_state, since = previous.get(entry.path, ("", now))
            since = since if last_state == state else now
            self._seen[entry.path] = (state, since)
            still = now - since >= self._unchanged_s
            if snapshot is not None and (snapshot.ready or (still and not snapshot.incomplete_reason)):
                found.append((since, entry, snapshot))
            elif still and (reason := error or (snapshot.incomplete_reason if snapshot is not None else "")):
                self.incomplete[entry.path] = reason
                if error:
                    self.unreadable[entry.path] = error
        found.sort(key=lambda item: (item[0], item[1].path))
        return [(entry, snapshot) for _, entry, snapshot in found]

    @property
    def is_tracking(self) -> bool:
        """True if the last scan found entries, which may still be changing."""
        return bool(self._seen)


def _try_snapshot(entry: InboxEntry, max_files: int) -> tuple[EntrySnapshot | None, str]:
    """Return a snapshot of an entry, or the error. The error is "" if the entry is being moved."""
    try:
        return take_snapshot(entry, max_files), ""
    except FileNotFoundError:
        return None, ""
    except OSError as error:
        return None, error.strerror or str(error)


def _is_job_entry(path: Path) -> bool:
    if path.suffix.lower() == _PARTIAL_SUFFIX:
        return False
    return path.is_dir() or (path.suffix.lower() in YAML_SUFFIXES and not _is_special_file(path))


def _is_special_file(path: Path) -> bool:
    try:
        return not stat.S_ISREG(path.stat().st_mode)
    except OSError:
        return not path.is_symlink()


def _is_utf8(name: str) -> bool:
    """Return False for a name with bytes that are not UTF-8. It cannot be written to a text file."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True


def _is_partial_or_hidden(name: str) -> bool:
    if name.lower().endswith(_PARTIAL_SUFFIX):
        return True
    return name.startswith(".") and name not in _FILE_MANAGER_FILES and not name.startswith("._")


def _files_below(path: Path) -> Iterator[tuple[Path, str]]:
    """Yield files, links and special files below a folder with their relative names; a file yields itself."""
    if not path.is_dir():
        yield path, path.name
        return
    folders = [(path, "")]
    while folders:
        folder, prefix = folders.pop()
        for entry in sorted(os.scandir(folder), key=lambda item: item.name):
            name = f"{prefix}{entry.name}"
            if entry.is_dir(follow_symlinks=False):
                folders.append((Path(entry.path), f"{name}/"))
            else:
                yield Path(entry.path), name
