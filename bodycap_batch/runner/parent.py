"""The parent's side: look a task's artefact up, else start a child and follow it."""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import bodycap_batch
from bodycap_batch.errors import BodycapError, Cancelled, StoreError, error_from_dict
from bodycap_batch.progress import Event, Listener
from bodycap_batch.runner.child import FULL_DISK_BYTES, disk_full
from bodycap_batch.runner.task import Task
from bodycap_batch.store import Artefact, Store, disk_errors

CHILD = (sys.executable, "-P", "-m", "bodycap_batch.runner")
KILL_AFTER_S = 3.0
_POLL_S = 0.2
_THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)
CHILDREN_LOG = "children.log"


class Runner:
    """Runs tasks in child processes; safe to be used from several threads.

    Args:
        store: Where artefacts are kept.
        logs: Folder for one log file and one task file per task.
        listener: Told what happens.
        cancelled: Asked several times a second whether to stop.
        command: The child's command line, without the task file.

    A child that has done its task waits for the next one, so that libraries are loaded once; it ends with
    `close`, after a crash or a bug, and with its parent.
    """

    def __init__(
        self,
        store: Store,
        *,
        logs: Path,
        listener: Listener,
        cancelled: Callable[[], bool],
        command: Sequence[str] = CHILD,
    ) -> None:
        self.store = store
        self._logs = logs
        self._listener = listener
        self._cancelled = cancelled
        self._command = tuple(command)
        self._idle: list[_Child] = []
        self._lock = threading.Lock()

    def __enter__(self) -> Runner:
        """The runner itself."""
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the children that wait for work."""
        with self._lock:
            waiting, self._idle = self._idle, []
        for child in waiting:
            child.kill()
        log = self._logs / CHILDREN_LOG
        if log.exists() and log.stat().st_size == 0:
            log.unlink()

    def prepare(self, *work: Sequence[str]) -> None:
        """Let one waiting child for each item load modules, starting children where none waits.

        Args:
            work: Names of modules, one list a child. A child is used next by the task that needs most of
                what it has loaded.
        """
        taken = []
        for modules in work:
            child = self._take(modules)
            child.order({"import": list(modules)})
            child.loaded |= set(modules)
            taken.append(child)
        with self._lock:
            self._idle += taken

    def _take(self, modules: Collection[str]) -> _Child:
        """The waiting child that has loaded most of `modules` and least else, or a new one."""
        with self._lock:
            if self._idle:
                wanted = set(modules)
                best = max(
                    self._idle, key=lambda child: (len(wanted & child.loaded), -len(child.loaded - wanted))
                )
                self._idle.remove(best)
                return best
        with disk_errors(self._logs):
            self._logs.mkdir(parents=True, exist_ok=True)
            with (self._logs / CHILDREN_LOG).open("ab") as log:
                return _Child(self._command, log)

    def run(self, task: Task, meanwhile: Sequence[Sequence[str]] = ()) -> tuple[Artefact, bool]:
        """Return the task's artefact and whether it had to be made.

        Args:
            task: What to make.
            meanwhile: If it has to be made, what other children load at the same time (see `prepare`).

        Raises:
            BodycapError: What the child reported, `StoreError` for the disk, `Cancelled` when stopped.
        """
        if (found := self.store.find(task.key)) is not None:
            self._tell(task, "reused")
            return found, False
        self._tell(task, "started")
        try:
            artefact = self._make(task, meanwhile)
        except BodycapError as error:
            self.store.sweep()
            self._tell(task, "stopped" if isinstance(error, Cancelled) else "failed")
            raise
        self._tell(task, "finished", seconds=float(artefact.made["seconds"]))
        return artefact, True

    def _make(self, task: Task, meanwhile: Sequence[Sequence[str]]) -> Artefact:
        log = self._logs / f"{task.file_stem}.log"
        child = self._take(task.modules)
        child.loaded |= set(task.modules)
        with disk_errors(self._logs):
            order = log.with_suffix(".task.json")
            order.write_text(json.dumps(task.to_json(self.store.root), indent=1), encoding="utf-8")
            log.write_bytes(b"")
        self.prepare(*meanwhile)
        child.order({"task": str(order), "log": str(log)})
        last = child.follow(self._cancelled, lambda message: self._forward(task, message))
        if last is not None and "ends" not in last and not self._cancelled():
            with self._lock:
                self._idle.append(child)
        else:
            child.end(at_once=self._cancelled())
        failure = last if last is not None and last["event"] == "error" else None
        if self._cancelled():
            raise Cancelled("stopped on request; finished stages are kept", hint="run it again to go on")
        if last is None or failure is not None:
            raise self._explain(task, failure, child.returncode, log)
        if (artefact := self.store.find(task.key)) is None:
            raise StoreError(f"{task.label}: its result is gone", path=self.store.root, hint="run it again")
        return artefact

    def _explain(
        self, task: Task, failure: dict[str, Any] | None, returncode: int, log: Path
    ) -> BodycapError:
        if failure is not None:
            error = error_from_dict(failure["error"])
            if "traceback" in failure:
                error.message = f"{task.label}: {error.message}"
                error.hint = f"this is a bug; please report it with {log} and the job file"
                error.add_note(failure["traceback"])
            return error
        if self.store.free_bytes() < FULL_DISK_BYTES:
            return disk_full(self.store.root)
        return BodycapError(f"{task.label}: {_death(returncode)}", path=log, hint=_crash_hint(returncode))

    def _forward(self, task: Task, message: dict[str, Any]) -> None:
        self._tell(
            task, "progress", done=message["done"], total=message["total"], what=message.get("what", "")
        )

    def _tell(self, task: Task, kind: Any, **values: Any) -> None:
        self._listener(Event(kind=kind, stage=task.key.stage, camera=task.camera, round=task.round, **values))


class _Child:
    """One child process in its own process group.

    Attributes:
        loaded: Modules it was asked to load.
    """

    def __init__(self, command: Sequence[str], log: BinaryIO) -> None:
        self.loaded: set[str] = set()
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            env=_environment(),
            start_new_session=True,
        )
        self._rest = b""

    @property
    def returncode(self) -> int:
        """Exit code once it has ended; negative for a signal."""
        return self._process.returncode

    def order(self, order: Mapping[str, Any]) -> None:
        """Send one order; a child that is gone is noticed by `follow`."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(order).encode() + b"\n")
            self._process.stdin.flush()

    def follow(
        self, cancelled: Callable[[], bool], on_progress: Callable[[dict[str, Any]], None]
    ) -> dict[str, Any] | None:
        """Read the child's lines until its task ends: its last message, None if it died or was cancelled."""
        assert self._process.stdout is not None
        pipe = self._process.stdout.fileno()
        while not cancelled():
            if not select.select([pipe], [], [], _POLL_S)[0]:
                continue
            if not (data := os.read(pipe, 1 << 16)):
                return None
            *lines, self._rest = (self._rest + data).split(b"\n")
            for message in map(json.loads, lines):
                if message["event"] != "progress":
                    return dict(message)
                on_progress(message)
        return None

    def end(self, *, at_once: bool) -> None:
        """Wait for the child, or stop its process group: SIGTERM, and SIGKILL after 3 s."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        if at_once:
            self._signal(signal.SIGTERM)
        try:
            self._process.wait(KILL_AFTER_S)
        except subprocess.TimeoutExpired:
            self._signal(signal.SIGKILL)
            self._process.wait()
        self._process.stdout.close()

    def kill(self) -> None:
        """End a child that waits, or loads libraries: there is nothing to lose."""
        self._signal(signal.SIGKILL)
        self.end(at_once=False)

    def _signal(self, number: signal.Signals) -> None:
        try:
            os.killpg(self._process.pid, number)
        except ProcessLookupError:
            return


def _environment() -> dict[str, str]:
    """The child's environment: the libraries' own pools off before they load, this package found.

    A stage's threads are its own: a pool's sums would depend on the machine's cores.
    """
    package = str(Path(bodycap_batch.__file__).parent.parent)
    path = os.pathsep.join(part for part in (package, os.environ.get("PYTHONPATH")) if part)
    pinned = dict.fromkeys(_THREAD_VARIABLES, "1")
    return {**os.environ, **pinned, "PYTHONPATH": path, "PYTHONUNBUFFERED": "1"}


def _death(returncode: int) -> str:
    if returncode >= 0:
        return f"the stage's process ended with code {returncode} and no message"
    try:
        name = signal.Signals(-returncode).name
    except ValueError:
        name = f"signal {-returncode}"
    return f"the stage's process was ended by {name}"


def _crash_hint(returncode: int) -> str:
    if returncode == -signal.SIGKILL:
        return (
            "probably out of memory: close other programs, or lower work_px in the job; run it again to go on"
        )
    return "a native library crashed; run it again, and if it stays, please report it with this log"
