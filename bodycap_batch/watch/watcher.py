"""Watch a folder: claim complete jobs, run them, and take over abandoned jobs."""

from __future__ import annotations

import collections
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from bodycap_batch.core.errors import BodycapError, StoreError, one_line
from bodycap_batch.watch.access_failures import AccessFailures
from bodycap_batch.watch.change_notifier import ChangeNotifier
from bodycap_batch.watch.claim import Claim, HeartbeatMonitor, take_over_job
from bodycap_batch.watch.inbox_claim import (
    claim_entry,
    finish_interrupted_retries,
    move_to_running,
    remove_empty_claim,
)
from bodycap_batch.watch.inbox_entries import (
    NOT_A_JOB,
    CompletionTracker,
    EntrySnapshot,
    InboxEntry,
    entries_in,
    ignored_paths_in,
)
from bodycap_batch.watch.job_worker import JobOutcome, JobWorker
from bodycap_batch.watch.spool import CLAIM_PREFIX, JobDir, Spool, visible_entries
from bodycap_batch.watch.watch_options import WatchOptions
from bodycap_batch.watch.watcher_status import WatcherStatusFile

MessageSink = Callable[[str], None]
_BUSY_POLL_S = 1.0
"""Time (seconds) between two scans of the inbox while a job runs, an entry is in the inbox, or jobs of other
watchers may have to be taken over. Evidence: none."""
_IDLE_POLL_S = 5.0
"""Time (seconds) between two scans while no job runs, the inbox is empty, and no jobs are left to take over.
The scans find changes that the system does not report. Evidence: none."""
_SCAN_PAUSE_FACTOR = 20.0
"""Minimum ratio of the time between two scans to the duration of a scan. With a ratio of 20, scans take at
most 5 % of the time. A scan of a thousand large folders on a slow disk takes several seconds."""
_TAKEOVER_PERIOD_S = 2.0
"""Minimum time (seconds) between two searches for abandoned jobs. Evidence: none."""


class Watcher:
    """One process that runs the jobs of a spool. Several processes may work on the same spool.

    Args:
        spool: The folders of the watcher.
        options: Options of the watcher.
        write_line: Function that is called with each line for the operator.

    Attributes:
        spool: The folders of the watcher.
        access_failures: Tracker of failures to access the folders.

    Raises:
        StoreError: A folder cannot be created or written, or the folders are on different file systems.
    """

    def __init__(self, spool: Spool, options: WatchOptions, write_line: MessageSink) -> None:
        spool.make()
        self.access_failures = AccessFailures(spool, write_line)
        self.spool = spool
        self._options = options
        self._write_line = write_line
        self._stop = threading.Event()
        self._woken = threading.Event()
        self._tracker = CompletionTracker(options.unchanged_s, int(options.permissions.limits.files))
        self._heartbeat_monitor = HeartbeatMonitor(options.stale_s)
        self._worker = JobWorker(spool, options, self._stop)
        self._running: dict[Future[JobOutcome], Claim] = {}
        self._unmovable: dict[str, tuple[str, float]] = {}
        self._reported: dict[Path, str] = {}
        self._complete: collections.deque[tuple[InboxEntry, EntrySnapshot]] = collections.deque()
        self._retry_failure_reported = False
        self._last_reports: dict[str, str] = {}
        self._has_waiting = False
        self._has_left_jobs = False
        self._next_scan_at = 0.0
        self._next_takeover_at = 0.0
        self._worst_exit_code = 0

    def stop(self) -> None:
        """End the watcher.

        Running jobs stop, and continue at the next start. Any thread may call this method.
        """
        self._stop.set()
        self._woken.set()

    def run(self) -> int:
        """Watch until `stop` is called. With the option `once`, also end when nothing is left to do.

        The watcher waits for a missing disk, with growing pauses between its attempts. With `once`, it waits
        for at most `stale_s` seconds. A job without a heartbeat is taken over after the same time.

        Returns:
            The highest exit code of the jobs that ended and of the watcher's own disk failures.
        """
        heartbeat = threading.Thread(target=self._write_heartbeats, name="heartbeat")
        with (
            ChangeNotifier(
                self.spool.inbox, self._woken, poll=self._options.poll, write_line=self._write_line
            ),
            ThreadPoolExecutor(max_workers=self._options.jobs, thread_name_prefix="job") as pool,
        ):
            heartbeat.start()
            try:
                while not self._stop.is_set():
                    self._collect()
                    if (pause_s := self._step(pool)) is None:
                        break
                    self._woken.wait(pause_s)
                    self._woken.clear()  # no stop is lost: `stop` sets `_stop` before `_woken`
            finally:
                self._stop.set()
                heartbeat.join()
        self._collect()
        return self._worst_exit_code

    def _step(self, pool: ThreadPoolExecutor) -> float | None:
        """Start the jobs that can start. Return the time (seconds) until the next scan, or None to end."""
        try:
            is_finished = not self._fill(pool) and self._options.once
            if is_finished:
                self._report_left_entries()
        except (OSError, StoreError) as error:
            pause_s = self.access_failures.record(error)
            if not self._options.once or self.access_failures.duration_s < self._options.stale_s:
                return pause_s
            self._worst_exit_code = max(self._worst_exit_code, StoreError.exit_code)
            return None
        self.access_failures.clear()
        if is_finished:
            return None
        return (
            _BUSY_POLL_S
            if self._tracker.is_tracking or self._running or self._has_left_jobs
            else _IDLE_POLL_S
        )

    def _finish_retries(self) -> None:
        try:
            finish_interrupted_retries(self.spool)
        except (OSError, StoreError) as error:
            if not self._retry_failure_reported:
                where = f"an interrupted retry in {self.spool.failed}"
                self._write_line(f"{where} cannot be completed: {one_line(error)}")
            self._retry_failure_reported = True

    def _report_left_entries(self) -> None:
        """Report for each path that stays in the inbox why it is not processed."""
        for path, reason in self._tracker.incomplete.items():
            self._write_line(f"{path.name} stays in the inbox: {reason}")
        for path in ignored_paths_in(self.spool.inbox):
            self._write_line(f"{path.name} stays in the inbox: {NOT_A_JOB}")

    def _write_heartbeats(self) -> None:
        status_file = WatcherStatusFile(self.spool)
        status_file.write(self.access_failures.text)
        while not self._stop.wait(self._options.heartbeat_period_s):
            status_file.write(self.access_failures.text)
            for claim in list(self._running.values()):
                claim.write_heartbeat()
        status_file.remove()

    def _collect(self) -> None:
        """Report the jobs that have ended."""
        for future in [future for future in self._running if future.done()]:
            del self._running[future]
            outcome = future.result()
            self._has_left_jobs |= outcome.state == "stopped"
            if outcome.state not in ("lost", "stopped"):
                self._worst_exit_code = max(self._worst_exit_code, outcome.exit_code)
            self._report_end(outcome)

    def _report_end(self, outcome: JobOutcome) -> None:
        """Report how a job ended.

        If the job is postponed again for the same reason, report the reason once.
        """
        where = f" -> {outcome.path}" if outcome.path is not None else ""
        line = f"{outcome.name}: {outcome.state}{where}" + (f": {outcome.message}" if outcome.message else "")
        if line != self._last_reports.pop(outcome.name, ""):
            self._write_line(line)
        if outcome.state in ("stopped", "stuck"):
            self._last_reports[outcome.name] = line

    def _fill(self, pool: ThreadPoolExecutor) -> bool:
        """Start jobs up to the maximum number. Return False if no job runs and no job is expected."""
        free = self._options.jobs - len(self._running)
        for claim in self._take_over_abandoned(free):
            self._start(pool, claim, None)
            free -= 1
        self._scan_inbox()
        while free > 0 and self._complete:
            if (claimed := self._try_claim(*self._complete.popleft())) is not None:
                self._start(pool, *claimed)
                free -= 1
        return bool(self._running or self._complete or self._has_waiting or self._has_left_jobs)

    def _scan_inbox(self) -> None:
        """Scan the inbox if enough time has passed since the last scan (see `_SCAN_PAUSE_FACTOR`)."""
        started = time.monotonic()
        if started < self._next_scan_at:
            return
        if not self.spool.inbox.is_dir():
            raise StoreError(
                "the inbox no longer exists",
                path=self.spool.inbox,
                hint="mount the disk of the inbox, or create the inbox again",
            )
        entries = entries_in(self.spool.inbox)
        self._complete = collections.deque(self._tracker.complete_entries(entries))
        names = {str(entry.path) for entry in entries}
        self._unmovable = {name: value for name, value in self._unmovable.items() if name in names}
        self._has_waiting = bool(names - self._unmovable.keys() - set(map(str, self._tracker.incomplete)))
        self._report_incomplete()
        now = time.monotonic()
        self._next_scan_at = now + _SCAN_PAUSE_FACTOR * (now - started)

    def _report_incomplete(self) -> None:
        """Report each entry that cannot be read or is not complete, once for each reason."""
        tracker, found = self._tracker, dict(self._tracker.incomplete)
        for path, reason in found.items():
            if self._reported.get(path) == reason:
                continue
            if path in tracker.unreadable:
                self._worst_exit_code = max(self._worst_exit_code, StoreError.exit_code)
                self._write_line(f"{path.name}: cannot be read: {reason}")
            elif not self._options.once:  # otherwise the reasons are reported at the end
                self._write_line(f"{path.name} waits: {reason}")
        self._reported = found

    def _start(self, pool: ThreadPoolExecutor, claim: Claim, read_error: BodycapError | None) -> None:
        if read_error is None and claim.job.name not in self._last_reports:
            self._write_line(f"{claim.job.name}: started")
        future = pool.submit(self._worker.process, claim, read_error)
        self._running[future] = claim
        future.add_done_callback(lambda _: self._woken.set())

    def _try_claim(
        self, entry: InboxEntry, snapshot: EntrySnapshot
    ) -> tuple[Claim, BodycapError | None] | None:
        """Claim an entry. Return None if it cannot be claimed.

        If the entry cannot be moved, report this once, and try again after `stale_s` seconds or when the
        entry changes.
        """
        digest, until = self._unmovable.get(str(entry.path), ("", 0.0))
        if digest == snapshot.digest and time.monotonic() < until:
            return None
        try:
            return claim_entry(self.spool, entry, snapshot, self._options.permissions)
        except StoreError as error:
            self._unmovable[str(entry.path)] = (snapshot.digest, time.monotonic() + self._options.stale_s)
            self._worst_exit_code = max(self._worst_exit_code, error.exit_code)
            if digest != snapshot.digest:
                self._write_line(f"{entry.name}: cannot be moved out of the inbox: {error.one_line}")
            return None

    def _take_over_abandoned(self, max_jobs: int) -> list[Claim]:
        """Take over at most `max_jobs` jobs that other watchers abandoned."""
        now = time.monotonic()
        if max_jobs <= 0 or now < self._next_takeover_at:
            return []
        own_jobs = {claim.job.path for claim in self._running.values()}
        unfinished_claims = [JobDir(path) for path in sorted(self.spool.running.glob(f"{CLAIM_PREFIX}*"))]
        jobs = [
            *unfinished_claims,
            *(JobDir(path) for path in visible_entries(self.spool.running) if path.is_dir()),
        ]
        self._finish_retries()
        self._next_takeover_at = now + _TAKEOVER_PERIOD_S
        found: list[Claim] = []
        for job in self._heartbeat_monitor.find_abandoned([job for job in jobs if job.path not in own_jobs]):
            if len(found) < max_jobs and (claim := self._take_over(job)) is not None:
                found.append(claim)
        self._has_left_jobs = bool(found)  # more abandoned jobs may be left
        return found

    def _take_over(self, job: JobDir) -> Claim | None:
        """Take a job over. Return None if there is nothing to run, or if another watcher was faster.

        If the disk fails, also return None. The next attempt follows when the claim is stale again, that is,
        after `stale_s` seconds without a heartbeat.
        """
        try:
            claim = take_over_job(job)
            if claim is None or not job.path.name.startswith(CLAIM_PREFIX):
                return claim
            if remove_empty_claim(job):  # the claiming watcher ended before it moved the entry
                return None
            move_to_running(self.spool, claim)
        except (StoreError, OSError) as error:
            self._worst_exit_code = max(self._worst_exit_code, StoreError.exit_code)
            self._write_line(f"{job.name}: cannot be taken over: {one_line(error)}")
            return None
        return claim
