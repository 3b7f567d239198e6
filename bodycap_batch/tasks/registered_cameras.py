"""The stored registrations of all cameras, in the form that later stages use."""

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
"""Name of the file, without suffix, that holds the relative poses of a rig's cameras."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisteredCameras:
    """The registrations of all cameras, in the form that later stages use.

    Attributes:
        trajectories: The trajectory of each camera.
        clocks: The clock of each camera, by camera name.
        row_fraction: For each camera name, the (N,) result of `mean_row_fraction` for the camera's frames.
            Only cameras with a known rolling shutter are included, and only if their poses are not corrected
            for the rolling shutter.
    """

    trajectories: tuple[Trajectory, ...]
    clocks: Mapping[str, CameraClock]
    row_fraction: Mapping[str, FloatArray]

    @staticmethod
    def load(paths: Sequence[Path], maps: Sequence[Map]) -> RegisteredCameras:
        """Read the registrations of all cameras.

        Args:
            paths: The folder of each camera's registration artefact.
            maps: The maps. They name the cameras whose rolling shutter was corrected.
        """
        from bodycap_batch.formats.dataclass_files import read_dataclass
        from bodycap_batch.model.camera import Camera
        from bodycap_batch.model.merge_data import CameraClock
        from bodycap_batch.model.rolling_shutter import mean_row_fraction

        corrected = {name for each in maps for name in each.readout_s}
        trajectories: list[Trajectory] = []
        clocks: dict[str, CameraClock] = {}
        rows: dict[str, FloatArray] = {}
        for path in paths:
            # Only one registration is in memory at a time: the tracks of a long video need much memory.
            found = load_registration(path)
            name = found.trajectory.camera
            trajectories.append(found.trajectory)
            clocks[name] = read_dataclass(CameraClock, path, "clock")
            if clocks[name].rolling_shutter_s and name not in corrected:
                rows[name] = mean_row_fraction(found, read_dataclass(Camera, path, "camera"))
        return RegisteredCameras(trajectories=tuple(trajectories), clocks=clocks, row_fraction=rows)

    def relative_poses(
        self, paths: Sequence[Path], segments: Sequence[Sequence[str]]
    ) -> tuple[RelativePose, ...]:
        """Return the relative pose of every pair of cameras that are mounted on the same body segment.

        Args:
            paths: The folder of each camera's registration artefact. If a rig was solved, its artefacts hold
                relative poses that were estimated before. These stored poses are preferred.
            segments: For each body segment with several cameras, the names of these cameras.
        """
        from bodycap_batch.formats.dataclass_files import read_dataclass
        from bodycap_batch.model.relative_pose import RigPoses, estimate_relative_pose

        trajectory_of = {trajectory.camera: trajectory for trajectory in self.trajectories}
        stored = {
            relative.cameras: relative
            for path in paths
            if (path / f"{RIG_POSES}.json").exists()
            for relative in read_dataclass(RigPoses, path, RIG_POSES).relative
        }
        out = []
        for pair in (pair for names in segments for pair in combinations(sorted(names), 2)):
            offset_s = self.clocks[pair[1]].offset_s - self.clocks[pair[0]].offset_s
            first, second = (trajectory_of[name] for name in pair)
            out.append(stored.get(pair) or estimate_relative_pose(first, second, round(1e9 * offset_s)))
        return tuple(out)
