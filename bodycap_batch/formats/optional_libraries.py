"""Check the libraries of file formats that need more than the base installation."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.util import find_spec

from bodycap_batch.core.errors import JobError

_LIBRARY_MODULES = {"usd": "pxr", "c3d": "ezc3d"}
"""Python module that each format needs. The keys are the names of the formats."""


def require_libraries(formats: Iterable[str]) -> None:
    """Check that the libraries of all formats are installed.

    A job calls this function first, so that a missing library is reported before the computation starts.

    Args:
        formats: Names of the formats of the job (`export.formats`).

    Raises:
        JobError: A library is missing. The hint explains how to install the library.
    """
    for name in formats:
        if name in _LIBRARY_MODULES and find_spec(_LIBRARY_MODULES[name]) is None:
            raise JobError(
                f"{name.upper()} files need a library that is not installed ({_LIBRARY_MODULES[name]})",
                field="export.formats",
                hint="run `make extras` or `pip install 'bodycap_batch[formats]'` to install the library, "
                "or leave the format out",
            )


def require_formats(formats: Iterable[str]) -> None:
    """Check that the libraries of all formats are installed, and that Blender starts if a format needs it.

    Args:
        formats: Names of the formats of the job (`export.formats`).

    Raises:
        JobError: A library or Blender is missing. The hint explains how to install it.
    """
    names = tuple(formats)
    require_libraries(names)
    if {"fbx", "abc"} & set(names):
        from bodycap_batch.formats.fbx import require_blender  # this import takes as long as all other code

        require_blender()
