"""The list of jobs for the live page, as JSON text. The spool is read once for all browsers."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from bodycap_batch.watch.commands import JobRow, inbox_rows, job_row
from bodycap_batch.watch.job_status import read_status
from bodycap_batch.watch.spool import JobDir, Spool, visible_entries
from bodycap_batch.watch.web.questions import (
    earlier_answers,
    files_below,
    is_answered_by_page,
    questions_about,
)

REPORT = "report.html"
_MAX_AGE_S = 0.8
"""Maximum age (seconds) of the list of jobs as JSON text. If the text is older, the spool is read again. The
limit is shorter than the page's update period of 1 s."""
_MAX_ENDED = 500
"""Maximum number of ended jobs on the page. The page shows the most recent jobs. Evidence: none."""
_MAX_LOG_BYTES = 64 << 10
"""Maximum size (bytes) of the log text that the page shows. If a log is longer, the page shows its end.
Evidence: none."""


class JobList:
    """The jobs of a spool in the format of the page. This class is thread-safe.

    Args:
        spool: The folders of the watcher.
        trouble: Function that returns why the watcher cannot access its folders; "" if it can access them.
        clock: Function that returns the time (seconds) of this process's monotonic clock.
    """

    def __init__(
        self, spool: Spool, trouble: Callable[[], str], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.spool = spool
        self._trouble = trouble
        self._clock = clock
        self._last_jobs: dict[str, Any] = {"jobs": [], "more": 0}
        self._lock = threading.Lock()
        self._text, self._read_at = "", -math.inf
        self._ended: dict[Path, tuple[int, dict[str, Any]]] = {}

    def json_text(self) -> str:
        """Return all jobs as JSON text that is at most one second old.

        While the disk is missing, return the jobs that were read last.
        """
        with self._lock:
            now = self._clock()
            if now - self._read_at >= _MAX_AGE_S:
                trouble = self._trouble()
                try:
                    self._last_jobs = self._jobs()
                except OSError as error:
                    trouble = trouble or str(error)
                self._text, self._read_at = json.dumps({**self._last_jobs, "trouble": trouble}), now
            return self._text

    def _jobs(self) -> dict[str, Any]:
        waiting = [_browser_entry(row, None) for row in inbox_rows(self.spool)]
        running = [_job_entry(JobDir(path)) for path in visible_entries(self.spool.running) if path.is_dir()]
        before, self._ended = self._ended, {}
        paths = [path for folder in (self.spool.done, self.spool.failed) for path in visible_entries(folder)]
        for path in paths:
            try:
                changed = path.stat().st_mtime_ns
            except OSError:
                continue
            known = before.get(path)
            self._ended[path] = (
                known if known and known[0] == changed else (changed, _job_entry(JobDir(path)))
            )
        ended = [entry for _, entry in sorted(self._ended.values(), key=lambda item: -item[0])]
        return {"jobs": [*running, *waiting, *ended[:_MAX_ENDED]], "more": max(0, len(ended) - _MAX_ENDED)}


def read_log_end(job: JobDir) -> str:
    """Return the end of a job's log; "" if the log cannot be read."""
    try:
        with job.log.open("rb") as stream:
            stream.seek(0, 2)
            stream.seek(max(0, stream.tell() - _MAX_LOG_BYTES))
            return stream.read().decode(errors="replace")
    except OSError:
        return ""


def list_result_files(job: JobDir) -> list[str]:
    """Return the paths of a job's result files, relative to the job's folder of results.

    The files that people want come first: motion, film, page, map. Logs come last.
    """
    if not job.result.is_dir():
        return []
    files = (path for path in job.result.rglob("*") if path.is_file() and not path.name.startswith("."))
    return sorted((path.relative_to(job.result).as_posix() for path in files), key=_file_order)


def _file_order(name: str) -> tuple[int, str]:
    """Return the sort key of a result file, given its path relative to the folder of results."""
    wanted = ("motion.", "preview.", REPORT, "map", "joints.", "metrics.json", "frames.csv", "trajectories/")
    own = name.removeprefix("partial/")
    place = next((place for place, start in enumerate(wanted) if own.startswith(start)), len(wanted))
    return (len(wanted) + 1 if own.startswith("logs/") else place), name


def _job_entry(job: JobDir) -> dict[str, Any]:
    return _browser_entry(job_row(job), job)


def _open_questions(row: JobRow, job: JobDir | None) -> dict[str, Any] | None:
    """Return what the page asks about a failed job; None if an answer would not help."""
    if job is None or row.state != "failed" or not job.input.is_dir():
        return None
    try:
        found = questions_about(files_below(job.input))
        is_open = bool(found["unknown"]) and is_answered_by_page(job.input)
        earlier = earlier_answers(job.input) if is_open else {}
    except (OSError, yaml.YAMLError):
        return None
    if earlier.get("find_places"):  # The motion did not show the places, and would not show them again.
        found["found_places"] = []
    return {**found, "height": earlier.get("height", "")} if is_open else None


def _browser_entry(row: JobRow, job: JobDir | None) -> dict[str, Any]:
    """Return a row in the format of the page.

    The row has no age, because the browser computes it.
    """
    entry = row.to_dict()
    del entry["age_s"], entry["path"]
    status = {} if job is None else read_status(job)
    entry["active"] = status.get("active", {}) if row.state == "running" else {}
    entry["notes"] = status.get("notes", [])
    entry["asks"] = _open_questions(row, job)
    entry["finished"] = len(status.get("finished_stages", []))
    reports = [] if job is None else [f"{REPORT}", f"partial/{REPORT}"]
    entry["report"] = next(
        (name for name in reports if job is not None and (job.result / name).is_file()), None
    )
    return entry
