"""The spool: a watched inbox and the folders `running`, `done` and `failed`, with the moves between them."""

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
_JOB_FOLDERS = (RUNNING, DONE, FAILED)
RETRY_PREFIX = ".retry-"
"""Name prefix of the hidden folder of a job that `bodycap retry` or `cancel` moves. If the command is killed,
the watcher moves the job to the inbox."""
MAX_NAME_BYTES = 200
"""Maximum length (bytes) of a job's name. File systems usually permit 255 bytes. The remaining bytes
are for a number and the suffixes of temporary files."""
_NAME_TAKEN_ERRORS = (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR, errno.EISDIR)
"""Error numbers that mean that the target name of a rename already exists."""


@dataclass(frozen=True, slots=True)
class JobDir:
    """The folder of one claimed job, with the paths of the files in this folder."""

    path: Path

    @property
    def name(self) -> str:
        """The job's name in the spool."""
        return self.path.name

    @property
    def input(self) -> Path:
        """The dropped folder, or a folder that holds the job file that was dropped without a folder."""
        return self.path / "input"

    @property
    def result(self) -> Path:
        """Folder of the results."""
        return self.path / "result"

    @property
    def job(self) -> Path:
        """File of the resolved job. Paths to the job's own videos are relative to the folder of this file."""
        return self.path / "job.yaml"

    @property
    def status(self) -> Path:
        """File with the state of the job, for other programs."""
        return self.path / "status.json"

    @property
    def cancel(self) -> Path:
        """File that exists once a user has requested to cancel the job."""
        return self.path / "cancel"

    @property
    def log(self) -> Path:
        """Log file of the job, with one line per event."""
        return self.result / "logs" / "job.log"


@dataclass(frozen=True, slots=True, kw_only=True)
class Spool:
    """The four folders of a watcher. Jobs move between the folders by renaming.

    Attributes:
        inbox: Folder where users drop folders and job files.
        root: Parent folder of `running`, `done` and `failed`.
    """

    inbox: Path
    root: Path

    @property
    def running(self) -> Path:
        """Folder of the jobs that a watcher has claimed."""
        return self.root / RUNNING

    @property
    def done(self) -> Path:
        """Folder of the jobs with results."""
        return self.root / DONE

    @property
    def failed(self) -> Path:
        """Folder of the jobs that failed or were cancelled."""
        return self.root / FAILED

    def make(self) -> None:
        """Create the folders, and test that renaming can move a folder through all of them.

        Raises:
            StoreError: A folder cannot be created or written, or the folders are on different file systems.
        """
        with disk_errors(self.root):
            for folder in (self.inbox, self.running, self.done, self.failed):
                folder.mkdir(parents=True, exist_ok=True)
            self._try_to_rename()

    def jobs(self) -> Iterator[JobDir]:
        """Yield every job in `running`, `done` and `failed`."""
        for folder in (self.running, self.done, self.failed):
            yield from (JobDir(path) for path in visible_entries(folder))

    def find(self, name: str) -> JobDir | None:
        """Return the job in `running`, `done` or `failed` with a given name, or None."""
        wanted = unicodedata.normalize("NFC", name)
        return next((job for job in self.jobs() if unicodedata.normalize("NFC", job.name) == wanted), None)

    def free_name(self, name: str) -> str:
        """Return the name if no job has it.

        Otherwise return the name with the lowest free number, for example name-2.
        """
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
            for folder_after in (self.running, self.done, self.failed):
                target = folder_after / folder.name
                os.rename(folder, target)
                folder = target
        except OSError as error:
            if error.errno != errno.EXDEV:
                raise
            raise StoreError(
                f"{self.inbox} and {folder_after} are on different file systems, so a job cannot be moved "
                "in one step",
                path=self.root,
                hint=f"put the folders {INBOX}, {RUNNING}, {DONE} and {FAILED} on one disk",
            ) from error
        finally:
            folder.rmdir()


def spool_from_path(path: Path) -> Spool:
    """Return the spool of a path. The path is either the inbox or the parent folder of the inbox.

    A folder that is not named `inbox` is treated as an inbox only if `running`, `done` and `failed` exist
    beside it. Any other folder is treated as the parent of the inbox, and the files in that folder are never
    treated as jobs.

    Raises:
        StoreError: The path is a file, or it is `running`, `done` or `failed`.
    """
    full = Path(os.path.abspath(path))
    if os.path.lexists(full) and not full.is_dir():
        raise StoreError(
            "this path is not a folder", path=full, hint="give the folder to watch, for example jobs/inbox"
        )
    if full.name == INBOX:
        return Spool(inbox=full, root=full.parent)
    if not (full / INBOX).is_dir():
        if full.name in _JOB_FOLDERS and (full.parent / INBOX).is_dir():
            hint = f"give {full.parent / INBOX} or {full.parent} instead"
            raise StoreError("finished or running jobs are moved to this folder", path=full, hint=hint)
        if all((full.parent / name).is_dir() for name in _JOB_FOLDERS):
            return Spool(inbox=full, root=full.parent)
    return Spool(inbox=full / INBOX, root=full)


def move_to_free_name(
    source: Path, folder: Path, name: str, before_move: Callable[[Path], None] | None = None, suffix: str = ""
) -> Path:
    """Move a file or folder into another folder. If the name is taken, add a number, for example name-2.

    Args:
        source: Path of the file or folder to move.
        folder: Folder into which the file or folder is moved.
        name: Preferred new name.
        before_move: Function that is called with the target path just before each attempt. There are several
            attempts if another process takes a name in the meantime.
        suffix: Suffix of the name, for example ".yaml"; a number is inserted before the suffix.

    Returns:
        The new path.
    """
    for number in itertools.count(1):
        target = folder / (name if number == 1 else f"{name.removesuffix(suffix)}-{number}{suffix}")
        if os.path.lexists(target):
            continue
        if before_move is not None:
            before_move(target)
        try:
            os.rename(source, target)
        except OSError as error:
            if error.errno not in _NAME_TAKEN_ERRORS or not os.path.lexists(target):
                raise
        else:
            return target
    raise AssertionError("numbers do not end")


def visible_entries(folder: Path) -> list[Path]:
    """Return the sorted entries of a folder whose names do not start with a dot.

    The result is empty if the folder does not exist.
    """
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except (FileNotFoundError, NotADirectoryError):
        return []


def folder_name_from_text(text: str) -> str:
    """Return a valid name for a job's folder that is close to a text.

    The name has at most `MAX_NAME_BYTES` bytes, no control characters, and no leading dash or dot.
    """
    clean = "".join("_" if unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") else c for c in text).strip()
    clean = unicodedata.normalize("NFC", clean)
    short = clean.encode()[:MAX_NAME_BYTES].decode(errors="ignore").strip()
    return "_" + short[1:] if short[:1] in ("-", ".", "") else short
