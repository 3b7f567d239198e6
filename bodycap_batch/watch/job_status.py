"""Write and read `status.json`: the state of a job for users, programs and the live page."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from types import NoneType
from typing import Any, Literal

from bodycap_batch.core.errors import BodycapError
from bodycap_batch.core.printable import printable
from bodycap_batch.core.progress import Event
from bodycap_batch.store.artefacts import disk_errors
from bodycap_batch.store.checked_json import checked_json, parse_checked_json
from bodycap_batch.watch.spool import JobDir

State = Literal["claimed", "running", "stopped", "done", "failed", "cancelled"]
FINAL = ("done", "failed", "cancelled")
"""States of a job that has ended. A job in such a state moves to its final folder, `done` or `failed`."""
_WRITE_PERIOD_S = 0.5
"""Minimum time (seconds) between two writes of the progress. Evidence: none."""
_MAX_NOTES = 100
"""Maximum number of notes in `status.json`. The limit keeps the file small. Evidence: none."""
_FIELD_TYPES: Mapping[str, tuple[type, ...]] = {
    **dict.fromkeys(("kind", "dropped", "state", "stage", "camera"), (str,)),
    "store": (str, NoneType),
    **dict.fromkeys(("notes", "finished_stages"), (list,)),
    "active": (dict,),
    "attempts": (int,),
    "progress": (int, float, NoneType),
    "error": (dict, NoneType),
    "verdict": (dict, NoneType),
}
"""Permitted types of each field of `status.json`. A value of another type is ignored, because a user may have
edited the file."""
_ACTIVITY_WITHOUT_END = "reading videos"
"""Label of an activity that is not a stage. No event reports the end of this activity. It is treated as ended
when a stage starts."""


class JobStatusFile:
    """Keep a job's `status.json` and its log up to date.

    The run of the job calls this object with each event.

    Args:
        job: The job's folder.
        previous: Content of an earlier `status.json` of the job, or None.
    """

    def __init__(self, job: JobDir, previous: Mapping[str, Any] | None = None) -> None:
        self._job = job
        self._lock = threading.Lock()
        self._written = 0.0
        self._failed = False
        now, previous = utc_text(), previous or {}
        self.document: dict[str, Any] = {
            "name": job.name,
            "kind": previous.get("kind", "folder"),
            "dropped": previous.get("dropped", job.name),
            "state": "claimed",
            "stage": "",
            "camera": "",
            "progress": None,
            "active": {},
            "finished_stages": [],
            "notes": list(previous.get("notes", [])),
            "claimed_at": previous.get("claimed_at", now),
            "started_at": None,
            "updated_at": now,
            "finished_at": None,
            "attempts": int(previous.get("attempts", 0)),
            "host": None,
            "store": previous.get("store"),
            "exit_code": None,
            "error": None,
            "verdict": None,
        }

    def __call__(self, event: Event) -> None:
        """Record one event of the job."""
        with self._lock:
            _apply_event(self.document, event)
            if event.kind != "note" and not self._failed:  # after a failure, keep the failed stage
                self.document.update(stage=event.stage, camera=event.camera)
                self._failed = event.kind == "failed"
            if event.kind != "progress":
                self._log(event)
            if event.kind != "progress" or time.monotonic() - self._written >= _WRITE_PERIOD_S:
                self._write()

    def update(self, **values: Any) -> None:
        """Set fields of the document, and write the file."""
        with self._lock:
            self.document.update(values)
            self._write()

    def add_note(self, text: str) -> None:
        """Add a note for the user."""
        with self._lock:
            _add_note(self.document, text)
            self._write()

    def finish(self, state: State, error: BodycapError | None, target: Path, inbox: Path) -> None:
        """Write the final state. Paths in the error are replaced by the paths after the move to `target`.

        Args:
            state: The final state.
            error: Error that ended the job, or None.
            target: The job's folder after the move.
            inbox: The folder in which the job was dropped.
        """
        new_paths = {
            str(inbox / self.document["dropped"]): str(target / "input"),
            str(self._job.path): str(target),
        }
        if self.document["kind"] == "file":
            del new_paths[str(inbox / self.document["dropped"])]
            new_paths[str(inbox)] = str(target / "input")
        with self._lock:
            self.document.update(
                name=target.name,
                state=state,
                active={},
                progress=1.0 if state == "done" else self.document["progress"],
                finished_at=utc_text(),
                exit_code=0 if error is None else error.exit_code,
                error=None if error is None else _with_replaced_paths(error.to_dict(), new_paths),
            )
            self._write()

    def _write(self) -> None:
        self.document["updated_at"] = utc_text()
        self._written = time.monotonic()
        if not self._job.path.is_dir():  # a user deleted the job
            return
        temporary = self._job.path / f".status.{os.getpid()}.{threading.get_ident()}.part"
        with disk_errors(self._job.path):
            temporary.write_text(checked_json(self.document), encoding="utf-8")
            os.replace(temporary, self._job.status)

    def _log(self, event: Event) -> None:
        text = event.what if event.kind == "note" else f"{event.label}: {event.kind}"
        if event.kind == "finished":
            text += f" in {event.seconds:.1f} s"
        append_log(self._job, text)


def append_log(job: JobDir, text: str) -> None:
    """Add a line, or several lines, to the job's log. Special characters are escaped."""
    lines = "\n".join(map(printable, text.split("\n")))
    if job.path.is_dir():
        with disk_errors(job.path):
            job.log.parent.mkdir(parents=True, exist_ok=True)
            with job.log.open("a", encoding="utf-8", errors="backslashreplace") as stream:
                stream.write(f"{utc_text()} {lines}\n")


def read_status(job: JobDir, *, strict: bool = False) -> dict[str, Any]:
    """Return the content of a job's `status.json`; empty if the file is missing or damaged.

    Args:
        job: The job's folder.
        strict: True: raise `OSError` if the file exists but cannot be read. False: return an empty result in
            this case.
    """
    try:
        found = parse_checked_json(job.status.read_bytes())
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return {}
    except OSError:
        if strict:
            raise
        return {}
    return {
        name: value for name, value in found.items() if isinstance(value, _FIELD_TYPES.get(name, (object,)))
    }


def utc_text(seconds: float | None = None) -> str:
    """Return a moment as text: UTC, whole seconds.

    Args:
        seconds: The moment in Unix seconds; None for the current time.
    """
    moment = datetime.now(UTC) if seconds is None else datetime.fromtimestamp(seconds, UTC)
    return moment.isoformat(timespec="seconds").replace("+00:00", "Z")


def _apply_event(document: dict[str, Any], event: Event) -> None:
    """Update the document with one event."""
    if event.kind == "note":
        _add_note(document, event.what)
        return
    if event.kind != "progress":
        document["active"].pop(_ACTIVITY_WITHOUT_END, None)
    document["progress"] = event.done / event.total if event.total else None
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
    """Append a note if the document does not hold it yet and holds fewer than `_MAX_NOTES` notes."""
    if text not in document["notes"] and len(document["notes"]) < _MAX_NOTES:
        document["notes"].append(text)


def _with_replaced_paths(error: Mapping[str, Any], new_paths: Mapping[str, str]) -> dict[str, Any]:
    """Return the error with each old path replaced by the path after the move."""

    def changed(text: str) -> str:
        for old, new in new_paths.items():
            text = text.replace(old, new)
        return text

    return {key: changed(value) if isinstance(value, str) else value for key, value in error.items()}
