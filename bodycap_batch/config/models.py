"""The typed job: the capture, the body, and one block of options per stage."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Discriminator, Field, Tag

from bodycap_batch.config.body_height import MAX_HEIGHT_M, MIN_HEIGHT_M, height_from_text
from bodycap_batch.config.bounds import (
    MAX_ANGLE_DEG,
    MAX_DRIFT_PPM,
    MAX_REACH_M,
    MAX_ROLLING_SHUTTER_S,
    MAX_TIME_S,
    MIN_SIGMA_DEG,
    MIN_SIGMA_M,
)
from bodycap_batch.config.calibration import Calibration
from bodycap_batch.config.lens_profiles import NAME_SEPARATOR, profiles_named
from bodycap_batch.config.mounts import NOT_WORN, mount_of, reference_index, role_of_segment
from bodycap_batch.config.options import (
    ExportOptions,
    KeyframeOptions,
    MapOptions,
    MergeOptions,
    Options,
    RegistrationOptions,
    TelemetryOptions,
)
from bodycap_batch.config.requirement import valid_requirement
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import JobError
from bodycap_batch.model.fill_data import FillMode
from bodycap_batch.model.geometry import make_transform, rotation_from_quat_xyzw

NO_SKELETON = "none"
"""Value of ``skeleton`` for a job that computes the camera paths and the map, but no body."""
AUTO_SKELETON = "auto"
"""Value of ``skeleton`` for a standard body, of which the parts with cameras are solved."""
SKELETON_PRESETS = (NO_SKELETON, AUTO_SKELETON, "full_body", "upper_body")
"""Values of ``skeleton`` that are no file. ``auto`` solves the limbs that have cameras. ``upper_body`` is its
former name, which stays valid."""
_MAX_ROTATION = 10.0
"""Maximum absolute value (no unit) of a component of a rotation that the job gives, as a quaternion or as a
matrix. The bound keeps products finite; `rules` checks that the components are a rotation. Evidence: none."""
MAX_NAME_LENGTH = 100
"""Maximum number of characters of a job's name. The name of a folder that names a job is shortened to it.
Evidence: none."""
_MAX_FRAME = 10**8
"""Maximum number of a frame of a skeleton file: a day of motion at the maximum rate has 86 million frames."""


def _calibration_kind(value: object) -> str:
    if isinstance(value, dict | Calibration):
        return "inline"
    if isinstance(value, str) and NAME_SEPARATOR in value:
        return "lens"
    return "auto" if value == "auto" else "file"


def _known_lens(name: str) -> str:
    """Return the name of a lens. Raises `ValueError` if the table of lens profiles does not have it."""
    profiles_named(name)
    return name


def _pose_kind(value: object) -> str:
    return "matrix" if isinstance(value, list | tuple) else "parts"


def _height(value: object) -> object:
    """Return a height in metres for a text or for a number of centimetres; else the value unchanged."""
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        return value
    if isinstance(value, str) or value >= 100.0 * MIN_HEIGHT_M:
        try:
            return height_from_text(value)
        except JobError as error:
            raise ValueError(error.message) from error
    return value


def _none_if_auto(value: object) -> object:
    return None if value == "auto" else value


def _as_tuple(value: object) -> object:
    """Return a tuple for a single path and for a list of paths; else the value unchanged."""
    return (value,) if isinstance(value, str) else tuple(value) if isinstance(value, list) else value


AnyCalibration = Annotated[
    Annotated[Calibration, Tag("inline")]
    | Annotated[Literal["auto"], Tag("auto")]
    | Annotated[str, AfterValidator(_known_lens), Tag("lens")]
    | Annotated[Path, Tag("file")],
    Discriminator(_calibration_kind),
]
Seconds = Annotated[float, Field(ge=-MAX_TIME_S, le=MAX_TIME_S)]
_Drift = Annotated[float, Field(ge=-MAX_DRIFT_PPM, le=MAX_DRIFT_PPM)]
_Component = Annotated[float, Field(ge=-_MAX_ROTATION, le=_MAX_ROTATION)]
_Metres = Annotated[float, Field(ge=-MAX_REACH_M, le=MAX_REACH_M)]
_Paths = Annotated[tuple[Path, ...], BeforeValidator(_as_tuple)]
Row = tuple[_Component, _Component, _Component, _Metres]
Activity = Literal["walk", "generic"]


class MountPose(Options):
    """Pose of a camera relative to the joint of its bone: x_in_joint = rotation · x_in_cam + translation."""

    translation_m: tuple[_Metres, _Metres, _Metres]
    quat_xyzw: tuple[_Component, _Component, _Component, _Component]


AnyPose = Annotated[
    Annotated[MountPose, Tag("parts")] | Annotated[tuple[Row, Row, Row, Row], Tag("matrix")],
    Discriminator(_pose_kind),
]


_FILE_FIELDS = ("video", "timestamps", "calibration", "samples", "mask")
"""Names of the fields of a camera that hold paths."""


class CameraConfig(Options):
    """One camera of the capture. Loaded jobs hold absolute paths and list all chapters and sidecar files."""

    name: str = Field(max_length=64, description="name of the camera; the camera's results have this name")
    video: _Paths = Field(
        min_length=1, description="a video file, a folder of chapters, or a list of chapters"
    )
    mount: str | None = Field(
        None,
        description="place of the camera on the body, or none for a camera that nobody wears, for example on "
        "a tripod; default: the place that the camera's name contains",
    )
    mount_source: Literal["motion"] | None = Field(
        None,
        description="motion: a run found the place `mount` from the motion of the cameras; a run writes this "
        "into the job.yaml of its results",
    )
    segment: str | None = Field(
        None, description="bone on which the camera is mounted, if no mount name describes its place"
    )
    joint_from_cam: AnyPose | None = Field(
        None,
        description="measured pose of the camera on its bone: a 4x4 matrix, or translation_m and quat_xyzw",
    )
    sigma_deg: float | None = Field(
        None,
        ge=MIN_SIGMA_DEG,
        le=MAX_ANGLE_DEG,
        description="standard deviation of the mount's rotation, in degrees",
    )
    sigma_m: float | None = Field(
        None,
        ge=MIN_SIGMA_M,
        le=MAX_REACH_M,
        description="standard deviation of the mount's position, in metres",
    )
    calibration: AnyCalibration | None = Field(
        None,
        description="a block with the calibration, the path of a calib.json, the name of a lens "
        "(`bodycap lenses`), or auto; default: the calibration of the capture",
    )
    fov_deg: float | None = Field(
        None,
        gt=10,
        lt=170,
        description="field of view along the long side of the picture, in degrees; `calibration: "
        "auto` starts from this value",
    )
    timestamps: _Paths = Field(
        (),
        description="file with one time for each frame, in seconds (other units are recognised); one file "
        "for all chapters, or one file for each chapter",
    )
    samples: Path | None = Field(
        None,
        description="file with the samples of an inertial sensor (.imu.csv or .gcsv); default: the one "
        "beside the video, with the name of the video or of the camera",
    )
    mask: Path | None = Field(
        None,
        description="PNG picture with the aspect ratio of the video: white where the room is visible, "
        "black where the wearer is visible",
    )
    stabilised: bool | None = Field(
        None,
        description="true: the camera stabilised the video by turning its pictures; false: it did not; "
        "default: what the file and its telemetry show",
    )
    offset_s: Annotated[Seconds | None, BeforeValidator(_none_if_auto)] = Field(
        None,
        description="offset of the camera's clock in seconds: common time = camera time · (1 + drift_ppm · "
        "1e-6) + offset_s; default: auto, which means estimated from the sound or from the motion",
    )
    drift_ppm: Annotated[_Drift | None, BeforeValidator(_none_if_auto)] = Field(
        None,
        description="drift of the camera's clock in parts per million; default: auto, which means estimated "
        "if the recording is long enough, else 0",
    )
    rolling_shutter_s: float | None = Field(
        None,
        ge=-MAX_ROLLING_SHUTTER_S,
        le=MAX_ROLLING_SHUTTER_S,
        description=(
            "time in seconds from the exposure of the first row to the exposure of the last row; "
            "default: estimated from the video"
        ),
    )

    @property
    def role(self) -> str | None:
        """Role of the bone that the camera is mounted on (``LeftHand``); None if it is unknown or none."""
        if self.segment is not None:
            return role_of_segment(self.segment)
        found = mount_of(self.mount or self.name)
        return None if found is None else found[1]

    @property
    def is_worn(self) -> bool:
        """False for a camera that nobody wears. Its path is solved, and the body never uses it."""
        return self.mount != NOT_WORN

    def mount_matrix(self) -> FloatArray | None:
        """Return `joint_from_cam` as a (4,4) transform, in metres; None if the job does not give it."""
        pose = self.joint_from_cam
        if isinstance(pose, MountPose):
            return make_transform(rotation_from_quat_xyzw(pose.quat_xyzw), pose.translation_m)
        return None if pose is None else np.array(pose, dtype=np.float64)

    def files(self) -> Iterator[tuple[str, Path]]:
        """Yield the name of the field and the path of each file or folder that the camera names."""
        for field in _FILE_FIELDS:
            value = getattr(self, field)
            paths = value if isinstance(value, tuple) else (value,)
            yield from ((field, path) for path in paths if isinstance(path, Path))

    def with_paths(self, change: Callable[[Path], Path]) -> CameraConfig:
        """Return the camera with each of its paths replaced by `change(path)`."""
        update: dict[str, Path | tuple[Path, ...]] = {}
        for field in _FILE_FIELDS:
            value = getattr(self, field)
            if isinstance(value, Path):
                update[field] = change(value)
            elif isinstance(value, tuple):
                update[field] = tuple(map(change, value))
        return self.model_copy(update=update)

    def input_files(self) -> tuple[Path, ...]:
        """Return the files that the camera's frames and times depend on."""
        return (*self.video, *self.timestamps, *(() if self.mask is None else (self.mask,)))


class CaptureConfig(Options):
    """The videos of one recording."""

    cameras: tuple[CameraConfig, ...] = Field(
        min_length=1,
        max_length=64,
        description="the cameras, as a list of blocks: - {name: torso, video: torso.mp4}",
    )
    cameras_only: bool = Field(
        False, description="true: no other cameras; default: videos beside a job.yaml become cameras, too"
    )
    calibration: AnyCalibration | None = Field(
        None,
        description="calibration of every camera that has no calibration of its own",
    )
    places: tuple[str, ...] = Field(
        (),
        max_length=64,
        description="the places on the body where the cameras were, in any order, if it is unknown which "
        "camera was where: [torso, left_palm, right_palm]; the run finds the place of each camera from the "
        "motion, or says that the motion does not show it",
    )
    rig: Literal["free", "synced"] = Field(
        "free",
        description="synced: one hardware trigger exposes the cameras on one segment, so they have one clock",
    )
    clocks: Literal["auto", "common"] = Field(
        "auto",
        description="common: the clocks of all cameras agree, except for stated offsets; auto: clocks that "
        "are not stated are estimated",
    )
    start_s: Seconds | None = Field(None, description="first moment to use, in seconds on the common clock")
    end_s: Seconds | None = Field(None, description="last moment to use, in seconds on the common clock")
    work_px: int = Field(
        960,
        ge=160,
        le=8192,
        description="larger frames are reduced until their long side has this number of pixels",
    )
    synthetic: dict[str, Any] | None = Field(
        None,
        description="options of `bodycap synth`; if given, the videos are rendered when the job runs "
        "for the first time",
    )

    def reference_camera(self) -> CameraConfig:
        """Return the camera whose clock is the common clock, unless another offset is stated for it.

        It is the torso's camera; without one, the first camera.
        """
        return self.cameras[reference_index([camera.role for camera in self.cameras])]

    def worn(self) -> tuple[CameraConfig, ...]:
        """Return the cameras that are on the body."""
        return tuple(camera for camera in self.cameras if camera.is_worn)

    def unplaced(self) -> tuple[CameraConfig, ...]:
        """Return the cameras whose place the run finds from the motion."""
        return tuple(camera for camera in self.worn() if self.places and camera.role is None)

    def segments(self) -> list[list[CameraConfig]]:
        """Return the cameras of each body segment on which two or more cameras are mounted."""
        by_role: dict[str, list[CameraConfig]] = {}
        for camera in self.cameras:
            if camera.role is not None:
                by_role.setdefault(camera.role, []).append(camera)
        return [cameras for cameras in by_role.values() if len(cameras) > 1]


class Job(Options):
    """A job: everything that a run needs. Without named cameras, the videos in the job's folder are used."""

    capture: CaptureConfig
    name: str = Field(
        "",
        max_length=MAX_NAME_LENGTH,
        description="name of the job and its results; default: the name of the job file or the folder",
    )
    out: Path | None = Field(
        None,
        description="folder for the results; default: out/<name> beside the job file or the folder of videos",
    )
    skeleton: str | None = Field(
        None,
        description="auto (the parts of the body that have cameras), full_body, none, or a BVH file; "
        "default: auto, or none if all cameras are on one bone",
    )
    skeleton_map: dict[str, str] = Field(
        default_factory=dict,
        description="roles of joints in the skeleton file, by joint name; a role given here replaces the "
        "role that the program finds from the names and the tree",
    )
    tpose_frame: int | None = Field(
        None,
        ge=0,
        le=_MAX_FRAME,
        description=(
            "number of the frame with the T-pose in the skeleton file (the first frame is 0), if "
            "the zero pose is no pose of a body; default: the frame nearest to a T-pose"
        ),
    )
    height_m: Annotated[float | None, BeforeValidator(_height)] = Field(
        None,
        ge=MIN_HEIGHT_M,
        le=MAX_HEIGHT_M,
        description="the subject's body height in metres, for example 1.75; 175 and 5'9 are understood, too",
    )
    require: Annotated[str, AfterValidator(valid_requirement)] | None = Field(
        None,
        description="grade (good, usable or poor) and share of the recording that the result must reach, for "
        "example good,0.9; a run that does not reach them writes all results and ends with exit code 6",
    )
    activity: Activity = Field("generic", description="what the subject does; walk: the subject only walks")
    keyframes: KeyframeOptions = KeyframeOptions()
    map: MapOptions = MapOptions()
    registration: RegistrationOptions = RegistrationOptions()
    telemetry: TelemetryOptions = TelemetryOptions()
    merge: MergeOptions = MergeOptions()
    fill: FillMode = Field(
        "plausible",
        description="pose of joints that no camera measures; plausible: legs, pelvis and head move as fits "
        "the measured joints, rest: they are held in the rest pose, none: they are left out of the files",
    )
    export: ExportOptions = ExportOptions()

    def files(self) -> Iterator[tuple[tuple[str | int, ...], Path]]:
        """Yield the location in the job and the path of each file or folder that the job names."""
        if self.skeleton is not None and self.skeleton not in SKELETON_PRESETS:
            yield ("skeleton",), Path(self.skeleton)
        if isinstance(self.capture.calibration, Path):
            yield ("capture", "calibration"), self.capture.calibration
        for index, camera in enumerate(self.capture.cameras):
            yield from ((("capture", "cameras", index, field), path) for field, path in camera.files())

    def with_paths(self, change: Callable[[Path], Path]) -> Job:
        """Return a resolved job with each path replaced by `change(path)`, and without an output folder."""
        cameras = tuple(camera.with_paths(change) for camera in self.capture.cameras)
        capture = self.capture.model_copy(update={"cameras": cameras})
        skeleton = self.skeleton
        if skeleton is not None and skeleton not in SKELETON_PRESETS:
            skeleton = str(change(Path(skeleton)))
        return self.model_copy(update={"capture": capture, "skeleton": skeleton, "out": None})

    def with_places(self, places: Mapping[str, str]) -> Job:
        """Return the job in which each camera without a place has the place that was found from the motion.

        Args:
            places: The place of each of these cameras, by camera name.
        """
        unplaced = self.capture.unplaced()
        cameras = tuple(
            camera.model_copy(update={"mount": places[camera.name], "mount_source": "motion"})
            if camera in unplaced
            else camera
            for camera in self.capture.cameras
        )
        capture = self.capture.model_copy(update={"cameras": cameras, "places": ()})
        return self.model_copy(update={"capture": capture})
