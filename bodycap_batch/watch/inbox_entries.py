"""List the entries of the inbox, and determine whether users have copied them completely."""

from __future__ import annotations

import hashlib
import itertools
import os
import stat
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from bodycap_batch.config.folder import is_system_folder, shown_name
from bodycap_batch.config.unfinished_videos import (
    names_video,
    relevant_files,
    unfinished_files,
)
from bodycap_batch.watch.spool import visible_entries

READY = "READY"
NOT_A_JOB = "this is not a job, because it is neither a folder nor a YAML file"
"""Text that explains why a path in the inbox is ignored."""
YAML_SUFFIXES = (".yaml", ".yml")
_PARTIAL_SUFFIX = ".part"
"""Suffix of a folder that a user renames when it is complete."""
_MAX_STALL_S = 1800.0
"""Time (seconds) without a change after which an entry with an incomplete file is processed anyway. Origin:
Linux closes a connection that does not answer after 13 to 30 minutes (tcp_retries2 in the manual page
tcp(7)). A copy over the network that has stopped for longer does not continue."""
_RECENT_S = 60.0
"""Time (seconds) for which a change of a file is named as the reason to wait. The usual time to wait is 10
seconds."""


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
        digest: Digest of the names, sizes and times of the videos and the YAML files. It changes if one of
            them is added, removed, renamed or modified. Unfinished copies of videos belong to the videos.
        changes: The same digest of all files but those that a system keeps for itself; "" for a complete
            entry in which a file that is neither a video nor a YAML file changes all the time.
        files: Number of files, at most `max_files` + 1 (see `take_snapshot`).
        ready: True if a file named READY states that the entry is complete.
        is_empty: True if there are no files but those that a system keeps for itself.
        newest: Time (Unix seconds) of the latest change of one of these files, and the name of the file.
        special: Relative path of a pipe, a device or another special file; "" if there is no such file.
        undecodable: Relative path that is not UTF-8 text; "" if there is no such path.
    """

    digest: str
    changes: str
    files: int
    ready: bool
    is_empty: bool
    newest: tuple[float, str]
    special: str
    undecodable: str

    def is_same(self, later: EntrySnapshot) -> bool:
        """Return True if the entry has not changed since this snapshot of a complete entry."""
        return later.digest == self.digest and self.changes in ("", later.changes)


def entries_in(inbox: Path) -> list[InboxEntry]:
    """Return the folders and job files of the inbox."""
    return [InboxEntry(path) for path in visible_entries(inbox) if _is_job_entry(path)]


def ignored_paths_in(inbox: Path) -> list[Path]:
    """Return the paths in the inbox that are not jobs: single videos and other files."""
    return [path for path in visible_entries(inbox) if not _is_job_entry(path)]


def take_snapshot(entry: InboxEntry, max_files: int) -> EntrySnapshot:
    """Record the names, sizes and times of an entry's files.

    Args:
        entry: Entry to record.
        max_files: Maximum number of files. The inspection ends at the first file beyond this number.
    """
    files = list(itertools.islice(_files_below(entry.path), max_files + 1))
    digest, changes = hashlib.sha256(), hashlib.sha256()
    special, newest = "", (0.0, "")
    relevant = relevant_files(files)
    for path, name in relevant:
        found = _state_of(path)
        state = repr((name, found.st_size, found.st_mtime_ns, found.st_ino)).encode()
        changes.update(state)
        if names_video(name) or path.suffix.lower() in YAML_SUFFIXES:
            digest.update(state)
        newest = max(newest, (found.st_mtime, shown_name(Path(name))))
    for path, name in files:
        mode = _state_of(path).st_mode
        if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode) and not path.is_symlink():
            special = name
    return EntrySnapshot(
        digest=digest.hexdigest(),
        changes=changes.hexdigest(),
        files=len(files),
        ready=any(name == READY for _, name in files),
        is_empty=not relevant,
        newest=newest,
        special=special,
        undecodable=next(
            (name for name in (entry.path.name, *(n for _, n in files)) if not _is_utf8(name)), ""
        ),
    )


def _state_of(path: Path) -> os.stat_result:
    try:
        return path.stat()
    except OSError:  # a broken link; the error is reported when the job is read
        return path.lstat()


def reason_to_wait(entry: InboxEntry, snapshot: EntrySnapshot, max_files: int) -> str:
    """Return why an entry is not complete, although its files do not change.

    Args:
        entry: Entry to inspect. Its videos are opened, but no frame is decoded.
        snapshot: The state of the entry's files.
        max_files: Maximum number of files that are inspected.

    Returns:
        Text for the user; "" if no file is known to be incomplete, or if the user says that it is complete.
    """
    if snapshot.ready:
        return ""
    limit = f"it is processed after {_MAX_STALL_S / 60:.0f} minutes without a change"
    if snapshot.is_empty:
        return f"the folder is empty ({limit})"
    for found in unfinished_files(itertools.islice(_files_below(entry.path), max_files)):
        return f"{shown_name(Path(found.name))} is not complete: {found.reason} ({limit})"
    return ""


def latest_change(snapshot: EntrySnapshot) -> str:
    """Return which file of an entry changed a short time ago, as text for the user; "" if there is none."""
    age_s = time.time() - snapshot.newest[0]
    return f"{snapshot.newest[1]} changed {age_s:.0f} s ago" if 0 <= age_s < _RECENT_S else ""


class CompletionTracker:
    """Find out which entries of the inbox users have copied completely.

    An entry is complete if it has not changed for some time, and if the content of its files agrees with
    their names and lengths. An entry with a damaged file never agrees. It is treated as complete after
    `_MAX_STALL_S` seconds without a change, so that its error is reported. A file that is neither a video nor
    a job file and changes all the time delays an entry for at most this time, too.

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
        self._seen: dict[Path, tuple[tuple[str, float], ...]] = {}
        self._reasons: dict[Path, tuple[str, str]] = {}
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
            states = (error, error) if snapshot is None else (snapshot.changes, snapshot.digest)
            last = previous.get(entry.path, (("", now), ("", now)))
            self._seen[entry.path] = tuple(
                (state, since if state == last_state else now)
                for state, (last_state, since) in zip(states, last, strict=True)
            )
            (_, since), (_, since_video) = self._seen[entry.path]
            is_still = now - since >= self._unchanged_s or now - since_video >= _MAX_STALL_S
            if snapshot is None:
                if is_still and error:
                    self.incomplete[entry.path] = self.unreadable[entry.path] = error
            elif snapshot.ready:
                found.append((since, entry, snapshot))
            elif is_still:
                reason = "" if now - since >= _MAX_STALL_S else self._reason_to_wait(entry, snapshot)
                if reason:
                    self.incomplete[entry.path] = reason
                else:
                    is_restless = now - since < self._unchanged_s
                    found.append((since, entry, replace(snapshot, changes="") if is_restless else snapshot))
        self._reasons = {path: value for path, value in self._reasons.items() if path in self._seen}
        found.sort(key=lambda item: (item[0], item[1].path))
        return [(entry, snapshot) for _, entry, snapshot in found]

    def _reason_to_wait(self, entry: InboxEntry, snapshot: EntrySnapshot) -> str:
        """Return why an entry is not complete. An unchanged entry is inspected only once."""
        changes, reason = self._reasons.get(entry.path, ("", ""))
        if changes != snapshot.changes:
            try:
                reason = reason_to_wait(entry, snapshot, self._most)
            except OSError:  # a copying program renames a file at this moment
                return "it is changing"
            self._reasons[entry.path] = (snapshot.changes, reason)
        return reason


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
        try:
            entries = sorted(os.scandir(folder), key=lambda item: item.name)
        except PermissionError:
            if is_system_folder(folder.name) and prefix:
                continue  # for example the waste basket of another user
            raise
        for entry in entries:
            name = f"{prefix}{entry.name}"
            if entry.is_dir(follow_symlinks=False):
                folders.append((Path(entry.path), f"{name}/"))
            else:
                yield Path(entry.path), name
