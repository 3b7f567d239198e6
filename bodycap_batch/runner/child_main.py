"""The child process: it runs tasks, commits their artefacts and reports to the parent process."""

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
from bodycap_batch.core.mechanisms import acted, begin_task
from bodycap_batch.core.memory import exempt_from_collection, release_memory
from bodycap_batch.core.progress import StepProgress
from bodycap_batch.runner.child_process import KILL_AFTER_S
from bodycap_batch.runner.memory_limit import (
    is_out_of_memory,
    lift_own_limit,
    limit_own_memory,
    out_of_memory,
    status_mb,
)
from bodycap_batch.runner.task import Task, TaskFunction, task_from_json
from bodycap_batch.store.artefacts import DISK_ERRORS, Store, store_error

_PROGRESS_PERIOD_S = 0.2
"""Minimum time (seconds) between two reports of progress. A display that changes faster is hard to read.
Evidence: none."""
RELEASE_PERIOD_S = 0.5
"""Minimum time (seconds) between two releases of freed memory. In a process with much memory, one release
takes about 50 ms. Evidence: docs/decisions/pipeline.md."""
FULL_DISK_BYTES = 8 << 20
"""A disk with less free space (bytes) is treated as full. After an unexpected failure, a full disk is
reported as the cause of the failure, because libraries hide the error ENOSPC. Evidence: none."""


def main(arguments: Sequence[str], stages: Mapping[str, TaskFunction]) -> int:
    """Run the task file given in `arguments`; without a file, follow orders until standard input closes.

    An order is one JSON line. ``{"task": task, "log": file, "memory_mb": limit}`` runs a task and writes the
    task's printed output to the log. ``{"import": [modules]}`` loads modules while the child has no task. If
    a task is ordered while modules are loading, the task waits until the modules are loaded.

    Args:
        arguments: The path of the task file; empty to follow orders.
        stages: For each stage name, the function that runs the stage's tasks.

    Returns:
        The exit code: 0 without an error, the exit code of a `BodycapError`, or 70 for a bug.
    """
    writer = _MessageWriter()
    orders = _OrderReader()
    if arguments:
        document = json.loads(Path(arguments[0]).read_text(encoding="utf-8"))
        return _run_task(document, stages, _Parent(writer, orders, asks=False))
    for order in iter(orders.next, None):
        if "import" in order:
            import_ahead(order["import"])
            continue
        _redirect_prints(Path(order["log"]))
        writer.send("started")
        parent = _Parent(writer, orders, asks=True, memory_mb=order["memory_mb"])
        if _run_task(order["task"], stages, parent) == EXIT_BUG:
            return EXIT_BUG
    return 0


@dataclass(frozen=True, slots=True)
class _Parent:
    """The connection to the parent process, which a task uses to send messages and to ask for permission.

    Attributes:
        messages: Writer of the messages to the parent.
        orders: Reader of the parent's orders and answers.
        asks: True if the child asks the parent for permission before a commit.
        memory_mb: Memory limit (MB) of the task; None for no limit.
    """

    messages: _MessageWriter
    orders: _OrderReader
    asks: bool
    memory_mb: int | None = None

    def before_commit(self) -> None:
        """Ask the parent whether the artefact may be committed; raise `Cancelled` if the parent refuses."""
        if not self.asks:
            return
        self.messages.send("ready")
        answer = self.orders.next()
        if answer is None or not answer["commit"]:
            raise Cancelled(
                "the result was not stored, because the job was stopped",
                hint="run the job again to continue",
            )


def _run_task(document: Mapping[str, Any], stages: Mapping[str, TaskFunction], parent: _Parent) -> int:
    """Run a task given as JSON values, report its end to the parent, and return the exit code."""
    task, root = task_from_json(document)
    try:
        store = Store(root)
        if parent.memory_mb is not None:
            limit_own_memory(parent.memory_mb, task.threads)
        _run(task, store, stages[task.key.stage], parent)
    except Exception as error:  # noqa: BLE001 - the only place that catches the bugs of a task
        lift_own_limit()
        if is_out_of_memory(error):
            full = out_of_memory(task.label, parent.memory_mb, peak_memory_mb())
            parent.messages.send("error", error=full.to_dict(), ends=True)
            return EXIT_BUG
        if isinstance(error, BodycapError):
            parent.messages.send("error", error=error.to_dict())
            return error.exit_code
        return _report_unexpected(error, root, parent.messages)
    return 0


def import_ahead(modules: Sequence[str]) -> None:
    """Load modules before a task needs them. A missing module is only logged; the task reports it later."""
    for name in modules:
        try:
            importlib.import_module(name)
        except ImportError as error:
            sys.stderr.write(f"{name}: {error}\n")


def _redirect_prints(log: Path) -> None:
    """Redirect standard output and standard error, also of native libraries, to the end of a file."""
    with log.open("ab") as stream:
        for number in (1, 2):
            os.dup2(stream.fileno(), number)


def _run(task: Task, store: Store, function: TaskFunction, parent: _Parent) -> None:
    """Verify the input artefacts of a task, run its stage's function and commit the files that it writes."""
    started, cpu_before = time.monotonic(), time.process_time()
    _pin_threads(task.threads)
    release_memory()
    exempt_from_collection()
    _reset_peak_memory()
    begin_task(task.key.options)
    for artefact in dict.fromkeys(store.artefacts_in(task.arguments)):
        store.verify(artefact)
    with store.draft(task.key) as draft, DiskFailures(store):
        progress = StepReporter(parent.messages.send_progress)
        context = StageContext(
            work_dir=draft.work,
            threads=task.threads,
            progress=progress,
            cancelled=parent.orders.closed.is_set,
        )
        context.check_cancelled()
        function(task.arguments, context, draft.files)
        progress.complete()
        made = {
            "seconds": round(time.monotonic() - started, 3),
            "cpu_seconds": round(time.process_time() - cpu_before, 3),
            "peak_memory_mb": round(peak_memory_mb(), 1),
            "threads": task.threads,
            "acted": acted(),
        }
        store.commit(draft, task.key, made, before=parent.before_commit, replace=task.replaces)
    parent.messages.send("done", **made)


class DiskFailures:
    """Context manager that converts an error of a stage into `StoreError` if a failing disk caused it.

    Exit this context before the draft is removed. The removal frees disk space and would hide a full disk.
    """

    def __init__(self, store: Store) -> None:
        self._store = store

    def __enter__(self) -> None:
        """Do nothing."""

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        if isinstance(error, OSError) and error.errno in DISK_ERRORS:
            raise store_error(error, self._store.root) from error
        if isinstance(error, CaptureError | JobError) and (away := _disk_away(error)) is not None:
            raise away from error
        # If the disk is full, replace the error. The error of a writer names the file that could not be
        # written; the new error names the store's folder.
        other = isinstance(error, Exception) and not isinstance(error, BodycapError)
        if (other or isinstance(error, StoreError)) and self._store.free_bytes() < FULL_DISK_BYTES:
            raise disk_full(self._store.root) from error


def _disk_away(error: BodycapError) -> DiskAway | None:
    """Return a `DiskAway` error if the file that `error` names is on a disk that does not answer, else None.

    FFmpeg reports EIO for broken files too, and it treats a file that becomes unreachable like a file that
    ends early. After either kind of error, this function reads the file to find the cause.
    """
    if error.path is None:
        return None
    path, failed = Path(error.path), error.__cause__
    if not isinstance(failed, OSError) or failed.errno in (None, errno.EIO):
        failed = _read_failure(path)
    found = store_error(failed, path) if isinstance(failed, OSError) else None
    return found if isinstance(found, DiskAway) else None


def _read_failure(path: Path) -> OSError | None:
    """Read a regular file at its start and end, and return the error; None without an error."""
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
    """Return the error for a store whose disk is full."""
    hint = (
        "free some space, or choose a folder on another disk with --store; the results of finished stages "
        "stay in the store"
    )
    return StoreError("No space left on device", path=root, hint=hint)


def _report_unexpected(error: Exception, root: Path, messages: _MessageWriter) -> int:
    """Report a bug to the parent; return the exit code with which the child must end."""
    text = traceback.format_exc()
    sys.stderr.write(text)
    bug = BodycapError(f"{type(error).__name__}: {error}", path=root if isinstance(error, OSError) else None)
    messages.send("error", error=bug.to_dict(), traceback=text, ends=True)
    return EXIT_BUG


def _pin_threads(threads: int) -> None:
    """Set the number of threads that OpenCV uses. All other libraries use one thread."""
    os.environ["OPENCV_FOR_THREADS_NUM"] = str(threads)
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(threads)


def _reset_peak_memory() -> None:
    """Reset the peak memory of this process, so that it is measured for the next task only (Linux only)."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def peak_memory_mb() -> float:
    """Return the peak resident memory (MB) since `_reset_peak_memory`, or since the start without a reset."""
    if peak_mb := status_mb("self", "VmHWM"):
        return peak_mb
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1 << 20) if sys.platform == "darwin" else peak / (1 << 10)


class _MessageWriter:
    """Sends JSON lines to the parent; redirects the printed output of libraries to the log."""

    def __init__(self) -> None:
        self._stream: TextIO = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
        sys.stdout.flush()
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
        self._lock = threading.Lock()
        self._last = 0.0

    def send(self, event: str, **values: Any) -> None:
        """Send one message: the name of an event and its values."""
        with self._lock:
            self._stream.write(json.dumps({"event": event, **values}) + "\n")
            self._stream.flush()

    def send_progress(self, done: int, total: int, what: str = "") -> None:
        """Send the progress if the last report is old enough; the end (`done` = `total`) is always sent."""
        now = time.monotonic()
        if done < total and now - self._last < _PROGRESS_PERIOD_S:
            return
        self._last = now
        self.send("progress", done=int(done), total=int(total), what=what)


class StepReporter:
    """Reports the progress of a stage, and releases freed memory when the stage starts another step.

    The C library keeps freed memory. Without releases, the peak memory of a stage would be almost the sum of
    the memory that each step needs.

    Args:
        report: Called as ``report(done, total, what)``.
        release: Function that releases freed memory to the system.
        period_s: Minimum time (seconds) between two releases.
    """

    def __init__(
        self,
        report: Callable[[int, int, str], None],
        release: Callable[[], None] = release_memory,
        period_s: float = RELEASE_PERIOD_S,
    ) -> None:
        self._report = StepProgress(report)
        self._release = release
        self._period_s = period_s
        self._step = ""
        self._last = time.monotonic()

    def __call__(self, done: int, total: int, what: str = "") -> None:
        """Report that `done` of `total` units are done. A new value of `what` starts another step."""
        if what != self._step:
            self._step = what
            if time.monotonic() - self._last >= self._period_s:
                self._release()
                self._last = time.monotonic()
        self._report(done, total, what)

    def complete(self) -> None:
        """Report that all units of the last step are done."""
        self._report.complete()


class _OrderReader:
    """Reads the orders from standard input, and ends the process some time after standard input closes.

    Standard input closes if the parent asks the child to stop, or if the parent has ended. The process kills
    itself `KILL_AFTER_S` later.
    """

    def __init__(self) -> None:
        self.closed = threading.Event()
        self._queue: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        threading.Thread(target=self._read, daemon=True).start()

    def next(self) -> dict[str, Any] | None:
        """Wait for the next order and return it; return None after the last order."""
        return self._queue.get()

    def _read(self) -> None:
        rest = b""
        while data := os.read(sys.stdin.fileno(), 1 << 12):
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                self._queue.put(json.loads(line))
        self.closed.set()
        self._queue.put(None)
        time.sleep(KILL_AFTER_S)
        os.kill(os.getpid(), signal.SIGKILL)
