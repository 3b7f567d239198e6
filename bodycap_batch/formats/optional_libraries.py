"""Formats that take more than the base installation."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.util import find_spec

from bodycap_batch.core.errors import JobError

_LIBRARY_MODULES = {"usd": "pxr", "c3d": "ezc3d"}


def require_libraries(formats: Iterable[str]) -> None:
    """Refuse formats whose library is not installed, before anything is computed.

    Args:
        formats: The job's `export.formats`.

    Raises:
        JobError: Names the format and the extra that brings it.
    """
    for name in formats:
        if name in _LIBRARY_MODULES and find_spec(_LIBRARY_MODULES[name]) is None:
            raise JobError(
                f"{name.upper()} files take a library that is not installed ({_LIBRARY_MODULES[name]})",
                field="export.formats",
                hint="`make extras`, or `pip install 'bodycap_batch[formats]'`; or leave the format out",
            )
