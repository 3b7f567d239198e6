"""Errors of the environment of a command: its working folder, its names of files, its disks."""

from __future__ import annotations

import os
from collections.abc import Sequence

from bodycap_batch.cli.shared_options import STORE_VARIABLE
from bodycap_batch.core.errors import BodycapError, JobError, StoreError


def require_usable_paths(arguments: Sequence[str]) -> None:
    """Check that the working folder exists, and that all paths of a command can be written to text files.

    Args:
        arguments: The words of the command line.

    Raises:
        StoreError: The working folder no longer exists.
        JobError: An argument, the name of the working folder or the name of the store is not UTF-8 text.
    """
    for text in (*arguments, os.environ.get(STORE_VARIABLE, ""), _working_folder()):
        try:
            text.encode()
        except UnicodeEncodeError as error:
            raise _name_error(text) from error


def error_of_environment(error: Exception) -> BodycapError | None:
    """Return the error for the user if the environment caused an exception; None if it is a bug."""
    if isinstance(error, UnicodeEncodeError) and _is_undecoded(error):
        return _name_error(error.object)
    if not isinstance(error, OSError):
        return None
    try:
        folder = _working_folder()
    except StoreError as gone:
        return gone
    from bodycap_batch.store.artefacts import disk_error  # slow to import, and not needed for `--help`

    return disk_error(error, folder)


def _working_folder() -> str:
    try:
        return os.getcwd()
    except FileNotFoundError as error:
        raise StoreError(
            "the working folder no longer exists", hint="go to a folder that exists (cd), then start again"
        ) from error


def _is_undecoded(error: UnicodeEncodeError) -> bool:
    """Return True if the text holds bytes of a name that Python could not decode."""
    return all("\udc80" <= character <= "\udcff" for character in error.object[error.start : error.end])


def _name_error(text: str) -> JobError:
    return JobError(
        f"the name {text} is not UTF-8 text",
        hint="rename the file or folder; if the name is correct, set the environment variable PYTHONUTF8=1",
    )
