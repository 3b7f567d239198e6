"""The task that compares the sound of the cameras, and the clocks that follow."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from bodycap_batch.config.models import CaptureConfig
from bodycap_batch.core.context import StageContext
from bodycap_batch.formats.dataclass_files import read_dataclass, write_dataclass
from bodycap_batch.tasks.inputs import CaptureRef
from bodycap_batch.tasks.stage import write_summary

if TYPE_CHECKING:
    from bodycap_batch.clocks import SoundEvidence

SOUND_NAME = "sound"
"""Name of the file, without suffix, that holds what the sound says about the clocks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SoundTask:
    """Compare the sound of all pairs of cameras.

    Attributes:
        capture: The videos of all cameras.
    """

    capture: CaptureRef


def run_sound(task: SoundTask, context: StageContext, files: Path) -> None:
    """Compare the sound of all pairs of cameras, and store what it says about the clocks."""
    from bodycap_batch.clocks import measure_sound

    found = measure_sound(task.capture.config, context.threads)
    write_dataclass(found, files, SOUND_NAME)
    write_summary(files)


def load_sound(artefact: Path | None) -> SoundEvidence:
    """Read what the sound says about the clocks.

    Args:
        artefact: Folder of the artefact of the stage `sound`; None if there is only one camera.
    """
    from bodycap_batch.clocks import SoundEvidence

    return SoundEvidence() if artefact is None else read_dataclass(SoundEvidence, artefact, SOUND_NAME)


def known_from_sound(capture: CaptureConfig, artefact: Path | None) -> CaptureConfig:
    """Return a capture that states the clock offset of each camera whose clock is known before the map.

    Args:
        capture: The capture block of the job.
        artefact: Folder of the artefact of the stage `sound`; None if there is only one camera.
    """
    from bodycap_batch.clocks import combine_evidence, decide_clocks, with_known_offsets

    clocks = decide_clocks(capture, combine_evidence(capture, load_sound(artefact)))
    return with_known_offsets(capture, clocks)
