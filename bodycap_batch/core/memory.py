"""Return freed memory to the operating system."""

from __future__ import annotations

import contextlib
import ctypes
import gc


def release_memory() -> None:
    """Return the memory that this process has freed to the operating system.

    glibc keeps freed memory, which raises the peak of the next step. Other C libraries have no
    ``malloc_trim``; there only Python's garbage collector runs. Evidence: docs/decisions/export.md.
    """
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
