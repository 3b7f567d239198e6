"""The names of an artefact's folders, and its summary: what the tasks of all stages use."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

SUMMARY = "summary.json"
CAPTURE_FOLDER = "capture"
"""Name of the folder for the videos and the ground truth, in an artefact of the stage `synth`."""
RESULTS_FOLDER = "results"
"""Name of the folder for the result files for the user, in an artefact."""


def read_summary(artefact: Path) -> dict[str, Any]:
    """Read the summary of an artefact: the numbers and notes that the pipeline uses to continue the job."""
    return dict(json.loads((artefact / SUMMARY).read_text(encoding="utf-8")))


def write_summary(files: Path, **values: Any) -> None:
    """Write the summary of an artefact: the numbers and notes that the pipeline uses to continue the job."""
    (files / SUMMARY).write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
