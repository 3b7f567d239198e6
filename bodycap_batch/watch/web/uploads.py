"""Receive videos from browsers. An upload stays in a hidden folder of the inbox until it is complete."""

from __future__ import annotations

import re
import shutil
import threading
import time
import uuid
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from bodycap_batch.config.folder import JOB_FILES, VIDEO_SUFFIXES
from bodycap_batch.config.limits import Limits
from bodycap_batch.config.sample_files import SAMPLE_SUFFIXES
from bodycap_batch.core.errors import CaptureError, JobError, StoreError
from bodycap_batch.store.artefacts import disk_errors
from bodycap_batch.watch.inbox_entries import READY
from bodycap_batch.watch.spool import MAX_NAME_BYTES, Spool, folder_name_from_text, move_to_free_name
from bodycap_batch.watch.web.questions import write_answers

_PREFIX = ".upload-"
_OTHER_FILES = ("calib.json", *JOB_FILES)
_RESERVED_NAMES = frozenset(name.lower() for name in (*_OTHER_FILES, READY))
"""Names, in lower case, that a folder must not have, because the watcher expects a file."""
_OTHER_SUFFIXES = (".timestamps.txt", ".bvh", ".png", *SAMPLE_SUFFIXES)
_MAX_OTHER_BYTES = 64 << 20
"""Maximum size (bytes) of a file that is not a video: job, calibration, timestamps, mask, skeleton. Evidence:
none."""
_NAME = re.compile(r"[^/\\\x00-\x1f\x7f.][^/\\\x00-\x1f\x7f]*")
_MIN_FREE_BYTES = 1 << 30
"""Minimum free space (bytes) on the disk after an upload. Evidence: none."""
_MAX_OPEN_UPLOADS = 8
"""Maximum number of folders that are uploaded at the same time. Evidence: none."""
_MAX_IDLE_S = 900.0
"""Maximum time (seconds) without data before an upload is removed: 15 minutes. Evidence: none."""


@dataclass(slots=True)
class _Upload:
    """A folder that is being uploaded.

    Attributes:
        name: Name that the job will get.
        folder: Hidden folder that receives the files.
        touched: Time at which the last data arrived, by the monotonic clock in seconds.
        files: Names of the files that are complete.
        coming: Size (bytes) of each file that is being received, by name.
        discarded: True if the upload was cancelled.
    """

    name: str
    folder: Path
    touched: float
    files: set[str] = field(default_factory=set)
    coming: dict[str, int] = field(default_factory=dict)
    discarded: bool = False


class Uploads:
    """The folders that browsers are uploading.

    Args:
        spool: The folders of the watcher. Complete uploads are moved to the inbox.
        limits: Maximum size and number of files.
        clock: Function that returns the time (seconds) of this process's monotonic clock.
    """

    def __init__(self, spool: Spool, limits: Limits, clock: Callable[[], float] = time.monotonic) -> None:
        self._spool = spool
        self._limits = limits
        self._clock = clock
        self._open: dict[str, _Upload] = {}
        self._lock = threading.Lock()

    def start(self, name: str) -> str:
        """Start the upload of a folder, and return the key of the upload.

        Raises:
            JobError: The name cannot be used, or too many folders are being uploaded.
            StoreError: The folder of the upload cannot be created.
        """
        _require_short(name.strip())
        if not _NAME.fullmatch(name.strip()):
            hint = "use letters, digits and spaces, but no / and no dot at the start"
            raise JobError(f"{name[:40]!r} cannot be the name of a job", hint=hint)
        self.remove_idle()
        with self._lock:
            if len(self._open) >= _MAX_OPEN_UPLOADS:
                raise JobError(
                    f"{_MAX_OPEN_UPLOADS} folders are being sent already",
                    hint="wait until one of these folders is complete; an upload without new data ends after "
                    "15 minutes",
                )
            key = uuid.uuid4().hex
            folder = self._spool.inbox / f"{_PREFIX}{key}"
            with disk_errors(folder):
                folder.mkdir()
            self._open[key] = _Upload(name=folder_name_from_text(name), folder=folder, touched=self._clock())
            return key

    async def write(self, key: str, name: str, size: int, chunks: AsyncIterator[bytes]) -> None:
        """Receive one file of an upload, and write it to the disk.

        Args:
            key: The key that `start` returned.
            name: Path of the file relative to the uploaded folder, with at most one subfolder.
            size: Size (bytes) that the browser gives for the file.
            chunks: The content of the file.

        Raises:
            JobError: The key is unknown, the upload was discarded, or the name is not permitted.
            CaptureError: The file is too large, its size differs from `size`, or there are too many files.
            StoreError: The disk is full or cannot be written.
        """
        upload, path = self._reserve(key, name, size)
        target = upload.folder / path
        is_complete = False
        try:
            with disk_errors(target):
                await _receive_file(target, size, self._touching(upload, chunks))
            is_complete = True
        except (CaptureError, StoreError):
            self._require_not_discarded(upload)
            raise
        finally:
            with self._lock:
                del upload.coming[name]
                if is_complete:
                    upload.files.add(name)
                if upload.discarded:
                    shutil.rmtree(upload.folder, ignore_errors=True)

    def finish(self, key: str, answers: Mapping[str, Any] | None = None) -> str:
        """Move a complete upload into the inbox, and return the name of the folder in the inbox.

        Args:
            key: The key that `start` returned.
            answers: The answers of the user, for `write_answers`; None without answers.

        Raises:
            JobError: The key is unknown, the folder holds no video, a file is still being sent, or an answer
                cannot be understood.
        """
        with self._lock:
            upload = self._get(key)
            if upload.coming:
                some = ", ".join(sorted(upload.coming)[:3])
                raise JobError(
                    f"{some}: the browser is still sending this file",
                    hint="wait until every file is complete",
                )
            if not any(PurePosixPath(name).suffix.lower() in VIDEO_SUFFIXES for name in upload.files):
                raise JobError(
                    "no video was sent", hint="name the videos torso.mp4, left_palm.mp4, right_palm.mp4"
                )
            write_answers(upload.folder, answers or {})
            with disk_errors(upload.folder):
                (upload.folder / READY).touch()
                target = move_to_free_name(upload.folder, self._spool.inbox, upload.name)
            del self._open[key]
        return target.name

    def discard(self, key: str) -> None:
        """Remove an upload that will not be completed."""
        with self._lock:
            if (upload := self._open.pop(key, None)) is not None:
                self._remove(upload)

    def remove_idle(self) -> None:
        """Remove the uploads that have received no data for `_MAX_IDLE_S` seconds."""
        with self._lock:
            now = self._clock()
            for key in [key for key, upload in self._open.items() if now - upload.touched > _MAX_IDLE_S]:
                self._remove(self._open.pop(key))

    def clear(self) -> None:
        """Remove all incomplete uploads, because they cannot be continued after the page ends."""
        for key in list(self._open):
            self.discard(key)

    def _get(self, key: str) -> _Upload:
        if key not in self._open:
            raise _unknown_upload()
        return self._open[key]

    def _reserve(self, key: str, name: str, size: int) -> tuple[_Upload, PurePosixPath]:
        """Check the path of a file, reserve it for this request, and return the upload and the path."""
        with self._lock:
            upload = self._get(key)
            with disk_errors(upload.folder):
                path = self._checked_path(upload, name, size)
            upload.coming[name] = size
            return upload, path

    @staticmethod
    def _require_not_discarded(upload: _Upload) -> None:
        """Raise the error for an unknown upload if the upload was discarded.

        The user sees this error instead of the error that the removal of the files causes.
        """
        if upload.discarded:
            raise _unknown_upload() from None

    @staticmethod
    def _remove(upload: _Upload) -> None:
        """Remove the folder of an upload.

        A request that still writes to the folder removes the remaining files when it ends.
        """
        upload.discarded = True
        shutil.rmtree(upload.folder, ignore_errors=True)

    def _checked_path(self, upload: _Upload, name: str, size: int) -> PurePosixPath:
        path = PurePosixPath(name)
        for part in path.parts:
            _require_short(part)
        if not 1 <= len(path.parts) <= 2 or not all(map(_NAME.fullmatch, name.split("/"))):
            raise JobError(
                f"{name[:80]!r} cannot be the name of a file",
                hint="send a file directly or in one folder; a name has no dot at its start and no backslash",
            )
        if len(path.parts) == 2 and path.parts[0].lower() in _RESERVED_NAMES:
            raise JobError(
                f"{path.parts[0]} is a folder, but only a file may have this name", hint="rename the folder"
            )
        video = path.suffix.lower() in VIDEO_SUFFIXES
        if not is_accepted(name):
            known = ", ".join((*_OTHER_FILES, *_OTHER_SUFFIXES))
            raise JobError(f"{path.name} is neither a video nor any of {known}", hint="leave this file out")
        sent = {*upload.files, *upload.coming}
        # Compare the names in lower case: some disks do not distinguish upper and lower case.
        if name.lower() in {other.lower() for other in sent} or (upload.folder / path).exists():
            raise JobError(f"{name} was sent twice", hint="give each file its own name")
        if any(str(path.parent) == other or str(PurePosixPath(other).parent) == name for other in sent):
            raise JobError(f"{name} is both a file and a folder", hint="rename the file or the folder")
        if len(sent) >= self._limits.files:
            raise CaptureError(
                f"the folder contains more than {self._limits.files:g} files", hint="send one recording only"
            )
        most = 1e9 * self._limits.video_gb if video else _MAX_OTHER_BYTES
        if size == 0:
            raise CaptureError("the file is empty", path=name, hint="copy it again from the camera")
        if size > most:
            hint = (
                "shorten the recording, or ask the operator of the watched folder to raise --limit video_gb"
            )
            raise CaptureError(
                f"the file has {size / 1e9:.3g} GB, but the limit is {most / 1e9:.3g} GB",
                path=name,
                hint=hint,
            )
        # Subtract the bytes that are still to be received, so that several uploads do not fill the disk.
        coming = sum(sum(other.coming.values()) for other in self._open.values())
        if shutil.disk_usage(upload.folder).free - coming - size < _MIN_FREE_BYTES:
            raise StoreError(
                "the disk has too little free space",
                path=self._spool.inbox,
                hint="free some space, then try again",
            )
        return path

    async def _touching(self, upload: _Upload, chunks: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
        """Yield the chunks, and record for the upload when the last data arrived."""
        async for chunk in chunks:
            if chunk:
                upload.touched = self._clock()
            yield chunk


def is_accepted(name: str) -> bool:
    """Return True if a file with this path is a video or another file that a job can use."""
    path = PurePosixPath(name)
    is_video = path.suffix.lower() in VIDEO_SUFFIXES
    return is_video or path.name in _OTHER_FILES or path.name.lower().endswith(_OTHER_SUFFIXES)


def _require_short(name: str) -> None:
    """Raise `JobError` if a name is too long for a file or folder."""
    if (length := len(name.encode(errors="replace"))) > MAX_NAME_BYTES:
        raise JobError(
            f"the name {name[:40]!r} is too long: {length} bytes",
            hint=f"use at most {MAX_NAME_BYTES} bytes, that is, as many letters without accents",
        )


def _unknown_upload() -> JobError:
    return JobError("the upload does not exist or has ended", hint="drop the folder again")


def remove_abandoned_uploads(inbox: Path) -> None:
    """Remove the uploads of killed servers. Only one watcher, and so only one server, uses an inbox."""
    for folder in inbox.glob(f"{_PREFIX}*"):
        shutil.rmtree(folder, ignore_errors=True)


async def _receive_file(target: Path, size: int, chunks: AsyncIterator[bytes]) -> None:
    """Write a file with a temporary name, and rename the file once it is complete."""
    target.parent.mkdir(exist_ok=True)
    partial = target.with_name(f"{target.name}.part")
    try:
        written = await _write_chunks(partial, size, chunks)
        if written != size:
            message = f"{written} bytes of the file arrived, but the browser stated {size} bytes"
            raise CaptureError(message, path=target.name, hint="send the file again")
        partial.rename(target)
    finally:
        partial.unlink(missing_ok=True)


async def _write_chunks(path: Path, size: int, chunks: AsyncIterator[bytes]) -> int:
    """Write the content of a file, and return the number of bytes received.

    Stop if more than `size` bytes arrive.
    """
    written = 0
    with path.open("xb") as stream:
        async for chunk in chunks:
            written += len(chunk)
            if written > size:
                break
            stream.write(chunk)
    return written
