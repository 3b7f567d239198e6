"""Tasks made in child processes of this machine."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from bodycap_batch.core.errors import BodycapError, Cancelled, error_from_dict
from bodycap_batch.runner.child import FULL_DISK_BYTES, disk_full
from bodycap_batch.runner.process import CHILD, Child, crash_hint, death
from bodycap_batch.runner.task import Task
from bodycap_batch.store.artefacts import Store, disk_errors

CHILDREN_LOG = "children.log"
STOPPED = "stopped on request; finished stages are kept"


@dataclass(frozen=True, slots=True, kw_only=True)
class Making:
    """The surroundings in which a task is made; nothing here changes its result.

    Attributes:
        store: Where the artefact is committed.
        logs: Folder for one log file and one task file per task.
        progress: Called as ``progress(done, total, what)``.
        cancelled: Asked several times a second whether to stop.
        may_commit: Asked before the artefact is committed.
        meanwhile: What other children load at the same time: names of modules, one list a child.
    """

    store: Store
    logs: Path
    progress: Callable[[int, int, str], None]
    cancelled: Callable[[], bool]
    may_commit: Callable[[], bool]
    meanwhile: Sequence[Sequence[str]] = ()


class Executor(Protocol):
    """Makes artefacts: here, or on other machines. Used from several threads."""

    def make(self, task: Task, making: Making) -> None:
        """Make and commit the task's artefact. Raises `BodycapError`; `Cancelled` when stopped."""

    def close(self, logs: Path) -> None:
        """The job with these logs has ended."""


class Children:
    """Child processes, each of which does one task after another.

    Libraries are loaded once; a child ends with `close`, after a crash or a bug, and with its parent.

    Args:
        command: The child's command line, without the task file.
    """

    def __init__(self, command: Sequence[str] = CHILD) -> None:
        self._command = tuple(command)
        self._idle: list[Child] = []
        self._lock = threading.Lock()

    def close(self, logs: Path) -> None:
        """End the children that wait for work."""
        with self._lock:
            waiting, self._idle = self._idle, []
        for child in waiting:
            child.kill()
        log = logs / CHILDREN_LOG
        if log.exists() and log.stat().st_size == 0:
            log.unlink()

    def prepare(self, logs: Path, work: Sequence[Sequence[str]]) -> None:
        """Let one waiting child for each item load modules, starting children where none waits.

        A child is used next by the task that needs most of what it has loaded.
        """
        taken = []
        for modules in work:
            child, _ = self._take(modules, logs)
            child.order({"import": list(modules)})
            child.loaded |= set(modules)
            taken.append(child)
        with self._lock:
            self._idle += taken

    def make(self, task: Task, making: Making) -> None:
        """Make and commit the task's artefact in a child.

        Raises:
            BodycapError: What the child reported, `StoreError` for the disk, `Cancelled` when stopped.
        """
        log = making.logs / f"{task.file_stem}.log"
        with disk_errors(making.logs):
            making.logs.mkdir(parents=True, exist_ok=True)
            order = log.with_suffix(".task.json")
            order.write_text(json.dumps(task.to_json(making.store.root), indent=1), encoding="utf-8")
            log.write_bytes(b"")
        child, last = self._done_by(task, making, {"task": str(order), "log": str(log)})
        stopped = making.cancelled()
        if last is not None and "ends" not in last and not stopped:
            with self._lock:
                self._idle.append(child)
        else:
            child.end(at_once=stopped)
        if stopped:
            raise Cancelled(STOPPED, hint="run it again to go on")
        if last is None or last["event"] == "error":
            raise _explained(task, last, child.returncode, (log, making.store))

    def _done_by(
        self, task: Task, making: Making, order: Mapping[str, str]
    ) -> tuple[Child, dict[str, Any] | None]:
        """Let a child do a task; one that had died while it waited for work is replaced."""
        ahead = making.meanwhile
        while True:
            child, is_new = self._take(task.modules, making.logs)
            child.loaded |= set(task.modules)
            heard: list[str] = []

            def hear(message: dict[str, Any], child: Child = child, heard: list[str] = heard) -> None:
                heard.append(message["event"])
                _answer(child, message, making)

            with ExitStack() as failing:  # whoever listens to the progress may: a full disk, a closed pipe
                failing.callback(child.end, at_once=True)
                self.prepare(making.logs, ahead)
                child.order(order)
                last = child.follow(making.cancelled, hear)
                failing.pop_all()
            if is_new or heard or last is not None or making.cancelled():
                return child, last
            child.end(at_once=False)
            ahead = ()

    def _take(self, modules: Collection[str], logs: Path) -> tuple[Child, bool]:
        """The waiting child that has loaded most of `modules` and least else, or a new one (True)."""
        with self._lock:
            if self._idle:
                wanted = set(modules)
                best = max(
                    self._idle, key=lambda child: (len(wanted & child.loaded), -len(child.loaded - wanted))
                )
                self._idle.remove(best)
                return best, False
        with disk_errors(logs):
            logs.mkdir(parents=True, exist_ok=True)
            with (logs / CHILDREN_LOG).open("ab") as log:
                return Child(self._command, log), True


def _answer(child: Child, message: dict[str, Any], making: Making) -> None:
    if message["event"] == "ready":
        child.order({"commit": making.may_commit()})
    elif message["event"] == "progress":
        making.progress(message["done"], message["total"], message.get("what", ""))


def _explained(
    task: Task, last: dict[str, Any] | None, returncode: int, where: tuple[Path, Store]
) -> BodycapError:
    log, store = where
    if last is not None:
        error = error_from_dict(last["error"])
        if "traceback" in last:
            error.message = f"{task.label}: {error.message}"
            error.hint = f"this is a bug; please report it with {log} and the job file"
            error.add_note(last["traceback"])
        return error
    if store.free_bytes() < FULL_DISK_BYTES:
        return disk_full(store.root)
    return BodycapError(f"{task.label}: {death(returncode)}", path=log, hint=crash_hint(returncode))
