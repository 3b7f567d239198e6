"""Return freed memory to the operating system."""

from __future__ import annotations

import contextlib
import ctypes
import gc


def release_memory() -> None:
    """Return to the operating system the memory that this process has freed.

    glibc keeps freed memory, and this increases the peak memory of the next step. Other C libraries have no
    ``malloc_trim``. With such a library, only Python's garbage collector runs. Evidence:
    docs/decisions/export.md.
    """
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
