"""The runner's task, and its conversion to and from JSON."""

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
"""Function that runs a task in the child. Its arguments are the task's arguments, the context, and the folder
that becomes the artefact."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One artefact to be computed. Only `key` identifies the artefact.

    Attributes:
        key: The key of the artefact. The key identifies everything that the artefact is computed from.
        arguments: The stage's typed task as JSON values: options, and paths of the inputs. The key identifies
            the content of the inputs.
        program: The code that computes the artefact. A worker on another machine refuses the task if its
            program differs. None disables this check.
        camera: Name of the camera that the task concerns; "" if it concerns no single camera.
        round: Round of the map, counted from 0.
        threads: Number of threads that the task may keep busy.
        modules: Names of the modules that the task needs. A child that has loaded them is preferred.
        memory_mb: Memory (MB) that the task may need.
        priority: Priority of the task; waiting tasks with a higher number run first.
        replaces: True to compute the artefact even if it is stored, and to replace the stored artefact.
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
        """Label of the task for messages: stage, camera and round."""
        return task_label(self.key.stage, self.camera, self.round)

    @property
    def file_stem(self) -> str:
        """Stem of the names of the task's files: stage, camera and round."""
        parts = (self.key.stage, self.camera, str(self.round) if self.round else "")
        return "_".join(part for part in parts if part)

    def to_json(self, store: Path) -> dict[str, Any]:
        """Return the task as plain JSON values, including the folder `store` that receives the artefact."""
        return {**asdict(self), "store": str(store)}


def task_from_json(data: Mapping[str, Any]) -> tuple[Task, Path]:
    """Rebuild a task and the folder of its store from the values that `Task.to_json` returned."""
    values = {item.name: data[item.name] for item in fields(Task)}
    values |= {"key": ArtefactKey(**data["key"]), "modules": tuple(data["modules"])}
    if (program := data["program"]) is not None:
        values["program"] = Program(program["module"], tuple(program["libraries"]))
    return Task(**values), Path(data["store"])
