"""What a stage is to the runner, and what every stage's task uses."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bodycap_batch.core.context import StageContext

SUMMARY = "summary.json"
CAPTURE = "capture"
"""Folder of a synth artefact that holds the videos and the truth."""
RESULTS = "results"
"""Folder of an export artefact that holds what goes to the user."""
VISION = ("numpy", "av", "opencv-python-headless|opencv-python")
"""Distributions of a stage that looks at pictures."""
SEEING = ("bodycap_batch.capture", "bodycap_batch.config.models", "cv2", "av")
"""Modules that such a stage loads."""
Json = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Stage:
    """A stage as the runner sees it.

    Attributes:
        function: Called in the child with options, arguments, context and the artefact's folder. The module
            it stands in, with all that this imports from here, is the stage's algorithm: it is part of
            the store's keys.
        libraries: Distributions the result depends on (``a|b``: either).
        modules: What takes long to load; a child may load it ahead.
        memory_mb: Memory to keep free for one task, so that two large ones don't meet on a small machine.
    """

    function: Callable[[Json, Json, StageContext, Path], None]
    libraries: tuple[str, ...]
    modules: tuple[str, ...] = ()
    memory_mb: int = 500

    @property
    def code(self) -> str:
        """Module of the stage's task, below this package."""
        return self.function.__module__.partition(".")[2]


def read_summary(artefact: Path) -> dict[str, Any]:
    """The few figures of an artefact that decide what is done next."""
    return dict(json.loads((artefact / SUMMARY).read_text(encoding="utf-8")))


def write_summary(files: Path, **values: Any) -> None:
    """Write the few figures of an artefact that decide what is done next."""
    (files / SUMMARY).write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
