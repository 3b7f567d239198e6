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
"""Folder of an artefact that holds the result files for the user."""
VISION_LIBRARIES = ("numpy", "av", "opencv-python-headless|opencv-python")
"""Python distributions that a stage needs to decode and process images."""
VISION_MODULES = ("bodycap_batch.capture", "bodycap_batch.config.models", "cv2", "av")
"""Modules that a stage loads to decode and process images."""
TaskT = TypeVar("TaskT")


@dataclass(frozen=True, slots=True, kw_only=True)
class Stage(Generic[TaskT]):
    """A stage, and what the runner needs to know to run its tasks.

    Attributes:
        name: Stage name.
        task: The dataclass that describes one task of the stage.
        function: Called in the child with the task, the context and the folder that becomes the artefact. The
            function's module and all modules that it imports from this package are the stage's algorithm. A
            digest of their code is part of the store's keys.
        libraries: Python distributions that the result depends on (``a|b``: a or b).
        modules: Modules that take long to load. A child process may load them before it gets a task.
        memory_mb: Memory (MB) to reserve for one task. Two large tasks therefore do not run at the same time
            on a small machine.
    """

    name: str
    task: type[TaskT]
    function: Callable[[TaskT, StageContext, Path], None]
    libraries: tuple[str, ...]
    modules: tuple[str, ...] = ()
    memory_mb: int = 500

    @property
    def module(self) -> str:
        """Name of the module with the stage's task, relative to this package (``tasks.keyframes``)."""
        return self.function.__module__.partition(".")[2]

    def run(self, arguments: Mapping[str, Any], context: StageContext, files: Path) -> None:
        """Run a task.

        Args:
            arguments: The task as JSON values, from `to_json`.
            context: The stage's context.
            files: The folder that becomes the artefact.
        """
        self.function(from_json(self.task, arguments), context, files)


def read_summary(artefact: Path) -> dict[str, Any]:
    """Read the summary of an artefact: the numbers and notes that the pipeline uses to continue the job."""
    return dict(json.loads((artefact / SUMMARY).read_text(encoding="utf-8")))


def write_summary(files: Path, **values: Any) -> None:
    """Write the summary of an artefact: the numbers and notes that the pipeline uses to continue the job."""
    (files / SUMMARY).write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
