"""Identify processes across machines and restarts."""

from __future__ import annotations

import hashlib
import os
import socket
from pathlib import Path

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_PID_NAMESPACE = Path("/proc/self/ns/pid")


def machine_id() -> str:
    """Return an identifier of this machine, its last start and the process namespace.

    Each container has a separate process namespace. The result is "" if the system does not provide this
    information.
    """
    try:
        boot = _BOOT_ID.read_text(encoding="ascii").strip()
        names = os.readlink(_PID_NAMESPACE)
    except OSError:
        return ""
    return f"{socket.gethostname()}/{boot}/{names}"


def process_start(pid: int) -> str:
    """Return the start time of a process of this machine in kernel clock ticks; "" if it does not run."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2]
    except OSError:
        return ""
    words = fields.split()
    return "" if words[0] in ("Z", "X") else words[19]


def process_tag() -> str:
    """Return a text that identifies this process among the processes of all machines.

    The text is used as a part of file names.
    """
    return f"{_machine_tag()}-{os.getpid()}-{process_start(os.getpid())}"


def is_process_running(tag: str) -> bool:
    """Return True if the process that a tag identifies runs on this machine.

    Args:
        tag: Text that begins with a result of `process_tag`.
    """
    machine, pid, start, *_ = [*tag.split("-"), "", ""]
    here = bool(machine_id()) and machine == _machine_tag()
    return here and pid.isdecimal() and bool(start) and process_start(int(pid)) == start


def is_from_this_machine(tag: str) -> bool:
    """Return True if a tag identifies a process that this machine has started since its last boot."""
    return bool(machine_id()) and tag.split("-", maxsplit=1)[0] == _machine_tag()


def _machine_tag() -> str:
    """Return a short digest of this machine's identifier."""
    return hashlib.sha256(machine_id().encode()).hexdigest()[:12]
