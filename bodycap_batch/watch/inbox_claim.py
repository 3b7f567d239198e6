"""Move jobs from the inbox to `running` and back. The rename out of the inbox is the claim."""

from __future__ import annotations

import contextlib
import os
import shutil
import uuid
from collections.abc import Callable
from pathlib import Path

from bodycap_batch.config.folder import JOB_FILES
from bodycap_batch.config.models import Job
from bodycap_batch.core.errors import BodycapError, StoreError
from bodycap_batch.store.artefacts import store_error
from bodycap_batch.watch.dropped_job import JobPermissions, read_dropped_job, unread_job_files, write_job
from bodycap_batch.watch.inbox_entries import YAML_SUFFIXES, EntrySnapshot, InboxEntry, take_snapshot
from bodycap_batch.watch.job_status import JobStatusFile, read_status
from bodycap_batch.watch.process_identity import is_process_running
from bodycap_batch.watch.spool import (
    CLAIM_PREFIX,
    RETRY_PREFIX,
    JobDir,
    Spool,
    folder_name_from_text,
    move_to_free_name,
)

_UNKNOWN_NAME = "job"
"""Name of a job whose own name is unknown."""


def claim_entry(
    spool: Spool, entry: InboxEntry, snapshot: EntrySnapshot, permissions: JobPermissions
) -> tuple[JobDir, BodycapError | None] | None:
    """Claim a complete entry of the inbox.

    First the job is read in the inbox and written to a hidden folder. Then the entry is renamed into that
    folder. This rename is the claim: if the watcher is killed before it, the entry is still in the inbox; if
    the watcher is killed after it, the next watcher runs the job. Finally the hidden folder gets its visible
    name in `running`.

    Args:
        spool: The folders of the watcher.
        entry: A complete entry of the inbox.
        snapshot: The state of the entry's files when the entry was found to be complete.
        permissions: Which folders the job may read, and the maximum size of the job.

    Returns:
        The job's folder, and the error that was found when the job was read (or None). The whole result is
        None if the entry is gone, or if it is still changing.

    Raises:
        StoreError: The entry cannot be moved.
    """
    job_dir = JobDir(spool.running / f"{CLAIM_PREFIX}{uuid.uuid4().hex}")
    try:
        spool.running.mkdir(exist_ok=True)  # a user may have removed the folder
        job_dir.path.mkdir()
        error = _write_job_files(job_dir, entry, snapshot, permissions)
        if not _move_entry(job_dir, entry, snapshot, permissions):
            shutil.rmtree(job_dir.path)
            return None
        return move_to_running(spool, job_dir), error
    except (OSError, StoreError) as failed:
        with contextlib.suppress(OSError, StoreError):  # else the watcher completes the claim later
            return_to_inbox(spool, job_dir)
        raise store_error(failed, entry.path) if isinstance(failed, OSError) else failed from failed


def move_to_running(spool: Spool, job_dir: JobDir) -> JobDir:
    """Give a claimed hidden folder its visible name in `running`, and return the renamed folder."""
    previous = read_status(job_dir, strict=True)
    status = JobStatusFile(job_dir, previous)
    dropped = dropped_name(job_dir)
    is_file = input_path(job_dir) != job_dir.input
    wanted = folder_name_from_text(Path(dropped).stem if is_file else dropped)

    def rename(target: Path) -> None:
        status.update(name=target.name)

    return JobDir(move_to_free_name(job_dir.path, spool.running, spool.free_name(wanted), rename))


def finish_interrupted_claims(spool: Spool) -> None:
    """Complete the claims of a watcher that was killed, or whose disk failed.

    The hidden folder of a claim gets its visible name. If no entry was moved into it, it is removed.
    """
    for path in sorted(spool.running.glob(f"{CLAIM_PREFIX}*")):
        if path_exists(input_path(JobDir(path))):
            move_to_running(spool, JobDir(path))
        else:
            shutil.rmtree(path, ignore_errors=True)


def path_exists(path: Path) -> bool:
    """Return True if a path is a file, folder or link. Raise `OSError` if the disk cannot be read."""
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def input_path(job_dir: JobDir) -> Path:
    """Return the current path of the dropped folder, or of the job file that was dropped without a folder."""
    document = read_status(job_dir, strict=True)
    if document.get("kind") == "file":
        return job_dir.input / str(document.get("dropped"))
    return (None if document else _only_job_file(job_dir.input)) or job_dir.input


def dropped_name(job_dir: JobDir) -> str:
    """Return the name that a job had in the inbox.

    If `status.json` is damaged, return the name of the job file, else the job's name.
    """
    if stated := read_status(job_dir, strict=True).get("dropped"):
        return str(stated)
    path = input_path(job_dir)
    if path != job_dir.input:
        return path.name
    return _UNKNOWN_NAME if job_dir.name.startswith(".") else job_dir.name


def _only_job_file(folder: Path) -> Path | None:
    """Return the only file in a folder if it is a YAML file. Such an input was dropped without a folder."""
    try:
        found = list(folder.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return None
    is_job_file = len(found) == 1 and found[0].suffix.lower() in YAML_SUFFIXES
    return found[0] if is_job_file and found[0].name not in JOB_FILES else None


def return_to_inbox(
    spool: Spool, job_dir: JobDir, before_move: Callable[[Path], None] | None = None
) -> Path | None:
    """Move the dropped folder or job file back to the inbox, and remove the rest of the job's folder.

    Args:
        spool: The folders of the watcher.
        job_dir: The job's folder.
        before_move: Function that is called with the target path just before the move.

    Returns:
        The new path in the inbox; None if the job's folder holds no input.
    """
    dropped, target = input_path(job_dir), None
    if path_exists(dropped):
        name = dropped_name(job_dir)
        suffix = dropped.suffix if dropped != job_dir.input else ""
        target = move_to_free_name(dropped, spool.inbox, name, before_move, suffix=suffix)
    shutil.rmtree(job_dir.path, ignore_errors=True)
    return target


def finish_interrupted_retries(spool: Spool) -> None:
    """Find jobs whose `retry` or `cancel` command was killed during the move, and move them to the inbox."""
    for path in sorted(spool.failed.glob(f"{RETRY_PREFIX}*")):
        if not is_process_running(path.name.removeprefix(RETRY_PREFIX)):
            return_to_inbox(spool, JobDir(path))


def _write_job_files(
    job_dir: JobDir, entry: InboxEntry, snapshot: EntrySnapshot, permissions: JobPermissions
) -> BodycapError | None:
    """Read the job, and write all its files except the input. Return the error of the job, or None."""
    job, warnings, error = _read_job_or_error(entry, snapshot, permissions)
    if job is not None:
        write_job(job, job_dir, entry.path.parent / entry.path.name if not entry.is_file else job_dir.input)
    status = JobStatusFile(job_dir)
    for name in [] if entry.is_file else unread_job_files(entry.path):
        status.add_note(f"{name} was not used, because a job file in a folder must have the name job.yaml")
    for warning in warnings:
        status.add_note(warning)
    status.update(kind="file" if entry.is_file else "folder", dropped=entry.path.name)
    return error


def _move_entry(
    job_dir: JobDir, entry: InboxEntry, snapshot: EntrySnapshot, permissions: JobPermissions
) -> bool:
    """Move the entry into the claimed folder.

    Return False if the entry is gone, or has changed since the snapshot. A changed entry returns to the
    inbox.
    """
    if entry.is_file:
        job_dir.input.mkdir()
    target = job_dir.input / entry.path.name if entry.is_file else job_dir.input
    leads_to = os.path.realpath(entry.path) if entry.path.is_symlink() else ""
    try:
        os.rename(entry.path, target)
    except FileNotFoundError:
        return False
    if leads_to:  # a relative link is not valid in the new folder
        absolute_link = job_dir.path / "link"
        absolute_link.symlink_to(leads_to)
        os.replace(absolute_link, target)
        return True
    if snapshot.is_same(take_snapshot(InboxEntry(target), int(permissions.limits.files))):
        return True
    move_to_free_name(target, entry.path.parent, entry.path.name)
    return False


def _read_job_or_error(
    entry: InboxEntry, snapshot: EntrySnapshot, permissions: JobPermissions
) -> tuple[Job | None, tuple[str, ...], BodycapError | None]:
    try:
        return *read_dropped_job(entry, snapshot, permissions), None
    except BodycapError as error:
        return None, (), error
