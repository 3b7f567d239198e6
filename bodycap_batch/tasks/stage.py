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
"""Name of the folder for the videos and the ground truth, in an artefact of the stage `synth`."""
RESULTS_FOLDER = "results"
"""Name of the folder for the result files for the user, in an artefact."""
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
        function: Function that runs a task in the child process. Its arguments are the task, the context and
            the folder that becomes the artefact. The stage's algorithm is the code of the function's module
            and of all modules of this package that this module imports. A digest of this code is part of the
            artefact's key.
        libraries: Python distributions that the result depends on. An entry ``a|b`` means that either a or b
            is installed.
        modules: Modules that take long to load. A child process may load them before it gets a task.
        memory_mb: Memory (MB) to reserve for one task. The reservation keeps two large tasks from running at
            the same time on a small machine.
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
