"""Find and remove the artefacts that no results refer to, and the artefacts that are damaged."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from bodycap_batch.core.errors import StoreError
from bodycap_batch.store.artefacts import Store, disk_errors
from bodycap_batch.store.references import REFERENCES_FOLDER, locked, read_references


@dataclass(frozen=True, slots=True, kw_only=True)
class Garbage:
    """Describes what cleaning the store removes, and what it keeps.

    Attributes:
        artefacts: Folders of the artefacts that no job refers to, relative to the store.
        corrupt: Folder names of damaged artefacts that were set aside.
        gone: Paths of folders of results that no longer exist; their references are removed.
        kept: Number of artefacts that jobs refer to.
        freed_bytes: Disk space (bytes) that the removal frees. The removal of a file that also has a hard
            link in a folder of results frees no space.
    """

    artefacts: tuple[str, ...]
    corrupt: tuple[str, ...]
    gone: tuple[str, ...]
    kept: int
    freed_bytes: int


def collect_garbage(store: Store, *, delete: bool) -> Garbage:
    """Find the artefacts that no job refers to, and remove them if `delete` is True.

    Raises:
        StoreError: A job is using the store, a list of used artefacts is damaged, or the disk fails.
    """
    busy = "a job that uses this store is running", "wait until the job has ended"
    with locked(store, fcntl.LOCK_EX | fcntl.LOCK_NB, *busy), disk_errors(store.root):
        lists = {path: _read_list(path) for path in sorted((store.root / REFERENCES_FOLDER).glob("*.json"))}
        gone = {path: places[0] for path, (places, _) in lists.items() if not any(map(_exists, places))}
        used = {name for path, (_, names) in lists.items() if path not in gone for name in names}
        found = [path for path in sorted((store.root / "artefacts").glob("*/*")) if path.is_dir()]
        unused = [path for path in found if path.relative_to(store.root).as_posix() not in used]
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


def _read_list(path: Path) -> tuple[list[str], list[str]]:
    """Return the paths and the artefacts of one folder of results. Raise `StoreError` if they are unknown."""
    if (found := read_references(path)) is None:
        raise StoreError(
            "a list of used artefacts is damaged, so nothing can be removed",
            path=path,
            hint="run the jobs of this store again, or remove the file; its job is then computed again",
        )
    return found


def _exists(place: str) -> bool:
    """Return True if a path exists.

    If the disk fails, this function raises `OSError`, and no artefact is removed by mistake.
    """
    return bool(place) and Path(place).exists()


def _freed_bytes(folder: Path) -> int:
    stats = (path.lstat() for path in folder.rglob("*") if path.is_file())
    return sum(stat.st_size for stat in stats if stat.st_nlink == 1)


def _remove(folders: Iterable[Path], trash: Path) -> None:
    """Remove folders. Each folder is first moved to `trash`, so that no incomplete artefact can remain."""
    for folder in folders:
        moved = trash / f"removed-{folder.name}"
        os.replace(folder, moved)
        shutil.rmtree(moved, ignore_errors=True)
