"""What lies in the inbox, and whether it has been copied completely."""

from __future__ import annotations

import hashlib
import os
import stat
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from bodycap_batch.watch.spool import visible

READY = "READY"
NO_JOB = "no job: neither a folder nor a YAML file"
YAML_SUFFIXES = (".yaml", ".yml")
_PART = ".part"
_HARMLESS = (".DS_Store", ".localized", ".directory", ".Spotlight-V100", ".Trashes", ".fseventsd", ".nomedia")
"""What file managers leave in every folder; resource forks (``._name``) likewise."""


@dataclass(frozen=True, slots=True)
class Drop:
    """A folder or a job file in the inbox."""

    path: Path

    @property
    def is_file(self) -> bool:
        """True for a job file, False for a folder."""
        return not self.path.is_dir()

    @property
    def name(self) -> str:
        """What the job is called."""
        return self.path.stem if self.is_file else self.path.name


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """What a drop looks like at one moment.

    Attributes:
        digest: Changes when a file is added, removed, renamed, or its size or time changes.
        files: How many files there are.
        ready: A file called READY says that all is there.
        unfinished: A file that a copying program is still at, relative to the drop; "" where there is none.
        special: Something that is neither file nor folder (a pipe, a device); "" where there is none.
        garbled: A name that is no UTF-8 text; "" where there is none.
    """

    digest: str
    files: int
    ready: bool
    unfinished: str
    special: str
    garbled: str

    @property
    def waits_for(self) -> str:
        """Why it cannot be complete yet; "" where nothing speaks against it."""
        if self.ready:
            return ""
        if self.unfinished:
            return f"{self.unfinished} is being copied"
        return "" if self.files else "the folder is empty"


def drops_in(inbox: Path) -> list[Drop]:
    """Folders and job files of the inbox."""
    return [Drop(path) for path in visible(inbox) if _is_drop(path)]


def strays_in(inbox: Path) -> list[Path]:
    """What lies in the inbox and is no job: single videos, other files."""
    return [path for path in visible(inbox) if not _is_drop(path)]


def look_at(drop: Drop, most: int) -> Look:
    """Look at names, sizes and times of a drop's files; nothing is opened.

    Args:
        drop: What to look at.
        most: Stop counting beyond that many files.
    """
    digest, count = hashlib.sha256(), 0
    ready, unfinished, special = False, "", ""
    garbled = "" if _is_text(drop.path.name) else drop.path.name
    for path, name in _files_below(drop.path):
        try:
            found = path.stat()
        except OSError:  # a link that leads nowhere: told when the job is read
            found = path.lstat()
        count += 1
        digest.update(repr((name, found.st_size, found.st_mtime_ns, found.st_ino)).encode())
        ready = ready or name == READY
        garbled = garbled if _is_text(name) else name
        if not unfinished and any(map(_is_unfinished, Path(name).parts)):
            unfinished = name
        if not stat.S_ISREG(found.st_mode) and not stat.S_ISDIR(found.st_mode) and not path.is_symlink():
            special = name
        if count > most:
            break
    return Look(
        digest=digest.hexdigest(),
        files=count,
        ready=ready,
        unfinished=unfinished,
        special=special,
        garbled=garbled,
    )


class Settling:
    """Follows drops until they are complete.

    Args:
        settle_s: How long names, sizes and times must stay as they are.
        most: How many files of a drop are looked at.
        clock: This process's own clock, seconds.

    Attributes:
        held: What keeps drops back that have not changed for as long: a copy that was broken off, no file.
        unreadable: Those of them that cannot even be looked at.
    """

    def __init__(self, settle_s: float, most: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._settle_s = settle_s
        self._most = most
        self._clock = clock
        self._seen: dict[Path, tuple[str, float]] = {}
        self.held: dict[Path, str] = {}
        self.unreadable: dict[Path, str] = {}

    def complete(self, drops: list[Drop]) -> list[tuple[Drop, Look]]:
        """The drops that are complete now, those that have been so for longest first."""
        now = self._clock()
        found: list[tuple[float, Drop, Look]] = []
        before, self._seen = self._seen, {}
        self.held, self.unreadable = {}, {}
        for drop in drops:
            look, error = _looked_at(drop, self._most)
            state = error if look is None else look.digest
            known, since = before.get(drop.path, ("", now))
            since = since if known == state else now
            self._seen[drop.path] = (state, since)
            still = now - since >= self._settle_s
            if look is not None and (look.ready or (still and not look.waits_for)):
                found.append((since, drop, look))
            elif still and (reason := error or (look.waits_for if look is not None else "")):
                self.held[drop.path] = reason
                if error:
                    self.unreadable[drop.path] = error
        found.sort(key=lambda each: (each[0], each[1].path))
        return [(drop, look) for _, drop, look in found]

    @property
    def waiting(self) -> bool:
        """True where something has been seen that may still be copied."""
        return bool(self._seen)


def _looked_at(drop: Drop, most: int) -> tuple[Look | None, str]:
    """A look at a drop, or why there is none; "" where something is just being moved."""
    try:
        return look_at(drop, most), ""
    except FileNotFoundError:
        return None, ""
    except OSError as error:
        return None, error.strerror or str(error)


def _is_drop(path: Path) -> bool:
    if path.suffix.lower() == _PART:
        return False
    return path.is_dir() or (path.suffix.lower() in YAML_SUFFIXES and not _is_special(path))


def _is_special(path: Path) -> bool:
    try:
        return not stat.S_ISREG(path.stat().st_mode)
    except OSError:
        return not path.is_symlink()


def _is_text(name: str) -> bool:
    """False for bytes that are no UTF-8: nothing could write such a name down."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True


def _is_unfinished(name: str) -> bool:
    if name.lower().endswith(_PART):
        return True
    return name.startswith(".") and name not in _HARMLESS and not name.startswith("._")


def _files_below(path: Path) -> Iterator[tuple[Path, str]]:
    """Files, links and special files below a folder with their names in it; a file itself for a file."""
    if not path.is_dir():
        yield path, path.name
        return
    folders = [(path, "")]
    while folders:
        folder, prefix = folders.pop()
        for entry in sorted(os.scandir(folder), key=lambda each: each.name):
            name = f"{prefix}{entry.name}"
            if entry.is_dir(follow_symlinks=False):
                folders.append((Path(entry.path), f"{name}/"))
            else:
                yield Path(entry.path), name
