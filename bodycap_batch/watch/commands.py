"""What people ask of a spool: how its jobs are, to try one again, to cancel one."""

from __future__ import annotations

import os
import shutil
import time
import unicodedata
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from bodycap_batch.core.errors import Cancelled, JobError
from bodycap_batch.store.artefacts import Store, disk_errors
from bodycap_batch.store.references import moving
from bodycap_batch.watch.claim import clear_claim, first_claim, host_key, process_mark, start_of
from bodycap_batch.watch.claiming import dropped_in, give_back, is_there, settle_claim
from bodycap_batch.watch.drops import NO_JOB, Drop, drops_in, look_at, strays_in
from bodycap_batch.watch.guard import read_owner
from bodycap_batch.watch.spool import CLAIM_PREFIX, RETRY_PREFIX, JobDir, Spool, move, spool_name, visible
from bodycap_batch.watch.status import FINAL, StatusFile, read_status, time_text

_MANY_FILES = 1000
_LOOK_S = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class JobRow:
    """One job as a table shows it.

    Attributes:
        name: The job.
        state: waiting (in the inbox), ignored (no job), claimed, running, interrupted (its watcher is gone),
            stopped, done, failed, cancelled.
        stage: What it is at, camera included.
        progress: Share of the stage, None where it is not known.
        since: When the state began, UTC.
        age_s: Seconds since then.
        cause: What it waits for, or why it failed.
        hint: What to do about it.
        path: Where it lies.
    """

    name: str
    state: str
    stage: str = ""
    progress: float | None = None
    since: str = ""
    age_s: float | None = None
    cause: str = ""
    hint: str = ""
    path: str = ""

    def to_dict(self) -> dict[str, Any]:
        """The row as plain JSON values."""
        return asdict(self)


def rows_of(spool: Spool) -> list[JobRow]:
    """Every job of a spool: waiting, running, done, failed."""
    claimed = [claimed_row(JobDir(path)) for path in visible(spool.running) if path.is_dir()]
    ended = [claimed_row(JobDir(path)) for folder in (spool.done, spool.failed) for path in visible(folder)]
    return [*waiting_rows(spool), *claimed, *ended]


def waiting_rows(spool: Spool) -> list[JobRow]:
    """What lies in the inbox."""
    waiting = [_waiting(drop) for drop in drops_in(spool.inbox)]
    strays = [
        JobRow(
            name=path.name,
            state="ignored",
            cause=NO_JOB,
            hint="put videos into a folder and drop that",
            path=str(path),
        )
        for path in strays_in(spool.inbox)
    ]
    return [*waiting, *strays]


def retry_job(spool: Spool, name: str) -> Path:
    """Put a failed or cancelled job back into the inbox; finished stages are kept in the store.

    Returns:
        Where its input lies now.

    Raises:
        JobError: There is no such job, or it has not failed, or it is being retried already.
    """
    job = spool.find(name)
    if job is None or job.path.parent != spool.failed:
        raise _no_such(spool, name, "has not failed", [path.name for path in visible(spool.failed)])
    with disk_errors(job.path):
        if not is_there(dropped_in(job)):
            raise JobError("its input is gone", path=job.path, hint="drop the videos again")
        dropped = str(read_status(job).get("dropped") or job.name)
        hidden = JobDir(spool.failed / f"{RETRY_PREFIX}{process_mark()}-{uuid.uuid4().hex}")
        with _stages_kept(job, hidden, spool) as keep_for:
            keep_for(spool.inbox / dropped)
            try:
                os.rename(job.path, hidden.path)
            except FileNotFoundError:
                hint = "`bodycap status` lists all jobs"
                raise JobError(f"job {name!r} is just being retried", path=job.path, hint=hint) from None
            target = give_back(spool, hidden, keep_for)
    return target or spool.inbox / dropped


@contextmanager
def _stages_kept(job: JobDir, hidden: JobDir, spool: Spool) -> Iterator[Callable[[Path], None]]:
    """Keep a job's artefacts in the store on its way through the inbox, until it is at work again."""
    store = read_status(job).get("store")
    if not store or not (Path(store) / "artefacts").is_dir():
        yield lambda _: None  # it never got as far as a stage
        return
    with moving(Store(Path(store)), job.result) as keep_for:

        def bound_for(target: Path) -> None:
            names = {job.name, spool_name(target.name), spool_name(target.stem)}
            later = [folder / name for folder in (spool.running, spool.failed) for name in sorted(names)]
            keep_for(target, hidden.path, *later)

        yield bound_for


def cancel_job(spool: Spool, name: str, wait_s: float = 5.0) -> JobDir | None:
    """Cancel a job that waits or runs; what its finished stages gave stays in the store.

    Returns:
        Where it lies now (it may have come to its end before it could be stopped: `read_status` tells), None
        while no watcher has noticed: it is filed away when one does.

    Raises:
        JobError: There is no such job, or it has ended.
    """
    end = time.monotonic() + wait_s
    with disk_errors(spool.root):
        while (asked := _ask_to_cancel(spool, name)) is None:
            # A watcher is just claiming it: neither in the inbox nor under its name among the running ones.
            if time.monotonic() > end:
                return None
            time.sleep(_LOOK_S)
    if asked.path.parent != spool.running:
        return asked
    while asked.path.exists() and time.monotonic() < end:
        time.sleep(_LOOK_S)
    return None if asked.path.exists() else spool.find(name)


def _ask_to_cancel(spool: Spool, name: str) -> JobDir | None:
    """Cancel a job that waits, mark one that runs; None where it is on its way from the one to the other.

    On its way it is marked, too; but the mark is lost where what was dropped is put back.
    """
    waiting = [drop for drop in drops_in(spool.inbox) if _same(drop.name, name)]
    job = spool.find(name)
    try:
        if job is not None and job.path.parent == spool.running:
            job.cancel.touch()
            return job
        if waiting:
            return _cancel_waiting(spool, waiting[0])
        for place in map(JobDir, spool.running.glob(f"{CLAIM_PREFIX}*")):
            if name in _names_of(place):  # whoever claims it may be gone: the next watcher goes on with it
                place.cancel.touch()
                return None
    except FileNotFoundError:  # it has just been claimed, or filed away
        return None
    raise _no_such(spool, name, "is not waiting or running", [drop.name for drop in drops_in(spool.inbox)])


def _names_of(place: JobDir) -> tuple[str, ...]:
    """What a job that is just being claimed was called in the inbox."""
    dropped = str(read_status(place).get("dropped", ""))
    return dropped, Path(dropped).stem


def _cancel_waiting(spool: Spool, drop: Drop) -> JobDir:
    """Move a drop that nobody has claimed to the failed jobs; `FileNotFoundError` where somebody just has."""
    place = JobDir(spool.running / f"{CLAIM_PREFIX}{uuid.uuid4().hex}")
    place.path.mkdir()
    claim = first_claim(place)
    status = StatusFile(place)
    status.change(kind="file" if drop.is_file else "folder", dropped=drop.path.name)
    if drop.is_file:
        place.input.mkdir()
    try:
        os.rename(drop.path, dropped_in(place))
    except FileNotFoundError:
        shutil.rmtree(place.path)
        raise
    settle_claim(spool, claim)
    status.moved_to(claim.job)
    error = Cancelled("cancelled before it was started", hint=f"`bodycap retry {claim.job.name}` starts it")
    target = move(
        claim.job.path,
        spool.failed,
        claim.job.name,
        lambda path: status.finish("cancelled", error, path, spool.inbox),
    )
    clear_claim(JobDir(target))
    return JobDir(target)


def _waiting(drop: Drop) -> JobRow:
    try:
        waits_for = look_at(drop, _MANY_FILES).waits_for
        changed = drop.path.stat().st_mtime
    except OSError as error:
        return JobRow(name=drop.name, state="waiting", cause=str(error), path=str(drop.path))
    return JobRow(
        name=drop.name,
        state="waiting",
        since=time_text(changed),
        age_s=_age(time_text(changed)),
        cause=waits_for,
        path=str(drop.path),
    )


def claimed_row(job: JobDir) -> JobRow:
    """A job that has been claimed, as its files tell it."""
    status = read_status(job)
    state = str(status.get("state", "claimed"))
    if state == "running" and _is_alone(job):
        state = "interrupted"
    error = status.get("error") or {}
    began = (
        status.get("finished_at") if state in FINAL else status.get("started_at") or status.get("claimed_at")
    )
    running = state == "running"
    cause = str(error.get("message", ""))
    if state == "stopped" and cause:  # a disk that is away, a cleaner at work
        where = error.get("path")
        cause = f"goes on later: {f'{where}: ' if where else ''}{cause}"
    if state == "interrupted":
        cause = "its watcher is gone; it goes on when one starts"
    return JobRow(
        name=job.name,
        state=state,
        stage=f"{status.get('stage', '')} {status.get('camera', '')}".strip() if state != "done" else "",
        progress=status.get("progress") if running else None,
        since=str(began or ""),
        age_s=_age(began),
        cause=cause,
        hint=str(error.get("hint") or ""),
        path=str(job.path),
    )


def _is_alone(job: JobDir) -> bool:
    owner = read_owner(job.owner)
    here = bool(host_key()) and owner.get("machine") == host_key()
    return bool(owner.get("released")) or (
        here and start_of(int(owner.get("pid", 0))) != owner.get("process")
    )


def _age(moment: object) -> float | None:
    try:
        return round(time.time() - datetime.fromisoformat(str(moment)).timestamp(), 1)
    except ValueError:
        return None


def _same(one: str, other: str) -> bool:
    return unicodedata.normalize("NFC", one) == unicodedata.normalize("NFC", other)


def _no_such(spool: Spool, name: str, why: str, names: list[str]) -> JobError:
    import difflib

    known = spool.find(name)
    if known is not None:
        state = read_status(known).get("state", known.path.parent.name)
        return JobError(
            f"job {name!r} {why}: it is {state}", path=known.path, hint="`bodycap status` lists all jobs"
        )
    near = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean {near[0]!r}?" if near else "`bodycap status` lists all jobs"
    return JobError(f"no job named {name!r}", path=spool.root, hint=hint)
