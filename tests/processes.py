"""Processes that tests start."""

from __future__ import annotations

import shutil
from pathlib import Path

END_WITH_PARENT = ("setpriv", "--pdeathsig", "KILL") if shutil.which("setpriv") else ()
"""Put before a command: the process gets SIGKILL when the test that started it ends (Linux)."""


def gone(pid: int) -> bool:
    """Tell whether a process has ended; one that waits to be collected has."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return True
    return state in ("Z", "X")
