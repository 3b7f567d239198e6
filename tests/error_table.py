"""The table of every error message, made from the source. `make docs` makes a page of it.

``python -m tests.error_table`` prints it.
"""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "bodycap_batch"
CODES = {"JobError": 2, "CaptureError": 3, "EstimationError": 4, "ImplausibleBody": 4, "StoreError": 5}
CODES |= {"Problem": 2, "error": 2}
"""Also what a job's rules find, and what the BVH parser says of a line."""
DEFAULT_REMEDY = {
    "Problem": "see the description of the field, which is printed with the message",
    "error": "export the skeleton again as BVH, or use a preset: `skeleton: auto`",
}
"""What these say where the code gives no remedy of its own."""


@dataclass(frozen=True, order=True)
class Message:
    """One place in the code that makes an error."""

    code: int
    text: str
    remedy: str
    where: str

    def row(self) -> str:
        return f"| {self.code} | {_cell(self.text)} | {_cell(self.remedy)} |"


@functools.cache
def messages() -> list[Message]:
    """All errors of the package, by exit code, then by text; equal ones once."""
    found: dict[tuple[int, str, str], Message] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        if not any(f"{name}(" in text for name in CODES):
            continue
        for message in _in_module(ast.parse(text), path.relative_to(ROOT).as_posix()):
            found.setdefault((message.code, message.text, message.remedy), message)
    return sorted(found.values())


def _in_module(tree: ast.Module, where: str) -> Iterator[Message]:
    constants = {
        target.id: node.value
        for node in tree.body
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    for function in ast.walk(tree):
        if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        known = {**constants, **_assigned(function)}
        for node in ast.walk(function):
            if not (isinstance(node, ast.Call) and node.args):
                continue
            called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if called not in CODES:
                continue
            position = 1 if called == "Problem" else 0
            named = {word.arg: word.value for word in node.keywords}
            hint = named.get("hint", node.args[2] if called == "Problem" and len(node.args) > 2 else None)
            remedy = _remedies(hint, known) or DEFAULT_REMEDY.get(called, "")
            for text in _texts(node.args[position], known):
                yield Message(CODES[called], text, remedy, f"{where}:{node.lineno}")


def _assigned(function: ast.AST) -> dict[str, ast.expr]:
    """The last plain value each name of a function is given."""
    return {
        node.targets[0].id: node.value
        for node in ast.walk(function)
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
    }


def _remedies(hint: ast.expr | None, known: dict[str, ast.expr]) -> str:
    return "" if hint is None else " / ".join(_texts(hint, known))


def _texts(node: ast.expr, known: dict[str, ast.expr], depth: int = 0) -> list[str]:
    """The texts an expression can be, values of the moment as …; both of an alternative."""
    if isinstance(node, ast.Constant):
        return [str(node.value)] if isinstance(node.value, str) else []
    if isinstance(node, ast.JoinedStr):
        parts = [part.value if isinstance(part, ast.Constant) else "…" for part in node.values]
        return [re.sub(r"…[\s…]*…", "…", "".join(map(str, parts)))]
    if isinstance(node, ast.IfExp):
        return [*_texts(node.body, known, depth), *_texts(node.orelse, known, depth)]
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        left, right = (_texts(side, known, depth) or ["…"] for side in (node.left, node.right))
        return [first + second for first in left for second in right]
    if isinstance(node, ast.BoolOp):
        return [text for value in node.values for text in _texts(value, known, depth)]
    if isinstance(node, ast.Name) and node.id in known and depth < 3:
        return _texts(known[node.id], known, depth + 1)
    return ["…"] if not isinstance(node, ast.Constant) else []


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "\\|").replace("<", "&lt;").split())


def table() -> str:
    """The table in Markdown."""
    rows = [message.row() for message in messages() if message.text != "…"]
    head = ["| code | message | what to do |", "|---|---|---|"]
    return "\n".join([*head, *rows])


if __name__ == "__main__":
    print(table())
