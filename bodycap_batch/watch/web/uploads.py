"""Videos sent by the browser: written beside the inbox's drops, out of sight until all are there."""

from __future__ import annotations

import contextlib
import re
import shutil
import threading
import time
import uuid
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from bodycap_batch.config.folder import JOB_FILES, VIDEO_SUFFIXES
from bodycap_batch.config.limits import Limits
from bodycap_batch.core.errors import CaptureError, JobError, StoreError
from bodycap_batch.store.artefacts import disk_errors
from bodycap_batch.watch.claim import is_at_work, is_of_this_machine, process_mark
from bodycap_batch.watch.drops import READY
from bodycap_batch.watch.spool import Spool, move, spool_name

_PREFIX = ".upload-"
_ALSO = ("calib.json", *JOB_FILES)
_ALSO_SUFFIXES = (".timestamps.txt", ".bvh", ".png")
_SMALL_BYTES = 64 << 20
"""What is no video is small: calibrations, times, masks, skeletons."""
_NAME = re.compile(r"[^/\\\x00-\x1f\x7f.][^/\\\x00-\x1f\x7f]{0,199}")
_KEEP_FREE_BYTES = 1 << 30
_MOST_OPEN = 8
_STALE_S = 86_400.0


@dataclass(slots=True)
class _Upload:
    """A folder being sent.

    Attributes:
        name: What the job will be called.
        folder: Where it is written to.
        touched: When something came last.
        files: Files that are there.
        coming: Files that are being sent just now, with their bytes.
        dropped: Nobody wants it any more.
    """

    name: str
    folder: Path
    touched: float
    files: set[str] = field(default_factory=set)
    coming: dict[str, int] = field(default_factory=dict)
    dropped: bool = False


class Uploads:
    """Folders that browsers are sending.

    Args:
        spool: Where complete folders are dropped.
        limits: How much may be sent.
    """

    def __init__(self, spool: Spool, limits: Limits) -> None:
        self._spool = spool
        self._limits = limits
        self._open: dict[str, _Upload] = {}
        self._lock = threading.Lock()

    def begin(self, name: str) -> str:
        """Start a folder; returns its key.

        Raises:
            JobError: The name is none, or too much is being sent at once.
        """
        if not _NAME.fullmatch(name.strip()):
            hint = "letters, digits, spaces; no / and no leading dot"
            raise JobError(f"{name[:40]!r} is no name for a job", hint=hint)
        with self._lock:
            self._forget_stale()
            if len(self._open) >= _MOST_OPEN:
                raise JobError(
                    f"{_MOST_OPEN} folders are being sent already", hint="wait until one of them is there"
                )
            key = uuid.uuid4().hex
            folder = self._spool.inbox / f"{_PREFIX}{process_mark()}-{key}"
            with disk_errors(folder):
                folder.mkdir()
            self._open[key] = _Upload(name=spool_name(name), folder=folder, touched=time.monotonic())
            return key

    async def write(self, key: str, name: str, size: int, chunks: AsyncIterator[bytes]) -> None:
        """Write one file.

        Args:
            key: What `begin` returned.
            name: The file's path in the folder, at most one folder deep.
            size: How many bytes there will be.
            chunks: The bytes.

        Raises:
            JobError: An unknown key or a name that is not expected here.
            CaptureError: More bytes than allowed, or not as many as were announced.
            StoreError: The disk is full.
        """
        upload, path = self._reserved(key, name, size)
        target = upload.folder / path
        try:
            with disk_errors(target):
                await _take_in(target, size, chunks, upload)
        except (CaptureError, StoreError):
            self._require_wanted(upload)
            raise
        finally:
            with self._lock:
                del upload.coming[name]
                if upload.dropped:
                    shutil.rmtree(upload.folder, ignore_errors=True)
        upload.files.add(name)

    def finish(self, key: str) -> str:
        """Drop the folder into the inbox; returns the name it has there.

        Raises:
            JobError: There is no video in it, or one is still being sent.
        """
        with self._lock:
            upload = self._get(key)
            if upload.coming:
                some = ", ".join(sorted(upload.coming)[:3])
                raise JobError(f"{some}: still being sent", hint="finish when every file is there")
            if not any(PurePosixPath(name).suffix.lower() in VIDEO_SUFFIXES for name in upload.files):
                raise JobError(
                    "no video was sent", hint="name them torso.mp4, left_palm.mp4, right_palm.mp4 …"
                )
            with disk_errors(upload.folder):
                (upload.folder / READY).touch()
                target = move(upload.folder, self._spool.inbox, upload.name)
            del self._open[key]
        return target.name

    def drop(self, key: str) -> None:
        """Forget a folder that will not be completed."""
        with self._lock:
            if (upload := self._open.pop(key, None)) is not None:
                self._remove(upload)

    def clear(self) -> None:
        """Remove what is not complete: the page ends, nobody can go on with it."""
        for key in list(self._open):
            self.drop(key)

    def _get(self, key: str) -> _Upload:
        if key not in self._open:
            raise _unknown()
        return self._open[key]

    def _reserved(self, key: str, name: str, size: int) -> tuple[_Upload, PurePosixPath]:
        """The upload, with a place in it that no other request can have."""
        with self._lock:
            upload = self._get(key)
            with disk_errors(upload.folder):
                path = self._checked(upload, name, size)
            upload.coming[name] = size
            return upload, path

    @staticmethod
    def _require_wanted(upload: _Upload) -> None:
        """Tell of a folder that was dropped while a file came, rather than of the file."""
        if upload.dropped:
            raise _unknown() from None

    @staticmethod
    def _remove(upload: _Upload) -> None:
        """Take a folder away; whoever is still writing to it notices, and takes the rest away."""
        upload.dropped = True
        shutil.rmtree(upload.folder, ignore_errors=True)

    def _checked(self, upload: _Upload, name: str, size: int) -> PurePosixPath:
        path = PurePosixPath(name)
        if not 1 <= len(path.parts) <= 2 or not all(map(_NAME.fullmatch, name.split("/"))):
            raise JobError(f"{name[:80]!r} is no name for a file", hint="a file, at most one folder deep")
        video = path.suffix.lower() in VIDEO_SUFFIXES
        if not video and path.name not in _ALSO and not path.name.lower().endswith(_ALSO_SUFFIXES):
            known = ", ".join((*_ALSO, *_ALSO_SUFFIXES))
            raise JobError(f"{path.name} is no video, nor any of {known}", hint="leave it out")
        sent = {*upload.files, *upload.coming}
        # Not by the disk alone: some of them do not tell upper from lower case.
        if name.lower() in {other.lower() for other in sent} or (upload.folder / path).exists():
            raise JobError(f"{name} was sent twice", hint="give each file its own name")
        if any(str(path.parent) == other or str(PurePosixPath(other).parent) == name for other in sent):
            raise JobError(f"{name} is a file and a folder", hint="give each its own name")
        if len(sent) >= self._limits.files:
            raise CaptureError(f"more than {self._limits.files:g} files", hint="one folder per recording")
        most = 1e9 * self._limits.video_gb if video else _SMALL_BYTES
        if not 0 < size <= most:
            hint = "cut the recording, or ask the operator to raise --limit video_gb"
            raise CaptureError(f"{size / 1e9:.3g} GB, the limit is {most / 1e9:.3g}", path=name, hint=hint)
        # What others have announced may not be there yet: rather too careful than a full disk.
        coming = sum(sum(other.coming.values()) for other in self._open.values())
        if shutil.disk_usage(upload.folder).free - coming - size < _KEEP_FREE_BYTES:
            raise StoreError(
                "too little room on the disk", path=self._spool.inbox, hint="make room, then try again"
            )
        return path

    def _forget_stale(self) -> None:
        now = time.monotonic()
        for key in [key for key, upload in self._open.items() if now - upload.touched > _STALE_S]:
            self._remove(self._open.pop(key))


def _unknown() -> JobError:
    return JobError("this upload is not known (any more)", hint="drop the folder again")


def sweep(inbox: Path) -> None:
    """Remove what killed pages left; those of other watchers may be taking videos in just now."""
    for folder in inbox.glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError):
            if _is_abandoned(folder):
                shutil.rmtree(folder)


def _is_abandoned(folder: Path) -> bool:
    marked = folder.name.removeprefix(_PREFIX)
    if is_of_this_machine(marked):
        return not is_at_work(marked)
    return time.time() - folder.stat().st_mtime > _STALE_S


async def _take_in(target: Path, size: int, chunks: AsyncIterator[bytes], upload: _Upload) -> None:
    """Write what comes beside its place; it gets its name when all of it is there."""
    target.parent.mkdir(exist_ok=True)
    partial = target.with_name(f"{target.name}.part")
    try:
        written = await _write(partial, size, chunks, upload)
        if written != size:
            wrong = f"{written} bytes came, {size} were announced"
            raise CaptureError(wrong, path=target.name, hint="send it again")
        partial.rename(target)
    finally:
        partial.unlink(missing_ok=True)


async def _write(path: Path, size: int, chunks: AsyncIterator[bytes], upload: _Upload) -> int:
    """Write what comes, at most one piece more than announced; returns how many bytes came."""
    written = 0
    with path.open("xb") as stream:
        async for chunk in chunks:
            written += len(chunk)
            if written > size:
                break
            stream.write(chunk)
            upload.touched = time.monotonic()
    return written
