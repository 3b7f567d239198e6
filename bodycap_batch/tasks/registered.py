"""What registration left of all cameras, as the stages after it take it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

from bodycap_batch.tasks.loading import load_registration

if TYPE_CHECKING:
    from bodycap_batch.core.arrays import FloatArray
    from bodycap_batch.model.merge_data import CameraClock
    from bodycap_batch.model.relative_pose import RelativePose
    from bodycap_batch.model.scene import Map, Trajectory

RIG_POSES = "rig"
"""Name of the bundle that says where a rig's cameras sit beside each other."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Registered:
    """What registration left of all cameras.

    Attributes:
        trajectories: One per camera.
        clocks: By camera.
        row_fraction: By camera whose rolling shutter is still in its poses: see `mean_row_fraction`.
    """

    trajectories: tuple[Trajectory, ...]
    clocks: Mapping[str, CameraClock]
    row_fraction: Mapping[str, FloatArray]

    @staticmethod
    def load(paths: Sequence[Path], maps: Sequence[Map]) -> Registered:
        """Read one artefact per camera; rows matter where a rolling shutter is still in the poses."""
        from bodycap_batch.formats.dataclass_files import read_dataclass
        from bodycap_batch.model.camera import Camera
        from bodycap_batch.model.merge_data import CameraClock
        from bodycap_batch.model.rolling_shutter import mean_row_fraction

        corrected = {name for each in maps for name in each.readout_s}
        trajectories: list[Trajectory] = []
        clocks: dict[str, CameraClock] = {}
        rows: dict[str, FloatArray] = {}
        for path in paths:
            # One at a time: what was tracked in a long video takes most of an artefact's memory.
            found = load_registration(path)
            name = found.trajectory.camera
            trajectories.append(found.trajectory)
            clocks[name] = read_dataclass(CameraClock, path, "clock")
            if clocks[name].rolling_shutter_s and name not in corrected:
                rows[name] = mean_row_fraction(found, read_dataclass(Camera, path, "camera"))
        return Registered(trajectories=tuple(trajectories), clocks=clocks, row_fraction=rows)

    def relative_poses(
        self, paths: Sequence[Path], segments: Sequence[Sequence[str]]
    ) -> tuple[RelativePose, ...]:
        """Where cameras on one segment sit beside each other, every pair once.

        Args:
            paths: The artefacts; those of a rig kept how its cameras' own poses lay.
            segments: Names of the cameras on each segment that carries several.
        """
        from bodycap_batch.formats.dataclass_files import read_dataclass
        from bodycap_batch.model.relative_pose import RigPoses, estimate_relative_pose

        path_of = {each.camera: each for each in self.trajectories}
        kept = {
            each.cameras: each
            for path in paths
            if (path / f"{RIG_POSES}.json").exists()
            for each in read_dataclass(RigPoses, path, RIG_POSES).relative
        }
        out = []
        for pair in (pair for names in segments for pair in combinations(sorted(names), 2)):
            offset_s = self.clocks[pair[1]].offset_s - self.clocks[pair[0]].offset_s
            first, second = (path_of[name] for name in pair)
            out.append(kept.get(pair) or estimate_relative_pose(first, second, round(1e9 * offset_s)))
        return tuple(out)
