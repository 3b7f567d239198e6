"""What the page shows: every job as one JSON value, read from the spool once for all browsers."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bodycap_batch.watch.commands import JobRow, claimed_row, waiting_rows
from bodycap_batch.watch.spool import JobDir, Spool, visible
from bodycap_batch.watch.status import read_status

REPORT = "report.html"
_FRESH_S = 0.8
_MOST_ENDED = 500
_LOG_BYTES = 64 << 10


class Feed:
    """The jobs of a spool as the page takes them; may be asked from several threads.

    Args:
        spool: The spool.
        trouble: Asked what keeps the watcher from its folders at the moment.
    """

    def __init__(self, spool: Spool, trouble: Callable[[], str]) -> None:
        self.spool = spool
        self._trouble = trouble
        self._known: dict[str, Any] = {"jobs": [], "more": 0}
        self._lock = threading.Lock()
        self._text, self._read_at = "", -_FRESH_S
        self._ended: dict[Path, tuple[int, dict[str, Any]]] = {}

    def text(self) -> str:
        """All jobs as JSON text, not older than a second; while the disk is away, those known before."""
        with self._lock:
            now = time.monotonic()
            if now - self._read_at >= _FRESH_S:
                trouble = self._trouble()
                try:
                    self._known = self._jobs()
                except OSError as error:
                    trouble = trouble or str(error)
                self._text, self._read_at = json.dumps({**self._known, "trouble": trouble}), now
            return self._text

    def _jobs(self) -> dict[str, Any]:
        waiting = [_public(row, None) for row in waiting_rows(self.spool)]
        running = [_entry(JobDir(path)) for path in visible(self.spool.running) if path.is_dir()]
        before, self._ended = self._ended, {}
        paths = [path for folder in (self.spool.done, self.spool.failed) for path in visible(folder)]
        for path in paths:
            try:
                changed = path.stat().st_mtime_ns
            except OSError:
                continue
            known = before.get(path)
            self._ended[path] = known if known and known[0] == changed else (changed, _entry(JobDir(path)))
        ended = [entry for _, entry in sorted(self._ended.values(), key=lambda item: -item[0])]
        return {"jobs": [*running, *waiting, *ended[:_MOST_ENDED]], "more": max(0, len(ended) - _MOST_ENDED)}


def log_of(job: JobDir) -> str:
    """The end of a job's log."""
    try:
        with job.log.open("rb") as stream:
            stream.seek(0, 2)
            stream.seek(max(0, stream.tell() - _LOG_BYTES))
            return stream.read().decode(errors="replace")
    except OSError:
        return ""


def files_of(job: JobDir) -> list[str]:
    """Results of a job, relative to its folder of results."""
    if not job.result.is_dir():
        return []
    files = (path for path in job.result.rglob("*") if path.is_file() and not path.name.startswith("."))
    return sorted(path.relative_to(job.result).as_posix() for path in files)


def _entry(job: JobDir) -> dict[str, Any]:
    return _public(claimed_row(job), job)


def _public(row: JobRow, job: JobDir | None) -> dict[str, Any]:
    """A row for the browser: ages are counted there."""
    entry = row.to_dict()
    del entry["age_s"], entry["path"]
    status = {} if job is None else read_status(job)
    entry["active"] = status.get("active", {}) if row.state == "running" else {}
    entry["notes"] = status.get("notes", [])
    entry["finished"] = len(status.get("finished_stages", []))
    reports = [] if job is None else [f"{REPORT}", f"partial/{REPORT}"]
    entry["report"] = next(
        (name for name in reports if job is not None and (job.result / name).is_file()), None
    )
    return entry
