"""The child process: run one stage, commit its artefact, report to the parent."""

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
"""Least time between two reports of progress, seconds: a display changes too fast to read otherwise.
Evidence: none."""
_GRACE_S = 3.0
"""Time for a stage to stop by itself after the parent has closed standard input, seconds. The parent waits as
long (`process.KILL_AFTER_S`). Evidence: none."""
RELEASE_PERIOD_S = 0.5
"""Least time between two releases of freed memory. One takes some 50 ms in a large process.
Evidence: docs/decisions/pipeline.md."""
FULL_DISK_BYTES = 8 << 20
"""Free space below which the full disk counts as the cause of any failure, bytes: libraries hide ENOSPC.
Evidence: none."""


def main(arguments: Sequence[str], stages: Mapping[str, TaskFunction]) -> int:
    """Run the task file named on the command line; without one, follow orders until standard input closes.

    An order is one JSON line. ``{"task": file, "log": file}`` runs a task and writes its prints to the log.
    ``{"import": [modules]}`` loads libraries while the child has no task. Only the first task of such a child
    waits until its libraries are loaded.

    Args:
        arguments: The path of the task file, or empty.
        stages: By stage name, the function that runs its tasks.

    Returns:
        The exit code: 0, that of a typed error, or 70.
    """
    writer = _MessageWriter()
    orders = _OrderReader()
    if arguments:
        return _run_task_file(Path(arguments[0]), stages, _Parent(writer, orders, asks=False))
    for order in iter(orders.next, None):
        if "import" in order:
            import_ahead(order["import"])
            continue
        _redirect_prints(Path(order["log"]))
        writer.send("started")
        if _run_task_file(Path(order["task"]), stages, _Parent(writer, orders, asks=True)) == EXIT_BUG:
            return EXIT_BUG
    return 0


@dataclass(frozen=True, slots=True)
class _Parent:
    """The connection of one task to the parent process.

    Attributes:
        messages: Messages to the parent.
        orders: Orders of the parent.
        asks: Whether the parent is asked before a commit.
    """

    messages: _MessageWriter
    orders: _OrderReader
    asks: bool

    def before_commit(self) -> None:
        """Ask the parent whether the artefact may be committed; raise `Cancelled` if not."""
        if not self.asks:
            return
        self.messages.send("ready")
        answer = self.orders.next()
        if answer is None or not answer["commit"]:
            raise Cancelled("not committed: the job was stopped or taken over", hint="run it again to go on")


def _run_task_file(file: Path, stages: Mapping[str, TaskFunction], parent: _Parent) -> int:
    """Run a task, report how it ended, and return the exit code."""
    task, root = task_from_json(json.loads(file.read_text(encoding="utf-8")))
    try:
        store = Store(root)
        _run(task, store, stages[task.key.stage], parent)
    except BodycapError as error:
        parent.messages.send("error", error=error.to_dict())
        return error.exit_code
    except Exception as error:  # noqa: BLE001 - the one place that catches the bugs of a task
        return _report_unexpected(error, root, parent.messages)
    return 0


def import_ahead(modules: Sequence[str]) -> None:
    """Load modules before they are needed; the stage that needs a missing one reports it."""
    for name in modules:
        try:
            importlib.import_module(name)
        except ImportError as error:
            sys.stderr.write(f"{name}: {error}\n")


def _redirect_prints(log: Path) -> None:
    """Append standard output and error, also those of native libraries, to a file from now on."""
    with log.open("ab") as stream:
        for number in (1, 2):
            os.dup2(stream.fileno(), number)


def _run(task: Task, store: Store, function: TaskFunction, parent: _Parent) -> None:
    """Run a stage's function on verified inputs and commit what it writes."""
    started, cpu_before = time.monotonic(), time.process_time()
    _pin_threads(task.threads)
    release_memory()
    _reset_peak_memory()
    for artefact in dict.fromkeys(store.artefacts_in(task.arguments)):
        store.verify(artefact)
    with store.draft(task.key) as draft, DiskFailures(store):
        context = StageContext(
            work_dir=draft.work,
            threads=task.threads,
            progress=StepReporter(parent.messages.send_progress),
            cancelled=parent.orders.closed.is_set,
        )
        function(task.arguments, context, draft.files)
        made = {
            "seconds": round(time.monotonic() - started, 3),
            "cpu_seconds": round(time.process_time() - cpu_before, 3),
            "peak_memory_mb": round(peak_memory_mb(), 1),
            "threads": task.threads,
        }
        store.commit(draft, task.key, made, before=parent.before_commit, replace=task.replaces)
    parent.messages.send("done", **made)


class DiskFailures:
    """Turns the errors of a stage whose disk fails into `StoreError`, before the draft is removed."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def __enter__(self) -> None:
        """Nothing to prepare."""

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        if isinstance(error, OSError) and error.errno in DISK_ERRORS:
            raise store_error(error, self._store.root) from error
        if isinstance(error, CaptureError | JobError) and (away := _disk_away(error)) is not None:
            raise away from error
        # A writer that finds the disk full knows its own file, but not that the folder belongs to the store.
        other = isinstance(error, Exception) and not isinstance(error, BodycapError)
        if (other or isinstance(error, StoreError)) and self._store.free_bytes() < FULL_DISK_BYTES:
            raise disk_full(self._store.root) from error


def _disk_away(error: BodycapError) -> DiskAway | None:
    """Return the error of a disk that does not answer, if that is why the file named by `error` failed.

    FFmpeg reports EIO for broken files too. It takes a file that becomes unreachable for one that ends early.
    In both cases the file is read here to find out.
    """
    if error.path is None:
        return None
    path, failed = Path(error.path), error.__cause__
    if not isinstance(failed, OSError) or failed.errno in (None, errno.EIO):
        failed = _read_failure(path)
    found = store_error(failed, path) if isinstance(failed, OSError) else None
    return found if isinstance(found, DiskAway) else None


def _read_failure(path: Path) -> OSError | None:
    """Return why a plain file cannot be read at its start or end; None if it can, or for other files."""
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
    """Return the error of a store whose disk is full."""
    hint = "free some space, or name a folder on another disk with --store; finished stages are kept"
    return StoreError("No space left on device", path=root, hint=hint)


def _report_unexpected(error: Exception, root: Path, messages: _MessageWriter) -> int:
    """Report a bug, or a lack of memory, after which the child ends; return the exit code."""
    if isinstance(error, MemoryError):
        full = BodycapError("out of memory", hint="close other programs, or lower work_px in the job")
        messages.send("error", error=full.to_dict(), ends=True)
        return EXIT_BUG
    text = traceback.format_exc()
    sys.stderr.write(text)
    bug = BodycapError(f"{type(error).__name__}: {error}", path=root if isinstance(error, OSError) else None)
    messages.send("error", error=bug.to_dict(), traceback=text, ends=True)
    return EXIT_BUG


def _pin_threads(threads: int) -> None:
    """Give the task's threads to OpenCV. The pools of other libraries are off: stages start own threads."""
    os.environ["OPENCV_FOR_THREADS_NUM"] = str(threads)
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(threads)


def _reset_peak_memory() -> None:
    """Start to count the peak memory of a task, if the system can (Linux)."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def peak_memory_mb() -> float:
    """Return the peak of resident memory since `_reset_peak_memory` or else since the start, MB."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024.0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1 << 20) if sys.platform == "darwin" else peak / (1 << 10)


class _MessageWriter:
    """Sends JSON lines to the parent; the prints of libraries go to the log instead."""

    def __init__(self) -> None:
        self._stream: TextIO = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
        sys.stdout.flush()
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
        self._lock = threading.Lock()
        self._last = 0.0

    def send(self, event: str, **values: Any) -> None:
        """Send one message."""
        with self._lock:
            self._stream.write(json.dumps({"event": event, **values}) + "\n")
            self._stream.flush()

    def send_progress(self, done: int, total: int, what: str = "") -> None:
        """Send the progress, except if the last message is very recent."""
        now = time.monotonic()
        if done < total and now - self._last < _PROGRESS_PERIOD_S:
            return
        self._last = now
        self.send("progress", done=int(done), total=int(total), what=what)


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


class _OrderReader:
    """Reads the orders from standard input. If it closes, the parent asks to stop, or has ended."""

    def __init__(self) -> None:
        self.closed = threading.Event()
        self._queue: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        threading.Thread(target=self._read, daemon=True).start()

    def next(self) -> dict[str, Any] | None:
        """Wait for the next order; return None after the last one."""
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
