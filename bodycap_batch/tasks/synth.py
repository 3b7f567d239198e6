"""The task that renders a synthetic capture."""

from __future__ import annotations

from pathlib import Path

from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.stage import CAPTURE, Json, Stage


def _synth(options: Json, _: Json, context: StageContext, files: Path) -> None:
    from bodycap_batch.synthetic import SynthOptions, synthesise

    synthesise(SynthOptions.model_validate(options), files / CAPTURE, context)


SYNTH = Stage(function=_synth, libraries=("numpy", "av", "open3d-cpu|open3d"))
