"""Versions of algorithms and libraries. A stored result is reused only if both versions are unchanged."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path

_PACKAGE = Path(__file__).parent.parent
_MENTION = re.compile(rb"bodycap_batch(?:\.([\w.]+)|[ ]import[ ](\w+))")
"""Pattern of the name of a module of this package."""
_BEFORE = (b"from ", b"import ", b'"', b"'")
"""What precedes the name of a module that is used: an import, or the quote of a string. The string may also
name a subpackage that contains data files."""
_NOT_COMPUTING = frozenset(
    {"core.errors", "core.context", "core.progress", "config", "config.options", "config.models"}
)
"""Modules that are not part of an algorithm's version, because they do not affect a result. Modules of
options are also excluded: options affect results, but an artefact's key holds the values of the options
separately."""
_SKIPPED_SUFFIXES = (".pyc", ".pyo")


@dataclass(frozen=True, slots=True)
class Program:
    """The code that computes a result.

    Attributes:
        module: Name of the module that runs the stage, relative to this package; see `algorithm_version`.
        libraries: Python distributions that the result depends on; see `library_versions`.
    """

    module: str
    libraries: tuple[str, ...]

    def versions(self) -> tuple[str, dict[str, str]]:
        """Return the version of the algorithm, and the version of each library installed on this machine."""
        return algorithm_version(self.module), library_versions(self.libraries)


@cache
def algorithm_version(module: str) -> str:
    """Return the version of a stage's algorithm: a digest of its module's file and of all imported files.

    The version is computed from the files and not maintained by hand. A stored result is therefore never
    reused after the code has changed.

    Args:
        module: Name of the stage's task module, relative to this package (``tasks.keyframes``). This module
            imports the algorithm. Only imports from this package are followed.
    """
    digest = hashlib.sha256()
    for path in sorted(_closure(module)):
        digest.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0")
        digest.update(_source(path).digest + b"\0")
    return digest.hexdigest()[:16]


@cache
def library_versions(names: tuple[str, ...]) -> dict[str, str]:
    """Return the installed version of each distribution.

    A name ``a|b`` lists alternatives. The version of the first installed alternative is returned for ``a``.
    The version is ``none`` if nothing is installed.
    """
    return {name.split("|")[0]: _installed(name.split("|")) for name in names}


def _installed(alternatives: Iterable[str]) -> str:
    for name in alternatives:
        try:
            return metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return "none"


def _closure(module: str) -> set[Path]:
    """Return the files of a module and of all modules that it imports from this package, also indirectly."""
    waiting, found = [module], set[Path]()
    while waiting:
        new = set(_files(waiting.pop())) - found
        found |= new
        waiting.extend(part for path in new for part in _source(path).mentions)
    return found


@dataclass(frozen=True, slots=True)
class _Source:
    """What the version of an algorithm needs from one file: its digest, and the modules that it names."""

    digest: bytes
    mentions: frozenset[str]


@cache
def _source(path: Path) -> _Source:
    """Read a file; the result is cached, because many stages share files."""
    content = path.read_bytes()
    found = _MENTION.finditer(content) if path.suffix == ".py" else ()
    named = {(each[1] or each[2]).decode() for each in found if content[: each.start()].endswith(_BEFORE)}
    return _Source(hashlib.sha256(content).digest(), frozenset(named) - _NOT_COMPUTING)


@cache
def _files(name: str) -> tuple[Path, ...]:
    """Return the file of a module, or all files of a package including its data files."""
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
