"""The memory limit of a child process: how it is set, and how a lack of memory is recognised.

The parent compares the resident memory with the limit several times a second, and RLIMIT_DATA stops single
allocations that are too large to wait for the next comparison. RLIMIT_AS is not used: it counts mappings that
never need memory. Evidence: docs/decisions/pipeline.md.
"""

from __future__ import annotations

import contextlib
import errno
import os
import resource
from collections.abc import Iterator
from pathlib import Path

from bodycap_batch.core.errors import OutOfMemory

_MB = 1 << 20
"""Bytes per MB."""
_DATA_FACTOR = 1.6
"""Ratio (no unit) of the private writable memory that a task may map, to the resident memory that it may use.
Evidence: docs/decisions/pipeline.md."""
_DATA_MB = 64
"""Private writable memory (MB) that a task and each of its threads may map in addition: stacks, and buffers
of libraries. Evidence: docs/decisions/pipeline.md."""
_OOM_SCORE = 500
"""Value of ``oom_score_adj`` of a child (no unit, at most 1000). If the memory of the machine is exhausted,
the kernel ends a child and not its parent. Evidence: none."""
_LOG_BYTES = 4096
"""Number of bytes at the end of a log in which the last words of a crashed child are looked for.
Evidence: none."""
_LAST_WORDS = (
    b"std::bad_alloc",
    b"MemoryError",
    b"Memory allocation still failed",
    b"Cannot allocate memory",
)
"""Texts that libraries print when they end the process because an allocation failed."""
_MESSAGES = ("bad_alloc", "insufficient memory", "can't start new thread", "cannot allocate memory")
"""Parts of the messages of exceptions that report a failed allocation, in lower case."""
_HINT = (
    "allow more with --memory-mb if the machine has more, lower work_px, or cut the capture with start_s and "
    "end_s; finished stages are kept"
)
_CGROUPS = Path("/sys/fs/cgroup")


def machine_memory_mb() -> int:
    """Return the memory (MB) of this machine, or the limit of this process's control group if smaller."""
    physical = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return min([physical, *_group_limits(_CGROUPS)]) // _MB


def default_limit_mb() -> int:
    """Return the default memory limit (MB) of a child: four fifths of the memory of the machine."""
    return machine_memory_mb() * 4 // 5


def _group_limits(root: Path) -> Iterator[int]:
    """Yield the memory limits (bytes) of the control groups of this process, of both versions."""
    own = _own_group(root)
    groups = [] if own is None else [own, *(each for each in own.parents if each.is_relative_to(root))]
    files = [*(group / "memory.max" for group in groups), root / "memory" / "memory.limit_in_bytes"]
    for file in files:
        with contextlib.suppress(OSError, ValueError):
            yield int(file.read_text(encoding="ascii"))


def _own_group(root: Path) -> Path | None:
    """Return the folder of the control group (version 2) of this process; None if there is none."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/cgroup").read_text(encoding="utf-8").splitlines():
            if line.startswith("0::/"):
                return root / line.removeprefix("0::/")
    return None


def kernel_kills() -> int:
    """Return how often the kernel has ended a process of this machine because of memory; 0 if unknown."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/vmstat").read_text(encoding="ascii").splitlines():
            if line.startswith("oom_kill "):
                return int(line.split()[1])
    return 0


def status_mb(process: str | int, name: str) -> float:
    """Return a size (MB) from the status of a process, such as ``VmRSS`` of a pid; 0 if it is unknown."""
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{process}/status").read_text(encoding="ascii").splitlines():
            if line.startswith(f"{name}:"):
                return int(line.split()[1]) / 1024.0
    return 0.0


def limit_own_memory(memory_mb: int, threads: int) -> None:
    """Limit the private writable memory of this process for its next task.

    Memory that the process has mapped before stays usable.

    Args:
        memory_mb: Resident memory (MB) that the process may use.
        threads: Number of threads of the task.
    """
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(_OOM_SCORE), encoding="ascii")
    more = max(0.0, memory_mb - status_mb("self", "VmRSS"))
    _set_data_limit(status_mb("self", "VmData") + _DATA_FACTOR * more + _DATA_MB * (1 + threads))


def lift_own_limit() -> None:
    """Remove the limit of `limit_own_memory`, so that an error can be reported."""
    _set_data_limit(None)


def _set_data_limit(memory_mb: float | None) -> None:
    most = resource.getrlimit(resource.RLIMIT_DATA)[1]
    wanted = resource.RLIM_INFINITY if memory_mb is None else round(memory_mb * _MB)
    if most != resource.RLIM_INFINITY:
        wanted = most if wanted == resource.RLIM_INFINITY else min(wanted, most)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_DATA, (wanted, most))


def is_out_of_memory(error: BaseException | None) -> bool:
    """Return True if a failed allocation caused an exception, directly or through other exceptions."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
            return True
        if any(text in str(error).lower() for text in _MESSAGES):
            return True
        error = error.__cause__ or error.__context__
    return False


def log_says_out_of_memory(log: Path) -> bool:
    """Return True if a log ends with the words of a library that ended the process for lack of memory."""
    with contextlib.suppress(OSError), log.open("rb") as stream:
        stream.seek(max(0, log.stat().st_size - _LOG_BYTES))
        tail = stream.read()
        return any(words in tail for words in _LAST_WORDS)
    return False


def out_of_memory(task: str, memory_mb: int | None, peak_mb: float) -> OutOfMemory:
    """Return the error of a task that needs more memory than it may use.

    Args:
        task: Label of the task.
        memory_mb: Memory limit (MB) of the task; None if it had no limit.
        peak_mb: Largest resident memory (MB) of the task that was seen.
    """
    limit = "no limit was set" if memory_mb is None else f"its limit is {memory_mb} MB"
    return OutOfMemory(f"{task}: out of memory: {limit}, it had used {peak_mb:.0f} MB", hint=_HINT)
