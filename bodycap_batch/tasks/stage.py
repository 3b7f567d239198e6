"""The description of a stage, and the helpers that the tasks of all stages use."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.typed_json import from_json

SUMMARY = "summary.json"
CAPTURE_FOLDER = "capture"
"""Folder of a synth artefact that holds the videos and the ground truth."""
RESULTS_FOLDER = "results"
"""Folder of an artefact that holds the files meant for the user."""
VISION_LIBRARIES = ("numpy", "av", "opencv-python-headless|opencv-python")
"""Distributions of a stage that decodes and processes images."""
VISION_MODULES = ("bodycap_batch.capture", "bodycap_batch.config.models", "cv2", "av")
"""Modules that such a stage loads."""
TaskT = TypeVar("TaskT")


@dataclass(frozen=True, slots=True, kw_only=True)
class Stage(Generic[TaskT]):
    """A stage, and how the runner treats its tasks.

    Attributes:
        name: Stage name.
        task: The dataclass that describes one task of the stage.
        function: Called in the child with the task, the context and the folder that becomes the artefact.
            Its module, with all that this imports from the package, is the stage's algorithm: a digest of
            their code is part of the store's keys.
        libraries: Distributions that the result depends on (``a|b``: either of them).
        modules: Modules that take long to load; a child may load them ahead.
        memory_mb: Memory to reserve for one task. It keeps two large tasks from running together on a small
            machine.
    """

    name: str
    task: type[TaskT]
    function: Callable[[TaskT, StageContext, Path], None]
    libraries: tuple[str, ...]
    modules: tuple[str, ...] = ()
    memory_mb: int = 500

    @property
    def module(self) -> str:
        """Module of the stage's task, below this package."""
        return self.function.__module__.partition(".")[2]

    def run(self, arguments: Mapping[str, Any], context: StageContext, files: Path) -> None:
        """Run a task whose arguments come from `to_json`; `files` is the folder that becomes the artefact."""
        self.function(from_json(self.task, arguments), context, files)


def read_summary(artefact: Path) -> dict[str, Any]:
    """Read the figures of an artefact that decide which task follows."""
    return dict(json.loads((artefact / SUMMARY).read_text(encoding="utf-8")))


def write_summary(files: Path, **values: Any) -> None:
    """Write the figures of an artefact that decide which task follows."""
    (files / SUMMARY).write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
