"""Write the part of the reference that comes from the code.

These are the job file, the commands, the errors, the results and the Python API.
"""

from __future__ import annotations

import dataclasses
import json
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import typer
import yaml
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from bodycap_batch import cli
from bodycap_batch.cli.application import COMMAND_GROUPS, app
from bodycap_batch.config.models import Job
from bodycap_batch.formats.frame_table import COLUMNS as FRAME_COLUMNS
from bodycap_batch.formats.joint_table import COLUMNS as JOINT_COLUMNS
from bodycap_batch.model import merge_report
from tests import error_table

DESCRIPTIONS = Path(__file__).with_name("descriptions.yaml")
"""Descriptions of the columns and keys of the results, which no type of the code holds."""
PYTHON_API = (
    ("Load and run a job", "bodycap_batch.api", ("load_job", "run_job", "Job")),
    (
        "Read results",
        "bodycap_batch.results",
        ("Result", "CameraPath", "ClockEstimate"),
    ),
    ("Frames", "bodycap_batch.formats.frame_table", ("FrameTable",)),
    ("The motion of the body", "bodycap_batch.formats.joint_table", ("BodyMotion",)),
    ("Progress", "bodycap_batch.core.progress", ("Event",)),
    ("Errors", "bodycap_batch.core.errors", ("BodycapError",)),
    ("Run many jobs", "bodycap_batch.pipeline", ("Batch", "BatchJob", "Outcome")),
    ("Read a BVH file", "bodycap_batch.formats.bvh", ("read_bvh",)),
)
"""Title, module and names of each part of the Python API."""


def write_all(folder: Path) -> None:
    """Write all generated pages into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    pages = {
        "job_file": job_file(),
        "command_line": command_line(),
        "errors": errors(),
        "results": results(),
        "python_api": python_api(),
    }
    for name, text in pages.items():
        path = folder / f"{name}.md"
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def job_file() -> str:
    """Return the page of the job file, from the types of the options."""
    head = "# Keys of the job file\n\nEvery key with its type, its default and its meaning.\n"
    return head + "".join(_block("", Job, set()))


def _block(place: str, model: type[BaseModel], done: set[str]) -> Iterator[str]:
    inner: list[tuple[str, type[BaseModel]]] = []
    title = f"`{place}`" if place else "The top of the file"
    rows = []
    for name, field in model.model_fields.items():
        rows.append((f"`{name}`", _type_text(field.annotation), _default(field), field.description or ""))
        for found in _models(field.annotation):
            inner.append((f"{place}.{name}".strip("."), found))
            if not field.description:
                rows[-1] = (rows[-1][0], "block", "", f"see `{f'{place}.{name}'.strip('.')}` below")
    yield f"\n## {title}\n\n{_table(('key', 'type', 'default', 'meaning'), rows)}"
    for where, found in inner:
        if found.__name__ not in done:
            done.add(found.__name__)
            yield from _block(where, found, done)


def _models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for argument in typing.get_args(annotation) for found in _models(argument)]


def _type_text(annotation: Any) -> str:
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Literal:
        return " or ".join(f"`{value}`" for value in arguments)
    if origin is typing.Annotated:
        return _type_text(arguments[0])
    if origin in (tuple, list):
        return "list"
    if origin is dict:
        return "block"
    if arguments:
        texts = [_type_text(part) for part in arguments if part is not type(None)]
        return " or ".join(dict.fromkeys(text for text in texts if text))
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "block"
    names = {str: "text", int: "whole number", float: "number", bool: "`true` or `false`", Path: "path"}
    return names.get(annotation, "")


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if isinstance(value, BaseModel):
        return ""
    return "" if value is None else f"`{json.dumps(value, ensure_ascii=False, default=str)}`"


def command_line() -> str:
    """Return the page of the commands, from their definitions."""
    assert cli.main  # importing the package registers the commands
    parts = ["# Commands\n\nEvery command prints this with `--help`.\n"]
    title_of = {names[0]: title for title, names in COMMAND_GROUPS.items()}
    for name, command in commands().items():
        if name in title_of:
            parts.append(f"\n## {title_of[name]}\n")
        arguments = [p for p in command.params if p.param_type_name == "argument"]
        words = " ".join(str(p.metavar or p.name.upper()) for p in arguments)
        text = "\n".join(_help_lines(command.help or ""))
        parts.append(f"\n### bodycap {name}\n\n```text\nbodycap {name} [OPTIONS] {words}\n```\n\n{text}\n")
        rows = [(_flags(p), str(getattr(p, "help", "") or "")) for p in command.params if p.name != "help"]
        parts.append("\n" + _table(("argument or option", "meaning"), rows))
    return "".join(parts)


def commands() -> dict[str, Any]:
    """Return the commands by name, in the order of the help."""
    known = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    return {name: known[name] for names in COMMAND_GROUPS.values() for name in names}


def _help_lines(text: str) -> Iterator[str]:
    """Yield the help of a command as Markdown; a paragraph after a backspace keeps its lines."""
    for paragraph in text.split("\n\n"):
        if paragraph.startswith("\b"):
            title, *lines = paragraph.lstrip("\b\n").split("\n")
            yield from (f"{title}\n", "```text", *(line.strip() for line in lines), "```", "")
        else:
            yield " ".join(paragraph.split()).replace("<", "\\<") + "\n"


def _flags(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return f"`{parameter.metavar or parameter.name}`"
    kind = getattr(getattr(parameter, "type", None), "name", "VALUE")
    value = "" if getattr(parameter, "is_flag", False) else f" {parameter.metavar or kind}"
    return ", ".join(f"`{flag}{value}`" for flag in (*parameter.opts, *parameter.secondary_opts))


def errors() -> str:
    """Return the page of the errors, from the source."""
    return (
        "# Errors\n\nEvery message that ends a command, with its exit code. A value of the moment is "
        "written as …. "
        f"The meaning of the codes is in [Results](../results.md#exit-codes).\n\n{error_table.table()}\n"
    )


def results() -> str:
    """Return the page of the columns and keys of the results."""
    known = descriptions()
    parts = ["# Columns and keys of the results\n"]
    for name in ("frames.csv", "joints.csv"):
        rows = [(f"`{column}`", known[name][column]) for column in columns()[name]]
        parts.append(f"\n## `{name}`\n\n{_table(('column', 'meaning'), rows)}")
    for name in ("metrics.json", "fill.json", "status.json", "run.json"):
        rows = [(f"`{key}`", text) for key, text in known[name].items()]
        parts.append(f"\n## `{name}`\n\n{_table(('key', 'meaning'), rows)}")
    parts.append("\n## `merge` in `metrics.json`\n")
    for report in reports():
        rows = [(f"`{key}`", text) for key, text in attributes(report).items()]
        parts.append(f"\n### {(report.__doc__ or '').splitlines()[0]}\n\n{_table(('key', 'meaning'), rows)}")
    return "".join(parts)


def columns() -> dict[str, tuple[str, ...]]:
    """Return the columns of each table of the results."""
    return {"frames.csv": tuple(FRAME_COLUMNS), "joints.csv": tuple(JOINT_COLUMNS.split(","))}


def reports() -> list[type]:
    """Return the types of the report of merging; the report as a whole comes first."""
    found = [
        item
        for item in vars(merge_report).values()
        if isinstance(item, type) and dataclasses.is_dataclass(item)
    ]
    return sorted(found, key=lambda item: item is not merge_report.MergeReport)


def attributes(report: type) -> dict[str, str]:
    """Return the descriptions of a dataclass's fields, from the part `Attributes` of its docstring."""
    _, _, text = (report.__doc__ or "").partition("Attributes:")
    found: dict[str, str] = {}
    name = ""
    for line in text.splitlines():
        start = line.strip()
        first = start.partition(":")[0]
        if line.startswith(" " * 8) and not line.startswith(" " * 9) and first.isidentifier():
            name = first
            found[name] = start.partition(":")[2].strip()
        elif name and start:
            found[name] += f" {start}"
    return found


def descriptions() -> dict[str, dict[str, str]]:
    """Return the descriptions of columns and keys, by file and name."""
    return dict(yaml.safe_load(DESCRIPTIONS.read_text(encoding="utf-8")))


def python_api() -> str:
    """Return the page of the Python API, which Sphinx fills with the docstrings."""
    parts = ["# Python API\n\nThese names stay as they are within a major version.\n"]
    for title, module, names in PYTHON_API:
        parts.append(f"\n## {title}\n\n```{{eval-rst}}\n.. automodule:: {module}\n   :no-index:\n\n")
        for name in names:
            kind = "autoclass" if name[0].isupper() else "autofunction"
            members = "   :members:\n" if kind == "autoclass" else ""
            parts.append(f".. {kind}:: {module}.{name}\n{members}\n")
        parts.append("```\n")
    return "".join(parts)


def _table(heads: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [heads, tuple("---" for _ in heads), *(tuple(map(_cell, row)) for row in rows)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "\\|").replace("<", "&lt;").split())


if __name__ == "__main__":
    write_all(Path(__file__).with_name("generated"))
