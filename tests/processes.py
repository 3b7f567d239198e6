"""Processes that tests start."""

from __future__ import annotations

import shutil

END_WITH_PARENT = ("setpriv", "--pdeathsig", "KILL") if shutil.which("setpriv") else ()
"""Put before a command: the process gets SIGKILL when the test that started it ends (Linux)."""
