"""`status.json`: what a job is doing, for people, programs and the live page."""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from types import NoneType
from typing import Any, Literal

from bodycap_batch.core.errors import BodycapError
from bodycap_batch.core.progress import Event
from bodycap_batch.store.artefacts import disk_errors
from bodycap_batch.watch.spool import JobDir

State = Literal["claimed", "running", "stopped", "done", "failed", "cancelled"]
FINAL = ("done", "failed", "cancelled")
_PERIOD_S = 0.5
_MOST_NOTES = 100
_EXPECTED: Mapping[str, tuple[type, ...]] = {
    **dict.fromkeys(("kind", "dropped", "state", "stage", "camera"), (str,)),
    "store": (str, NoneType),
    **dict.fromkeys(("notes", "finished_stages"), (list,)),
    "active": (dict,),
    "attempts": (int,),
    "progress": (int, float, NoneType),
    "error": (dict, NoneType),
}
"""What somebody has put into the file by hand counts only where it is of the right kind."""
_UNENDED = "reading videos"
"""No stage, so nobody tells its end: it is over when a stage begins."""


class StatusFile:
    """Keeps a job's `status.json` and its log up to date; told events by the stages.

    Args:
        job: The job's folder.
        before: What was written there earlier.
        may_write: Asked before each write; False once the job belongs to another watcher.
    """

    def __init__(
        self,
        job: JobDir,
        before: Mapping[str, Any] | None = None,
        may_write: Callable[[], bool] = lambda: True,
    ) -> None:
        self._job = job
        self._may_write = may_write
        self._lock = threading.Lock()
        self._written = 0.0
        self._failed = False
        now, before = time_text(), before or {}
        self.document: dict[str, Any] = {
            "name": job.name,
            "kind": before.get("kind", "folder"),
            "dropped": before.get("dropped", job.name),
            "state": "claimed",
            "stage": "",
            "camera": "",
            "progress": None,
            "active": {},
            "finished_stages": [],
            "notes": list(before.get("notes", [])),
            "claimed_at": before.get("claimed_at", now),
            "started_at": None,
            "updated_at": now,
            "finished_at": None,
            "attempts": int(before.get("attempts", 0)),
            "host": None,
            "generation": None,
            "store": before.get("store"),
            "exit_code": None,
            "error": None,
        }

    def __call__(self, event: Event) -> None:
        """Take one event of the job in."""
        with self._lock:
            _take(self.document, event)
            if event.kind != "note" and not self._failed:  # a report made afterwards is no end
                self.document.update(stage=event.stage, camera=event.camera)
                self._failed = event.kind == "failed"
            if event.kind != "progress":
                self._log(event)
            if event.kind != "progress" or time.monotonic() - self._written >= _PERIOD_S:
                self._write()

    def change(self, **values: Any) -> None:
        """Set fields and write the file."""
        with self._lock:
            self.document.update(values)
            self._write()

    def moved_to(self, job: JobDir) -> None:
        """The job's folder has got another name."""
        with self._lock:
            self._job = job
            self.document["name"] = job.name

    def note(self, text: str) -> None:
        """Keep something worth telling."""
        with self._lock:
            _add_note(self.document, text)
            self._write()

    def finish(self, state: State, error: BodycapError | None, target: Path, inbox: Path) -> None:
        """Write the last word, paths as they will be once the job's folder is `target`."""
        where = {
            str(inbox / self.document["dropped"]): str(target / "input"),
            str(self._job.path): str(target),
        }
        if self.document["kind"] == "file":
            del where[str(inbox / self.document["dropped"])]
            where[str(inbox)] = str(target / "input")
        with self._lock:
            self.document.update(
                name=target.name,
                state=state,
                active={},
                progress=1.0 if state == "done" else self.document["progress"],
                finished_at=time_text(),
                exit_code=0 if error is None else error.exit_code,
                error=None if error is None else _relocated(error.to_dict(), where),
            )
            self._write()

    def _write(self) -> None:
        self.document["updated_at"] = time_text()
        self._written = time.monotonic()
        if not self._job.path.is_dir() or not self._may_write():  # taken over, perhaps filed away already
            return
        temporary = self._job.path / f".status.{os.getpid()}.{threading.get_ident()}.part"
        with disk_errors(self._job.path):
            temporary.write_text(json.dumps(self.document, indent=1) + "\n", encoding="utf-8")
            os.replace(temporary, self._job.status)

    def _log(self, event: Event) -> None:
        text = event.what if event.kind == "note" else f"{event.label}: {event.kind}"
        if event.kind == "finished":
            text += f" in {event.seconds:.1f} s"
        if self._may_write():
            append_log(self._job, text)


def append_log(job: JobDir, text: str) -> None:
    """Add a line to the job's log."""
    if job.path.is_dir():
        with disk_errors(job.path):
            job.log.parent.mkdir(parents=True, exist_ok=True)
            with job.log.open("a", encoding="utf-8", errors="backslashreplace") as stream:
                stream.write(f"{time_text()} {text}\n")


def read_status(job: JobDir, *, strict: bool = False) -> dict[str, Any]:
    """What a job's `status.json` says; empty where there is none or it is garbled.

    Args:
        job: The job's folder.
        strict: Raise `OSError` where it is there but the disk does not give it, else empty then, too.
    """
    try:
        found = json.loads(job.status.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return {}
    except OSError:
        if strict:
            raise
        return {}
    if not isinstance(found, dict):
        return {}
    return {name: value for name, value in found.items() if isinstance(value, _EXPECTED.get(name, (object,)))}


def time_text(seconds: float | None = None) -> str:
    """A moment (now, or Unix seconds) as text: UTC, whole seconds."""
    moment = datetime.now(UTC) if seconds is None else datetime.fromtimestamp(seconds, UTC)
    return moment.isoformat(timespec="seconds").replace("+00:00", "Z")


def _take(document: dict[str, Any], event: Event) -> None:
    if event.kind == "note":
        _add_note(document, event.what)
        return
    if event.kind != "progress":
        document["active"].pop(_UNENDED, None)
    share = event.done / event.total if event.total else None
    document["progress"] = share
    if event.kind in ("started", "progress"):
        document["active"][event.label] = {"done": event.done, "total": event.total, "what": event.what}
    else:
        document["active"].pop(event.label, None)
    if event.kind in ("finished", "reused"):
        document["progress"] = 1.0
        document["finished_stages"].append(
            {"stage": event.label, "reused": event.kind == "reused", "seconds": round(event.seconds, 3)}
        )


def _add_note(document: dict[str, Any], text: str) -> None:
    if text not in document["notes"] and len(document["notes"]) < _MOST_NOTES:
        document["notes"].append(text)


def _relocated(error: Mapping[str, Any], where: Mapping[str, str]) -> dict[str, Any]:
    """The error with paths as they will be."""

    def changed(text: str) -> str:
        for here, there in where.items():
            text = text.replace(here, there)
        return text

    return {key: changed(value) if isinstance(value, str) else value for key, value in error.items()}
