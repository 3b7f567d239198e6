"""What the export stage works on."""

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
    """All results of a job, before they become files.

    Attributes:
        out_dir: Folder the files go into (created where missing).
        maps: The models, largest first, each in its own gauge.
        trajectories: One per camera, in the gauge of the map it was solved in.
        clocks: By camera name.
        selections: Keyframe selections, one per camera.
        merge: The body in the world; None for ``skeleton: none`` or when merging failed.
        partial_reason: Why there is no body although one was asked for.
        row_fraction: By camera, (N,) mean row of the observations behind each pose over the image height, for
            rolling shutters; a camera that is missing is taken at the middle row.
        relative_poses: Of cameras on one segment, in the unit of the gauge both were solved in.
        log: Plain JSON values about the map's making (no clocks, no paths), kept in ``metrics.json``.
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
        missing = [t.camera for t in self.trajectories if t.camera not in self.clocks]
        if missing:
            raise ValueError(f"no clock for {', '.join(missing)}")
