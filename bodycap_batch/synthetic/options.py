"""The options of a synthetic capture."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from bodycap_batch.config.bounds import (
    MAX_ANGLE_DEG,
    MAX_CAPTURE_S,
    MAX_FPS,
    MAX_LENS_PARAMETER,
    MAX_MOTION_FPS,
    MAX_REACH_M,
    MAX_ROLLING_SHUTTER_S,
    MAX_SEED,
    MIN_FPS,
)
from bodycap_batch.config.mounts import mount_of
from bodycap_batch.config.options import Options
from bodycap_batch.model.camera import CAMERA_MODELS, Camera, focal_count, parameter_count

_MAX_RATE_HZ = 2000.0
"""Maximum samples per second of an inertial sensor. Sensors of cameras have 100 to 1,600. Evidence: none."""
_MAX_DELAY_S = 1.0
"""Maximum delay of an inertial sensor, seconds. Evidence: none."""
_ERRORS = (
    *("gyro_noise_rad_s", "accelerometer_noise_m_s2", "gyro_bias_rad_s", "accelerometer_bias_m_s2"),
    *("turned_deg", "late_s"),
)
"""Options of `ImuOptions` that are 0 for a sensor without errors."""


class ImuOptions(Options):
    """Inertial sensors that are written beside the videos, by default those of a consumer's camera."""

    rate_hz: float = Field(200.0, ge=10.0, le=_MAX_RATE_HZ, description="samples per second")
    gyro_noise_rad_s: float = Field(
        0.004,
        ge=0,
        le=10,
        description="white noise of each sample of the gyroscope at 100 samples per second, in rad/s; at "
        "another rate it grows with the root of the rate",
    )
    accelerometer_noise_m_s2: float = Field(
        0.03, ge=0, le=100, description="the same of the accelerometer, in m/s²"
    )
    gyro_bias_rad_s: float = Field(
        0.01, ge=0, le=1, description="standard deviation of the gyroscope's bias, per axis, in rad/s"
    )
    accelerometer_bias_m_s2: float = Field(
        0.1, ge=0, le=10, description="standard deviation of the accelerometer's bias, per axis, in m/s²"
    )
    gyro_range_deg_s: float = Field(
        2000.0, gt=0, le=100_000, description="largest angular rate that the sensor measures, in degrees/s"
    )
    accelerometer_range_g: float = Field(
        16.0, gt=0, le=1000, description="largest acceleration that the sensor measures, in multiples of g"
    )
    turned_deg: float = Field(
        2.0, ge=0, le=MAX_ANGLE_DEG, description="angle between the sensor and the camera, in degrees"
    )
    late_s: float = Field(
        0.008,
        ge=-_MAX_DELAY_S,
        le=_MAX_DELAY_S,
        description="the sensor's time stamp of an instant is later than the camera's by this, in seconds",
    )


def imu_from_word(value: Any) -> Any:
    """Return the options for a word: ``true`` or ``consumer``, ``perfect``, ``false``."""
    if value is True or value == "consumer":
        return {}
    if value == "perfect":
        return dict.fromkeys(_ERRORS, 0.0)
    return None if value is False else value


_EARLIEST_S = 3.0
"""Maximum time (seconds) from the start of a camera to time 0 of the common clock. The built-in walk starts
even earlier."""
_MAX_SECONDS = 3600.0
"""Maximum length (seconds) of a synthetic video, and maximum delay of a camera. Evidence: none."""
_MAX_FRAMES = 432_000
"""Maximum number of frames of one camera, from the start of the first camera to the end of the last: four
hours at 30 frames per second. The true poses of all joints take about 1.4 GB for this number of frames."""
_FREE_OFFSET_S = 3.0
"""Maximum offset (seconds) of a clock that is drawn at random. It is not larger than `_EARLIEST_S`."""
_FREE_OFFSET_SHARE = 0.25
"""Maximum offset of a clock that is drawn at random, as a share of the length of the video. Origin: two
cameras then have at least half of their videos in common."""
_MAX_DRIFT_PPM = 1000.0
"""Maximum absolute drift (parts per million). Evidence: none."""
_MAX_SKEW_S = 1.0
"""Maximum absolute time (seconds) between sound and pictures. Evidence: none."""
_MAX_SOUND_S = 1200.0
"""Maximum length (seconds) of a video with sound. The sources of the sound take about 1 GB for this length.
"""
_DEFAULT_FOCAL_PX = 420.0
"""Focal length (px) of the default lens at an image width of 640 px. The horizontal angle of view is 75
degrees."""
_CROP_ZOOM = 1.25
"""Focal length of stabilised pictures divided by that of the lens: a tenth of the picture is cut off on each
side, as GoPro states of HyperSmooth."""
_DEFAULT_FOV_OMEGA_RAD = 0.8
"""Distortion parameter (radians) of the default lens for the camera model FOV. Evidence: none."""


_LensParameter = Annotated[float, Field(ge=-MAX_LENS_PARAMETER, le=MAX_LENS_PARAMETER)]
_Offset = Annotated[float, Field(ge=-_EARLIEST_S, le=_MAX_SECONDS)]
_Drift = Annotated[float, Field(ge=-_MAX_DRIFT_PPM, le=_MAX_DRIFT_PPM)]
_Skew = Annotated[float, Field(ge=-_MAX_SKEW_S, le=_MAX_SKEW_S)]
_Moment = Annotated[float, Field(ge=0, le=_MAX_SECONDS)]
_Rate = Annotated[float, Field(ge=MIN_FPS, le=MAX_FPS)]
_GapFrames = Annotated[int, Field(ge=1, le=_MAX_FRAMES)]


_MOTION = "the program does not change the motion of the BVH file"
_WALK = "only the simple walk can do it"
_VIDEO = "no videos are written"
_EXCLUSIVE = (
    *(
        (key, "motion", _MOTION)
        for key in ("t_pose_s", "on_the_spot", "still", "carried_s", "pressed_s", "walk")
    ),
    ("still", "on_the_spot", "both say how the person stands"),
    ("still", "walk", _WALK),
    ("carried_s", "walk", _WALK),
    ("sound", "poses_only", _VIDEO),
    ("stabilised", "poses_only", _VIDEO),
    ("bit_rate_mbps", "quality", "a lossless video has no given bit rate"),
    ("room", "bare", "bare surfaces differ from the others"),
)
"""Options that cannot be used together, and why."""
_NEEDED = (
    *(
        (key, "body_in_view", "it cannot be seen without body_in_view")
        for key in ("carried_s", "hand_in_view", "pressed_s", "clothes")
    ),
    *((key, "sound", "it has no effect without sound") for key in ("sound_skews_s", "sound_skew_range_s")),
    ("drifts_ppm", "clocks", "common clocks have no drift"),
    ("rates_fps", "poses_only", "videos have one rate"),
)
"""Options that need another one, and why."""


class SynthOptions(Options):
    """Options of a synthetic capture: a person walks with body cameras in a textured room."""

    seconds: float = Field(12.0, gt=0, le=_MAX_SECONDS, description="duration of each video, in seconds")
    fps: float = Field(30.0, ge=MIN_FPS, le=MAX_MOTION_FPS, description="frames per second of every camera")
    width: int = Field(640, ge=32, le=7680, multiple_of=2, description="image width in pixels (even)")
    height: int = Field(480, ge=32, le=4320, multiple_of=2, description="image height in pixels (even)")
    cameras: tuple[str, ...] = Field(
        ("torso", "left_palm", "right_palm"),
        min_length=1,
        description="mount names; each name adds one camera",
    )
    lens: str = Field("PINHOLE", description="COLMAP camera model of every camera")
    lens_params: tuple[_LensParameter, ...] | None = Field(
        None,
        max_length=16,
        description=(
            "parameters of the camera model in COLMAP's order, in pixels of the given image size, "
            "with COLMAP's pixel origin; default: a lens with a field of view of 75 degrees, the "
            "principal point in the middle and no distortion"
        ),
    )
    seed: int = Field(
        0,
        ge=0,
        le=MAX_SEED,
        description=(
            "seed of the random numbers for the body, the mounts, the walk, the textures and the noise"
        ),
    )
    subject_height_m: float = Field(
        1.75,
        ge=1.2,
        le=2.2,
        description=(
            "body height in metres of the person in the built-in walk, and in a BVH file in which no person "
            "has the size of the body in metres or centimetres"
        ),
    )
    walk: Literal["simple", "gait"] = Field(
        "simple",
        description=(
            "kind of the built-in walk; simple: laps with arms that reach out, whose feet slide; gait: walks "
            "with bends, turns, side and back steps and standing, whose feet stand still on the floor; the "
            "times of the steps are written to gt/contacts.json"
        ),
    )
    motion: Path | None = Field(
        None, description="BVH file with the motion to use instead of the built-in walk"
    )
    motion_start_s: float = Field(
        0.0,
        ge=0,
        le=MAX_CAPTURE_S,
        description="time in the BVH file at which the capture starts, in seconds",
    )
    t_pose_s: float = Field(
        0.0, ge=0, le=_MAX_SECONDS, description="duration of the T-pose before the built-in walk, in seconds"
    )
    proportion_range: float = Field(
        0.05,
        ge=0,
        lt=0.5,
        description="in the built-in walk, the bone lengths differ from a mean person by up to this ratio",
    )
    posture_spread: float = Field(
        0.0,
        ge=0,
        le=3,
        description="in the built-in walk, the posture is random; 1: varies as much as between people, 0: "
        "the mean posture of people",
    )
    mount_sigma_deg: float = Field(
        15.0,
        ge=0,
        le=MAX_ANGLE_DEG,
        description=(
            "standard deviation of the rotation between the true and the nominal mount, in degrees,"
            " for all three axes together"
        ),
    )
    mount_sigma_m: float = Field(
        0.05,
        ge=0,
        le=MAX_REACH_M,
        description=(
            "standard deviation of the distance between the true and the nominal mount, in metres, "
            "for all three axes together"
        ),
    )
    noise: float = Field(
        2.0,
        ge=0,
        le=50,
        description="standard deviation of the image noise at medium grey, in grey levels from 0 to 255",
    )
    auto_exposure: float = Field(
        0.0,
        ge=0,
        le=1,
        description=(
            "how far the brightness follows the mean of the pictures, with a delay of half a second; 1: the "
            "mean becomes medium grey, 0: the brightness is constant; noise grows with the gain"
        ),
    )
    exposure_s: float = Field(
        0.0,
        ge=0,
        le=1,
        description=(
            "exposure time in seconds, which causes motion blur; the timestamp is the middle of the exposure"
        ),
    )
    rolling_shutter_s: float = Field(
        0.0,
        ge=0,
        le=MAX_ROLLING_SHUTTER_S,
        description="time in seconds from the exposure of the first row to the exposure of the last row",
    )
    offsets_s: Mapping[str, _Offset] = Field(
        default_factory=dict,
        description="clock offset of each camera in seconds: common time = camera time + offset",
    )
    clocks: Literal["common", "free"] = Field(
        "common",
        description=(
            "free: each camera has a clock of its own, with a random offset of up to 3 s or a quarter of "
            "seconds, and a random drift of up to 50 ppm; the torso's camera, or else the first camera, "
            "gives the common time; the clocks are only written to gt/clocks.json"
        ),
    )
    drifts_ppm: Mapping[str, _Drift] = Field(
        default_factory=dict,
        description=(
            "with free clocks: drift of each camera's clock in parts per million instead of a random drift: "
            "common time = camera time × (1 + drift / 1,000,000) + offset"
        ),
    )
    sound: bool = Field(
        False,
        description=(
            "give the videos sound: a voice, claps, a distant source, and footsteps at the time of the true "
            "steps, through the room, with cloth noise, as AAC"
        ),
    )
    sound_ratio_db: float = Field(
        6.0,
        ge=-40,
        le=40,
        description=(
            "with sound: power of the sound over the power of the cloth noise, from 200 to 6,000 Hz, in "
            "decibels"
        ),
    )
    sound_skews_s: Mapping[str, _Skew] = Field(
        default_factory=dict,
        description="with sound: time in seconds by which the sound of a camera is late against its pictures",
    )
    sound_skew_range_s: float = Field(
        0.0,
        ge=0,
        le=_MAX_SKEW_S,
        description=(
            "with sound: the sound of each camera is late or early against its pictures by a random time of "
            "up to this value, in seconds"
        ),
    )
    stabilised: Literal["none", "recorded", "unrecorded"] = Field(
        "none",
        description=(
            "the cameras stabilise their pictures by rotation, and crop them; recorded: the videos hold the "
            "orientations of the pictures, as those of GoPro cameras do; unrecorded: they only state the "
            "setting. The lens of the crop is written to gt/calib.json, and no calib.json is written"
        ),
    )
    drop_frames: float = Field(
        0.0,
        ge=0,
        lt=0.5,
        description="share of frames that are left out of the videos; the times of the other frames "
        "are written to <camera>.timestamps.txt",
    )
    body_in_view: bool = Field(False, description="show the wearer's own body in the videos")
    clothes: Literal["plain", "patterned"] = Field(
        "plain",
        description="with body_in_view: cloth of one colour with folds, or cloth with a printed pattern that "
        "can be tracked like the room",
    )
    hands_inward_deg: float = Field(
        0.0,
        ge=0,
        le=90,
        description="rotation of the true mounts of cameras on hands towards the wearer, in degrees; with "
        "80, they see chest, arms and legs in much of their pictures",
    )
    arms_ahead: float = Field(
        0.0,
        ge=0,
        le=1,
        description="how far both forearms are lifted forward; with 1, the torso camera sees both forearms",
    )
    on_the_spot: bool = Field(
        False,
        description="in the built-in walk, the person stands and turns to both sides, so that there "
        "is hardly any parallax",
    )
    still: bool = Field(
        False,
        description="in the built-in walk, the person stands at a table: the head and the trunk hardly move, "
        "and the hands do",
    )
    carried_s: Mapping[Literal["left", "right"], tuple[_Moment, _Moment]] = Field(
        default_factory=dict,
        description=(
            "for a hand that carries a box with pictures, the start and the end (in seconds) of a time in "
            "which it holds the box in front of the chest; before and after that, the arm hangs down"
        ),
    )
    hand_in_view: float = Field(
        0.0,
        ge=0,
        le=0.7,
        description="share of the picture of a camera on a forearm that shows the hand and the sleeve of "
        "the same arm",
    )
    texture: float = Field(
        1.0,
        ge=0,
        le=1,
        description="contrast of walls, floor and furniture, and density of the pictures on the walls; 1: as "
        "in a full laboratory, 0: plain paint",
    )
    room: Literal["single", "bays_90", "bays_180", "bays_along", "two_rooms"] = Field(
        "single",
        description=(
            "identical parts of the room; bays_90: four equal walls with equal furniture, bays_180: walls "
            "that face each other are equal, bays_along: equal shelves and pictures along the north wall, "
            "two_rooms: two equal rooms with a wall with two openings between them"
        ),
    )
    furnished: bool = Field(True, description="false: the room is empty except for pictures on the walls")
    bare: tuple[Literal["ceiling", "floor", "north", "east", "south", "west"], ...] = Field(
        (),
        description="plain surfaces of the room: ceiling, floor, or the walls in the directions +y (north), "
        "+x (east), -y (south) and -x (west); nothing but flat_pictures is on them",
    )
    flat_pictures: int = Field(
        3, ge=0, le=20, description="number of flat pictures on each plain surface that bare names"
    )
    repeated_posters: bool = Field(False, description="hang the same poster in several places of the room")
    pressed_s: Mapping[str, tuple[_Moment, _Moment]] = Field(
        default_factory=dict,
        description=(
            "for each camera on a hand, the start and the end (in seconds) of a time in which the "
            "hand lies on the wearer's chest"
        ),
    )
    poses_only: bool = Field(False, description="write only camera poses with noise, and no videos")
    pose_sigma_m: float = Field(
        0.005,
        ge=0,
        le=MAX_REACH_M,
        description="with poses_only: standard deviation of each position, per axis, in metres",
    )
    pose_sigma_deg: float = Field(
        0.3,
        ge=0,
        le=MAX_ANGLE_DEG,
        description="with poses_only: standard deviation of each rotation, per axis, in degrees",
    )
    outliers: float = Field(
        0.02,
        ge=0,
        lt=0.5,
        description=(
            "with poses_only: share of frames with a grossly wrong pose; these frames come in groups"
        ),
    )
    lost: float = Field(
        0.02,
        ge=0,
        lt=0.9,
        description="with poses_only: share of frames without a pose; these frames come in gaps",
    )
    gap_frames: tuple[_GapFrames, _GapFrames] = Field(
        (10, 20), description="with poses_only: shortest and longest gap, in frames"
    )
    rates_fps: Mapping[str, _Rate] = Field(
        default_factory=dict,
        description="with poses_only: frame rate of each camera whose rate differs from fps",
    )

    imu: Annotated[ImuOptions | None, BeforeValidator(imu_from_word)] = Field(
        None,
        description="inertial sensors, written to <camera>.imu.csv: true for those of a consumer's camera, "
        "perfect for sensors without errors, or a block with options of its own",
    )
    quality: Literal["high", "lossless"] = Field(
        "high", description="quality of the videos; high: H.264 with CRF 16, lossless: no loss of quality"
    )
    bit_rate_mbps: float | None = Field(
        None,
        ge=0.05,
        le=200,
        description="bit rate of each video in megabits per second, instead of a constant quality; phones "
        "record about 0.25 bits for each pixel",
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for problems in (self._name_problems, self._pair_problems, self._place_problems, self._time_problems):
            for problem in problems():
                raise ValueError(problem)
        return self

    def _name_problems(self) -> Iterator[str]:
        """Yield what is wrong with names of cameras, of surfaces and of the lens."""
        for name in self.cameras:
            if mount_of(name) is None:
                yield f"cameras: {name!r} is not the name of a place on the body"
        if len(set(self.cameras)) != len(self.cameras):
            yield "cameras: each name must occur only once"
        if self.lens not in CAMERA_MODELS:
            yield f"lens: there is no camera model {self.lens!r}; use one of {', '.join(CAMERA_MODELS)}"
        elif self.lens_params is not None and len(self.lens_params) != parameter_count(self.lens):
            yield f"lens_params: the model {self.lens} needs {parameter_count(self.lens)} parameters"
        if len(set(self.bare)) != len(self.bare):
            yield "bare: each surface must occur only once"
        for key in ("offsets_s", "drifts_ppm", "sound_skews_s", "rates_fps"):
            unknown = sorted(set(getattr(self, key)) - set(self.cameras))
            if unknown:
                yield f"{key}: there is no camera {', '.join(unknown)}"

    def _place_problems(self) -> Iterator[str]:
        """Yield what is wrong with options for hands and forearms."""
        places = {name: mount_of(name) for name in self.cameras}
        roles = {name: place[1] for name, place in places.items() if place is not None}
        for name in self.pressed_s:
            if not roles.get(name, "").endswith("Hand"):
                yield f"pressed_s: there is no camera {name} on a hand"
        for side in self.carried_s:
            if f"{side.capitalize()}Hand" in roles.values():
                yield f"carried_s: the box would cover the camera on the {side} hand"
        if self.hand_in_view and not any(role.endswith("ForeArm") for role in roles.values()):
            yield "hand_in_view: there is no camera on a forearm"

    def _pair_problems(self) -> Iterator[str]:
        """Yield which options cannot be used together, or have no effect without another one."""
        for key, other, reason in _EXCLUSIVE:
            if self._is_set(key) and self._is_set(other):
                yield f"{key}: cannot be used with {other}, because {reason}; leave out one of the two"
        for key, other, reason in _NEEDED:
            if self._is_set(key) and not self._is_set(other):
                yield f"{key}: {reason}; set {other}"
        if self.room != "single" and not self.furnished:
            yield "room: identical parts cannot be used without furniture"
        if self.room == "two_rooms" and (self._is_set("motion") or self._is_set("walk")):
            yield "room: two_rooms needs the simple built-in walk, which passes the openings"

    def _time_problems(self) -> Iterator[str]:
        """Yield what is wrong with times, and with the number of frames, which takes memory."""
        if self.exposure_s > 1.0 / self.fps or self.rolling_shutter_s > 1.0 / self.fps:
            yield "exposure_s, rolling_shutter_s: they cannot exceed the time between two frames (1 / fps)"
        for key, spans in (("carried_s", self.carried_s), ("pressed_s", self.pressed_s)):
            for name, (start_s, end_s) in spans.items():
                if end_s <= start_s:
                    yield f"{key}: the end of the time for {name} is not after its start"
        if self.gap_frames[0] > self.gap_frames[1]:
            yield "gap_frames: shortest first"
        if self.sound and self.seconds > _MAX_SOUND_S:
            yield f"seconds: a video with sound can last {_MAX_SOUND_S:g} s at most; lower seconds"
        drawn_s = self.offset_range_s if self.clocks == "free" else 0.0
        offsets_s = [0.0, -drawn_s, drawn_s, *self.offsets_s.values()]
        length_s = self.seconds + max(offsets_s) - min(offsets_s)
        fps = max(self.fps, *self.rates_fps.values(), self.fps)
        if length_s * fps > _MAX_FRAMES:
            yield (
                f"seconds: {length_s:g} s at {fps:g} frames per second are more than {_MAX_FRAMES} frames; "
                "lower seconds, fps or offsets_s"
            )

    def _is_set(self, key: str) -> bool:
        """Return True if an option does not have its default value."""
        field = type(self).model_fields[key]
        return bool(getattr(self, key) != field.get_default(call_default_factory=True))

    @property
    def frame_count(self) -> int:
        """Number of frames of each camera at the common frame rate, including the frames that are dropped."""
        return max(1, round(self.seconds * self.fps))

    @property
    def offset_range_s(self) -> float:
        """Maximum absolute offset of a clock that is drawn at random, seconds."""
        return min(_FREE_OFFSET_S, _FREE_OFFSET_SHARE * self.seconds)

    def rate_fps(self, camera: str) -> float:
        """Return the frame rate of one camera, frames per second."""
        return self.rates_fps.get(camera, self.fps)

    def camera(self) -> Camera:
        """Return the intrinsics of all cameras of the capture. Stabilised pictures are a crop."""
        params = self.lens_params
        if params is None:
            params = _default_lens_params(self.lens, self.width, self.height)
        if self.stabilised != "none":
            focals = focal_count(self.lens)
            params = (*(_CROP_ZOOM * focal for focal in params[:focals]), *params[focals:])
        return Camera(model=self.lens, width_px=self.width, height_px=self.height, params=list(params))  # type: ignore[arg-type]


def _default_lens_params(model: str, width: int, height: int) -> tuple[float, ...]:
    """Return the parameters of the default lens for a camera model.

    The lens has a usual angle of view. It has no distortion, except for the model FOV.
    """
    focal = width * _DEFAULT_FOCAL_PX / 640.0
    head = [focal] * focal_count(model) + [width / 2.0, height / 2.0]
    rest = [0.0] * (parameter_count(model) - len(head))
    if model == "FOV":
        rest = [_DEFAULT_FOV_OMEGA_RAD]
    return tuple(head + rest)
