"""Watch a folder: claim what is complete, work on it, take over what was left behind."""

from __future__ import annotations

import collections
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from bodycap_batch.core.errors import BodycapError, StoreError
from bodycap_batch.watch.changes import Changes
from bodycap_batch.watch.claim import Claim, Onlooker, take_over
from bodycap_batch.watch.claiming import claim_drop, discard_empty, finish_retries, settle_claim
from bodycap_batch.watch.drops import NO_JOB, Drop, Look, Settling, drops_in, strays_in
from bodycap_batch.watch.options import WatchOptions
from bodycap_batch.watch.presence import Presence
from bodycap_batch.watch.spool import CLAIM_PREFIX, JobDir, Spool, visible
from bodycap_batch.watch.trouble import Trouble
from bodycap_batch.watch.work import Outcome, Worker

Teller = Callable[[str], None]
_LOOK_S = 1.0
_IDLE_LOOK_S = 5.0
"""A look at the folder although nobody told a change, with and without something being copied."""
_LOOK_SHARE = 20.0
"""A thousand large folders on a slow disk take seconds to look at: then one look in twenty times that."""
_ORPHANS_S = 2.0


class Watcher:
    """One process that works on a spool; others may work on the same one.

    Args:
        spool: The folders.
        options: How they are watched.
        tell: Called with a line for the operator.

    Attributes:
        spool: The folders.
        trouble: What keeps it from them, while something does.

    Raises:
        StoreError: The folders cannot be written, or do not lie on one file system.
    """

    def __init__(self, spool: Spool, options: WatchOptions, tell: Teller) -> None:
        spool.make()
        self.trouble = Trouble(spool, tell)
        self.spool = spool
        self._options = options
        self._tell = tell
        self._stop = threading.Event()
        self._woken = threading.Event()
        self._settling = Settling(options.settle_s, int(options.terms.limits.files))
        self._onlooker = Onlooker(options.stale_s)
        self._worker = Worker(spool, options, self._stop)
        self._running: dict[Future[Outcome], Claim] = {}
        self._refused: dict[str, tuple[str, float]] = {}
        self._unreadable: dict[Path, str] = {}
        self._complete: collections.deque[tuple[Drop, Look]] = collections.deque()
        self._retry_told = False
        self._held_up: dict[str, str] = {}
        self._waiting = False
        self._left = False
        self._look_at = 0.0
        self._orphans_at = 0.0
        self._worst = 0

    def stop(self) -> None:
        """End: running jobs stop and are left for the next start. May be called from anywhere."""
        self._stop.set()
        self._woken.set()

    def run(self) -> int:
        """Watch until stopped, or with `once` until nothing is left to do.

        A disk that goes away is waited for, with growing pauses; with `once` no longer than a job of another
        watcher is.

        Returns:
            The worst exit code of the jobs that ended.
        """
        heart = threading.Thread(target=self._beat, name="heartbeat")
        with (
            Changes(self.spool.inbox, self._woken, poll=self._options.poll),
            ThreadPoolExecutor(max_workers=self._options.jobs, thread_name_prefix="job") as pool,
        ):
            heart.start()
            try:
                while not self._stop.is_set():
                    self._collect()
                    if (pause_s := self._step(pool)) is None:
                        break
                    self._woken.wait(pause_s)
                    self._woken.clear()  # and only then look whether to stop: `stop` says so before it wakes
            finally:
                self._stop.set()
                heart.join()
        self._collect()
        return self._worst

    def _step(self, pool: ThreadPoolExecutor) -> float | None:
        """Start what can be started; seconds until the next look, None where none is wanted."""
        try:
            over = not self._fill(pool) and self._options.once
            if over:
                self._tell_what_is_left()
        except (OSError, StoreError) as error:
            pause_s = self.trouble.met(error)
            if not self._options.once or self.trouble.lasted_s < self._options.stale_s:
                return pause_s
            self._worst = max(self._worst, StoreError.exit_code)
            return None
        self.trouble.over()
        if over:
            return None
        return _LOOK_S if self._settling.waiting or self._running or self._left else _IDLE_LOOK_S

    def _finish_retries(self) -> None:
        try:
            finish_retries(self.spool)
        except (OSError, StoreError) as error:
            if not self._retry_told:
                self._tell(f"a retry that was cut short is still in {self.spool.failed}: {error}")
            self._retry_told = True

    def _tell_what_is_left(self) -> None:
        """Say why something stays in the inbox although nothing is left to do."""
        for path, reason in self._settling.held.items():
            self._tell(f"{path.name}: left in the inbox: {reason}")
        for path in strays_in(self.spool.inbox):
            self._tell(f"{path.name}: left in the inbox: {NO_JOB}")

    def _beat(self) -> None:
        presence = Presence(self.spool)
        presence.tell(self.trouble.text)
        while not self._stop.wait(self._options.beat_s):
            presence.tell(self.trouble.text)
            for claim in list(self._running.values()):
                claim.beat()
        presence.end()

    def _collect(self) -> None:
        """Tell how the jobs ended that have."""
        for future in [future for future in self._running if future.done()]:
            del self._running[future]
            outcome = future.result()
            self._left |= outcome.state == "stopped"
            if outcome.state not in ("lost", "stopped"):
                self._worst = max(self._worst, outcome.exit_code)
            self._tell_end(outcome)

    def _tell_end(self, outcome: Outcome) -> None:
        """Say how a job ended; what holds it up time and again only once."""
        where = f" -> {outcome.place}" if outcome.place is not None else ""
        line = f"{outcome.name}: {outcome.state}{where}" + (f": {outcome.message}" if outcome.message else "")
        if line != self._held_up.pop(outcome.name, ""):
            self._tell(line)
        if outcome.state in ("stopped", "stuck"):
            self._held_up[outcome.name] = line

    def _fill(self, pool: ThreadPoolExecutor) -> bool:
        """Start jobs while there is room; False where nothing runs and nothing is to come."""
        free = self._options.jobs - len(self._running)
        for claim in self._orphans(free):
            self._start(pool, claim, None)
            free -= 1
        self._look()
        while free > 0 and self._complete:
            if (claimed := self._claim(*self._complete.popleft())) is not None:
                self._start(pool, *claimed)
                free -= 1
        return bool(self._running or self._complete or self._waiting or self._left)

    def _look(self) -> None:
        """See what lies in the inbox; not so often that looking is all there is time for."""
        started = time.monotonic()
        if started < self._look_at:
            return
        if not self.spool.inbox.is_dir():
            raise StoreError(
                "the inbox is gone", path=self.spool.inbox, hint="mount its disk, or make it again"
            )
        drops = drops_in(self.spool.inbox)
        self._complete = collections.deque(self._settling.complete(drops))
        names = {str(drop.path) for drop in drops}
        self._refused = {name: told for name, told in self._refused.items() if name in names}
        self._waiting = bool(names - self._refused.keys() - set(map(str, self._settling.held)))
        self._tell_unreadable()
        now = time.monotonic()
        self._look_at = now + _LOOK_SHARE * (now - started)

    def _tell_unreadable(self) -> None:
        """Say once what cannot even be looked at."""
        found = self._settling.unreadable
        for path in found.keys() - self._unreadable.keys():
            self._worst = max(self._worst, StoreError.exit_code)
            self._tell(f"{path.name}: cannot be looked at: {found[path]}")
        self._unreadable = found

    def _start(self, pool: ThreadPoolExecutor, claim: Claim, refused: BodycapError | None) -> None:
        if refused is None and claim.job.name not in self._held_up:
            self._tell(f"{claim.job.name}: started")
        future = pool.submit(self._worker.work, claim, refused)
        self._running[future] = claim
        future.add_done_callback(lambda _: self._woken.set())

    def _claim(self, drop: Drop, look: Look) -> tuple[Claim, BodycapError | None] | None:
        """Claim a drop; one that cannot be moved is told once, and tried again later or when it changes."""
        digest, until = self._refused.get(str(drop.path), ("", 0.0))
        if digest == look.digest and time.monotonic() < until:
            return None
        try:
            return claim_drop(self.spool, drop, look, self._options.terms)
        except StoreError as error:
            self._refused[str(drop.path)] = (look.digest, time.monotonic() + self._options.stale_s)
            self._worst = max(self._worst, error.exit_code)
            if digest != look.digest:
                self._tell(f"{drop.name}: cannot be taken out of the inbox: {error}")
            return None

    def _orphans(self, most: int) -> list[Claim]:
        """Take over jobs whose watcher is gone."""
        now = time.monotonic()
        if most <= 0 or now < self._orphans_at:
            return []
        mine = {claim.job.path for claim in self._running.values()}
        half_claimed = [JobDir(path) for path in sorted(self.spool.running.glob(f"{CLAIM_PREFIX}*"))]
        jobs = [*half_claimed, *(JobDir(path) for path in visible(self.spool.running) if path.is_dir())]
        self._finish_retries()
        self._orphans_at = now + _ORPHANS_S
        found: list[Claim] = []
        for job in self._onlooker.abandoned([job for job in jobs if job.path not in mine]):
            if len(found) < most and (claim := self._adopt(job)) is not None:
                found.append(claim)
        self._left = bool(found)  # there may be more of them than there was room for
        return found

    def _adopt(self, job: JobDir) -> Claim | None:
        """Take a job over; one that the disk does not let go of is tried again when it is stale anew."""
        try:
            claim = take_over(job)
            if claim is None or not job.path.name.startswith(CLAIM_PREFIX):
                return claim
            if discard_empty(job):  # its watcher ended before it had claimed anything
                return None
            settle_claim(self.spool, claim)
        except (StoreError, OSError) as error:
            self._worst = max(self._worst, StoreError.exit_code)
            self._tell(f"{job.name}: cannot be taken over: {error}")
            return None
        return claim
