"""A task of the runner, and how it is written to and read from JSON."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from bodycap_batch.core.context import StageContext
from bodycap_batch.core.progress import task_label
from bodycap_batch.store.artefacts import ArtefactKey
from bodycap_batch.store.code_version import Program

TaskFunction = Callable[[Mapping[str, Any], StageContext, Path], None]
"""Called in the child with the task's arguments, the context and the folder that becomes the artefact."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One artefact to be computed. Only `key` identifies it.

    Attributes:
        key: What the artefact is computed from.
        arguments: What the child loads, as JSON values: options and paths. The key identifies their content.
        program: The code that computes it. A worker on another machine must have the same; None: not checked.
        camera: The camera that it concerns, or "".
        round: Round of the map, from 0.
        threads: Number of threads that it may keep busy.
        modules: Modules that its child loads. A child that has loaded them is preferred.
        memory_mb: Memory that it may need.
        priority: Of waiting tasks, the one with the highest priority runs first.
        replaces: Compute the artefact although it is stored, and replace it.
    """

    key: ArtefactKey
    arguments: Mapping[str, Any] = field(default_factory=dict)
    program: Program | None = None
    camera: str = ""
    round: int = 0
    threads: int = 1
    modules: tuple[str, ...] = ()
    memory_mb: int = 0
    priority: int = 0
    replaces: bool = False

    @property
    def label(self) -> str:
        """Stage, camera and round, for messages."""
        return task_label(self.key.stage, self.camera, self.round)

    @property
    def file_stem(self) -> str:
        """Stage, camera and round, for names of files."""
        parts = (self.key.stage, self.camera, str(self.round) if self.round else "")
        return "_".join(part for part in parts if part)

    def to_json(self, store: Path) -> dict[str, Any]:
        """Return the task as plain JSON values, with the folder of the store that receives the artefact."""
        return {**asdict(self), "store": str(store)}


def task_from_json(data: Mapping[str, Any]) -> tuple[Task, Path]:
    """Rebuild a task and the folder of the store from `Task.to_json`."""
    values = {item.name: data[item.name] for item in fields(Task)}
    values |= {"key": ArtefactKey(**data["key"]), "modules": tuple(data["modules"])}
    if (program := data["program"]) is not None:
        values["program"] = Program(program["module"], tuple(program["libraries"]))
    return Task(**values), Path(data["store"])
