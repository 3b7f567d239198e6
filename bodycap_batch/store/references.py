"""Which artefacts the jobs still refer to, and the removal of the others."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from bodycap_batch.core.errors import StoreError
from bodycap_batch.store.artefacts import Store, disk_errors
from bodycap_batch.store.digests import json_digest, write_atomically

_FOLDER = "references"
_LOCK = "in-use"


class StoreBusy(StoreError):
    """The store is in use in a way that leaves no room for this; trying again later helps."""


class References:
    """The artefacts one folder of results was made from.

    Args:
        store: Where the artefacts are.
        owner: The folder of results. When it is gone, so is its claim.
        also: Where else it may lie, as it is being moved: its claim lasts while something is at one of them.
    """

    def __init__(self, store: Store, owner: Path, also: Iterable[Path] = ()) -> None:
        self._root = store.root
        self._places = [str(place) for place in dict.fromkeys((owner.resolve(), *also))]
        self._lock = threading.Lock()
        self.named = set(_read(self._path)[1])

    @property
    def _path(self) -> Path:
        return self._root / _FOLDER / f"{json_digest(self._places[0])[:32]}.json"

    def add(self, artefact: Path) -> None:
        """Keep one artefact more. Raises `StoreError`."""
        name = artefact.relative_to(self._root).as_posix()
        with self._lock:
            if name not in self.named:
                self.named.add(name)
                self._write()

    def keep_only(self, artefacts: Iterable[str]) -> None:
        """Keep these (folders relative to the store) and no other. Raises `StoreError`."""
        with self._lock:
            before, self.named = self.named, set(artefacts)
            if before != self.named:
                self._write()

    def take_over(self, artefacts: Iterable[str]) -> None:
        """Keep these, too, and say anew where the folder may lie. Raises `StoreError`."""
        with self._lock:
            self.named |= set(artefacts)
            self._write()

    def forget(self) -> None:
        """Keep nothing. Raises `StoreError`."""
        with disk_errors(self._root):
            self._path.unlink(missing_ok=True)

    def _write(self) -> None:
        content = {"owner": self._places[0], "also": self._places[1:], "artefacts": sorted(self.named)}
        with disk_errors(self._root):
            self._path.parent.mkdir(exist_ok=True)
            write_atomically(self._path, json.dumps(content, indent=1).encode())


@contextlib.contextmanager
def moving(store: Store, before: Path, *, wait: bool = True) -> Iterator[Callable[..., None]]:
    """Keep what a folder of results was made from while its job is moved, also if this process is killed.

    Args:
        store: Where the artefacts are.
        before: Where the folder is.
        wait: Wait while the store is being cleaned, or raise `StoreBusy`.

    Yields:
        To be called as ``to(after, *others)`` just before the move: where the folder (or what it will be made
        from again) will lie, and where else it may lie after that.

    Raises:
        StoreError: The disk fails.
    """
    with in_use(store, wait=wait):
        old = References(store, before)
        bound: list[tuple[Path, ...]] = []

        def to(after: Path, *others: Path) -> None:
            if old.named:
                References(store, after, (*others, before)).take_over(old.named)
                bound.append((after, *others))

        yield to
        for after, *others in bound[-1:]:
            References(store, after, others).take_over(())
            old.forget()


@dataclass(frozen=True, slots=True, kw_only=True)
class Garbage:
    """What no job refers to.

    Attributes:
        artefacts: Folders relative to the store.
        corrupt: Damaged artefacts that were set aside.
        gone: Folders of results that no longer exist.
        kept: How many artefacts are referred to.
        freed_bytes: What removing frees; a file that is also linked from a folder of results frees nothing.
    """

    artefacts: tuple[str, ...]
    corrupt: tuple[str, ...]
    gone: tuple[str, ...]
    kept: int
    freed_bytes: int


@contextlib.contextmanager
def in_use(store: Store, *, wait: bool = False) -> Iterator[None]:
    """Keep `collect_garbage` from this store meanwhile; while it is at work, wait or raise `StoreBusy`."""
    kind = fcntl.LOCK_SH if wait else fcntl.LOCK_SH | fcntl.LOCK_NB
    with _locked(store, kind, "the store is being cleaned", "start again when `bodycap gc` has ended"):
        yield


def collect_garbage(store: Store, *, delete: bool) -> Garbage:
    """Find, and on request remove, what no job refers to.

    Raises:
        StoreError: A job is using the store, or the disk fails.
    """
    busy = "a job is running on this store", "wait until it has ended"
    with _locked(store, fcntl.LOCK_EX | fcntl.LOCK_NB, *busy), disk_errors(store.root):
        lists = {path: _read(path) for path in sorted((store.root / _FOLDER).glob("*.json"))}
        gone = {path: places[0] for path, (places, _) in lists.items() if not any(map(_is_there, places))}
        wanted = {name for path, (_, names) in lists.items() if path not in gone for name in names}
        found = [path for path in sorted((store.root / "artefacts").glob("*/*")) if path.is_dir()]
        unused = [path for path in found if path.relative_to(store.root).as_posix() not in wanted]
        corrupt = sorted((store.root / "corrupt").iterdir())
        garbage = Garbage(
            artefacts=tuple(path.relative_to(store.root).as_posix() for path in unused),
            corrupt=tuple(path.name for path in corrupt),
            gone=tuple(gone.values()),
            kept=len(found) - len(unused),
            freed_bytes=sum(_freed_bytes(path) for path in (*unused, *corrupt)),
        )
        if delete:
            _remove((*unused, *corrupt), store.root / "tmp")
            for path in gone:
                path.unlink()
            store.sweep()
    return garbage


@contextlib.contextmanager
def _locked(store: Store, kind: int, refusal: str, hint: str) -> Iterator[None]:
    with disk_errors(store.root):
        handle = os.open(store.root / _LOCK, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        try:
            fcntl.flock(handle, kind)
        except BlockingIOError:
            raise StoreBusy(refusal, path=store.root, hint=hint) from None
        yield
    finally:
        os.close(handle)


def _read(path: Path) -> tuple[list[str], list[str]]:
    """Places and artefacts of a list; a list that cannot be read claims nothing."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        places = [content["owner"], *content.get("also", ())]
        return [str(place) for place in places], [str(name) for name in content["artefacts"]]
    except (FileNotFoundError, ValueError, KeyError, TypeError, AttributeError):
        return [""], []


def _is_there(place: str) -> bool:
    """Whether something lies there; a disk that does not answer raises `OSError`: nothing is removed then."""
    return bool(place) and Path(place).exists()


def _freed_bytes(folder: Path) -> int:
    stats = (path.lstat() for path in folder.rglob("*") if path.is_file())
    return sum(stat.st_size for stat in stats if stat.st_nlink == 1)


def _remove(folders: Iterable[Path], trash: Path) -> None:
    """Out of sight in one step each, so that a kill leaves no half artefact, then away."""
    for folder in folders:
        moved = trash / f"removed-{folder.name}"
        os.replace(folder, moved)
        shutil.rmtree(moved, ignore_errors=True)
