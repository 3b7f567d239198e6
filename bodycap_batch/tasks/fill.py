"""The task that poses the joints that no camera measured."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bodycap_batch.core.context import StageContext
from bodycap_batch.formats.dataclass_files import write_dataclass
from bodycap_batch.model.fill_data import FillMode
from bodycap_batch.model.merge_data import MergeResult
from bodycap_batch.tasks.inputs import ArtefactRef
from bodycap_batch.tasks.motion import MOTION_NAME, load_motion
from bodycap_batch.tasks.stage import write_summary

if TYPE_CHECKING:
    from bodycap_batch.fill.standing_height import HeightSigmas

_MEASURED_FLOORS = ("map", "feet")
"""Names of the methods of merging that measure the height of the floor. Other methods assume it."""
_FLOOR_SIGMA_M = 0.01
"""Standard deviation (metres) of a measured floor. Derivation: a third of the thickness of the slab of points
in which merging finds it."""


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

    merged = load_motion(task.merge)
    filled = fill_motion(
        merged.motion,
        merged.solved,
        heights=_heights(merged),
        mode=task.mode,
        context=context,
    )
    write_dataclass(replace(merged, motion=filled.motion, fill=filled.report), files, MOTION_NAME)
    write_summary(files, filled=int(filled.report.filled.sum()))


def _heights(merged: MergeResult) -> HeightSigmas:
    """Return how exactly the heights of floor and pelvis are known.

    The height of the trunk over the floor has the errors of the scale and of the mount of its camera. Where
    the bones are scaled from the stature, the pelvis takes up the error. Bones that were measured keep their
    lengths, so that the floor takes it up.
    """
    from bodycap_batch.fill.standing_height import HeightSigmas

    scale = merged.report.scale
    trunk = merged.skeleton.roles[int(np.argmax(merged.solved))]
    mount_m = min((mount.sigma_m for mount in merged.mounts if mount.role == trunk), default=0.0)
    trunk_m = float(np.hypot(scale.relative_sigma * (scale.trunk_over_floor_m or 0.0), mount_m))
    floor_m = _FLOOR_SIGMA_M if merged.report.floor.source in _MEASURED_FLOORS else np.inf
    if any(source.name == "skeleton" for source in scale.sources):
        return HeightSigmas(float(np.hypot(floor_m, trunk_m)), 0.0)
    return HeightSigmas(floor_m, trunk_m)
