"""Versions of algorithms and libraries, so that a stored result is never taken for another's."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Iterator
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

_PACKAGE = Path(__file__).parent
_MENTION = re.compile(r"\bbodycap_batch(?:\.| import )(\w+(?:\.\w+)*)")
"""An import, or a package named in a string to read its data files."""
_NOT_COMPUTING = frozenset({"errors", "context", "progress", "config", "config.options", "config.models"})
"""Modules that decide nothing about a result: options are part of the key by their values."""
_SKIPPED_SUFFIXES = (".pyc", ".pyo")


@cache
def algorithm_version(module: str) -> str:
    """Version of a stage's algorithm: a digest of a module's source and of all it imports from here.

    Derived rather than counted by hand, so that changed code can never be answered with an old result.

    Args:
        module: Below this package: the stage's task (``tasks.keyframes``), which imports the algorithm.
    """
    digest = hashlib.sha256()
    for path in sorted(_closure(module)):
        digest.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0")
        digest.update(_source(path).content + b"\0")
    return digest.hexdigest()[:16]


@cache
def library_versions(names: tuple[str, ...]) -> dict[str, str]:
    """Installed version of each distribution; of alternatives (``a|b``) the one that is installed."""
    return {name.split("|")[0]: _installed(name.split("|")) for name in names}


def _installed(alternatives: Iterable[str]) -> str:
    for name in alternatives:
        try:
            return metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return "none"


def _closure(module: str) -> set[Path]:
    """Files of the module and of what it imports from here."""
    waiting, found = [module], set[Path]()
    while waiting:
        new = set(_files(waiting.pop())) - found
        found |= new
        waiting.extend(part for path in new for part in _source(path).mentions)
    return found


class _Source(NamedTuple):
    """A file's bytes, and the modules of this package that it imports."""

    content: bytes
    mentions: frozenset[str]


@cache
def _source(path: Path) -> _Source:
    """Read a file once, however many stages it is part of."""
    content = path.read_bytes()
    if path.suffix != ".py":
        return _Source(content, frozenset())
    return _Source(content, frozenset(_MENTION.findall(content.decode())) - _NOT_COMPUTING)


@cache
def _files(name: str) -> tuple[Path, ...]:
    """Files of a module; a package's are all files in it, data included."""
    return tuple(_files_of(name))


def _files_of(name: str) -> Iterator[Path]:
    path = _PACKAGE.joinpath(*name.split("."))
    if path.is_dir():
        yield from (
            file for file in path.rglob("*") if file.is_file() and not file.name.endswith(_SKIPPED_SUFFIXES)
        )
    elif (file := path.with_suffix(".py")).is_file():
        yield file
    elif "." in name:
        yield from _files(name.rpartition(".")[0])
