"""The task that renders a synthetic capture."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from bodycap_batch.core.context import StageContext
from bodycap_batch.synthetic.options import SynthOptions
from bodycap_batch.tasks.inputs import FileRef
from bodycap_batch.tasks.stage import CAPTURE_FOLDER
from bodycap_batch.tasks.typed_json import omitted_from_key


@dataclass(frozen=True, slots=True, kw_only=True)
class SynthTask:
    """Render a synthetic capture.

    Attributes:
        options: The renderer's options.
        motion: The BVH file that the options name; None if they name no file.
        motion_name: Name of this BVH file, to be written to the ground truth; None without a file.
    """

    options: SynthOptions = field(metadata=omitted_from_key("motion"))
    motion: FileRef | None
    motion_name: str | None


def run_synth(task: SynthTask, context: StageContext, files: Path) -> None:
    """Render the synthetic capture and store it."""
    from bodycap_batch.synthetic import synthesise

    synthesise(task.options, files / CAPTURE_FOLDER, context)
