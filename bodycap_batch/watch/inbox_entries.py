"""List the entries of the inbox, and determine whether users have copied them completely."""

from __future__ import annotations

import hashlib
import itertools
import os
import stat
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from bodycap_batch.config.folder import VIDEO_SUFFIXES
from bodycap_batch.formats.file_completeness import missing_part
from bodycap_batch.watch.spool import visible_entries

READY = "READY"
NOT_A_JOB = "this is not a job, because it is neither a folder nor a YAML file"
"""Text that explains why a path in the inbox is ignored."""
YAML_SUFFIXES = (".yaml", ".yml")
_PARTIAL_SUFFIX = ".part"
_MAX_STALL_S = 1800.0
"""Time (seconds) without a change after which an entry with an incomplete file is processed anyway. Origin:
Linux closes a connection that does not answer after 13 to 30 minutes (tcp_retries2 in the manual page
tcp(7)). A copy over the network that has stopped for longer does not continue."""
_FILE_MANAGER_FILES = (
    ".DS_Store",
    ".localized",
    ".directory",
    ".Spotlight-V100",
    ".Trashes",
    ".fseventsd",
    ".nomedia",
)
"""Names of hidden files that file managers create in folders. A folder that holds such files can be complete.
Names that start with ``._`` (resource forks) are treated in the same way."""


@dataclass(frozen=True, slots=True)
class InboxEntry:
    """A folder or a job file in the inbox. It becomes a job when a watcher claims it."""

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
    """The state of an entry's files at one moment.

    Two snapshots show whether a user is still copying or changing the files.

    Attributes:
        digest: Digest of the names, sizes and times of all files. It changes if a file is added, removed,
            renamed or modified.
        files: Number of files, at most `max_files` + 1 (see `take_snapshot`).
        ready: True if a file named READY states that the entry is complete.
        unfinished: Relative path of a file that is still being copied; "" if there is no such file.
        special: Relative path of a pipe, a device or another special file; "" if there is no such file.
        undecodable: Relative path that is not UTF-8 text; "" if there is no such path.
    """

    digest: str
    files: int
    ready: bool
    unfinished: str
    special: str
    undecodable: str

    @property
    def incomplete_reason(self) -> str:
        """Reason why the entry cannot be complete yet; "" if there is no reason."""
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
    """Record the names, sizes and times of an entry's files. No file is opened.

    Args:
        entry: Entry to record.
        max_files: Maximum number of files. The inspection ends at the first file beyond this number.
    """
    digest, count = hashlib.sha256(), 0
    ready, unfinished, special = False, "", ""
    undecodable = "" if _is_utf8(entry.path.name) else entry.path.name
    for path, name in _files_below(entry.path):
        try:
            found = path.stat()
        except OSError:  # a broken link; the error is reported when the job is read
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


def missing_content(entry: InboxEntry, max_files: int) -> str:
    """Return which file of an entry is not complete according to its own content.

    Args:
        entry: Entry to inspect. Its videos are opened, but no frame is decoded.
        max_files: Maximum number of files that are inspected.

    Returns:
        Text for the user; "" if no file is known to be incomplete.
    """
    for path, name in itertools.islice(_files_below(entry.path), max_files):
        if missing := missing_part(path, VIDEO_SUFFIXES):
            limit = f"it is processed after {_MAX_STALL_S / 60:.0f} minutes without a change"
            return f"{name} is not complete: {missing} ({limit})"
    return ""


class CompletionTracker:
    """Find out which entries of the inbox users have copied completely.

    An entry is complete if it has not changed for some time, and if the content of its files agrees with
    their lengths. An entry with a damaged file never agrees. It is treated as complete after `_MAX_STALL_S`
    seconds without a change, so that its error is reported.

    Args:
        unchanged_s: Time (seconds) for which the names, sizes and times of an entry's files must not change
            before the entry is treated as complete.
        max_files: Maximum number of files of an entry that are inspected.
        clock: Function that returns the time (seconds) of this process's monotonic clock.

    Attributes:
        incomplete: Reason why a path is not complete, for each path that has not changed for `unchanged_s`
            seconds but is not complete. Examples are an interrupted copy, an empty folder and an unreadable
            entry.
        unreadable: Error text for each path in `incomplete` that cannot be read.
    """

    def __init__(
        self, unchanged_s: float, max_files: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._unchanged_s = unchanged_s
        self._most = max_files
        self._clock = clock
        self._seen: dict[Path, tuple[str, float]] = {}
        self._missing: dict[Path, tuple[str, str]] = {}
        self.incomplete: dict[Path, str] = {}
        self.unreadable: dict[Path, str] = {}

    def complete_entries(self, entries: list[InboxEntry]) -> list[tuple[InboxEntry, EntrySnapshot]]:
        """Return the entries that are complete now.

        Entries that have not changed for the longest time come first.
        """
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
            is_still = now - since >= self._unchanged_s
            if snapshot is None:
                if is_still and error:
                    self.incomplete[entry.path] = self.unreadable[entry.path] = error
            elif snapshot.ready:
                found.append((since, entry, snapshot))
            elif is_still:
                reason = snapshot.incomplete_reason
                if not reason and now - since < _MAX_STALL_S:
                    reason = self._missing_content(entry, snapshot)
                if reason:
                    self.incomplete[entry.path] = reason
                else:
                    found.append((since, entry, snapshot))
        self._missing = {path: value for path, value in self._missing.items() if path in self._seen}
        found.sort(key=lambda item: (item[0], item[1].path))
        return [(entry, snapshot) for _, entry, snapshot in found]

    def _missing_content(self, entry: InboxEntry, snapshot: EntrySnapshot) -> str:
        """Return which file of an entry is not complete. An unchanged entry is inspected only once."""
        digest, reason = self._missing.get(entry.path, ("", ""))
        if digest != snapshot.digest:
            try:
                reason = missing_content(entry, self._most)
            except OSError:  # a copying program renames a file at this moment
                return "it is changing"
            self._missing[entry.path] = (snapshot.digest, reason)
        return reason

    @property
    def is_tracking(self) -> bool:
        """True if the last scan found entries. Some of the entries may still be changing."""
        return bool(self._seen)


def _try_snapshot(entry: InboxEntry, max_files: int) -> tuple[EntrySnapshot | None, str]:
    """Return a snapshot of an entry and an error text.

    If the entry cannot be read, the snapshot is None. The error text is "" if there is no error, and also if
    the entry no longer exists.
    """
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
    """Return False for a name with bytes that are not UTF-8. Such a name cannot be written to a text file."""
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
    """Yield the path and relative name of each file, link and special file in a folder and its subfolders.

    If the path is not a folder, yield the path itself.
    """
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
