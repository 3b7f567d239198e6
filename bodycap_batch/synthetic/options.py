"""The options of a synthetic capture."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

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
from bodycap_batch.model.camera import CAMERA_MODELS, Camera, parameter_count

_EARLIEST_S = 3.0
"""Maximum time (seconds) from the start of a camera to time 0 of the common clock. The built-in walk starts
even earlier."""
_MAX_SECONDS = 3600.0
"""Maximum length (seconds) of a synthetic video, and maximum delay of a camera. Evidence: none."""
_MAX_FRAMES = 432_000
"""Maximum number of frames of one camera, from the start of the first camera to the end of the last: four
hours at 30 frames per second. The true poses of all joints take about 1.4 GB for this number of frames."""
_DEFAULT_FOCAL_PX = 420.0
"""Focal length (px) of the default lens at an image width of 640 px. The horizontal angle of view is 75
degrees."""
_DEFAULT_FOV_OMEGA_RAD = 0.8
"""Distortion parameter (radians) of the default lens for the camera model FOV. Evidence: none."""


_LensParameter = Annotated[float, Field(ge=-MAX_LENS_PARAMETER, le=MAX_LENS_PARAMETER)]
_Offset = Annotated[float, Field(ge=-_EARLIEST_S, le=_MAX_SECONDS)]
_Moment = Annotated[float, Field(ge=0, le=_MAX_SECONDS)]
_Rate = Annotated[float, Field(ge=MIN_FPS, le=MAX_FPS)]
_GapFrames = Annotated[int, Field(ge=1, le=_MAX_FRAMES)]


class SynthOptions(Options):
    """Options of a synthetic capture: a person walks with body cameras in a textured room."""

    seconds: float = Field(12.0, gt=0, le=_MAX_SECONDS, description="length of each camera's video")
    fps: float = Field(30.0, ge=MIN_FPS, le=MAX_MOTION_FPS, description="frames per second of every camera")
    width: int = Field(640, ge=32, le=7680, multiple_of=2, description="image width in pixels (even)")
    height: int = Field(480, ge=32, le=4320, multiple_of=2, description="image height in pixels (even)")
    cameras: tuple[str, ...] = Field(
        ("torso", "left_palm", "right_palm"), min_length=1, description="mount names, one camera each"
    )
    lens: str = Field("PINHOLE", description="COLMAP camera model of every camera")
    lens_params: tuple[_LensParameter, ...] | None = Field(
        None,
        max_length=16,
        description="parameters in COLMAP's order, pixels of the given size, COLMAP's pixel origin; "
        "default: a lens 75 degrees wide, principal point in the middle, no distortion",
    )
    seed: int = Field(0, ge=0, le=MAX_SEED, description="seed of body, mounts, walk, textures and noise")
    subject_height_m: float = Field(1.75, ge=1.2, le=2.2, description="stature of the built-in walker")
    motion: Path | None = Field(None, description="BVH file to follow instead of the built-in walk")
    motion_start_s: float = Field(
        0.0, ge=0, le=MAX_CAPTURE_S, description="time (s) in the BVH file at the capture's start"
    )
    t_pose_s: float = Field(
        0.0, ge=0, le=_MAX_SECONDS, description="duration of the T-pose before the built-in walk, s"
    )
    proportion_range: float = Field(
        0.05, ge=0, lt=0.5, description="bone lengths of the built-in walker differ by up to this ratio"
    )
    posture_spread: float = Field(
        0.0,
        ge=0,
        le=3,
        description="random posture of the built-in walker; 1: varies as between people, 0: mean of people",
    )
    mount_sigma_deg: float = Field(
        15.0,
        ge=0,
        le=MAX_ANGLE_DEG,
        description="standard deviation of mount rotations from nominal, total of three axes",
    )
    mount_sigma_m: float = Field(
        0.05,
        ge=0,
        le=MAX_REACH_M,
        description="standard deviation of mount positions from nominal, total of three axes",
    )
    noise: float = Field(
        2.0, ge=0, le=50, description="standard deviation of noise at mid grey, grey levels of 0 to 255"
    )
    exposure_s: float = Field(
        0.0, ge=0, le=1, description="exposure time, s: causes motion blur; the timestamp is at its middle"
    )
    rolling_shutter_s: float = Field(
        0.0, ge=0, le=MAX_ROLLING_SHUTTER_S, description="time from the first row to the last"
    )
    offsets_s: Mapping[str, _Offset] = Field(
        default_factory=dict, description="clock offset by camera: common time = camera time + offset"
    )
    drop_frames: float = Field(
        0.0, ge=0, lt=0.5, description="fraction of frames that are lost; writes <camera>.timestamps.txt"
    )
    body_in_view: bool = Field(False, description="render the wearer's own body")
    arms_ahead: float = Field(
        0.0,
        ge=0,
        le=1,
        description="how far both forearms are held up ahead; 1 brings them into the torso's view",
    )
    on_the_spot: bool = Field(
        False, description="the built-in walker stands and turns to both sides: hardly any parallax"
    )
    furnished: bool = Field(True, description="False: a bare room, with pictures on its walls only")
    repeated_posters: bool = Field(False, description="hang one and the same poster in several places")
    pressed_s: Mapping[str, tuple[_Moment, _Moment]] = Field(
        default_factory=dict,
        description="for a camera on a hand: start and end (s) of a time with the hand on the wearer's chest",
    )
    poses_only: bool = Field(False, description="write noisy camera poses, no video")
    pose_sigma_m: float = Field(
        0.005, ge=0, le=MAX_REACH_M, description="poses only: noise of each position, per axis"
    )
    pose_sigma_deg: float = Field(
        0.3, ge=0, le=MAX_ANGLE_DEG, description="poses only: noise of each rotation, per axis"
    )
    outliers: float = Field(0.02, ge=0, lt=0.5, description="poses only: share of gross outliers, in bursts")
    lost: float = Field(0.02, ge=0, lt=0.9, description="poses only: share of frames lost, in gaps")
    gap_frames: tuple[_GapFrames, _GapFrames] = Field(
        (10, 20), description="poses only: shortest and longest gap"
    )
    rates_fps: Mapping[str, _Rate] = Field(
        default_factory=dict, description="poses only: frame rate of each camera that differs from fps"
    )
    quality: Literal["high", "lossless"] = Field("high", description="H.264 at CRF 16, or lossless")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for name in self.cameras:
            if mount_of(name) is None:
                raise ValueError(f"cameras: {name!r} names no place on the body")
        if len(set(self.cameras)) != len(self.cameras):
            raise ValueError("cameras: every name once")
        if self.lens not in CAMERA_MODELS:
            raise ValueError(f"lens: unknown model {self.lens!r}; known: {', '.join(CAMERA_MODELS)}")
        if self.lens_params is not None and len(self.lens_params) != parameter_count(self.lens):
            raise ValueError(f"lens_params: {self.lens} takes {parameter_count(self.lens)} parameters")
        self._check_cameras_named()
        self._check_frames()
        if self.exposure_s > 1.0 / self.fps or self.rolling_shutter_s > 1.0 / self.fps:
            raise ValueError("exposure_s and rolling_shutter_s cannot exceed the frame interval")
        for key in ("t_pose_s", "on_the_spot"):
            if self.motion is not None and getattr(self, key):
                raise ValueError(f"{key}: a BVH motion is followed as it is")
        self._check_pressed()
        return self

    def _check_cameras_named(self) -> None:
        """Check the options that have a value for each camera, and the lengths of gaps.

        All camera names must exist. Different frame rates are permitted only without videos.
        """
        for key, named in (("offsets_s", self.offsets_s), ("rates_fps", self.rates_fps)):
            unknown = sorted(set(named) - set(self.cameras))
            if unknown:
                raise ValueError(f"{key}: no camera {', '.join(unknown)}")
        if self.rates_fps and not self.poses_only:
            raise ValueError("rates_fps: videos have one rate; set poses_only")
        if self.gap_frames[0] > self.gap_frames[1]:
            raise ValueError("gap_frames: shortest first")

    def _check_frames(self) -> None:
        """Check the number of frames, which determines the memory that the renderer needs."""
        offsets_s = [0.0, *self.offsets_s.values()]
        length_s = self.seconds + max(offsets_s) - min(offsets_s)
        fps = max(self.fps, *self.rates_fps.values(), self.fps)
        if length_s * fps > _MAX_FRAMES:
            raise ValueError(
                f"seconds: {length_s:g} s at {fps:g} frames per second are more than {_MAX_FRAMES} frames; "
                "lower seconds, fps or offsets_s"
            )

    def _check_pressed(self) -> None:
        """Check the option that holds a hand against the chest.

        Only the built-in walk supports it, only for hands, and only if the body is rendered.
        """
        for name, (start_s, end_s) in self.pressed_s.items():
            place = mount_of(name)
            if name not in self.cameras or place is None or not place[1].endswith("Hand"):
                raise ValueError(f"pressed_s: no camera {name} on a hand")
            if end_s <= start_s:
                raise ValueError(f"pressed_s: {name} leaves the chest before it gets there")
        if self.pressed_s and not self.body_in_view:
            raise ValueError("pressed_s: needs body_in_view, else there is no chest to see")
        if self.pressed_s and self.motion is not None:
            raise ValueError("pressed_s: a BVH motion is followed as it is")

    @property
    def frame_count(self) -> int:
        """Number of frames of each camera at the common frame rate, including the frames that are dropped."""
        return max(1, round(self.seconds * self.fps))

    def rate_fps(self, camera: str) -> float:
        """Return the frame rate of one camera, frames per second."""
        return self.rates_fps.get(camera, self.fps)

    def camera(self) -> Camera:
        """Return the intrinsics of all cameras of the capture."""
        params = self.lens_params
        if params is None:
            params = _default_lens_params(self.lens, self.width, self.height)
        return Camera(model=self.lens, width_px=self.width, height_px=self.height, params=list(params))  # type: ignore[arg-type]


def _default_lens_params(model: str, width: int, height: int) -> tuple[float, ...]:
    """Return the parameters of the default lens for a camera model.

    The lens has a usual angle of view. It has no distortion, except for the model FOV.
    """
    focal = width * _DEFAULT_FOCAL_PX / 640.0
    has_one_focal = model in (
        "SIMPLE_PINHOLE",
        "SIMPLE_RADIAL",
        "RADIAL",
        "SIMPLE_RADIAL_FISHEYE",
        "RADIAL_FISHEYE",
    )
    head = [focal] if has_one_focal else [focal, focal]
    head += [width / 2.0, height / 2.0]
    rest = [0.0] * (parameter_count(model) - len(head))
    if model == "FOV":
        rest = [_DEFAULT_FOV_OMEGA_RAD]
    return tuple(head + rest)
