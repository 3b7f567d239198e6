"""Versions of algorithms and libraries. A stored result is reused only if both versions are unchanged."""

from __future__ import annotations

import ast
import contextlib
import hashlib
import importlib.util
import json
import os
import re
import sys
import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import ClassVar, NamedTuple

_PACKAGE = Path(__file__).parent.parent
_NAMED = re.compile(r"bodycap_batch\.(\w+(?:\.\w+)*)")
"""Pattern of a string in the code that names a module of this package. The string may also name a subpackage
that contains data files."""
_NOT_COMPUTING = frozenset(
    {"core.errors", "core.context", "core.progress", "config", "config.options", "config.models"}
)
"""Modules that are not part of an algorithm's version, because they do not affect a result. Modules of
options are also excluded: options affect results, but an artefact's key holds the values of the options
separately."""
_SKIPPED_SUFFIXES = (".pyc", ".pyo")
_CACHE_NAME = "code_versions.json"
"""Name of the file that keeps what was found in each source file. It lies beside Python's compiled files."""
_reading = threading.Lock()
"""Lock that is held while sources are read, so that several jobs of one process parse each file only once."""


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
    """Return the version of a stage's algorithm: a digest of its module's code and of all imported code.

    The version is computed from the code and not maintained by hand. A stored result is therefore never
    reused after the code has changed. Comments, docstrings and the layout of the source do not affect the
    version.

    Args:
        module: Name of the stage's task module, relative to this package (``tasks.keyframes``). This module
            imports the algorithm. Only imports from this package are followed.
    """
    digest = hashlib.sha256()
    with _reading:
        for path in sorted(_closure(module)):
            digest.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0")
            digest.update(_source(path).digest.encode() + b"\0")
        _parsed_sources(_PACKAGE).save()
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


class _Source(NamedTuple):
    """What the digest of an algorithm needs from one file: a digest of its code, and the modules it names."""

    digest: str
    mentions: frozenset[str]


class _ParsedSources:
    """What was found in each source file of a package, kept in a file for later processes.

    To parse all source files takes more than a second. An entry is used only for a file with the same
    content. If the file of the entries cannot be read or written, the sources are parsed again.

    Args:
        package: Folder of the package.
    """

    def __init__(self, package: Path) -> None:
        self._package = package
        compiled = Path(importlib.util.cache_from_source(str(package / "__init__.py")))
        self._path = compiled.with_name(_CACHE_NAME)
        own = package / Path(__file__).relative_to(Path(__file__).parent.parent)
        self._reader = hashlib.sha256(own.read_bytes()).hexdigest()
        self._entries: dict[str, tuple[str, str, list[str]]] = {}
        self._is_new = False
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            document = json.loads(self._path.read_text(encoding="utf-8"))
            if document["reader"] == self._reader:
                self._entries = {
                    str(name): (str(content), str(digest), [str(module) for module in mentions])
                    for name, (content, digest, mentions) in document["sources"].items()
                }

    def find(self, path: Path, content: bytes) -> _Source:
        """Return what is in a source file with this content; the file is parsed if it is unknown."""
        name, content_digest = path.relative_to(self._package).as_posix(), hashlib.sha256(content).hexdigest()
        known = self._entries.get(name)
        if known is not None and known[0] == content_digest:
            return _Source(known[1], frozenset(known[2]))
        reader = _TreeReader()
        text = reader.text(ast.parse(content, str(path)))
        mentions = frozenset(reader.mentions) - _NOT_COMPUTING
        source = _Source(hashlib.sha256(text.encode()).hexdigest(), mentions)
        self._entries[name] = (content_digest, source.digest, sorted(mentions))
        self._is_new = True
        return source

    def save(self) -> None:
        """Write the entries if there are new ones and Python may write files beside the sources."""
        if not self._is_new or sys.dont_write_bytecode:
            return
        self._is_new = False
        text = json.dumps({"reader": self._reader, "sources": self._entries})
        with contextlib.suppress(OSError):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            part = self._path.with_suffix(f".{os.getpid()}")
            part.write_text(text, encoding="utf-8")
            os.replace(part, self._path)


@cache
def _parsed_sources(package: Path) -> _ParsedSources:
    """Return what was found in the source files of a package; read once in a process."""
    return _ParsedSources(package)


@cache
def _source(path: Path) -> _Source:
    """Read a file, and parse it if needed; the result is cached, because many stages share files."""
    content = path.read_bytes()
    if path.suffix != ".py":
        return _Source(hashlib.sha256(content).hexdigest(), frozenset())
    return _parsed_sources(_PACKAGE).find(path, content)


def code_text(tree: ast.AST) -> str:
    """Return a syntax tree as text that is equal on all supported versions of Python.

    The text omits positions, docstrings, other bare strings and empty fields. Empty fields differ between
    versions: Python 3.12 added the field ``type_params``, and Python 3.13 prints trees without empty lists.
    These differences must not change a digest.
    """
    return _TreeReader().text(tree)


_IGNORED_FIELDS = frozenset({"ctx", "kind", "type_comment", "type_ignores"})
"""Fields of syntax nodes that do not affect what the code does."""


class _TreeReader:
    """Reads the text of a syntax tree and the modules that it names, in one walk over the tree.

    Attributes:
        mentions: Modules of this package that the tree imports or names in a string, outside of bare strings.
    """

    _FIELDS: ClassVar[dict[type[ast.AST], tuple[str, ...]]] = {}
    """The fields of each class of nodes that affect what the code does."""

    def __init__(self) -> None:
        self.mentions = set[str]()

    def text(self, node: ast.AST) -> str:
        """Return the text of a node; see `code_text`."""
        kind = node.__class__
        names = self._FIELDS.get(kind)
        if names is None:
            names = self._FIELDS[kind] = tuple(name for name in kind._fields if name not in _IGNORED_FIELDS)
        if kind is ast.ImportFrom or kind is ast.Import:
            self.mentions.update(_imported(node))
        fields = []
        for name in names:
            text = self._field_text(getattr(node, name, None))
            if text:
                fields.append(f"{name}={text}")
        return f"{kind.__name__}({','.join(fields)})"

    def _field_text(self, value: object) -> str:
        """Return a field of a syntax node as text; the text of an empty field is empty."""
        if value is None:
            return ""
        if isinstance(value, ast.Constant):
            if isinstance(value.value, str) and (named := _NAMED.fullmatch(value.value)):
                self.mentions.add(named[1])
            return f"{type(value.value).__name__}:{value.value!r}"
        if isinstance(value, ast.JoinedStr):
            # Python 3.12 adds empty strings to the parts of f-strings; they are ignored.
            parts = [part for part in value.values if getattr(part, "value", None) != ""]
            return f"JoinedStr{self._field_text(parts)}"
        if isinstance(value, ast.AST):
            return self.text(value)
        if isinstance(value, list):
            items = [self._field_text(item) for item in value if not _is_bare_string(item)]
            return f"[{','.join(items)}]" if items else ""
        return repr(value)


def _imported(node: ast.AST) -> Iterator[str]:
    """Yield the modules of this package that an import statement names."""
    if isinstance(node, ast.ImportFrom):
        if node.module == "bodycap_batch":
            yield from (alias.name for alias in node.names)
        elif (node.module or "").startswith("bodycap_batch."):
            yield str(node.module).partition(".")[2]
    elif isinstance(node, ast.Import):
        yield from (match[1] for alias in node.names if (match := _NAMED.fullmatch(alias.name)))


def _is_bare_string(node: object) -> bool:
    """Return True for a bare string: a docstring, or the note below an assignment."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


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
