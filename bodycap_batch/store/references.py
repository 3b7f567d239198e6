"""Record which artefacts the results of jobs refer to."""

from __future__ import annotations

import contextlib
import fcntl
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from bodycap_batch.core.errors import StoreError
from bodycap_batch.store.artefacts import Store, disk_errors
from bodycap_batch.store.checked_json import checked_json, parse_checked_json
from bodycap_batch.store.digests import json_digest, write_atomically

REFERENCES_FOLDER = "references"
"""Subfolder of the store. It holds one file for each folder of results. The file lists the artefacts that
these results refer to."""
_LOCK = "in-use"
"""Name of the file that is locked while jobs use the store, and while the store is cleaned."""


class StoreBusy(StoreError):
    """Error: a job is using the store, or the store is being cleaned; try again later."""


class References:
    """The references of one folder of results to the artefacts from which the results were made.

    Cleaning the store keeps these artefacts as long as the folder exists.

    Args:
        store: The store of the artefacts.
        owner: The folder of results.
        also: Other paths that the folder of results may have while it is being moved. The artefacts are kept
            as long as `owner` or one of these paths exists.
    """

    def __init__(self, store: Store, owner: Path, also: Iterable[Path] = ()) -> None:
        self._root = store.root
        self._places = [str(place) for place in dict.fromkeys((owner.resolve(), *also))]
        self._lock = threading.Lock()
        self.named = set((read_references(self._path) or ([], []))[1])

    @property
    def _path(self) -> Path:
        return self._root / REFERENCES_FOLDER / f"{json_digest(self._places[0])[:32]}.json"

    def add(self, artefact: Path) -> None:
        """Add a reference to an artefact, given its folder. Raises `StoreError`."""
        name = artefact.relative_to(self._root).as_posix()
        with self._lock:
            if name not in self.named:
                self.named.add(name)
                self._write()

    def keep_only(self, artefacts: Iterable[str]) -> None:
        """Replace the references by these artefacts (folders relative to the store). Raises `StoreError`."""
        with self._lock:
            before, self.named = self.named, set(artefacts)
            if before != self.named:
                self._write()

    def take_over(self, artefacts: Iterable[str]) -> None:
        """Add references to these artefacts, and store all paths of the folder. Raises `StoreError`."""
        with self._lock:
            self.named |= set(artefacts)
            self._write()

    def forget(self) -> None:
        """Remove all references of this folder of results. Raises `StoreError`."""
        with disk_errors(self._root):
            self._path.unlink(missing_ok=True)

    def _write(self) -> None:
        content = {"owner": self._places[0], "also": self._places[1:], "artefacts": sorted(self.named)}
        with disk_errors(self._root):
            self._path.parent.mkdir(exist_ok=True)
            write_atomically(self._path, checked_json(content).encode())


@contextlib.contextmanager
def moving(store: Store, before: Path, *, wait: bool = True) -> Iterator[Callable[..., None]]:
    """Keep the artefacts of a folder of results while the folder is moved, even if this process is killed.

    Args:
        store: The store of the artefacts.
        before: The folder's present path.
        wait: What to do while the store is being cleaned: True waits for the end, False raises `StoreBusy`.

    Yields:
        A function to call as ``to(after, *others)`` just before the move. `after` is the folder's new path,
        or the path of the folder in which the results will be computed again. `others` are further paths that
        the folder may have later.

    Raises:
        StoreError: The disk fails.
    """
    with in_use(store, wait=wait):
        old = References(store, before)
        moves: list[tuple[Path, ...]] = []

        def to(after: Path, *others: Path) -> None:
            if old.named:
                References(store, after, (*others, before)).take_over(old.named)
                moves.append((after, *others))

        yield to
        for after, *others in moves[-1:]:
            References(store, after, others).take_over(())
            old.forget()


@contextlib.contextmanager
def in_use(store: Store, *, wait: bool = False) -> Iterator[None]:
    """Prevent the cleaning of the store while it is in use.

    If the store is being cleaned already, wait for the end of the cleaning if `wait` is True; otherwise raise
    `StoreBusy`.
    """
    kind = fcntl.LOCK_SH if wait else fcntl.LOCK_SH | fcntl.LOCK_NB
    with locked(
        store,
        kind,
        "`bodycap gc` is removing artefacts from the store",
        "start the job again when `bodycap gc` has ended",
    ):
        yield


@contextlib.contextmanager
def locked(store: Store, kind: int, refusal: str, hint: str) -> Iterator[None]:
    """Hold a lock of the whole store.

    Args:
        store: The store.
        kind: Kind of the lock, as for `fcntl.flock`.
        refusal: Message of the error if the lock is not free.
        hint: Hint of this error.

    Raises:
        StoreBusy: The lock is not free, and `kind` contains ``LOCK_NB``.
    """
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


def read_references(path: Path) -> tuple[list[str], list[str]] | None:
    """Return the paths and the artefacts of one folder of results; None if the list is missing or damaged."""
    try:
        content = parse_checked_json(path.read_bytes())
        places = [content["owner"], *content.get("also", ())]
        return [str(place) for place in places], [str(name) for name in content["artefacts"]]
    except (FileNotFoundError, ValueError, KeyError, TypeError):
        return None
