"""The inputs of the export stage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.camera_clock import CameraClock
from bodycap_batch.model.inertial_camera import InertialCamera
from bodycap_batch.model.merge_data import MergeResult
from bodycap_batch.model.relative_pose import RelativePose
from bodycap_batch.model.scene import KeyframeSelection, Map, Trajectory
from bodycap_batch.model.take import Timecode


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoFacts:
    """What the files for 3D programs state about the video of a camera.

    Attributes:
        width_px: Width of the shown pictures.
        height_px: Height of the shown pictures.
        timecode: Timecode of the first frame of the file; None if the file has none.
        first_frame_ns: Time of the first frame of the file on the clock of the camera, nanoseconds.
    """

    width_px: int
    height_px: int
    timecode: Timecode | None = None
    first_frame_ns: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportInputs:
    """The results of all earlier stages of a job.

    Attributes:
        out_dir: Folder for the result files. The folder is created if it does not exist.
        maps: The maps, largest first, each in its own gauge.
        trajectories: One trajectory for each camera, in the gauge of the camera's map.
        other_paths: Trajectories of lost frames in other maps than the map of the camera's trajectory.
        clocks: The clock of each camera, by camera name.
        reference_camera: Name of the camera to which clock offsets are relative; "" if they are relative to
            the common clock.
        selections: One keyframe selection for each camera.
        merge: The result of merging, with the body in the world; None for ``skeleton: none``, or if merging
            failed.
        partial_reason: The reason for a missing body, if the job asks for a body; None otherwise.
        row_fraction: (N,) mean image row of the observations of each pose, as a fraction of the image height,
            by camera name. It is used to correct times for a rolling shutter. For a camera without an entry
            the fraction is 0.5.
        relative_poses: Relative poses of cameras on the same segment, in the unit of the gauge of both
            cameras.
        inertial: What the inertial sensor of each camera gives, by camera name. Only cameras with telemetry
            have an entry.
        take: Name of the take; "" if it is unknown.
        videos: What is known about the video of each camera, by camera name. Without an entry, the picture
            has the work size, and there is no timecode.
        log: Diagnostics of mapping as plain JSON values without run times and file paths. They are written to
            ``metrics.json``.
    """

    out_dir: Path
    maps: tuple[Map, ...]
    trajectories: tuple[Trajectory, ...]
    clocks: Mapping[str, CameraClock]
    reference_camera: str = ""
    selections: tuple[KeyframeSelection, ...] = ()
    merge: MergeResult | None = None
    partial_reason: str | None = None
    row_fraction: Mapping[str, FloatArray] = field(default_factory=dict)
    relative_poses: tuple[RelativePose, ...] = ()
    inertial: Mapping[str, InertialCamera] = field(default_factory=dict)
    other_paths: tuple[Trajectory, ...] = ()
    take: str = ""
    videos: Mapping[str, VideoFacts] = field(default_factory=dict)
    log: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        missing = [path.camera for path in self.trajectories if path.camera not in self.clocks]
        if missing:
            raise ValueError(f"no clock for {', '.join(missing)}")
