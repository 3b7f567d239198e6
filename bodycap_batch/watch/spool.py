"""The watched folder and its siblings: where jobs lie in each state, and how they move between them."""

from __future__ import annotations

import errno
import itertools
import os
import unicodedata
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from bodycap_batch.core.errors import StoreError
from bodycap_batch.store.artefacts import disk_errors

INBOX, RUNNING, DONE, FAILED = "inbox", "running", "done", "failed"
_MOVED_TO = (RUNNING, DONE, FAILED)
CLAIM_PREFIX, RETRY_PREFIX = ".claim-", ".retry-"
"""Folders between two states; a watcher that starts finishes what they were made for."""
_NAME_BYTES = 200
"""Room for a number and for the suffixes of temporary files below a file system's usual 255."""
_TAKEN = (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR, errno.EISDIR)


@dataclass(frozen=True, slots=True)
class JobDir:
    """The folder of one claimed job."""

    path: Path

    @property
    def name(self) -> str:
        """The job's name in the spool."""
        return self.path.name

    @property
    def input(self) -> Path:
        """What was dropped: a folder, or for a job file that came alone a folder with that file."""
        return self.path / "input"

    @property
    def result(self) -> Path:
        """Folder of the results."""
        return self.path / "result"

    @property
    def job(self) -> Path:
        """The job as it was resolved where it was dropped; paths into the footage relative to it."""
        return self.path / "job.yaml"

    @property
    def status(self) -> Path:
        """What other programs read."""
        return self.path / "status.json"

    @property
    def owner(self) -> Path:
        """Which watcher works on it."""
        return self.path / "owner.json"

    @property
    def cancel(self) -> Path:
        """Present once somebody asked to cancel the job."""
        return self.path / "cancel"

    @property
    def log(self) -> Path:
        """What happened, a line an event."""
        return self.result / "logs" / "job.log"


@dataclass(frozen=True, slots=True, kw_only=True)
class Spool:
    """The four folders; jobs move between them by renaming.

    Attributes:
        inbox: Where folders and job files are dropped.
        root: The folder of `running`, `done` and `failed`.
    """

    inbox: Path
    root: Path

    @property
    def running(self) -> Path:
        """Jobs that a watcher has claimed."""
        return self.root / RUNNING

    @property
    def done(self) -> Path:
        """Jobs with their results."""
        return self.root / DONE

    @property
    def failed(self) -> Path:
        """Jobs with the reason why there are none."""
        return self.root / FAILED

    def make(self) -> None:
        """Make the folders and try that a folder can be renamed from each to the next.

        Raises:
            StoreError: They cannot be made or written, or do not lie on one file system.
        """
        with disk_errors(self.root):
            for folder in (self.inbox, self.running, self.done, self.failed):
                folder.mkdir(parents=True, exist_ok=True)
            self._try_to_rename()

    def jobs(self) -> Iterator[JobDir]:
        """Every claimed job: running, done, failed."""
        for folder in (self.running, self.done, self.failed):
            yield from (JobDir(path) for path in visible(folder))

    def find(self, name: str) -> JobDir | None:
        """The claimed job of that name."""
        wanted = unicodedata.normalize("NFC", name)
        return next((job for job in self.jobs() if unicodedata.normalize("NFC", job.name) == wanted), None)

    def free_name(self, name: str) -> str:
        """The name, or name-2, name-3 … where a job of that name has been here before."""
        folders = (self.running, self.done, self.failed)
        for number in itertools.count(1):
            candidate = name if number == 1 else f"{name}-{number}"
            if not any(os.path.lexists(folder / candidate) for folder in folders):
                return candidate
        raise AssertionError("numbers do not end")

    def _try_to_rename(self) -> None:
        folder = self.inbox / f".probe-{uuid.uuid4().hex}"
        folder.mkdir()
        try:
            for place in (self.running, self.done, self.failed):
                target = place / folder.name
                os.rename(folder, target)
                folder = target
        except OSError as error:
            if error.errno != errno.EXDEV:
                raise
            raise StoreError(
                f"{self.inbox} and {place} lie on different file systems, so no job can be moved in one step",
                path=self.root,
                hint=f"make {INBOX}, {RUNNING}, {DONE} and {FAILED} plain folders of one disk",
            ) from error
        finally:
            folder.rmdir()


def spool_at(path: Path) -> Spool:
    """The spool a user means: its inbox, or the folder that holds it.

    A folder under another name is an inbox only where `running`, `done` and `failed` lie beside it already.
    Any other is the folder that will hold the inbox: nothing that lies in it is ever taken for a job.

    Raises:
        StoreError: The path is a file, or one of the folders that jobs are moved to.
    """
    full = Path(os.path.abspath(path))
    if os.path.lexists(full) and not full.is_dir():
        raise StoreError("no folder", path=full, hint="name the folder to watch, for example jobs/inbox")
    if full.name == INBOX:
        return Spool(inbox=full, root=full.parent)
    if not (full / INBOX).is_dir():
        if full.name in _MOVED_TO and (full.parent / INBOX).is_dir():
            hint = f"name {full.parent / INBOX}, or {full.parent}"
            raise StoreError("jobs are moved to this folder, none is dropped into it", path=full, hint=hint)
        if all((full.parent / name).is_dir() for name in _MOVED_TO):
            return Spool(inbox=full, root=full.parent)
    return Spool(inbox=full / INBOX, root=full)


def move(
    source: Path, folder: Path, name: str, before: Callable[[Path], None] | None = None, suffix: str = ""
) -> Path:
    """Rename a file or folder into another folder under the first free name (name, name-2, name-3 and so on).

    Args:
        source: What to move.
        folder: Where to.
        name: The name it should have there.
        before: Called with the target just before the move (again, where that name was taken meanwhile).
        suffix: How the name ends, after any number.

    Returns:
        Where it is now.
    """
    for number in itertools.count(1):
        target = folder / (name if number == 1 else f"{name.removesuffix(suffix)}-{number}{suffix}")
        if os.path.lexists(target):
            continue
        if before is not None:
            before(target)
        try:
            os.rename(source, target)
        except OSError as error:
            if error.errno not in _TAKEN or not os.path.lexists(target):
                raise
        else:
            return target
    raise AssertionError("numbers do not end")


def visible(folder: Path) -> list[Path]:
    """Entries of a folder whose names do not start with a dot, sorted; none where it is missing."""
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except (FileNotFoundError, NotADirectoryError):
        return []


def spool_name(text: str) -> str:
    """A dropped name as the name of a job's folder: no control characters, not too long, no leading dash."""
    clean = "".join("_" if unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") else c for c in text).strip()
    clean = unicodedata.normalize("NFC", clean)
    short = clean.encode()[:_NAME_BYTES].decode(errors="ignore").strip()
    return "_" + short[1:] if short[:1] in ("-", ".", "") else short
