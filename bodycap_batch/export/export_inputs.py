"""The inputs of the export stage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.merge_data import CameraClock, MergeResult
from bodycap_batch.model.relative_pose import RelativePose
from bodycap_batch.model.scene import KeyframeSelection, Map, Trajectory


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportInputs:
    """The results of all earlier stages of a job.

    Attributes:
        out_dir: Folder for the files; it is created if it does not exist.
        maps: The maps, largest first, each in its own gauge.
        trajectories: One per camera, in the gauge of its map.
        clocks: The clock of each camera, by name.
        selections: Keyframe selections, one per camera.
        merge: The body in the world; None for ``skeleton: none``, or if merging failed.
        partial_reason: Why there is no body although the job asks for one; None otherwise.
        row_fraction: By camera, (N,) mean image row of the observations behind each pose, as a fraction of
            the image height. It corrects times for a rolling shutter. A camera without an entry has 0.5.
        relative_poses: Relative poses of cameras on one segment, in the unit of the gauge of both cameras.
        log: Diagnostics of mapping as plain JSON values without times and paths; they are written to
            ``metrics.json``.
    """

    out_dir: Path
    maps: tuple[Map, ...]
    trajectories: tuple[Trajectory, ...]
    clocks: Mapping[str, CameraClock]
    selections: tuple[KeyframeSelection, ...] = ()
    merge: MergeResult | None = None
    partial_reason: str | None = None
    row_fraction: Mapping[str, FloatArray] = field(default_factory=dict)
    relative_poses: tuple[RelativePose, ...] = ()
    log: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        missing = [path.camera for path in self.trajectories if path.camera not in self.clocks]
        if missing:
            raise ValueError(f"no clock for {', '.join(missing)}")
