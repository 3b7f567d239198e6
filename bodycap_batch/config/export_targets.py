"""The programs that the files for animation can be made for, and the export options of each program."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any, Literal, get_args

import yaml

from bodycap_batch.core.errors import JobError

Target = Literal["blender", "maya", "motionbuilder", "unreal", "unity", "mixamo"]
TARGETS: tuple[str, ...] = get_args(Target)


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportTarget:
    """What one program expects of the files for animation.

    Attributes:
        title: Name of the program.
        options: Values of export options, by name of the option.
        file: Name of the file to import.
        steps: What to do in the program, one sentence or more for each step.
    """

    title: str
    options: Mapping[str, Any]
    file: str
    steps: tuple[str, ...]


@cache
def export_target(name: str) -> ExportTarget:
    """Return a program by its name.

    Raises:
        JobError: There is no program with this name.
    """
    if name not in TARGETS:
        near = difflib.get_close_matches(name.lower(), TARGETS, n=1)
        known = f"use one of {', '.join(TARGETS)}"
        raise JobError(
            f"there is no export target {name[:40]!r}",
            field="export.target",
            hint=f"did you mean {near[0]!r}? {known}" if near else known,
        )
    text = resources.files("bodycap_batch.presets").joinpath("targets.yaml").read_text(encoding="utf-8")
    entry = yaml.safe_load(text)[name]
    return ExportTarget(
        title=entry["title"], options=entry["options"], file=entry["file"], steps=tuple(entry["steps"])
    )
