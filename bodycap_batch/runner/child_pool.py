"""Run tasks in child processes on this machine."""

from __future__ import annotations

import contextlib
import json
import os
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from bodycap_batch.core.errors import BodycapError, Cancelled, error_from_dict
from bodycap_batch.runner.child_main import FULL_DISK_BYTES, disk_full
from bodycap_batch.runner.child_process import CHILD_COMMAND, Child, crash_hint, describe_end
from bodycap_batch.runner.memory_limit import default_limit_mb, log_says_out_of_memory, out_of_memory
from bodycap_batch.runner.task import Task
from bodycap_batch.store.artefacts import Store, disk_errors

CHILDREN_LOG = "children.log"
"""Name of the log file for the output that children print while they have no task."""


def stopped() -> Cancelled:
    """Return the error for a job that was stopped."""
    return Cancelled(
        "the job stopped on request; the results of finished stages stay in the store",
        hint="run the job again to continue",
    )


def do_nothing() -> None:
    """Do nothing when children begin to load modules."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Preload:
    """Modules that idle children load while a task runs.

    Attributes:
        modules: One list of module names for each child.
        step: Name of the step of the task at which the children begin to load: the unit of its progress
            reports. "" to begin with the task.
        then: Called in this process when the children begin to load.
    """

    modules: Sequence[Sequence[str]] = ()
    step: str = ""
    then: Callable[[], object] = do_nothing


NOTHING_TO_LOAD = Preload()
"""No child loads modules."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskEnvironment:
    """The environment in which a task runs. It does not change the result of the task.

    Attributes:
        store: The store into which the artefact is committed.
        logs: Folder for the log file and the task file of each task.
        progress: Called as ``progress(done, total, what)``.
        cancelled: Called several times a second, and before the artefact is committed; True stops the task.
        preload: Modules that idle children load while the task runs.
        memory_mb: Memory limit (MB) of the task; None for four fifths of the machine's memory.
    """

    store: Store
    logs: Path
    progress: Callable[[int, int, str], None]
    cancelled: Callable[[], bool]
    preload: Preload = NOTHING_TO_LOAD
    memory_mb: int | None = None

    @property
    def memory_limit_mb(self) -> int:
        """Memory limit (MB) of the task."""
        return default_limit_mb() if self.memory_mb is None else self.memory_mb


class Executor(Protocol):
    """Runs tasks on this machine or on other machines. Several threads may use it at the same time."""

    def execute(self, task: Task, environment: TaskEnvironment) -> None:
        """Compute and commit the task's artefact. Raises `BodycapError`; `Cancelled` if the task stops."""

    def close(self, logs: Path) -> None:
        """Release the resources of a job that has ended; `logs` is the job's folder of logs."""


class Children:
    """Child processes, each of which runs one task after another.

    Because a child runs several tasks, it loads the libraries only once. A child ends when `close` is called,
    after a crash or a bug, and when its parent process ends.

    Args:
        command: The child's command line, without the task file.
    """

    def __init__(self, command: Sequence[str] = CHILD_COMMAND) -> None:
        self._command = tuple(command)
        self._idle: list[Child] = []
        self._lock = threading.Lock()

    def close(self, logs: Path) -> None:
        """End the idle children; remove their log from the folder `logs` if the log is empty."""
        with self._lock:
            waiting, self._idle = self._idle, []
        for child in waiting:
            child.kill()
        log = logs / CHILDREN_LOG
        with contextlib.suppress(FileNotFoundError):  # another run of the same job may have removed it
            if log.stat().st_size == 0:
                log.unlink()

    def start_ahead(self, modules: Sequence[str]) -> None:
        """Start one child before the job has a task, and let it load modules.

        What the child prints before its first task is not kept. If the child dies before its first task,
        another child runs the task.

        Args:
            modules: The modules to load.
        """
        with Path(os.devnull).open("wb") as nothing:
            child = Child(self._command, nothing)
        child.order({"import": list(modules)})
        child.loaded |= set(modules)
        with self._lock:
            self._idle.append(child)

    def prepare(self, logs: Path, work: Sequence[Sequence[str]]) -> None:
        """Let idle children load modules: one child per list. If too few children are idle, start new ones.

        A later task runs in the child that has loaded most of the task's modules.

        Args:
            logs: Folder for the logs of the children.
            work: The modules to load: one list of module names for each child.
        """
        taken = []
        for modules in work:
            child, _ = self._take(modules, logs)
            child.order({"import": list(modules)})
            child.loaded |= set(modules)
            taken.append(child)
        with self._lock:
            self._idle += taken

    def execute(self, task: Task, environment: TaskEnvironment) -> None:
        """Compute and commit the task's artefact in a child.

        Raises:
            BodycapError: The error of the task; `StoreError` if the disk fails; `Cancelled` if the task is
                stopped.
        """
        log = environment.logs / f"{task.file_stem}.log"
        document = task.to_json(environment.store.root)
        with disk_errors(environment.logs):
            environment.logs.mkdir(parents=True, exist_ok=True)
            # The child does not read this file: another run of the same job may write it at any moment.
            log.with_suffix(".task.json").write_text(json.dumps(document, indent=1), encoding="utf-8")
            log.write_bytes(b"")
        child, last = self._run_in_child(task, environment, {"task": document, "log": str(log)})
        is_stopped = environment.cancelled()
        if last is not None and "ends" not in last and not is_stopped:
            with self._lock:
                self._idle.append(child)
        else:
            child.end(at_once=is_stopped)
        if is_stopped:
            raise stopped()
        if last is None or last["event"] == "error":
            raise _task_error(task, last, child, log, environment)

    def _run_in_child(
        self, task: Task, environment: TaskEnvironment, order: Mapping[str, Any]
    ) -> tuple[Child, dict[str, Any] | None]:
        """Run a task in a child, and return the child and its last message.

        If an idle child has died before it receives the task, another child runs the task.
        """
        due = [environment.preload]

        def load_ahead(step: str) -> None:
            if due and step == due[0].step:
                preload = due.pop()
                self.prepare(environment.logs, preload.modules)
                preload.then()

        while True:
            child, is_new = self._take(task.modules, environment.logs)
            child.loaded |= set(task.modules)
            events: list[str] = []

            def receive(message: dict[str, Any], child: Child = child, events: list[str] = events) -> None:
                events.append(message["event"])
                if message["event"] == "progress":
                    load_ahead(message.get("what", ""))
                _answer(child, message, environment)

            # End the child if the listener of the progress raises an error, for example because its pipe is
            # closed.
            with ExitStack() as on_error:
                on_error.callback(child.end, at_once=True)
                load_ahead("")
                memory_mb = environment.memory_limit_mb
                child.limit_memory(memory_mb)
                child.order({**order, "memory_mb": memory_mb})
                last = child.follow(environment.cancelled, receive)
                on_error.pop_all()
            if is_new or events or last is not None or environment.cancelled():
                return child, last
            child.end(at_once=False)

    def _take(self, modules: Collection[str], logs: Path) -> tuple[Child, bool]:
        """Return a child for a task that needs `modules`, and whether the child is new.

        The idle child that has loaded most of `modules` is preferred. If several children have loaded the
        same number of these modules, the child that has loaded the fewest other modules is preferred.
        """
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


def _answer(child: Child, message: dict[str, Any], environment: TaskEnvironment) -> None:
    """Answer the child's question before a commit, or report the child's progress."""
    if message["event"] == "ready":
        child.order({"commit": not environment.cancelled()})
    elif message["event"] == "progress":
        environment.progress(message["done"], message["total"], message.get("what", ""))


def _task_error(
    task: Task, last: dict[str, Any] | None, child: Child, log: Path, environment: TaskEnvironment
) -> BodycapError:
    """Return the error of a failed task, from the child's last message or else from the child's end."""
    if last is not None:
        error = error_from_dict(last["error"])
        if "traceback" in last:
            error.message = f"{task.label}: {error.message}"
            error.hint = f"this is a bug in bodycap; please report it with {log} and the job file"
            error.add_note(last["traceback"])
        return error
    if child.ended_by_memory() or log_says_out_of_memory(log):
        return out_of_memory(task.label, environment.memory_limit_mb, child.peak_mb)
    if environment.store.free_bytes() < FULL_DISK_BYTES:
        return disk_full(environment.store.root)
    code = child.returncode
    return BodycapError(f"{task.label}: {describe_end(code)}", path=log, hint=crash_hint(code))
