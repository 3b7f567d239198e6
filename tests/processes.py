"""Processes that tests start."""

from __future__ import annotations

import shutil

END_WITH_PARENT = ("setpriv", "--pdeathsig", "KILL") if shutil.which("setpriv") else ()
"""Before a command: it gets SIGKILL when the test that started it ends, however that ends (Linux)."""
