"""Write files atomically: a reader sees either the old file or the complete new file."""

from __future__ import annotations

import errno
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from bodycap_batch.core.errors import StoreError

_HINTS = {
    errno.ENOSPC: "the disk is full: free some space, or choose another disk with --out",
    errno.EDQUOT: "your disk quota is used up: free some space, or choose another disk with --out",
    errno.EACCES: "the program has no permission to write into this folder: choose another folder with --out",
    errno.EROFS: "the file system is read-only: choose another folder with --out",
}


def store_error_from_os_error(error: OSError, path: Path) -> StoreError:
    """Convert the error of a failed write to `path` into a `StoreError` with a hint."""
    return StoreError(
        f"the file cannot be written: {error.strerror or error}",
        path=path,
        hint=_HINTS.get(error.errno or 0, "check the folder, and check the disk for errors"),
    )


@contextmanager
def atomic_replacement(path: Path) -> Iterator[Path]:
    """Yield the path of a temporary file, and rename the file to `path` if the block succeeds.

    The temporary file is in the folder of `path`. It has the suffix of `path`, because libraries choose the
    format by the suffix. After a failure, the temporary file is deleted, and an existing file at `path` is
    unchanged.

    Raises:
        StoreError: The file cannot be written, for example because the disk is full.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        with open(temporary, "rb") as handle:
            os.fsync(handle.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise store_error_from_os_error(error, path) from error
    finally:
        with suppress(OSError):  # the file no longer exists after the rename
            temporary.unlink()


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically, in UTF-8 and with LF line ends.

    Raises:
        StoreError: The file cannot be written.
    """
    with (
        atomic_replacement(path) as temporary,
        open(temporary, "w", encoding="utf-8", newline="\n") as handle,
    ):
        handle.write(text)
