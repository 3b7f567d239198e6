"""Read the motion of the skeleton that merging, or the filling after it, stored."""

from __future__ import annotations

from bodycap_batch.formats.dataclass_files import read_dataclass
from bodycap_batch.model.merge_data import MergeResult
from bodycap_batch.tasks.inputs import ArtefactRef

MOTION_NAME = "merge"
"""Name of the file, without suffix, that holds the motion."""


def load_motion(artefact: ArtefactRef) -> MergeResult:
    """Read the motion of the skeleton from an artefact."""
    return read_dataclass(MergeResult, artefact.path, MOTION_NAME)
