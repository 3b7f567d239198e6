"""Camera calibrations: given inline in the job, or read from a ``calib.json``."""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import (
    AllowInfNan,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from bodycap_batch.config.bounds import MAX_ROLLING_SHUTTER_S, MAX_TIME_S
from bodycap_batch.config.foreign_calibrations import (
    CALIBRATION_EXAMPLE,
    cameras_of,
    in_own_format,
    name_of_format,
    parse_calibration,
)
from bodycap_batch.config.mounts import mount_of
from bodycap_batch.config.options import Options
from bodycap_batch.config.yaml_source import MAX_BYTES
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.model.camera import (
    CAMERA_MODELS,
    CV2_PIXEL_OFFSET_PX,
    Camera,
    focal_count,
    parameter_count,
)

_FOCAL_RANGE = (0.02, 50.0)
"""Minimum and maximum plausible focal length, as a ratio to the long side of the image. Derivation: a fisheye
lens that shows 180° has about 0.3; a telephoto lens of 1000 mm on a 35 mm camera has 28. Values outside the
range are errors of unit or of typing."""
_MAX_CENTRE_DISTANCE = 1.0
"""Maximum distance of the principal point from the centre of the image, along each axis, as a ratio to the
image size. At 0.5 the principal point is on the edge of the image; more occurs only in images that are cut
out of a larger image. Evidence: none."""
_MAX_DISTORTION = 10.0
"""Maximum size of one distortion term at half the distance from the centre to the edge of the image, as a
ratio to this distance. Real lenses are below 1 there. Evidence: none."""
_MAX_RATIONAL_DISTORTION = 1000.0
"""As `_MAX_DISTORTION`, for FULL_OPENCV. Its terms in the numerator and in the denominator are often large
and cancel each other. Evidence: none."""
_TERM_RANGES = {"omega": (-math.pi, math.pi), "alpha": (0.0, 1.0), "beta": (0.01, 100.0)}
"""Plausible values of the parameters that are no powers of the image radius. Omega (radians) is the angle of
view of a FOV lens, whose model is not defined beyond 180°. Alpha and beta of EUCM: the model needs an alpha
from 0 to 1 and a positive beta, which is 0.5 to 2 for real lenses. Source: Khomutenko and others, 2016."""
_DISTORTION = {
    "SIMPLE_RADIAL": (("k", 2),),
    "RADIAL": (("k1", 2), ("k2", 4)),
    "OPENCV": (("k1", 2), ("k2", 4), ("p1", 1), ("p2", 1)),
    "OPENCV_FISHEYE": (("k1", 2), ("k2", 4), ("k3", 6), ("k4", 8)),
    "FULL_OPENCV": (
        *(("k1", 2), ("k2", 4), ("p1", 1), ("p2", 1)),
        *(("k3", 6), ("k4", 2), ("k5", 4), ("k6", 6)),
    ),
    "FOV": (("omega", 0),),
    "EUCM": (("alpha", 0), ("beta", 0)),
    "SIMPLE_RADIAL_FISHEYE": (("k", 2),),
    "RADIAL_FISHEYE": (("k1", 2), ("k2", 4)),
    "THIN_PRISM_FISHEYE": (
        *(("k1", 2), ("k2", 4), ("p1", 1), ("p2", 1)),
        *(("k3", 6), ("k4", 8), ("sx1", 1), ("sy1", 1)),
    ),
}
"""By camera model: name of each distortion parameter, and the power of the image radius that it is multiplied
with, relative to the radius; 0 for those in `_TERM_RANGES`. Source: COLMAP, sensor/models.h."""


class ImplausibleValue(NamedTuple):
    """A value that no usable calibration has.

    Attributes:
        field: The value's field in `Calibration`, with dots.
        message: The value and the plausible values.
    """

    field: str
    message: str


MAX_RMS_PX = 1.0
"""Maximum reprojection error of a usable calibration, px of a picture with a long side of 640 px. Evidence:
docs/decisions/calibration.md."""
NOTED_RMS_RATIO = 0.5
"""Maximum ratio of the reprojection error of a calibration to `max_rms_px`. With a larger ratio, the user
gets a note. Evidence: docs/decisions/calibration.md."""


def max_rms_px(size: tuple[int, int]) -> float:
    """Return the maximum reprojection error (pixels) of a usable calibration at a picture size.

    Pictures with a long side below 640 px have the limit of 640 px, because the error of a corner is at least
    a fraction of a pixel.
    """
    return MAX_RMS_PX * max(640, *size) / 640.0


_MAX_PARAMETERS = 16
"""Maximum number of parameters of a lens. COLMAP's largest model has 16 parameters."""


class CalibratedWith(BaseModel):
    """How a calibration was made. Other keys of the block are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    rms_px: float | None = Field(
        None, ge=0, le=1e6, description="root mean square of the reprojection errors, pixels"
    )
    camera: str = Field("", description="model of the camera, if the video of the board states it")
    lens_mode: str = Field("", description="lens mode of the camera, if the video of the board states it")
    notes: tuple[str, ...] = Field((), description="reasons why the calibration may be wrong")


class Calibration(Options):
    """Intrinsics of a camera at the size of its calibration images.

    The images are upright, as a video player shows them.
    """

    model: str = Field(description="COLMAP camera model")
    params: tuple[Annotated[float, AllowInfNan()], ...] = Field(
        max_length=_MAX_PARAMETERS, description="the model's parameters in COLMAP's order, pixels"
    )
    width: int = Field(gt=0, le=65536, description="image width of the calibration, pixels")
    height: int = Field(gt=0, le=65536, description="image height of the calibration, pixels")
    pixel_origin: Literal["colmap", "opencv"] = Field(
        "colmap",
        description="coordinates of the centre of the first pixel: colmap = (0.5, 0.5), opencv = (0, 0)",
    )

    calibrated_with: CalibratedWith | None = Field(None, description="how the calibration was made")

    @field_validator("model")
    @classmethod
    def _check_model(cls, value: str) -> str:
        name = value.upper()
        if name in CAMERA_MODELS:
            return name
        near = difflib.get_close_matches(name, CAMERA_MODELS, n=1)
        hint = f"did you mean {near[0]}?" if near else f"choose one of {', '.join(CAMERA_MODELS)}"
        raise ValueError(f"unknown camera model {value!r}; {hint}")

    @field_validator("pixel_origin", mode="before")
    @classmethod
    def _first_word(cls, value: object) -> object:
        """Keep only the first word of a text such as ``OpenCV (centre of the first pixel = 0, 0)``."""
        return value.split(maxsplit=1)[0].lower() if isinstance(value, str) and value.strip() else value

    @model_validator(mode="after")
    def _check_params(self) -> Calibration:
        count = parameter_count(self.model)
        if len(self.params) != count:
            advice = ""
            if self.model in ("OPENCV", "PINHOLE") and len(self.params) in (9, 12):
                advice = (
                    "; OpenCV's five or eight distortion coefficients, in its order, are those of the model "
                    "FULL_OPENCV (k4 to k6 are 0 if there are five)"
                )
            raise ValueError(
                f"the model {self.model} needs {count} params ({', '.join(_parameter_names(self.model))}), "
                f"but {len(self.params)} are given{advice}"
            )
        return self

    def implausible_value(self) -> ImplausibleValue | None:
        """Return the first parameter that no camera has, or a too large error; None if all is plausible."""
        centre = focal_count(self.model)
        for index, (name, value) in enumerate(zip(_parameter_names(self.model), self.params, strict=True)):
            low, high, what, unit = self._plausible_range(index, centre)
            if not (math.isfinite(value) and low <= value <= high):
                message = f"{what} {name} is {value:g}{unit}; plausible is {low:.6g} to {high:.6g}{unit}"
                return ImplausibleValue(f"params.{index}", message)
        made, limit = self.calibrated_with, max_rms_px((self.width, self.height))
        if made is not None and made.rms_px is not None and made.rms_px > limit:
            message = f"its reprojection error is {made.rms_px:.1f} px; at most {limit:.1f} px is plausible"
            return ImplausibleValue("calibrated_with.rms_px", message)
        return None

    def _plausible_range(self, index: int, centre: int) -> tuple[float, float, str, str]:
        """Return the smallest and the largest plausible value, the meaning and the unit of a parameter.

        Args:
            index: Index of the parameter.
            centre: Index of the x coordinate of the principal point.
        """
        long_side = max(self.width, self.height)
        if index < centre:
            low, high = (ratio * long_side for ratio in _FOCAL_RANGE)
            return low, high, "the focal length", " px"
        if index < centre + 2:
            side = self.width if index == centre else self.height
            reach = _MAX_CENTRE_DISTANCE * side
            return 0.5 * side - reach, 0.5 * side + reach, "the principal point", " px"
        name, power = _DISTORTION[self.model][index - centre - 2]
        if name in _TERM_RANGES:
            return *_TERM_RANGES[name], "the distortion", ""
        ratio = _MAX_RATIONAL_DISTORTION if self.model == "FULL_OPENCV" else _MAX_DISTORTION
        limit = ratio / (0.25 * long_side / max(self.params[:centre])) ** power
        return -limit, limit, "the distortion", ""

    def camera(self) -> Camera:
        """Return the camera model at the image size of the calibration, with COLMAP's pixel origin."""
        params = list(self.params)
        if self.pixel_origin == "opencv":
            index = focal_count(self.model)
            params[index] += CV2_PIXEL_OFFSET_PX
            params[index + 1] += CV2_PIXEL_OFFSET_PX
        return Camera(model=self.model, width_px=self.width, height_px=self.height, params=params)  # type: ignore[arg-type]


def _parameter_names(model: str) -> list[str]:
    centre = focal_count(model)
    names = [*(("f",) if centre == 1 else ("fx", "fy")), "cx", "cy"]
    return [*names, *(name for name, _ in _DISTORTION.get(model, ()))]


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationEntry:
    """The entry of one camera in a calibration file.

    Attributes:
        calibration: Intrinsics of the camera.
        offset_s: Clock offset (seconds): common time = camera time + offset; None if the file does not give
            it.
        rolling_shutter_s: Time (seconds) from the exposure of the first row to the exposure of the last row;
            None if the file does not give it.
    """

    calibration: Calibration
    offset_s: float | None
    rolling_shutter_s: float | None


def read_calibration(path: Path, camera: str) -> CalibrationEntry:
    """Read the entry of one camera in a calibration file.

    The file holds one calibration for all cameras, or ``{"cameras": {name: {...}}}``. In the second form,
    values beside the key ``cameras`` apply to all cameras. Keys: model, params, width, height, pixel_origin,
    calibrated_with; offsets_s (by camera name) or offset_s; rolling_shutter_s. Other keys are ignored. Files
    of other programs are read, too: see `foreign_calibrations`. If such a file contains a single camera, it
    applies to all cameras, unless it is named after a place on the body.

    Args:
        path: Path of the calibration file.
        camera: Camera name.

    Raises:
        CaptureError: The file is unreadable, it has no entry for the camera, or a value is wrong. The error
            names the field.
    """
    data = _read_content(path)
    field = ""
    if foreign := cameras_of(data):
        only = next(iter(foreign)) if len(foreign) == 1 else camera
        name = only if mount_of(only) is None else camera
        if name not in foreign:
            raise _no_such_camera(path, camera, foreign)
        field = f"{name}." if name else ""
        data = in_own_format(foreign[name], path, name)
    elif "cameras" in data:
        cameras = data["cameras"]
        if not isinstance(cameras, dict) or not isinstance(cameras.get(camera), dict):
            raise _no_such_camera(path, camera, cameras)
        field = f"cameras.{camera}."
        data = {**data, **cameras[camera]}
    elif not {"model", "params"} & data.keys():
        known = name_of_format(data)
        raise CaptureError(
            f"calibrations of {known} cannot be read" if known else "the file contains no calibration",
            path=path,
            field="model",
            hint=f"give a file of OpenCV, ROS, Kalibr, COLMAP or Gyroflow, or {CALIBRATION_EXAMPLE}",
        )
    try:
        values = {key: data[key] for key in Calibration.model_fields if key in data}
        if not isinstance(values.get("calibrated_with"), dict):  # another program's text
            values.pop("calibrated_with", None)
        calibration = Calibration.model_validate(values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        name = field + ".".join(str(part) for part in first["loc"])
        raise CaptureError(
            f"the calibration is not valid: {first['msg'].removeprefix('Value error, ')}",
            path=path,
            field=name or None,
            hint=_example_of(str(data.get("model")), first["msg"]),
        ) from error
    if (implausible := calibration.implausible_value()) is not None:
        raise implausible_calibration(implausible, path, field.removesuffix("."))
    offsets = data.get("offsets_s", {})
    by_camera = isinstance(offsets, dict)
    offset = data.get("offset_s", offsets.get(camera) if by_camera else offsets)
    has_offset = "offset_s" in data or not by_camera or camera in offsets
    return CalibrationEntry(
        calibration=calibration,
        offset_s=_seconds(offset, MAX_TIME_S, path, f"{field}offsets_s") if has_offset else None,
        rolling_shutter_s=None
        if data.get("rolling_shutter_s") is None
        else _seconds(data["rolling_shutter_s"], MAX_ROLLING_SHUTTER_S, path, f"{field}rolling_shutter_s"),
    )


def _example_of(model: str, message: str) -> str:
    """Return advice on how to write a calibration with a model, or with the model that a message advises."""
    model = "FULL_OPENCV" if "FULL_OPENCV" in message else model.upper()
    if model not in CAMERA_MODELS:
        return CALIBRATION_EXAMPLE
    names = ", ".join(_parameter_names(model))
    return CALIBRATION_EXAMPLE.replace("PINHOLE", model).replace("fx, fy, cx, cy", names)


def implausible_calibration(
    found: ImplausibleValue, path: Path, place: str, line: int | None = None
) -> CaptureError:
    """Return the error for a calibration with a value that no usable calibration has.

    Args:
        found: The value.
        path: Path of the calibration file or of the job.
        place: Name of the field that holds the calibration; "" for the whole file.
        line: Number of the value's line in the file; None if it is not known.
    """
    return CaptureError(
        f"the calibration is not plausible: {found.message}",
        path=path,
        line=line,
        field=f"{place}.{found.field}".removeprefix("."),
        hint="calibrate this camera again (`bodycap calibrate`), or use calibration: auto",
    )


def _read_content(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise CaptureError(
                "the file is too large for a calibration",
                path=path,
                hint="give a calib.json that `bodycap calibrate` wrote",
            )
        return parse_calibration(path.read_bytes(), path)
    except OSError as error:
        raise CaptureError(
            f"the calibration cannot be read ({error})",
            path=path,
            hint="give a calib.json, or use `calibration: auto`",
        ) from error


def _no_such_camera(path: Path, camera: str, cameras: object) -> CaptureError:
    names = [str(name) for name in cameras] if isinstance(cameras, dict) else []
    near = difflib.get_close_matches(camera, names, n=1)
    return CaptureError(
        f"the file has no calibration of a camera named {camera!r}",
        path=path,
        field="cameras",
        hint=f"did you mean {near[0]!r}?"
        if near
        else f"the cameras in the file are {', '.join(names) or 'none'}: give the camera's entry the name "
        f"{camera!r}, or copy the entry alone into a file, and name it as `calibration:` of the camera",
    )


def _seconds(value: object, largest_s: float, path: Path, field: str) -> float:
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= largest_s:
        return float(value)
    raise CaptureError(
        f"{value!r:.40} is not a time in seconds",
        path=path,
        field=field,
        hint=f"a number from {-largest_s:g} to {largest_s:g}, e.g. 0.12",
    )
