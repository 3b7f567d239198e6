"""The typed job: the capture, the body, and one block of options per stage."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag

from bodycap_batch.config.bounds import (
    MAX_ANGLE_DEG,
    MAX_REACH_M,
    MAX_ROLLING_SHUTTER_S,
    MAX_TIME_S,
    MIN_SIGMA_DEG,
    MIN_SIGMA_M,
)
from bodycap_batch.config.calibration import Calibration
from bodycap_batch.config.mounts import mount_of, role_of_segment
from bodycap_batch.config.options import (
    ExportOptions,
    KeyframeOptions,
    MapOptions,
    MergeOptions,
    RegistrationOptions,
)
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import make_transform, rotation_from_quat_xyzw

NO_SKELETON = "none"
"""Value of ``skeleton`` for a job that computes the camera paths and the map, but no body."""
SKELETON_PRESETS = (NO_SKELETON, "upper_body", "full_body")
_MAX_ROTATION = 10.0
"""Maximum absolute value (no unit) of a component of a rotation that the job gives, as a quaternion or as a
matrix. The bound keeps products finite; `rules` checks that the components are a rotation. Evidence: none."""
_MAX_FRAME = 10**8
"""Maximum number of a frame of a skeleton file: a day of motion at the maximum rate has 86 million frames."""


class _Block(BaseModel):
    """Base class of the job's blocks: immutable; unknown keys, NaN and infinity are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def _calibration_kind(value: object) -> str:
    if isinstance(value, dict | Calibration):
        return "inline"
    return "auto" if value == "auto" else "file"


def _pose_kind(value: object) -> str:
    return "matrix" if isinstance(value, list | tuple) else "parts"


AnyCalibration = Annotated[
    Annotated[Calibration, Tag("inline")]
    | Annotated[Literal["auto"], Tag("auto")]
    | Annotated[Path, Tag("file")],
    Discriminator(_calibration_kind),
]
Seconds = Annotated[float, Field(ge=-MAX_TIME_S, le=MAX_TIME_S)]
_Component = Annotated[float, Field(ge=-_MAX_ROTATION, le=_MAX_ROTATION)]
_Metres = Annotated[float, Field(ge=-MAX_REACH_M, le=MAX_REACH_M)]
Row = tuple[_Component, _Component, _Component, _Metres]
Activity = Literal["walk", "generic"]


class MountPose(_Block):
    """Pose of a camera relative to the joint of its bone: x_in_joint = rotation · x_in_cam + translation."""

    translation_m: tuple[_Metres, _Metres, _Metres]
    quat_xyzw: tuple[_Component, _Component, _Component, _Component]


AnyPose = Annotated[
    Annotated[MountPose, Tag("parts")] | Annotated[tuple[Row, Row, Row, Row], Tag("matrix")],
    Discriminator(_pose_kind),
]


class CameraConfig(_Block):
    """One camera of the capture. Loaded jobs hold absolute paths and list all chapters and sidecar files."""

    name: str = Field(max_length=64, description="names the camera's results")
    video: tuple[Path, ...] = Field(
        min_length=1, description="video file, folder of chapters, or list of chapters"
    )
    mount: str | None = Field(None, description="place on the body; default: from the camera's name")
    segment: str | None = Field(None, description="bone of the camera, if no mount name fits")
    joint_from_cam: AnyPose | None = Field(
        None, description="measured mount: 4x4 matrix, or translation_m and quat_xyzw"
    )
    sigma_deg: float | None = Field(
        None, ge=MIN_SIGMA_DEG, le=MAX_ANGLE_DEG, description="uncertainty of the mount's rotation"
    )
    sigma_m: float | None = Field(
        None, ge=MIN_SIGMA_M, le=MAX_REACH_M, description="uncertainty of the mount's position"
    )
    calibration: AnyCalibration | None = Field(
        None, description="inline block, path of a calib.json, or auto; default: the capture's"
    )
    fov_deg: float | None = Field(
        None, gt=10, lt=170, description="field of view along the long side: first guess of calibration: auto"
    )
    timestamps: tuple[Path, ...] = Field(
        (), description="sidecar with one time in seconds per frame (of all chapters, or one per chapter)"
    )
    mask: Path | None = Field(
        None, description="PNG in the video's shape, white where the room is seen, black over the wearer"
    )
    offset_s: Seconds | None = Field(None, description="common time = camera time + offset_s")
    rolling_shutter_s: float | None = Field(
        None,
        ge=-MAX_ROLLING_SHUTTER_S,
        le=MAX_ROLLING_SHUTTER_S,
        description="time from the first row's exposure to the last's; default: found from the video",
    )

    @property
    def role(self) -> str | None:
        """Role of the bone that the camera is mounted on (``LeftHand``); None if the role is unknown."""
        if self.segment is not None:
            return role_of_segment(self.segment)
        found = mount_of(self.mount or self.name)
        return None if found is None else found[1]

    def mount_matrix(self) -> FloatArray | None:
        """Return `joint_from_cam` as a (4,4) transform, in metres; None if the job does not give it."""
        pose = self.joint_from_cam
        if isinstance(pose, MountPose):
            return make_transform(rotation_from_quat_xyzw(pose.quat_xyzw), pose.translation_m)
        return None if pose is None else np.array(pose, dtype=np.float64)

    def input_files(self) -> tuple[Path, ...]:
        """Return the files that the camera's frames and times depend on."""
        return (*self.video, *self.timestamps, *(() if self.mask is None else (self.mask,)))


class CaptureConfig(_Block):
    """The videos of one recording."""

    cameras: tuple[CameraConfig, ...] = Field(
        min_length=1, max_length=64, description="a list of blocks: - {name: torso, video: torso.mp4}"
    )
    cameras_only: bool = Field(
        False, description="true: no other cameras; default: videos beside a job.yaml become cameras, too"
    )
    calibration: AnyCalibration | None = Field(
        None,
        description="calibration of every camera that does not give a calibration itself; "
        "default: the calib.json beside a job.yaml, else auto",
    )
    rig: Literal["free", "synced"] = Field(
        "free",
        description="synced: cameras on one segment are held rigidly and exposed by one hardware trigger",
    )
    start_s: Seconds | None = Field(None, description="first moment used, common clock")
    end_s: Seconds | None = Field(None, description="last moment used, common clock")
    work_px: int = Field(
        960, ge=160, le=8192, description="long side of the frames, pixels; larger frames are reduced to it"
    )
    synthetic: dict[str, Any] | None = Field(
        None, description="options of `bodycap synth`: the videos are rendered on first use"
    )

    def segments(self) -> list[list[CameraConfig]]:
        """Return the cameras of each body segment on which two or more cameras are mounted."""
        by_role: dict[str, list[CameraConfig]] = {}
        for camera in self.cameras:
            if camera.role is not None:
                by_role.setdefault(camera.role, []).append(camera)
        return [cameras for cameras in by_role.values() if len(cameras) > 1]


class Job(_Block):
    """A job: everything that a run needs. Without named cameras, the videos in the job's folder are used."""

    capture: CaptureConfig
    name: str = Field("", max_length=100, description="names the results; default: the file's or folder's")
    out: Path | None = Field(None, description="folder of the results; default out/<name>")
    skeleton: str | None = Field(
        None, description="none, upper_body, full_body or a BVH file; default upper_body, none for one camera"
    )
    skeleton_map: dict[str, str] = Field(
        default_factory=dict,
        description="role by joint name of a skeleton file; replaces the role found from the joint's name",
    )
    tpose_frame: int | None = Field(
        None,
        ge=0,
        le=_MAX_FRAME,
        description="frame of the skeleton file with the T-pose, if the zero pose is not a T-pose",
    )
    height_m: float | None = Field(
        None, ge=0.4, le=2.6, description="the subject's height in metres, e.g. 1.75"
    )
    activity: Activity = Field("generic", description="what the subject does")
    keyframes: KeyframeOptions = KeyframeOptions()
    map: MapOptions = MapOptions()
    registration: RegistrationOptions = RegistrationOptions()
    merge: MergeOptions = MergeOptions()
    export: ExportOptions = ExportOptions()
