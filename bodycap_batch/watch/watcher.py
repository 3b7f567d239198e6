"""Watch a folder: claim complete jobs, run them, and continue jobs that were stopped."""

from __future__ import annotations

import collections
import shutil
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from bodycap_batch.core.errors import StoreError, one_line, worst_exit_code
from bodycap_batch.store.artefacts import store_error
from bodycap_batch.watch.inbox_claim import (
    claim_entry,
    finish_interrupted_retries,
    input_path,
    is_unfinished_claim,
    path_exists,
)
from bodycap_batch.watch.inbox_entries import (
    NOT_A_JOB,
    CompletionTracker,
    EntrySnapshot,
    InboxEntry,
    entries_in,
    ignored_paths_in,
)
from bodycap_batch.watch.job_status import FINAL, read_status
from bodycap_batch.watch.job_worker import JobOutcome, JobWorker, WatchOptions
from bodycap_batch.watch.spool import JobDir, Spool, visible_entries
from bodycap_batch.watch.watcher_status import WatcherStatusFile


class AccessFailures:
    """Track failures to access the folders of a spool.

    The operator gets one line when the failures start, one line for each different failure, and one line when
    the failures end.

    Args:
        spool: The spool that the watcher cannot access.
        write_line: Function that is called with each line for the operator.
        clock: Function that returns the time (seconds) of this process's monotonic clock.

    Attributes:
        current: The latest failure; None while the folders are accessible.
    """

    def __init__(
        self, spool: Spool, write_line: Callable[[str], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._spool = spool
        self._write_line = write_line
        self._clock = clock
        self._since = 0.0
        self.current: StoreError | None = None

    @property
    def text(self) -> str:
        """The current failure as text; "" if there is no failure."""
        failure = self.current  # read only once: the live page reads it in another thread
        return "" if failure is None else f"{failure.path}: {failure.message}"

    @property
    def duration_s(self) -> float:
        """Time (seconds) since the first of the current failures; 0 if there is no failure."""
        return 0.0 if self.current is None else self._clock() - self._since

    def record(self, error: OSError | StoreError) -> None:
        """Record a failure."""
        previous_text = self.text
        failure = store_error(error, self._spool.root) if isinstance(error, OSError) else error
        if self.current is None:
            self._since = self._clock()
        self.current = failure
        if self.text != previous_text:
            self._write_line(
                f"{self.text}; the watcher tries again until the folder is accessible ({failure.hint})"
            )

    def clear(self) -> None:
        """Record that the folders are accessible again."""
        if self.current is not None:
            self._write_line(
                f"{self._spool.root} is accessible again after {self.duration_s:.0f} s; the watcher continues"
            )
        self.current = None


MessageSink = Callable[[str], None]
_POLL_S = 1.0
"""Time (seconds) between two scans of the folders. Derivation: an entry must not change for `unchanged_s`, 10
seconds, before its job starts, so a job starts at most a tenth later than it could."""
_SCAN_PAUSE_FACTOR = 20.0
"""Minimum ratio of the time between two scans to the duration of a scan. With a ratio of 20, scans take at
most 5 % of the time. A scan of a thousand large folders on a slow disk takes several seconds."""


class Watcher:
    """The process that runs the jobs of a spool. A lock keeps a second watcher out.

    Args:
        spool: The folders of the watcher.
        options: Options of the watcher.
        write_line: Function that is called with each line for the operator.

    Attributes:
        spool: The folders of the watcher.
        access_failures: Tracker of failures to access the folders.

    Raises:
        StoreError: A folder cannot be created or written, the folders are on different file systems, or
            another watcher works on them.
    """

    def __init__(self, spool: Spool, options: WatchOptions, write_line: MessageSink) -> None:
        spool.make()
        self._status_file = WatcherStatusFile(spool)
        self.access_failures = AccessFailures(spool, write_line)
        self.spool = spool
        self._options = options
        self._write_line = write_line
        self._stop = threading.Event()
        self._woken = threading.Event()
        self._tracker = CompletionTracker(options.unchanged_s, int(options.permissions.limits.files))
        self._worker = JobWorker(spool, options, self._stop)
        self._running: dict[Future[JobOutcome], JobDir] = {}
        self._stuck_until: dict[str, float] = {}
        self._unmovable: dict[str, tuple[str, float]] = {}
        self._complete: collections.deque[tuple[InboxEntry, EntrySnapshot]] = collections.deque()
        self._reports: dict[str, str] = {}
        self._has_waiting = False
        self._has_stopped_jobs = False
        self._next_scan_at = 0.0
        self._next_continue_at = 0.0
        self._worst_exit_code = 0

    def stop(self) -> None:
        """End the watcher.

        Running jobs stop, and continue at the next start. Any thread may call this method.
        """
        self._stop.set()
        self._woken.set()

    def run(self) -> int:
        """Watch until `stop` is called. With the option `once`, also end when nothing is left to do.

        The watcher waits for a missing disk. With `once`, it waits for at most `retry_s` seconds.

        Returns:
            The worst exit code of the jobs that ended and of the watcher's own disk failures.
        """
        with ThreadPoolExecutor(max_workers=self._options.jobs, thread_name_prefix="job") as pool:
            try:
                self._status_file.write("")
                while not self._stop.is_set():
                    self._collect()
                    is_finished = self._step(pool)
                    self._status_file.write(self.access_failures.text)
                    if is_finished:
                        break
                    self._woken.wait(_POLL_S)
                    self._woken.clear()  # no stop is lost: `stop` sets `_stop` before `_woken`
            finally:
                self._stop.set()
        self._collect()
        self._status_file.remove()
        return self._worst_exit_code

    def _note_exit_code(self, code: int) -> None:
        self._worst_exit_code = worst_exit_code((self._worst_exit_code, code))

    def _step(self, pool: ThreadPoolExecutor) -> bool:
        """Start the jobs that can start. Return True if the watcher must end."""
        try:
            is_finished = not self._fill(pool) and self._options.once
            if is_finished:
                self._report_left_entries()
        except (OSError, StoreError) as error:
            self.access_failures.record(error)
            if not self._options.once or self.access_failures.duration_s < self._options.retry_s:
                return False
            self._note_exit_code(StoreError.exit_code)
            return True
        self.access_failures.clear()
        return is_finished

    def _report(self, subject: str, line: str) -> None:
        """Report a line to the operator, unless it is the last line that was reported about its subject."""
        if self._reports.get(subject) != line:
            self._reports[subject] = line
            self._write_line(line)

    def _report_left_entries(self) -> None:
        """Report for each path that stays in the inbox why it is not processed."""
        for path, reason in self._tracker.incomplete.items():
            self._write_line(f"{path.name} stays in the inbox: {reason}")
        for path in ignored_paths_in(self.spool.inbox):
            self._write_line(f"{path.name} stays in the inbox: {NOT_A_JOB}")

    def _collect(self) -> None:
        """Report the jobs that have ended."""
        for future in [future for future in self._running if future.done()]:
            job_dir = self._running.pop(future)
            outcome = future.result()
            if outcome.state == "stuck":
                self._stuck_until[job_dir.name] = time.monotonic() + self._options.retry_s
            self._has_stopped_jobs |= outcome.state == "stopped"
            if outcome.state != "stopped":
                self._note_exit_code(outcome.exit_code)
            self._report_end(outcome)

    def _report_end(self, outcome: JobOutcome) -> None:
        """Report how a job ended, or why it was postponed."""
        where = f" -> {outcome.path}" if outcome.path is not None else ""
        line = f"{outcome.name}: {outcome.state}{where}" + (f": {outcome.message}" if outcome.message else "")
        self._report(outcome.name, line)
        if outcome.state not in ("stopped", "stuck"):
            del self._reports[outcome.name]

    def _fill(self, pool: ThreadPoolExecutor) -> bool:
        """Start jobs up to the maximum number. Return False if no job runs and no job is expected."""
        free = self._options.jobs - len(self._running)
        for job_dir in self._stopped_jobs(free):
            self._start(pool, job_dir)
            free -= 1
        self._scan_inbox()
        while free > 0 and self._complete:
            if (claimed := self._try_claim(*self._complete.popleft())) is not None:
                self._start(pool, claimed)
                free -= 1
        return bool(self._running or self._complete or self._has_waiting or self._has_stopped_jobs)

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
        gone = [name for name in self._reports if name not in names and Path(name).parent == self.spool.inbox]
        for name in gone:
            del self._reports[name]
        self._has_waiting = bool(names - self._unmovable.keys() - set(map(str, self._tracker.incomplete)))
        self._report_incomplete()
        now = time.monotonic()
        self._next_scan_at = now + _SCAN_PAUSE_FACTOR * (now - started)

    def _report_incomplete(self) -> None:
        """Report each entry that cannot be read or is not complete."""
        for path, reason in self._tracker.incomplete.items():
            if path in self._tracker.unreadable:
                self._note_exit_code(StoreError.exit_code)
                self._report(str(path), f"{path.name}: cannot be read: {reason}")
            elif not self._options.once:  # otherwise the reasons are reported at the end
                self._report(str(path), f"{path.name} waits: {reason}")

    def _start(self, pool: ThreadPoolExecutor, job_dir: JobDir) -> None:
        if job_dir.name not in self._reports and read_status(job_dir).get("state") not in FINAL:
            self._write_line(f"{job_dir.name}: started")
        future = pool.submit(self._worker.process, job_dir)
        self._running[future] = job_dir
        future.add_done_callback(lambda _: self._woken.set())

    def _try_claim(self, entry: InboxEntry, snapshot: EntrySnapshot) -> JobDir | None:
        """Claim an entry. Return None if it cannot be claimed.

        If the entry cannot be moved, report this, and try again after `retry_s` seconds or when the entry
        changes.
        """
        digest, until = self._unmovable.get(str(entry.path), ("", 0.0))
        if digest == snapshot.digest and time.monotonic() < until:
            return None
        try:
            return claim_entry(self.spool, entry, snapshot, self._options.permissions)
        except StoreError as error:
            self._unmovable[str(entry.path)] = (snapshot.digest, time.monotonic() + self._options.retry_s)
            self._note_exit_code(error.exit_code)
            self._report(str(entry.path), f"{entry.name}: cannot be moved out of the inbox: {error.one_line}")
            return None

    def _stopped_jobs(self, max_jobs: int) -> list[JobDir]:
        """Return at most `max_jobs` jobs in `running` that nobody runs and that may continue now.

        No other watcher works on the spool, so these jobs were left by an earlier watcher, or stopped.
        """
        now = time.monotonic()
        if max_jobs <= 0 or now < self._next_continue_at:
            return []
        self._finish_retries()
        own_jobs, found = {job_dir.path for job_dir in self._running.values()}, []
        paths = visible_entries(self.spool.running)
        self._next_continue_at = now + _POLL_S
        for job_dir in map(JobDir, paths):
            is_free = job_dir.path.is_dir() and job_dir.path not in own_jobs
            if not is_free or self._stuck_until.get(job_dir.name, now) > now:
                continue
            if path_exists(input_path(job_dir)):
                found.append(job_dir)
            elif is_unfinished_claim(job_dir):
                shutil.rmtree(job_dir.path, ignore_errors=True)
            else:
                line = f"{job_dir.name} stays in {self.spool.running}: the videos no longer exist"
                self._report(str(job_dir.path), line)
        self._has_stopped_jobs = bool(found)  # more stopped jobs may be left
        return found[:max_jobs]

    def _finish_retries(self) -> None:
        """Complete the moves of `retry` commands that were killed."""
        try:
            finish_interrupted_retries(self.spool)
        except (OSError, StoreError) as error:
            self._note_exit_code(StoreError.exit_code)
            folder = self.spool.failed
            self._report(
                str(folder), f"an interrupted move in {folder} cannot be completed: {one_line(error)}"
            )
