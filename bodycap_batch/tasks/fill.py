"""The task that poses the joints that no camera measured."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from bodycap_batch.core.context import StageContext
from bodycap_batch.model.fill_data import FillMode
from bodycap_batch.tasks.inputs import ArtefactRef
from bodycap_batch.tasks.stage import Stage, write_summary

_MEASURED_FLOORS = ("map", "feet")
"""Names of the methods of merging that measure the height of the floor. Other methods assume it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FillTask:
    """Pose the joints that no camera measured.

    The artefact holds the result of merging with the motion of all joints. Export, report and preview read it
    in place of the result of merging.

    Attributes:
        mode: How these joints are posed.
        merge: The result of merging.
    """

    mode: FillMode
    merge: ArtefactRef


def run_fill(task: FillTask, context: StageContext, files: Path) -> None:
    """Pose the joints and store the motion."""
    from bodycap_batch.fill import fill_motion
    from bodycap_batch.formats.dataclass_files import read_dataclass, write_dataclass
    from bodycap_batch.model.merge_data import MergeResult

    merged = read_dataclass(MergeResult, task.merge.path, "merge")
    filled = fill_motion(
        merged.motion,
        merged.solved,
        floor_is_measured=merged.report.floor.source in _MEASURED_FLOORS,
        mode=task.mode,
        context=context,
    )
    write_dataclass(replace(merged, motion=filled.motion, fill=filled.report), files, "merge")
    write_summary(files, filled=int(filled.report.filled.sum()))


FILL = Stage(
    name="fill",
    task=FillTask,
    function=run_fill,
    libraries=("numpy", "scipy"),
    modules=("bodycap_batch.fill", "scipy.signal", "scipy.spatial.transform"),
)
