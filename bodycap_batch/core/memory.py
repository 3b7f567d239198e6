"""Return freed memory to the operating system."""

from __future__ import annotations

import contextlib
import ctypes
import gc


def release_memory() -> None:
    """Return the freed memory of this process to the operating system.

    The C library glibc keeps freed memory for later use, which increases the peak memory of the next step.
    Other C libraries have no function ``malloc_trim``. With another library, this function only runs Python's
    garbage collector. Evidence: docs/decisions/export.md.
    """
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def exempt_from_collection() -> None:
    """Exempt all objects that exist now from Python's garbage collector.

    The objects of loaded libraries stay until the process ends. Without them, `release_memory` takes a few
    milliseconds instead of tens. An exempt object is still freed when its last reference is gone.
    """
    gc.freeze()
