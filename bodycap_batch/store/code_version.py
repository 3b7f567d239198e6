"""Versions of algorithms and libraries, so that a stored result is never taken for another's."""

from __future__ import annotations

import ast
import hashlib
import re
import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

_PACKAGE = Path(__file__).parent.parent
_NAMED = re.compile(r"bodycap_batch\.(\w+(?:\.\w+)*)")
"""A string that names a module: one that a child loads ahead, or a package whose data files are read."""
_NOT_COMPUTING = frozenset(
    {"core.errors", "core.context", "core.progress", "config", "config.options", "config.models"}
)
"""Modules that decide nothing about a result: options are part of the key by their values."""
_SKIPPED_SUFFIXES = (".pyc", ".pyo")
_reading = threading.Lock()
"""Held while sources are read, so that several jobs of one process parse no file twice."""


@dataclass(frozen=True, slots=True)
class Program:
    """The code that computes a result.

    Attributes:
        module: Module below this package that runs the stage; see `algorithm_version`.
        libraries: Distributions that the result depends on; see `library_versions`.
    """

    module: str
    libraries: tuple[str, ...]

    def versions(self) -> tuple[str, dict[str, str]]:
        """Return the version of the algorithm and those of the libraries, as installed here."""
        return algorithm_version(self.module), library_versions(self.libraries)


@cache
def algorithm_version(module: str) -> str:
    """Version of a stage's algorithm: a digest of a module's code and of all it imports from this package.

    The version is derived, not counted by hand, so that changed code never reuses a stored result. Comments,
    docstrings and the layout of the source are not part of it: rewording a sentence changes no version.

    Args:
        module: Below this package: the stage's task (``tasks.keyframes``), which imports the algorithm.
    """
    digest = hashlib.sha256()
    with _reading:
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
    """What a file contributes to the digest, and the modules of this package that it names."""

    content: bytes
    mentions: frozenset[str]


@cache
def _source(path: Path) -> _Source:
    """Read a file once, however many stages it is part of."""
    content = path.read_bytes()
    if path.suffix != ".py":
        return _Source(content, frozenset())
    tree = ast.parse(content, str(path))
    return _Source(code_text(tree).encode(), frozenset(_mentions(tree)) - _NOT_COMPUTING)


def _mentions(tree: ast.AST) -> Iterator[str]:
    """Modules below this package that are imported, or named by a string."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("bodycap_batch."):
            yield str(node.module).partition(".")[2]
        elif isinstance(node, ast.ImportFrom) and node.module == "bodycap_batch":
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.Import):
            named = (_NAMED.fullmatch(alias.name) for alias in node.names)
            yield from (match[1] for match in named if match)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield from _NAMED.findall(node.value) if _NAMED.fullmatch(node.value) else ()


def code_text(tree: ast.AST) -> str:
    """The syntax tree as text, equal on all supported versions of Python.

    Left out: positions, docstrings and other bare strings, and empty fields. Python 3.12 added the field
    ``type_params``, Python 3.13 prints trees without empty lists; neither may change a digest.
    """
    fields = []
    for name, value in ast.iter_fields(tree):
        text = _field_text(value)
        if text and name not in _IGNORED_FIELDS:
            fields.append(f"{name}={text}")
    return f"{type(tree).__name__}({','.join(fields)})"


_IGNORED_FIELDS = frozenset({"ctx", "kind", "type_comment", "type_ignores"})
"""Fields of syntax nodes that say nothing about what the code does."""


def _field_text(value: object) -> str:
    """A field of a syntax node; empty where the field is."""
    if isinstance(value, ast.Constant):
        return f"{type(value.value).__name__}:{value.value!r}"
    if isinstance(value, ast.JoinedStr):
        # Python 3.12 adds empty strings to f-strings.
        parts = [part for part in value.values if getattr(part, "value", None) != ""]
        return f"JoinedStr{_field_text(parts)}"
    if isinstance(value, ast.AST):
        return code_text(value)
    if isinstance(value, list):
        items = [_field_text(item) for item in value if not _is_bare_string(item)]
        return f"[{','.join(items)}]" if items else ""
    return "" if value is None else repr(value)


def _is_bare_string(node: object) -> bool:
    """A docstring, or the note on an assignment."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


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
