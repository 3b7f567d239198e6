"""One claimed job: run it, say how it ended, file it away."""

from __future__ import annotations

import os
import socket
import threading
import traceback
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from bodycap_batch.core.errors import BodycapError, Cancelled, DiskAway, JobError, StoreError, error_from_dict
from bodycap_batch.pipeline import Settings, run_job
from bodycap_batch.runner.turns import Turns
from bodycap_batch.store.artefacts import Store, store_error
from bodycap_batch.store.references import StoreBusy, moving
from bodycap_batch.watch.claim import Claim, clear_claim
from bodycap_batch.watch.intake import read_job, rewrite_results
from bodycap_batch.watch.options import WatchOptions
from bodycap_batch.watch.spool import JobDir, Spool, move
from bodycap_batch.watch.status import FINAL, State, StatusFile, append_log, read_status, time_text

_MOST_SETBACKS = 5
"""A job whose disk fails again and again, although it can be looked at in between, has failed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """How a job ended.

    Attributes:
        name: The job.
        state: As in `status.json`; "lost" where another watcher has it now.
        exit_code: 0, that of the error, or 70.
        message: One line for the operator.
        place: Where the job lies now.
    """

    name: str
    state: str
    exit_code: int = 0
    message: str = ""
    place: Path | None = None


class Worker:
    """Works on claimed jobs; one instance for all of them.

    Args:
        spool: The spool.
        options: How it is watched.
        stop: Set when the watcher is to end.
    """

    def __init__(self, spool: Spool, options: WatchOptions, stop: threading.Event) -> None:
        self._spool = spool
        self._options = options
        self._stop = stop
        self._setbacks: Counter[str] = Counter()
        self._turns = Turns()
        self._store = Store(options.store or spool.root / ".store")

    def work(self, claim: Claim, refused: BodycapError | None = None) -> Outcome:
        """Take a claimed job to its end: filed away, or left for the next watcher.

        Args:
            claim: The hold on the job.
            refused: What was found wrong with it when it was read.
        """
        try:
            return self._work(claim, refused)
        except (BodycapError, OSError) as error:
            return self._stuck(claim, error)

    def _work(self, claim: Claim, refused: BodycapError | None) -> Outcome:
        before = read_status(claim.job, strict=True)
        if before.get("state") in FINAL:  # all was said before its watcher ended, but for the move
            return self._file(claim, before["state"], _told(before), None)
        status = StatusFile(claim.job, before, claim.guard.holds)
        try:
            if refused is not None:
                raise refused
            self._run(claim, status)
        except Cancelled as error:
            return self._interrupted(claim, status, error)
        except StoreBusy as error:  # `bodycap gc` is at work: seconds, and nothing has been attempted
            status.document["attempts"] = int(before.get("attempts", 0))
            return self._leave(claim, status, error)
        except DiskAway as error:
            return self._put_off(claim, status, error)
        except BodycapError as error:
            return self._end(claim, status, "failed", error)
        except Exception as error:  # noqa: BLE001 - the one place where a job's bugs are caught
            away = store_error(error, claim.job.path) if isinstance(error, OSError) else None
            if isinstance(away, DiskAway):
                return self._put_off(claim, status, away)
            append_log(claim.job, traceback.format_exc())
            hint = "this is a bug in bodycap; please report it with this log and the job"
            bug = BodycapError(f"{type(error).__name__}: {error}", path=claim.job.log, hint=hint)
            return self._end(claim, status, "failed", bug)
        return self._end(claim, status, "done", None)

    def _run(self, claim: Claim, status: StatusFile) -> None:
        place = claim.job
        self._check_cancelled(claim)
        status.change(
            state="running",
            started_at=time_text(),
            attempts=status.document["attempts"] + 1,
            host=socket.gethostname(),
            generation=claim.generation,
            store=str(self._store.root),
        )
        if not place.job.is_file():  # its watcher ended before the job was written down
            raise JobError("the job was never read", path=place.input, hint="retry it: it is read anew")
        job = read_job(place, self._options.terms)
        settings = Settings(
            store=self._store,
            threads=max(1, self._options.threads // self._options.jobs),
            listener=status,
            cancelled=lambda: self._is_cancelled(claim),
            command=self._options.command,
            may_commit=claim.guard.holds,
            limits=self._options.terms.limits,
            turns=self._turns,
        )
        try:
            run_job(job, out_dir=place.result, settings=settings)
        finally:
            if claim.guard.holds():
                rewrite_results(place, job)

    def _is_cancelled(self, claim: Claim) -> bool:
        return self._stop.is_set() or claim.lost.is_set() or claim.job.cancel.exists()

    def _check_cancelled(self, claim: Claim) -> None:
        if self._is_cancelled(claim):
            raise Cancelled("stopped before it was started", hint="retry it")

    def _interrupted(self, claim: Claim, status: StatusFile, error: Cancelled) -> Outcome:
        """The user cancelled the job, the watcher ends, or another watcher has the job."""
        name = claim.job.name
        if not claim.guard.holds():
            claim.lost.set()
            return Outcome(name=name, state="lost", message="another watcher has taken it over")
        if claim.job.cancel.exists():
            error = Cancelled("cancelled; finished stages are kept", hint=f"`bodycap retry {name}` goes on")
            return self._end(claim, status, "cancelled", error)
        return self._leave(claim, status, error)

    def _put_off(self, claim: Claim, status: StatusFile, error: DiskAway) -> Outcome:
        """Begin again once the disk has had time: the claim beats no more, and is taken over when stale."""
        name = claim.job.name
        if any(not stage["reused"] for stage in status.document["finished_stages"]):
            del self._setbacks[name]  # it has come further since
        if _answers(Path(error.path or claim.job.path)):
            self._setbacks[name] += 1
        if self._setbacks[name] > _MOST_SETBACKS:
            return self._end(claim, status, "failed", error)
        claim.end()
        append_log(claim.job, f"put off: {error}")
        status.change(state="stopped", active={}, error=error.to_dict())
        return self._stuck(claim, error)

    def _stuck(self, claim: Claim, error: Exception) -> Outcome:
        """The spool's own disk fails: tried again once the claim is stale."""
        claim.end()
        code, name = StoreError.exit_code, claim.job.name
        return Outcome(name=name, state="stuck", exit_code=code, message=f"goes on later: {error}")

    def _leave(self, claim: Claim, status: StatusFile, error: BodycapError) -> Outcome:
        """Leave the job where it is, for the next watcher or a later look of this one."""
        held_up_by = None if isinstance(error, Cancelled) else error.to_dict()
        status.change(state="stopped", active={}, error=held_up_by)
        return self._release(claim, error)

    def _release(self, claim: Claim, error: BodycapError) -> Outcome:
        claim.release()
        message = (
            "goes on at the next start" if isinstance(error, Cancelled) else f"goes on later: {error.message}"
        )
        return Outcome(name=claim.job.name, state="stopped", exit_code=error.exit_code, message=message)

    def _end(self, claim: Claim, status: StatusFile, state: State, error: BodycapError | None) -> Outcome:
        del self._setbacks[claim.job.name]
        if error is not None:
            append_log(claim.job, f"{state}: {error}")
        return self._file(claim, state, error, status)

    def _file(
        self, claim: Claim, state: State, error: BodycapError | None, status: StatusFile | None
    ) -> Outcome:
        """Say the last word and move the job where it belongs; while the store is cleaned, leave the move."""
        try:
            return self._move(claim, state, error, status)
        except StoreBusy as busy:
            if status is not None:
                status.finish(state, error, self._folder(state) / claim.job.name, self._spool.inbox)
            return self._release(claim, busy)

    def _folder(self, state: State) -> Path:
        return self._spool.done if state == "done" else self._spool.failed

    def _move(
        self, claim: Claim, state: State, error: BodycapError | None, status: StatusFile | None
    ) -> Outcome:
        folder = self._folder(state)
        with moving(self._store, claim.job.result, wait=False) as keep_for:
            claim.end()
            if not claim.guard.holds():
                return Outcome(name=claim.job.name, state="lost", message="another watcher has taken it over")

            def last_word(target: Path) -> None:
                keep_for(JobDir(target).result)
                if status is not None:
                    status.finish(state, error, target, self._spool.inbox)

            folder.mkdir(exist_ok=True)  # cleared away by somebody who has taken the results
            target = move(claim.job.path, folder, claim.job.name, last_word)
        clear_claim(JobDir(target))
        return Outcome(
            name=target.name,
            state=state,
            exit_code=0 if error is None else error.exit_code,
            message="" if error is None else error.message,
            place=target,
        )


def _answers(path: Path) -> bool:
    """Whether the disk of a file that could not be read lets itself be looked at: the file is at fault then.

    One that does not is away, and is waited for however long that takes.
    """
    try:
        os.statvfs(path.parent)
        os.listdir(path.parent)
    except OSError as error:
        return not isinstance(store_error(error, path), DiskAway)
    return True


def _told(document: dict[str, object]) -> BodycapError | None:
    """The error that a status tells, as far as its exit code and message matter."""
    error = document.get("error")
    if not isinstance(error, dict):
        return None
    return error_from_dict(error)
