"""Publish results: link or copy them from the store to the user's folder, and remove outdated results."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from bodycap_batch.config.folder import PARTIAL, RUN_FILE
from bodycap_batch.store.artefacts import disk_errors, sync_folder
from bodycap_batch.store.checked_json import parse_checked_json
from bodycap_batch.store.digests import remove_abandoned, temporary_beside, write_atomically


def publish(files: Mapping[str, Path], folder: Path) -> None:
    """Put files of the store into a folder: by hard link if possible, else by copy.

    Each file appears completely or not at all.

    Args:
        files: Path of each file in the store, by the file's new name relative to the folder.
        folder: The target folder; created if it does not exist.

    Raises:
        StoreError: The folder cannot be written.
    """
    changed, folders = set[Path](), {folder}
    with disk_errors(folder):
        for name, source in files.items():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            folders.add(target.parent)
            if not _is_link_to(source, target):
                _link_or_copy(source, target)
                changed.add(target.parent)
        for parent in changed:
            sync_folder(parent)
        for parent in folders:
            remove_abandoned(parent)


def write_results_file(folder: Path, name: str, text: str) -> None:
    """Write a small file with this text into the folder of results. Raises `StoreError`."""
    with disk_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / name, text.encode())


def remove_outdated(folder: Path, keep: Iterable[str]) -> None:
    """Remove the result files of the last run, except the files named in `keep`."""
    kept = set(keep)
    for name in _files_of_last_run(folder):
        path = folder / name
        if name not in kept and path.resolve().is_relative_to(folder.resolve()):
            path.unlink(missing_ok=True)
            _remove_empty(path.parent, folder)


def clear_partial(folder: Path) -> None:
    """Remove the partial results of an earlier run, because complete results now replace them."""
    shutil.rmtree(folder / PARTIAL, ignore_errors=True)


def _is_link_to(source: Path, target: Path) -> bool:
    """Return True if `target` exists and is a hard link to `source`."""
    try:
        return target.samefile(source)
    except FileNotFoundError:  # also if another run of the same job removes the target at this moment
        return False


def _link_or_copy(source: Path, target: Path) -> None:
    temporary = temporary_beside(target)
    try:
        try:
            os.link(source, temporary)
        except OSError:  # another file system, or a file system without hard links
            shutil.copyfile(source, temporary)
            with temporary.open("rb") as stream:
                os.fsync(stream.fileno())
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


def stored_name(store: Path, folder: Path) -> str:
    """Return the path of a store as a folder of results records it.

    If the folder of results lies below the folder that holds the store, the path is relative to the results.
    Both can then be moved or copied together.
    """
    store, folder = store.resolve(), folder.resolve()
    return os.path.relpath(store, folder) if folder.is_relative_to(store.parent) else str(store)


def store_of_last_run(folder: Path) -> Path | None:
    """Return the store that a folder of results names; None if there is no record of a run, or no store."""
    try:
        return (folder / str(parse_checked_json((folder / RUN_FILE).read_bytes())["store"])).resolve()
    except (OSError, ValueError, KeyError, TypeError):  # also results of versions that did not name it
        return None


def _files_of_last_run(folder: Path) -> list[str]:
    try:
        last: Any = parse_checked_json((folder / RUN_FILE).read_bytes())
        return [str(name) for name in last["files"]]
    except (OSError, ValueError, KeyError, TypeError):
        return []


def _remove_empty(folder: Path, top: Path) -> None:
    """Remove a folder and its parent folders below `top`, as long as they are empty. `top` itself is kept."""
    while folder != top:
        try:
            folder.rmdir()
        except OSError:  # not empty, or another run of the same job has just removed it
            return
        folder = folder.parent
