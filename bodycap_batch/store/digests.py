"""Digests of files. The digest of a large file is stored, so that the file is not read again."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bodycap_batch.core.errors import CaptureError

_BLOCK_BYTES = 1 << 20
"""Size (bytes) of the blocks in which a file is read and hashed. Evidence: none."""
_SHA256_DIGITS = 64
"""Number of hexadecimal digits of a SHA-256. Origin: 256 bits, four bits per digit."""
_TEMPORARY = re.compile(r"\.([0-9a-f]{8})\.(\d+)\.\d+\.part$")
"""Pattern of the name of a temporary file. The name ends with a code of the machine, the process id and a
time. The code of the machine is needed because several machines may share a folder."""
_MIN_AGE_S = 1.0
"""Minimum time (seconds) since a file's last change before the digest of the file is stored. If a file
changes twice within the resolution of the file system's clock, its times may stay the same. Evidence: none.
"""


def json_digest(value: Any) -> str:
    """Return the SHA-256 of a JSON value in its canonical form (sorted keys, no spaces)."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def file_sha256(path: Path, on_bytes: Callable[[int], None] | None = None) -> str:
    """Return the SHA-256 of a file's bytes; `on_bytes` is called with the size of each block read."""
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(_BLOCK_BYTES):
            digest.update(block)
            if on_bytes is not None:
                on_bytes(len(block))
    return digest.hexdigest()


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file such that readers see either all old or all new bytes, even after a power failure."""
    temporary = temporary_beside(path)
    try:
        with temporary.open("wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def temporary_beside(path: Path) -> Path:
    """Return a path in the same folder for a temporary file that is renamed to `path` when it is complete."""
    return path.with_name(f".{path.name}.{_machine()}.{os.getpid()}.{time.monotonic_ns()}.part")


def remove_abandoned(folder: Path) -> None:
    """Remove the temporary files that killed processes of this machine left in a folder."""
    for path in folder.glob(".*.part"):
        named = _TEMPORARY.search(path.name)
        if named is not None and named.group(1) == _machine() and not _is_alive(int(named.group(2))):
            path.unlink(missing_ok=True)


def _machine() -> str:
    return hashlib.sha256(platform.node().encode()).hexdigest()[:8]


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


class FileDigests:
    """Stores digests of large files. Device, inode, size, mtime and ctime identify the state of a file.

    If the bytes of a file change, its ctime changes too, and no program can set the ctime back. A stored
    digest is therefore correct, and a finished job does not read its videos again. Each stored digest has a
    checksum. If the checksum does not match, the digest is computed again.

    Args:
        folder: Folder of the stored digests; each digest is one small file.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def sha256(self, path: Path, on_bytes: Callable[[int], None] | None = None) -> str:
        """Return the SHA-256 of a file. If the file has not changed, return the stored digest.

        Args:
            path: Path of the file.
            on_bytes: Called with the number of bytes after each block that is read.

        Raises:
            CaptureError: The file changes while it is read.
        """
        before = _identity(path)
        entry = self._folder / hashlib.sha256(json.dumps(before).encode()).hexdigest()
        stored = entry.read_bytes() if entry.is_file() else b""
        digest = stored[:_SHA256_DIGITS].decode("ascii", "replace")
        if stored == _entry_text(entry.name, digest):
            return digest
        digest = file_sha256(path, on_bytes)
        after = _identity(path)
        if after != before:
            # Another hard link changes the ctime and no byte: jobs with equal results link the same files of
            # the store. A second reading proves that the bytes are the same.
            is_same = after[:-1] == before[:-1] and file_sha256(path, on_bytes) == digest
            if is_same and _identity(path)[:-1] == before[:-1]:
                return digest
            raise CaptureError(
                "the file changed while the program read it",
                path=path,
                hint="wait until the file is copied completely, then run the job again",
            )
        if time.time() - max(before[3], before[4]) / 1e9 > _MIN_AGE_S:
            self._folder.mkdir(parents=True, exist_ok=True)
            write_atomically(entry, _entry_text(entry.name, digest))
        return digest


def _entry_text(name: str, digest: str) -> bytes:
    """Return the content of the file `name` of a stored digest: the digest, and a checksum of both."""
    return f"{digest} {hashlib.sha256(f'{name} {digest}'.encode()).hexdigest()}\n".encode()


def _identity(path: Path) -> tuple[int, int, int, int, int]:
    stat = path.stat()
    return stat.st_dev, stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns
