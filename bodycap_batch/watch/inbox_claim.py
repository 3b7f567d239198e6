"""Move jobs from the inbox to `running` and back. The rename out of the inbox is the claim."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path

from bodycap_batch.config.folder import JOB_FILES
from bodycap_batch.config.models import Job
from bodycap_batch.core.errors import BodycapError, StoreError
from bodycap_batch.store.artefacts import disk_errors, store_error
from bodycap_batch.watch.dropped_job import JobPermissions, read_dropped_job, unread_job_files, write_job
from bodycap_batch.watch.inbox_entries import YAML_SUFFIXES, EntrySnapshot, InboxEntry, take_snapshot
from bodycap_batch.watch.job_status import JobStatusFile, append_log, read_status
from bodycap_batch.watch.spool import RETRY_PREFIX, JobDir, Spool, folder_name_from_text, move_to_free_name


def claim_entry(
    spool: Spool, entry: InboxEntry, snapshot: EntrySnapshot, permissions: JobPermissions
) -> JobDir | None:
    """Claim a complete entry of the inbox.

    First the job is read in the inbox, and written to a new folder in `running`. Then the entry is renamed
    into that folder. This rename is the claim: if the watcher is killed before it, the entry is still in the
    inbox; if the watcher is killed after it, the next watcher runs the job. The status of a job that cannot
    be read says from the start that the job has failed.

    Args:
        spool: The folders of the watcher.
        entry: A complete entry of the inbox.
        snapshot: The state of the entry's files when the entry was found to be complete.
        permissions: Which folders the job may read, and the maximum size of the job.

    Returns:
        The job's folder; None if the entry is gone, or if it is still changing.

    Raises:
        StoreError: The entry cannot be moved.
    """
    job, warnings, error = _read_job_or_error(entry, snapshot, permissions)
    job_dir = JobDir(spool.running / spool.free_name(folder_name_from_text(entry.name)))
    with disk_errors(entry.path):
        spool.running.mkdir(exist_ok=True)  # a user may have removed the folder
        job_dir.path.mkdir()
    try:
        if job is not None:
            write_job(job, job_dir, job_dir.input if entry.is_file else entry.path)
        status = JobStatusFile(job_dir)
        status.update(kind="file" if entry.is_file else "folder", dropped=entry.path.name)
        for note in (*_notes_about_job_files(entry), *warnings):
            status.add_note(note)
        if error is not None:
            append_log(job_dir, f"failed: {error}")
            status.finish("failed", error, spool.failed / job_dir.name, spool.inbox)
        if _move_entry(job_dir, entry, snapshot, permissions):
            return job_dir
        shutil.rmtree(job_dir.path)
    except (OSError, StoreError) as failed:
        with contextlib.suppress(OSError, StoreError):  # else the next watcher runs the job
            return_to_inbox(spool, job_dir)
        raise store_error(failed, entry.path) if isinstance(failed, OSError) else failed from failed
    return None


def is_unfinished_claim(job_dir: JobDir) -> bool:
    """Return True for a folder in `running` whose watcher was killed before the entry was moved into it."""
    status = read_status(job_dir, strict=True)
    if status.get("started_at") or path_exists(input_path(job_dir)):
        return False
    return bool(status) or {path.name for path in job_dir.path.iterdir()} <= {job_dir.job.name}


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
    return job_dir.name.removeprefix(RETRY_PREFIX)


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
        The new path in the inbox; None if the job's folder holds no input, or if another process moved it.
    """
    dropped, target = input_path(job_dir), None
    if path_exists(dropped):
        name = dropped_name(job_dir)
        suffix = dropped.suffix if dropped != job_dir.input else ""
        with contextlib.suppress(FileNotFoundError):  # another process moves the job, too
            target = move_to_free_name(dropped, spool.inbox, name, before_move, suffix=suffix)
    shutil.rmtree(job_dir.path, ignore_errors=True)
    return target


def finish_interrupted_retries(spool: Spool) -> None:
    """Move the jobs to the inbox whose `retry` command was killed during the move.

    It does no harm if the command is still at work: both do the same, and the second one finds nothing to
    move.
    """
    for path in sorted(spool.failed.glob(f"{RETRY_PREFIX}*")):
        return_to_inbox(spool, JobDir(path))


def _notes_about_job_files(entry: InboxEntry) -> list[str]:
    names = [] if entry.is_file else unread_job_files(entry.path)
    return [
        f"{name} was not used, because a job file in a folder must have the name job.yaml" for name in names
    ]


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
