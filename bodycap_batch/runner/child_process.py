"""Start a child process, send orders to it, read its messages and end it."""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import bodycap_batch
from bodycap_batch.runner.memory_limit import kernel_kills, status_mb

CHILD_COMMAND = (sys.executable, "-P", "-m", "bodycap_batch.tasks")
"""Command line of a child, without the task file. The command names the package `tasks`, which belongs to a
higher layer. The package `runner` must not import the package `tasks`."""
KILL_AFTER_S = 3.0
"""Time (seconds) that a child has to end by itself. Then its parent kills it, or it kills itself if its
parent has ended. Evidence: none."""
POLL_S = 0.2
"""Time (seconds) between two checks whether a job that waits was stopped. Evidence: none."""
_THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)


class Child:
    """Starts and controls one child process, in its own process group.

    Attributes:
        loaded: Names of the modules that the child was asked to load.
        peak_mb: Largest resident memory (MB) that was seen during the current task.
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
        self._incomplete = b""
        self.peak_mb = 0.0
        self._memory_mb = 0
        self._kills_before = self._kills_after = 0
        self._exceeded = False

    @property
    def returncode(self) -> int:
        """Exit code of a child that has ended; the negative signal number if a signal ended it."""
        return self._process.returncode

    def limit_memory(self, memory_mb: int) -> None:
        """Limit the resident memory of the next task."""
        self._memory_mb, self.peak_mb, self._exceeded = memory_mb, 0.0, False
        self._kills_before = kernel_kills()

    def ended_by_memory(self) -> bool:
        """Return True if the limit or the kernel ended this child, because of its memory."""
        killed = self.returncode == -signal.SIGKILL
        return self._exceeded or (killed and self._kills_after != self._kills_before)

    def _check_memory(self) -> bool:
        """Note the resident memory. If it is above the limit, kill the child and return False."""
        now = status_mb(self._process.pid, "VmRSS")
        self.peak_mb = max(self.peak_mb, now)
        if now > self._memory_mb > 0:
            self._exceeded = True
            self._signal(signal.SIGKILL)
            return False
        return True

    def order(self, order: Mapping[str, Any]) -> None:
        """Send one order to the child. If the child has ended, do nothing; `follow` then returns None."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(order).encode() + b"\n")
            self._process.stdin.flush()

    def follow(
        self, cancelled: Callable[[], bool], on_message: Callable[[dict[str, Any]], None]
    ) -> dict[str, Any] | None:
        """Read the child's messages until its task ends; kill the child if it exceeds its memory limit.

        Args:
            cancelled: Called several times a second; True ends the reading.
            on_message: Called with every message except the last message.

        Returns:
            The last message of the task; None if the child died or the task was cancelled.
        """
        assert self._process.stdout is not None
        pipe = self._process.stdout.fileno()
        while not cancelled():
            ready = select.select([pipe], [], [], POLL_S)[0]
            if not self._check_memory():
                return None
            if not ready:
                continue
            if not (data := os.read(pipe, 1 << 16)):
                return None
            *lines, self._incomplete = (self._incomplete + data).split(b"\n")
            for message in map(json.loads, lines):
                if message["event"] in ("done", "error"):
                    return dict(message)
                on_message(message)
        return None

    def end(self, *, at_once: bool) -> None:
        """End the child: close its standard input, and kill it if it has not ended after `KILL_AFTER_S`.

        Args:
            at_once: Send SIGTERM after standard input is closed.
        """
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
        self._kills_after = kernel_kills()

    def kill(self) -> None:
        """Kill a child that has no task. No results can be lost."""
        self._signal(signal.SIGKILL)
        self.end(at_once=False)

    def _signal(self, number: signal.Signals) -> None:
        try:
            os.killpg(self._process.pid, number)
        except ProcessLookupError:
            return


def _environment() -> dict[str, str]:
    """Return the environment variables of a child: Python finds this package, and libraries use one thread.

    The variables must be set before the libraries load. With a library's thread pool, floating-point sums
    would depend on the machine's number of cores. Stages start their own threads instead.
    """
    package = str(Path(bodycap_batch.__file__).parent.parent)
    path = os.pathsep.join(part for part in (package, os.environ.get("PYTHONPATH")) if part)
    pinned = dict.fromkeys(_THREAD_VARIABLES, "1")
    return {**os.environ, **pinned, "PYTHONPATH": path, "PYTHONUNBUFFERED": "1"}


def describe_end(returncode: int) -> str:
    """Return a text that says how a child without a last message ended, from the child's exit code."""
    if returncode >= 0:
        return f"the process of the stage ended with code {returncode} and without a message"
    try:
        name = signal.Signals(-returncode).name
    except ValueError:
        name = f"signal {-returncode}"
    return f"the process of the stage was ended by {name}"


def crash_hint(returncode: int) -> str:
    """Return advice for the user, from the exit code of a child that sent no last message."""
    if returncode == -signal.SIGKILL:
        return (
            "the machine probably had too little memory: close other programs, or lower work_px in the "
            "job, then run the job again"
        )
    return "a native library crashed; run the job again; if it crashes again, please report it with this log"
