"""The child's side: run one stage, commit its artefact, tell the parent."""

from __future__ import annotations

import contextlib
import errno
import importlib
import json
import os
import queue
import resource
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import (
    EXIT_BUG,
    BodycapError,
    Cancelled,
    CaptureError,
    DiskAway,
    JobError,
    StoreError,
)
from bodycap_batch.core.memory import release_memory
from bodycap_batch.runner.task import Task, TaskFunction, task_from_json
from bodycap_batch.store.artefacts import DISK_ERRORS, Store, store_error

_PROGRESS_PERIOD_S = 0.2
_GRACE_S = 3.0
RELEASE_PERIOD_S = 0.5
"""Least time between two releases of freed memory. One takes some 50 ms in a large process.
Evidence: docs/decisions/pipeline.md."""
FULL_DISK_BYTES = 8 << 20
"""Below this much free space a failure is put down to the full disk: libraries hide ENOSPC."""


def main(arguments: Sequence[str], stages: Mapping[str, TaskFunction]) -> int:
    """Run the task file named on the command line; without one, take orders until standard input closes.

    An order is one JSON line: ``{"task": file, "log": file}`` runs a task and sends its prints to the log;
    ``{"import": [modules]}`` loads libraries while there is nothing else to do. Taking orders saves every
    task but the first the seconds in which libraries load.

    Args:
        arguments: The path of the task file, or nothing.
        stages: By stage name, the function that runs its tasks.

    Returns:
        The exit code: 0, that of a typed error, or 70.
    """
    speak = _Speaker()
    orders = _Orders()
    if arguments:
        return _perform(Path(arguments[0]), stages, _Link(speak, orders, asks=False))
    for order in iter(orders.next, None):
        if "import" in order:
            _import(order["import"])
            continue
        _send_prints_to(Path(order["log"]))
        speak.say("begun")
        if _perform(Path(order["task"]), stages, _Link(speak, orders, asks=True)) == EXIT_BUG:
            return EXIT_BUG
    return 0


@dataclass(frozen=True, slots=True)
class _Link:
    """The parent, as one task talks to it; `asks`: whether it wants to be asked before a commit."""

    speak: _Speaker
    orders: _Orders
    asks: bool

    def before_commit(self) -> None:
        """Wait until the parent lets the artefact be committed; raise `Cancelled` if it does not."""
        if not self.asks:
            return
        self.speak.say("ready")
        answer = self.orders.next()
        if answer is None or not answer["commit"]:
            raise Cancelled("not committed: the job was stopped or taken over", hint="run it again to go on")


def _perform(order: Path, stages: Mapping[str, TaskFunction], link: _Link) -> int:
    task, root = task_from_json(json.loads(order.read_text(encoding="utf-8")))
    try:
        store = Store(root)
        _run(task, store, stages[task.key.stage], link)
    except BodycapError as error:
        link.speak.say("error", error=error.to_dict())
        return error.exit_code
    except Exception as error:  # noqa: BLE001 - the one place where a task's bugs are caught
        return _report_unexpected(error, root, link.speak)
    return 0


def _import(modules: Sequence[str]) -> None:
    """Load libraries ahead of their use; what is missing is told by the stage that needs it."""
    for name in modules:
        try:
            importlib.import_module(name)
        except ImportError as error:
            sys.stderr.write(f"{name}: {error}\n")


def _send_prints_to(log: Path) -> None:
    """Let standard output and error, the native libraries' too, go to a file from here on."""
    with log.open("ab") as stream:
        for number in (1, 2):
            os.dup2(stream.fileno(), number)


def _run(task: Task, store: Store, function: TaskFunction, link: _Link) -> None:
    started, cpu_before = time.monotonic(), time.process_time()
    _pin_threads(task.threads)
    release_memory()
    _forget_peak_memory()
    for artefact in dict.fromkeys(store.artefacts_in(task.arguments)):
        store.verify(artefact)
    with store.draft(task.key) as draft, _DiskWatch(store):
        context = StageContext(
            work_dir=draft.work,
            threads=task.threads,
            progress=StepReporter(link.speak.progress),
            cancelled=link.orders.closed.is_set,
        )
        function(task.arguments, context, draft.files)
        made = {
            "seconds": round(time.monotonic() - started, 3),
            "cpu_seconds": round(time.process_time() - cpu_before, 3),
            "peak_memory_mb": round(peak_memory_mb(), 1),
            "threads": task.threads,
        }
        store.commit(draft, task.key, made, before=link.before_commit, replace=task.replaces)
    link.speak.say("done", **made)


class _DiskWatch:
    """Turns what a stage raises when a disk fails into `StoreError`, before the draft is removed."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def __enter__(self) -> None:
        """Nothing to prepare."""

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        if isinstance(error, OSError) and error.errno in DISK_ERRORS:
            raise store_error(error, self._store.root) from error
        if isinstance(error, CaptureError | JobError) and (away := _away(error)) is not None:
            raise away from error
        # A writer that met the full disk knows its own file, but not that the folder is the store's.
        other = isinstance(error, Exception) and not isinstance(error, BodycapError)
        if (other or isinstance(error, StoreError)) and self._store.free_bytes() < FULL_DISK_BYTES:
            raise disk_full(self._store.root) from error


def _away(error: BodycapError) -> DiskAway | None:
    """What is wrong where the file that an error names is not to blame: its disk does not answer.

    FFmpeg says EIO of broken files, too, and takes a file whose disk goes away for one that ends early: then
    the file is asked.
    """
    if error.path is None:
        return None
    path, failed = Path(error.path), error.__cause__
    if not isinstance(failed, OSError) or failed.errno in (None, errno.EIO):
        failed = _failure_to_read(path)
    found = store_error(failed, path) if isinstance(failed, OSError) else None
    return found if isinstance(found, DiskAway) else None


def _failure_to_read(path: Path) -> OSError | None:
    """What the first or the last byte of a file cannot be read for; None where it is no plain file."""
    try:
        if path.is_file():
            with path.open("rb") as stream:
                stream.read(1)
                stream.seek(max(0, path.stat().st_size - 1))
                stream.read(1)
    except OSError as error:
        return error
    return None


def disk_full(root: Path) -> StoreError:
    """The disk has no room left."""
    hint = "free some space, or name a folder on another disk with --store; finished stages are kept"
    return StoreError("No space left on device", path=root, hint=hint)


def _report_unexpected(error: Exception, root: Path, speak: _Speaker) -> int:
    if isinstance(error, MemoryError):
        full = BodycapError("out of memory", hint="close other programs, or lower work_px in the job")
        speak.say("error", error=full.to_dict(), ends=True)
        return EXIT_BUG
    text = traceback.format_exc()
    sys.stderr.write(text)
    bug = BodycapError(f"{type(error).__name__}: {error}", path=root if isinstance(error, OSError) else None)
    speak.say("error", error=bug.to_dict(), traceback=text, ends=True)
    return EXIT_BUG


def _pin_threads(threads: int) -> None:
    """OpenCV's pool follows the task; the other libraries' pools are off, their threads are a stage's own."""
    os.environ["OPENCV_FOR_THREADS_NUM"] = str(threads)
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(threads)


def _forget_peak_memory() -> None:
    """Count a task's peak memory from its own beginning, where the system can (Linux)."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def peak_memory_mb() -> float:
    """Largest resident memory of this process since `_forget_peak_memory`, or ever."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024.0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1 << 20) if sys.platform == "darwin" else peak / (1 << 10)


class _Speaker:
    """JSON lines to the parent; the libraries' own prints go to the log instead."""

    def __init__(self) -> None:
        self._stream: TextIO = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
        sys.stdout.flush()
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
        self._lock = threading.Lock()
        self._last = 0.0

    def say(self, event: str, **values: Any) -> None:
        """Write one line."""
        with self._lock:
            self._stream.write(json.dumps({"event": event, **values}) + "\n")
            self._stream.flush()

    def progress(self, done: int, total: int, what: str = "") -> None:
        """Tell the progress, not more often than anyone can see."""
        now = time.monotonic()
        if done < total and now - self._last < _PROGRESS_PERIOD_S:
            return
        self._last = now
        self.say("progress", done=int(done), total=int(total), what=what)


class StepReporter:
    """Reports the progress of a stage, and releases freed memory whenever the stage begins another step.

    The C library keeps freed memory. Without its release, the peak of a stage would be nearly the sum of what
    its steps need.

    Args:
        report: Called as ``report(done, total, what)``.
        release: Releases freed memory.
        period_s: Least time between two releases, seconds.
    """

    def __init__(
        self,
        report: Callable[[int, int, str], None],
        release: Callable[[], None] = release_memory,
        period_s: float = RELEASE_PERIOD_S,
    ) -> None:
        self._report = report
        self._release = release
        self._period_s = period_s
        self._step = ""
        self._last = time.monotonic()

    def __call__(self, done: int, total: int, what: str = "") -> None:
        """Report that `done` of `total` units are done; another name `what` begins another step."""
        if what != self._step:
            self._step = what
            if time.monotonic() - self._last >= self._period_s:
                self._release()
                self._last = time.monotonic()
        self._report(done, total, what)


class _Orders:
    """The lines of standard input; when it closes the parent asks to stop, or is gone."""

    def __init__(self) -> None:
        self.closed = threading.Event()
        self._queue: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        threading.Thread(target=self._read, daemon=True).start()

    def next(self) -> dict[str, Any] | None:
        """Wait for the next order; None when there are no more."""
        return self._queue.get()

    def _read(self) -> None:
        rest = b""
        while data := os.read(sys.stdin.fileno(), 1 << 12):
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                self._queue.put(json.loads(line))
        self.closed.set()
        self._queue.put(None)
        time.sleep(_GRACE_S)
        os.kill(os.getpid(), signal.SIGKILL)
