"""The artefact store: it holds the results of tasks and finds a result by its key.

An artefact is a folder. Its key names the stage, the version of the algorithm, the options, the content of
the inputs, and the versions of the libraries. A process writes the files into a temporary folder in the
store, syncs the files to the disk, and writes a manifest last. Then the process renames the folder to its
final name in one step. Every folder that has its final name is therefore complete, even if a process was
killed.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

from bodycap_batch.core.errors import DiskAway, StoreError
from bodycap_batch.store.digests import (
    FileDigests,
    file_sha256,
    json_digest,
    remove_abandoned,
    write_atomically,
)

MANIFEST = "manifest.json"
"""Name of the file that describes an artefact: its key, the digest of each file, and the cost of computing
it."""
_AWAY = frozenset({
    errno.EIO, errno.ESTALE, errno.ETIMEDOUT, errno.ENOTCONN, errno.ECONNRESET, errno.ECONNABORTED,
    errno.EHOSTDOWN, errno.EHOSTUNREACH, errno.ENETDOWN, errno.ENETUNREACH, errno.ENODEV, errno.ENXIO,
})  # fmt: skip
"""Error numbers (errno) of a failing disk, and of a network disk with a server that does not answer."""
DISK_ERRORS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG}) | _AWAY
"""Error numbers (errno) of failures that are caused by the disk and not by the file."""
_VOLATILE_SUFFIXES = (".db",)
"""Suffixes of files that the digest of an artefact's content omits. The bytes of a database differ from run
to run, even if the rows in the database are equal."""
_REMEMBER_BYTES = 1 << 20
"""Maximum size (bytes) of a file that is hashed at every look-up of its artefact. A larger file is hashed
again only if its inode, size or times have changed. Look-ups of large artefacts are therefore fast. The
inputs of a task are always hashed before the task runs. Evidence: none."""
_Found = TypeVar("_Found")
_LOCK = "lock"
"""Name of the lock file in a draft's folder. The process that writes the draft keeps this file locked."""
_SETTING_ASIDE = "setting-aside"
"""Name of the lock file that a process locks while it moves a damaged artefact away."""
_UNLOCKED = "new-"
"""Prefix of a draft's name until the draft is locked."""
_STALE_S = 60.0
"""Minimum age (seconds) before a draft that was never locked is removed. Creating and locking a draft takes
only milliseconds. Evidence: none."""
_KEY_LENGTH = 32
"""Number of hexadecimal digits in the name of a key. These 128 bits make equal names of two different keys
practically impossible."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ArtefactKey:
    """Identifies an artefact by everything that it is computed from. Equal keys mean equal results.

    Attributes:
        stage: Stage name.
        algorithm: Version of the stage's algorithm, see `code_version`.
        options: The options of this stage, as JSON values.
        inputs: Digest, or small JSON value, of each input, by name of the input.
        libraries: Version of each library that the stage uses, by name of the library.
    """

    stage: str
    algorithm: str
    options: Mapping[str, Any]
    inputs: Mapping[str, Any]
    libraries: Mapping[str, str]

    def document(self) -> dict[str, Any]:
        """Return the whole key as JSON values."""
        return asdict(self)

    @property
    def name(self) -> str:
        """Name of the key: the first hexadecimal digits of the key's digest."""
        return json_digest(self.document())[:_KEY_LENGTH]


@dataclass(frozen=True, slots=True, kw_only=True)
class Artefact:
    """A complete, verified artefact.

    Attributes:
        path: Folder of the artefact.
        digest: Digest of the content. Artefacts with equal contents have equal digests, even if the keys of
            the artefacts differ.
        made: Cost of computing the artefact (seconds, peak memory, threads); not part of the content.
        files: SHA-256 of each file, by the file's path relative to the artefact's folder.
    """

    path: Path
    digest: str
    made: Mapping[str, Any]
    files: Mapping[str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Draft:
    """An artefact that is being written.

    Attributes:
        files: Folder whose content becomes the artefact.
        work: Folder for temporary files on the same file system; removed together with the draft.
    """

    files: Path
    work: Path


class Store:
    """Stores artefacts below one folder, and finds them by their keys.

    Args:
        root: Folder of the store; created if it does not exist.

    Raises:
        StoreError: The folder cannot be created or written.
    """

    def __init__(self, root: Path) -> None:
        self.root = root.resolve()
        self._artefacts = self.root / "artefacts"
        self._temporary = self.root / "tmp"
        self._corrupt = self.root / "corrupt"
        with disk_errors(self.root):
            for folder in (self._artefacts, self._temporary, self._corrupt):
                folder.mkdir(parents=True, exist_ok=True)
            if not os.access(self._temporary, os.W_OK | os.X_OK):
                raise PermissionError(errno.EACCES, "not writable", str(self._temporary))
        self.digests = FileDigests(self.root / "digests")

    def find(self, key: ArtefactKey) -> Artefact | None:
        """Return the artefact of a key; None if it is missing or damaged. Move a damaged artefact away."""
        path = self._path(key)
        with disk_errors(self.root):
            if not path.is_dir():
                return None
            artefact = self._verified(path, key)
            return artefact or self._set_aside(path, lambda: self._verified(path, key))

    def verify(self, path: Path) -> None:
        """Hash all files of an artefact that a task will read. If the artefact is damaged, move it away.

        Args:
            path: The artefact's folder.

        Raises:
            StoreError: The artefact is damaged. No program writes to artefacts, so the disk is the cause.
        """
        with disk_errors(self.root):
            if not _is_sound(path) and not self._set_aside(path, lambda: _is_sound(path)):
                hint = (
                    "check the disk for errors, then run the job again: the program computes damaged "
                    "results again"
                )
                raise StoreError("a stored result of a stage is damaged", path=path, hint=hint)

    def artefacts_in(self, value: Any) -> Iterator[Path]:
        """Yield the folder of each artefact to which the arguments of a task (`value`) refer."""
        if isinstance(value, Mapping):
            value = list(value.values())
        if isinstance(value, list | tuple):
            for part in value:
                yield from self.artefacts_in(part)
        elif isinstance(value, str) and value.startswith(f"{self._artefacts}{os.sep}"):
            yield Path(value)

    @contextmanager
    def draft(self, key: ArtefactKey) -> Iterator[Draft]:
        """Yield a draft: a temporary folder for an artefact, locked while in use and removed afterwards."""
        with disk_errors(self.root):
            unlocked = Path(tempfile.mkdtemp(dir=self._temporary, prefix=_UNLOCKED))
            # Network file systems lock a file across machines only if it is open for writing.
            lock = os.open(unlocked / _LOCK, os.O_RDWR | os.O_CREAT)
            fcntl.flock(lock, fcntl.LOCK_EX)
            folder = unlocked.with_name(f"{key.stage}-{unlocked.name.removeprefix(_UNLOCKED)}")
            unlocked.rename(folder)
            draft = Draft(files=folder / "files", work=folder / "work")
            draft.files.mkdir()
            draft.work.mkdir()
        try:
            yield draft
        finally:
            shutil.rmtree(folder, ignore_errors=True)
            os.close(lock)

    def commit(
        self,
        draft: Draft,
        key: ArtefactKey,
        made: Mapping[str, Any],
        *,
        before: Callable[[], None] = lambda: None,
        replace: bool = False,
    ) -> Artefact:
        """Make a draft's files the artefact of `key`, or return the artefact that was committed earlier.

        Args:
            draft: The draft; its files are synced to the disk.
            key: The key of the artefact.
            made: Cost of computing the artefact (seconds, peak memory, threads).
            before: Called before the last, atomic step; may raise an error to prevent the commit.
            replace: True to replace the artefact if one with this key is stored already.

        Raises:
            StoreError: The disk is full or fails.
        """
        with disk_errors(self.root):
            files = _sync_files(draft.files)
            body = {
                "format": 1,
                "key": key.document(),
                "digest": _content_digest(files),
                "files": files,
                "made": dict(made),
            }
            manifest = {"seal": json_digest(body), **body}
            write_atomically(draft.files / MANIFEST, json.dumps(manifest, indent=1).encode())
            _sync_folders(draft.files)
            before()
            if replace:
                with self._setting_aside(), contextlib.suppress(FileNotFoundError):
                    os.replace(self._path(key), draft.work.with_name("replaced"))
            return self._move_in(draft.files, key)

    def sweep(self) -> int:
        """Remove the drafts and temporary files of killed processes; return the number of removed drafts."""
        try:
            folders = list(self._temporary.iterdir())
            for folder in (self.root / "digests", self.root / "references"):
                remove_abandoned(folder)
        except OSError:  # not reported here: the next draft fails too, and reports the error
            return 0
        return sum(_remove_if_abandoned(folder) for folder in folders)

    def free_bytes(self) -> int:
        """Return the free space on the store's disk, in bytes."""
        return shutil.disk_usage(self.root).free

    def _path(self, key: ArtefactKey) -> Path:
        return self._artefacts / key.stage / key.name

    def _move_in(self, files: Path, key: ArtefactKey) -> Artefact:
        path = self._path(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        while True:
            try:
                os.replace(files, path)
            except OSError as error:
                if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                    raise
            sync_folder(path.parent)
            if (artefact := self.find(key)) is not None:
                return artefact
            if not files.is_dir():
                raise StoreError(
                    "a stored result of a stage differs from the data that were written",
                    path=path,
                    hint="check the disk for errors, or choose a store on another disk with --store",
                )

    def _verified(self, path: Path, key: ArtefactKey) -> Artefact | None:
        manifest = _sealed_manifest(path)
        if manifest is None or manifest["key"] != _as_json(key.document()):
            return None  # the artefact is damaged, or another process has just moved it away
        if not all(self._has_digest(path / name, expected) for name, expected in manifest["files"].items()):
            return None
        return Artefact(path=path, digest=manifest["digest"], made=manifest["made"], files=manifest["files"])

    def _has_digest(self, path: Path, expected: str) -> bool:
        try:
            large = path.stat().st_size > _REMEMBER_BYTES
            return (self.digests.sha256(path) if large else file_sha256(path)) == expected
        except (FileNotFoundError, NotADirectoryError):  # another process may have just moved it away
            return False

    def _set_aside(self, path: Path, look: Callable[[], _Found]) -> _Found:
        """Move a damaged artefact away, and return the result of `look`.

        The function `look` searches for the artefact again. If `look` finds a sound artefact, nothing is
        moved, because another process has already replaced the damaged artefact. If no artefact existed
        before `look`, nothing is moved, because a new artefact may have been committed since. A lock prevents
        other processes from moving the artefact between `look` and the move.
        """
        with self._setting_aside():
            existed = os.path.lexists(path)
            if not (found := look()) and existed:
                target = self._corrupt / f"{path.parent.name}-{path.name}-{time.time_ns()}"
                with contextlib.suppress(FileNotFoundError):
                    os.replace(path, target)
        return found

    @contextmanager
    def _setting_aside(self) -> Iterator[None]:
        """Hold the lock that a process needs to move artefacts away from their final names."""
        handle = os.open(self.root / _SETTING_ASIDE, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX)
            yield
        finally:
            os.close(handle)


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Convert operating system errors into `StoreError` with advice for the user."""
    try:
        yield
    except OSError as error:
        raise store_error(error, path) from error


def store_error(error: OSError, path: Path) -> StoreError:
    """Return the `StoreError` for an operating system error, with advice for the user."""
    no_permission = (
        "the program has no permission to use this folder; choose another folder with --store or --out"
    )
    hints = {
        errno.ENOSPC: "free some space, or choose another disk with --store; the results of finished stages "
        "stay in the store",
        errno.EDQUOT: "your disk quota is used up; choose a folder on another disk with --store",
        errno.EROFS: "the file system is read-only; choose another folder with --store or --out",
        errno.EACCES: no_permission,
        errno.EPERM: no_permission,
        errno.ENOTDIR: "there is a file where a folder is needed; choose another folder with --store or "
        "--out",
    }
    where = error.filename if isinstance(error.filename, str) else path
    reason = os.strerror(error.errno) if error.errno else str(error)
    hint = hints.get(error.errno or 0, "check the disk for errors, or choose another folder with --store")
    if error.errno in _AWAY:
        hint = (
            "check that the disk is mounted and that its server is reachable, or choose another folder "
            "with --store or --out"
        )
        return DiskAway(reason, path=where, hint=hint)
    return StoreError(reason, path=where, hint=hint)


def disk_error(error: OSError, path: Path | str) -> StoreError | None:
    """Return the `StoreError` for an operating system error that a disk caused; None for another cause."""
    return store_error(error, Path(path)) if error.errno in DISK_ERRORS else None


def _is_sound(path: Path) -> bool:
    """Return True if every file of an artefact has the digest given in the manifest."""
    manifest = _sealed_manifest(path)
    try:
        return manifest is not None and all(
            file_sha256(path / name) == expected for name, expected in manifest["files"].items()
        )
    except FileNotFoundError:
        return False


def _sealed_manifest(path: Path) -> dict[str, Any] | None:
    """Return the manifest of an artefact; None if it is missing, or if its digest does not hold."""
    try:
        manifest = json.loads((path / MANIFEST).read_text(encoding="utf-8"))
        seal = manifest.pop("seal")
        return dict(manifest) if seal == json_digest(manifest) else None
    except (FileNotFoundError, NotADirectoryError, ValueError, KeyError, AttributeError, TypeError):
        return None


def _as_json(value: Any) -> Any:
    return json.loads(json.dumps(value))


def _content_digest(files: Mapping[str, str]) -> str:
    return json_digest({name: sha for name, sha in files.items() if not name.endswith(_VOLATILE_SUFFIXES)})


def _sync_files(folder: Path) -> dict[str, str]:
    """Sync every file below a folder to the disk; return each file's SHA-256 by the file's relative path."""
    digests: dict[str, str] = {}
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        with path.open("rb") as stream:
            os.fsync(stream.fileno())
        digests[path.relative_to(folder).as_posix()] = file_sha256(path)
    return digests


def _sync_folders(folder: Path) -> None:
    for path in (*(path for path in folder.rglob("*") if path.is_dir()), folder):
        sync_folder(path)


def sync_folder(path: Path) -> None:
    """Sync a folder's list of names to the disk, so that the names survive a power failure."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _remove_if_abandoned(folder: Path) -> bool:
    """Remove a draft if its process has ended, and return True if it was removed.

    The process has ended if the draft's lock is free.
    """
    try:
        if folder.name.startswith(_UNLOCKED) and time.time() - folder.stat().st_mtime < _STALE_S:
            return False
        lock = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT)
    except OSError:
        return False
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    else:
        shutil.rmtree(folder, ignore_errors=True)
        return True
    finally:
        os.close(lock)
