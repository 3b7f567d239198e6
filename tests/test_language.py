"""Names, comments, docstrings and messages follow the glossary, and constants have a note."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
PACKAGE = REPOSITORY / "bodycap_batch"
GLOSSARY = REPOSITORY / "docs" / "glossary.md"
CAPTURES = ("tum_fr1_xyz", "walk12", "walk131", "room12", "room131", "roll131", "clocks05", "cpl_lab")
"""Captures of the tests and benchmarks; figures of theirs belong into docs/decisions."""
MAY_NAME_CAPTURES = {"pipeline/sample.py"}

SOURCES = sorted(path for path in PACKAGE.rglob("*.py"))
each_source = pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.relative_to(PACKAGE).as_posix())


def unused_words() -> list[str]:
    """The first column of the glossary's table of words that are not used."""
    table = GLOSSARY.read_text(encoding="utf-8").partition("## Words not used")[2]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    return [word for row in rows for word in re.findall(r"`([^`]+)`", row)]


UNUSED = re.compile(rf"\b({'|'.join(sorted(map(re.escape, unused_words()), key=len, reverse=True))})\b", re.I)


def texts(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the line and the words of each name, comment and string of a source file."""
    with io.StringIO(path.read_text(encoding="utf-8")) as stream:
        for token in tokenize.generate_tokens(stream.readline):
            if token.type == tokenize.NAME:
                yield token.start[0], words_of(token.string)
            elif token.type in (tokenize.COMMENT, tokenize.STRING):
                yield token.start[0], PUBLIC.sub("", " ".join(token.string.split()))


PUBLIC = re.compile(r"--[a-z-]+|jobs/[a-z_]+\.yaml")
"""Command-line flags and the sample jobs: names that users type."""


def words_of(name: str) -> str:
    """The words of a name in snake case or camel case."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", name).replace("_", " ")


def test_the_glossary_names_words() -> None:
    assert len(unused_words()) > 30
    assert UNUSED.search(words_of("_steadiedPath"))
    assert UNUSED.search("what the map tells of it")
    assert not UNUSED.search("a stride of two")


@each_source
def test_no_unused_words(path: Path) -> None:
    found = [f"{line}: {match[0]}" for line, text in texts(path) if (match := UNUSED.search(text))]
    assert not found


@each_source
def test_no_figures_of_captures(path: Path) -> None:
    if path.relative_to(PACKAGE).as_posix() in MAY_NAME_CAPTURES:
        return
    assert not [f"{line}: {name}" for line, text in texts(path) for name in CAPTURES if name in text]


def constants_without_note(path: Path) -> list[str]:
    """Module constants that hold a number and have neither a note below nor a comment beside or above."""
    source = path.read_text(encoding="utf-8")
    lines = source.splitlines()
    body = ast.parse(source).body
    found = []
    for number, node in enumerate(body):
        targets = getattr(node, "targets", None) or [getattr(node, "target", None)]
        names = [
            name.id
            for target in targets
            for name in ast.walk(target or ast.Pass())
            if isinstance(name, ast.Name)
        ]
        value = getattr(node, "value", None)
        if not isinstance(node, ast.Assign | ast.AnnAssign) or not all(n.isupper() for n in names):
            continue
        numbers = [n.value for n in ast.walk(value or ast.Pass()) if isinstance(n, ast.Constant)]
        if not any(isinstance(n, int | float) and not isinstance(n, bool) for n in numbers):
            continue
        below = body[number + 1] if number + 1 < len(body) else None
        noted = isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
        commented = "#" in lines[node.end_lineno - 1] or lines[node.lineno - 2].lstrip().startswith("#")  # type: ignore[operator]
        if not noted and not commented:
            found.append(f"{node.lineno}: {', '.join(names)}")
    return found


@pytest.mark.parametrize(
    "path",
    SOURCES,
    ids=lambda path: path.relative_to(PACKAGE).as_posix(),
)
def test_each_constant_has_a_note(path: Path) -> None:
    assert not constants_without_note(path)
