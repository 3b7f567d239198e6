"""What a child process is asked to do, and how both sides read and write it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from bodycap_batch.core.context import StageContext
from bodycap_batch.core.progress import task_label
from bodycap_batch.store.artefacts import ArtefactKey

TaskFunction = Callable[[Mapping[str, Any], Mapping[str, Any], StageContext, Path], None]
"""Called with options, arguments, context and the folder that becomes the artefact."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One artefact to be made.

    Attributes:
        key: What it is made from; its options are the stage's options.
        arguments: What the child loads: JSON values and paths. The key names their content.
        camera: The camera it concerns, or "".
        round: Which round of growing the map, from 0.
        threads: Threads it may keep busy; no part of the key.
        modules: What its child loads for it, to choose a child that has; no part of the key.
        memory_mb: Memory it may need; no part of the key.
        priority: Higher goes first where tasks wait; no part of the key.
        again: Replaces an artefact that is stored already; no part of the key.
    """

    key: ArtefactKey
    arguments: Mapping[str, Any] = field(default_factory=dict)
    camera: str = ""
    round: int = 0
    threads: int = 1
    modules: tuple[str, ...] = ()
    memory_mb: int = 0
    priority: int = 0
    again: bool = False

    @property
    def label(self) -> str:
        """Stage, camera and round as one reads them."""
        return task_label(self.key.stage, self.camera, self.round)

    @property
    def file_stem(self) -> str:
        """Stage, camera and round as a file name."""
        parts = (self.key.stage, self.camera, str(self.round) if self.round else "")
        return "_".join(part for part in parts if part)

    def to_json(self, store: Path) -> dict[str, Any]:
        """The task as plain JSON values, with the store it is for."""
        return {**asdict(self), "store": str(store)}


def task_from_json(data: Mapping[str, Any]) -> tuple[Task, Path]:
    """Rebuild a task and the store's folder from `Task.to_json`."""
    values = {each.name: data[each.name] for each in fields(Task)}
    values |= {"key": ArtefactKey(**data["key"]), "modules": tuple(data["modules"])}
    return Task(**values), Path(data["store"])
