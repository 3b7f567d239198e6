"""The stored registrations of all cameras, in the form that later stages use."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.formats.dataclass_files import read_dataclass, write_dataclass
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.camera_clock import CameraClock, CaptureClocks, FrameTiming
from bodycap_batch.model.inertial_camera import InertialCamera
from bodycap_batch.model.relative_pose import RelativePose, estimate_relative_pose
from bodycap_batch.model.rolling_shutter import mean_row_fraction
from bodycap_batch.model.scene import FrameStatus, Map, OtherPaths, Registration, Trajectory
from bodycap_batch.tasks.loading import load_registration
from bodycap_batch.tasks.stage import write_summary

INERTIAL_CAMERA = "inertial"
"""Name of the file, without suffix, that holds what the inertial sensor of a camera gives."""
OTHER_PATHS = "other_paths"
"""Name of the file, without suffix, that holds the poses of a camera in other maps than that of its path."""


def replace_registration(found: Registration, before: Path, files: Path, **summary: Any) -> None:
    """Store poses in place of stored ones; the rest of the camera's registration stays as it is.

    Args:
        found: Poses and observations of the camera.
        before: Folder of the registration that is replaced.
        files: Folder of the artefact.
        summary: Further values of the summary.
    """
    write_dataclass(found, files, "registration")
    for name in ("timing", "camera", INERTIAL_CAMERA):
        for file in before.glob(f"{name}.*"):
            shutil.copyfile(file, files / file.name)
    write_summary(files, **registration_summary(found), **summary)


def registration_summary(found: Registration) -> dict[str, Any]:
    """Return the numbers of frames by their outcome, and the frames that should become keyframes."""
    path = found.trajectory
    return {
        "frames": len(path.status),
        "localised": int(path.localised.sum()),
        "rotations": int(path.rotation_only.sum()),
        "contradicted": path.status.count(FrameStatus.CONTRADICTED),
        "wanted": [int(frame) for frame in found.wanted_keyframes],
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisteredCameras:
    """The registrations of all cameras, in the form that later stages use.

    Attributes:
        trajectories: The trajectory of each camera.
        clocks: The clock of each camera, by camera name.
        row_fraction: For each camera name, the (N,) result of `mean_row_fraction` for the camera's frames.
            Only cameras with a known rolling shutter are included, and only if their poses are not corrected
            for the rolling shutter.
        inertial: By camera name, what the inertial sensor of the camera gives. Only cameras with telemetry
            have an entry.
        other_paths: The trajectories of lost frames in other maps than that of the camera's path.
    """

    trajectories: tuple[Trajectory, ...]
    clocks: Mapping[str, CameraClock]
    row_fraction: Mapping[str, FloatArray]
    inertial: Mapping[str, InertialCamera]
    other_paths: tuple[Trajectory, ...] = ()

    @staticmethod
    def load(paths: Sequence[Path], maps: Sequence[Map], clocks: CaptureClocks) -> RegisteredCameras:
        """Read the registrations of all cameras.

        Args:
            paths: The folder of each camera's registration artefact.
            maps: The maps. They name the cameras whose rolling shutter was corrected.
            clocks: The clocks of all cameras.
        """
        corrected = {name for each in maps for name in each.readout_s}
        trajectories: list[Trajectory] = []
        timings: dict[str, FrameTiming] = {}
        rows: dict[str, FloatArray] = {}
        inertial: dict[str, InertialCamera] = {}
        other_paths: list[Trajectory] = []
        for path in paths:
            # Only one registration is in memory at a time: the tracks of a long video need much memory.
            found = load_registration(path)
            name = found.trajectory.camera
            trajectories.append(found.trajectory)
            timings[name] = read_dataclass(FrameTiming, path, "timing")
            if timings[name].rolling_shutter_s and name not in corrected:
                rows[name] = mean_row_fraction(found, read_dataclass(Camera, path, "camera"))
            if (path / f"{INERTIAL_CAMERA}.json").exists():
                inertial[name] = read_dataclass(InertialCamera, path, INERTIAL_CAMERA)
            if (path / f"{OTHER_PATHS}.json").exists():
                other_paths += read_dataclass(OtherPaths, path, OTHER_PATHS).trajectories
        return RegisteredCameras(
            trajectories=tuple(trajectories),
            clocks=clocks.with_timing(timings),
            row_fraction=rows,
            inertial=inertial,
            other_paths=tuple(other_paths),
        )

    def relative_poses(self, segments: Sequence[Sequence[str]]) -> tuple[RelativePose, ...]:
        """Return the relative pose of every pair of cameras that are mounted on the same body segment.

        Args:
            segments: For each body segment with several cameras, the names of these cameras.

        Returns:
            The relative poses. A pair with an unknown clock has none.
        """
        trajectory_of = {path.camera: self._camera_path(path) for path in self.trajectories}
        out = []
        for pair in (pair for names in segments for pair in combinations(sorted(names), 2)):
            if all(self.clocks[name].is_known for name in pair):
                first, second = (self._on_common_clock(trajectory_of[name]) for name in pair)
                out.append(estimate_relative_pose(first, second, 0))
        return tuple(out)

    def _camera_path(self, trajectory: Trajectory) -> Trajectory:
        """Return a trajectory in the axes of the camera instead of those of stabilised pictures."""
        sensor = self.inertial.get(trajectory.camera)
        return trajectory if sensor is None or sensor.turns is None else sensor.turns.camera_path(trajectory)

    def _on_common_clock(self, trajectory: Trajectory) -> Trajectory:
        """Return a trajectory with common times instead of the camera's times."""
        return replace(trajectory, times_ns=self.clocks[trajectory.camera].common_ns(trajectory.times_ns))
