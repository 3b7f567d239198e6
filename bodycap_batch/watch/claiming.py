"""From the inbox into `running`, where the rename is the claim; and back into the inbox."""

from __future__ import annotations

import contextlib
import os
import shutil
import uuid
from collections.abc import Callable
from pathlib import Path

from bodycap_batch.config.models import Job
from bodycap_batch.core.errors import BodycapError, StoreError
from bodycap_batch.store.artefacts import store_error
from bodycap_batch.watch.claim import Claim, first_claim, is_at_work
from bodycap_batch.watch.drops import Drop, Look, look_at
from bodycap_batch.watch.intake import Terms, other_job_files, read_drop, write_job
from bodycap_batch.watch.spool import CLAIM_PREFIX, RETRY_PREFIX, JobDir, Spool, move, spool_name
from bodycap_batch.watch.status import StatusFile, read_status


def claim_drop(
    spool: Spool, drop: Drop, look: Look, terms: Terms
) -> tuple[Claim, BodycapError | None] | None:
    """Take a complete drop out of the inbox.

    The job is read where it was dropped and written into a folder that nobody sees. Renaming the drop into
    that folder is the claim: of two watchers one finds nothing left to rename. Then the folder gets its name
    in `running`.

    Returns:
        The claim and what is wrong with the job, if anything; None where another watcher was quicker, or
        the drop is still being written to after all.

    Raises:
        StoreError: The drop cannot be moved.
    """
    place = JobDir(spool.running / f"{CLAIM_PREFIX}{uuid.uuid4().hex}")
    try:
        spool.running.mkdir(exist_ok=True)  # somebody may have tidied up
        place.path.mkdir()
        claim = first_claim(place)
        error = _prepare(place, drop, look, terms)
        if not _take(place, drop, look, terms):
            shutil.rmtree(place.path)
            return None
        settle_claim(spool, claim)
    except (OSError, StoreError) as failed:
        with contextlib.suppress(OSError, StoreError):  # else it stays claimed, and is adopted later
            give_back(spool, place)
        raise store_error(failed, drop.path) if isinstance(failed, OSError) else failed from failed
    return claim, error


def settle_claim(spool: Spool, claim: Claim) -> None:
    """Give a claimed folder its name in `running`."""
    before = read_status(claim.job, strict=True)
    status = StatusFile(claim.job, before)
    dropped = str(before.get("dropped") or "job")
    wanted = spool_name(Path(dropped).stem if before.get("kind") == "file" else dropped)

    def rename(target: Path) -> None:
        status.change(name=target.name)

    claim.moved_to(JobDir(move(claim.job.path, spool.running, spool.free_name(wanted), rename)))


def discard_empty(place: JobDir) -> bool:
    """Remove a folder that was made to claim something, if nothing was; False where a drop is in it.

    It gets another name before it is looked at: whoever made it and wakes up now finds no place to put a
    drop into.
    """
    hidden = JobDir(place.path.with_name(f"{CLAIM_PREFIX}{uuid.uuid4().hex}"))
    os.rename(place.path, hidden.path)
    if is_there(dropped_in(hidden)):
        os.rename(hidden.path, place.path)
        return False
    shutil.rmtree(hidden.path, ignore_errors=True)
    return True


def is_there(path: Path) -> bool:
    """Whether a file, folder or link is there; a disk that does not answer raises `OSError`."""
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def dropped_in(place: JobDir) -> Path:
    """What was dropped: the folder, or the job file that came alone."""
    document = read_status(place, strict=True)
    return place.input / str(document.get("dropped")) if document.get("kind") == "file" else place.input


def give_back(spool: Spool, place: JobDir, before: Callable[[Path], None] | None = None) -> Path | None:
    """Put what was dropped back into the inbox and remove the rest.

    Args:
        spool: The spool.
        place: The job's folder.
        before: Called with the target just before the move.

    Returns:
        Where it lies now; None where nothing had been dropped, or another process has put it back.
    """
    dropped, target = dropped_in(place), None
    if is_there(dropped):
        name = str(read_status(place, strict=True).get("dropped") or place.name)
        suffix = dropped.suffix if dropped != place.input else ""
        try:
            target = move(dropped, spool.inbox, name, before, suffix=suffix)
        except FileNotFoundError:
            if is_there(dropped):
                raise
    shutil.rmtree(place.path, ignore_errors=True)
    return target


def finish_retries(spool: Spool) -> None:
    """Finish moves back into the inbox that a killed `retry` began."""
    for path in sorted(spool.failed.glob(f"{RETRY_PREFIX}*")):
        if not is_at_work(path.name.removeprefix(RETRY_PREFIX)):
            with contextlib.suppress(FileNotFoundError):  # another watcher is just doing it
                give_back(spool, JobDir(path))


def _prepare(place: JobDir, drop: Drop, look: Look, terms: Terms) -> BodycapError | None:
    """Read the job and write all but its input; returns what is wrong with it."""
    job, error = _read(drop, look, terms)
    if job is not None:
        write_job(job, place, drop.path.parent / drop.path.name if not drop.is_file else place.input)
    status = StatusFile(place)
    for name in [] if drop.is_file else other_job_files(drop.path):
        status.note(f"{name} was not read: a job file in a folder is called job.yaml")
    status.change(kind="file" if drop.is_file else "folder", dropped=drop.path.name)
    return error


def _take(place: JobDir, drop: Drop, look: Look, terms: Terms) -> bool:
    """Rename the drop into the claimed folder; False where it is gone, or changes still."""
    if drop.is_file:
        place.input.mkdir()
    target = place.input / drop.path.name if drop.is_file else place.input
    leads_to = os.path.realpath(drop.path) if drop.path.is_symlink() else ""
    try:
        os.rename(drop.path, target)
    except FileNotFoundError:
        return False
    if leads_to:  # a relative link would lead elsewhere from its new place
        whole = place.path / "link"
        whole.symlink_to(leads_to)
        os.replace(whole, target)
        return True
    if look_at(Drop(target), int(terms.limits.files)).digest == look.digest:
        return True
    move(target, drop.path.parent, drop.path.name)
    return False


def _read(drop: Drop, look: Look, terms: Terms) -> tuple[Job | None, BodycapError | None]:
    try:
        return read_drop(drop, look, terms), None
    except BodycapError as error:
        return None, error
