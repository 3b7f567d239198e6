"""Camera calibrations: given inline in the job, or read from a ``calib.json``."""

from __future__ import annotations

import difflib
import json
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
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.model.camera import CAMERA_MODELS, CV2_PIXEL_OFFSET_PX, Camera, parameter_count

_MAX_BYTES = 1 << 20
"""Maximum size (bytes) of a calibration file. Real calibration files have a few kilobytes. Evidence: none."""
_CENTRE_INDEX = {
    "SIMPLE_PINHOLE": 1,
    "SIMPLE_RADIAL": 1,
    "RADIAL": 1,
    "SIMPLE_RADIAL_FISHEYE": 1,
    "RADIAL_FISHEYE": 1,
}
"""Index, in a camera model's parameters, of the x coordinate of the principal point. The table lists the
models with one focal length. For all other models the index is 2."""
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
_MAX_FOV_OMEGA = math.pi
"""Maximum absolute value (radians) of the parameter omega of the camera model FOV. Omega is the angle of view
of the lens; the model is not defined beyond 180°."""
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
    "SIMPLE_RADIAL_FISHEYE": (("k", 2),),
    "RADIAL_FISHEYE": (("k1", 2), ("k2", 4)),
    "THIN_PRISM_FISHEYE": (
        *(("k1", 2), ("k2", 4), ("p1", 1), ("p2", 1)),
        *(("k3", 6), ("k4", 8), ("sx1", 1), ("sy1", 1)),
    ),
}
"""By camera model: name of each distortion parameter, and the power of the image radius that it is multiplied
with, relative to the radius. Omega has a range of its own. Source: COLMAP, sensor/models.h."""


class ImplausibleParameter(NamedTuple):
    """A parameter of a calibration that no camera has.

    Attributes:
        position: Index of the parameter in `Calibration.params`.
        message: The parameter, its value and the plausible values.
    """

    position: int
    message: str


_MAX_PARAMETERS = 16
"""Maximum number of parameters of a lens. COLMAP's largest model has 16 parameters."""


class Calibration(BaseModel):
    """Intrinsics of a camera at the size of its calibration images.

    The images are upright, as a video player shows them.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

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
            raise ValueError(f"the model {self.model} needs {count} params, but {len(self.params)} are given")
        return self

    def implausible_parameter(self) -> ImplausibleParameter | None:
        """Return the first parameter that no camera has; None if all parameters are plausible."""
        centre = _CENTRE_INDEX.get(self.model, 2)
        names = [*(("f",) if centre == 1 else ("fx", "fy")), "cx", "cy"]
        names += [name for name, _ in _DISTORTION.get(self.model, ())]
        for index, (name, value) in enumerate(zip(names, self.params, strict=True)):
            low, high, what, unit = self._plausible_range(index, centre)
            if not (math.isfinite(value) and low <= value <= high):
                message = f"{what} {name} is {value:g}{unit}; plausible is {low:.6g} to {high:.6g}{unit}"
                return ImplausibleParameter(index, message)
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
        _, power = _DISTORTION[self.model][index - centre - 2]
        limit = _MAX_FOV_OMEGA
        if power:
            ratio = _MAX_RATIONAL_DISTORTION if self.model == "FULL_OPENCV" else _MAX_DISTORTION
            limit = ratio / (0.25 * long_side / max(self.params[:centre])) ** power
        return -limit, limit, "the distortion", ""

    def camera(self) -> Camera:
        """Return the camera model at the image size of the calibration, with COLMAP's pixel origin."""
        params = list(self.params)
        if self.pixel_origin == "opencv":
            index = _CENTRE_INDEX.get(self.model, 2)
            params[index] += CV2_PIXEL_OFFSET_PX
            params[index + 1] += CV2_PIXEL_OFFSET_PX
        return Camera(model=self.model, width_px=self.width, height_px=self.height, params=params)  # type: ignore[arg-type]


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
    values beside the key ``cameras`` apply to all cameras. Keys: model, params, width, height, pixel_origin;
    offsets_s (by camera name) or offset_s; rolling_shutter_s. Other keys are ignored.

    Args:
        path: Path of the calibration file.
        camera: Camera name.

    Raises:
        CaptureError: The file is unreadable, it has no entry for the camera, or a value is wrong. The error
            names the field.
    """
    data = _read_object(path)
    field = ""
    if "cameras" in data:
        cameras = data["cameras"]
        if not isinstance(cameras, dict) or not isinstance(cameras.get(camera), dict):
            raise _no_such_camera(path, camera, cameras)
        field = f"cameras.{camera}."
        data = {**data, **cameras[camera]}
    try:
        calibration = Calibration.model_validate(
            {key: data[key] for key in Calibration.model_fields if key in data}
        )
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        name = field + ".".join(str(part) for part in first["loc"])
        raise CaptureError(
            f"the calibration is not valid: {first['msg'].removeprefix('Value error, ')}",
            path=path,
            field=name or None,
            hint="write the calibration like this example: "
            '{"model": "PINHOLE", "params": [fx, fy, cx, cy], "width": 1920, "height": 1080}',
        ) from error
    if (implausible := calibration.implausible_parameter()) is not None:
        raise implausible_calibration(implausible, path, f"{field}params")
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


def implausible_calibration(
    found: ImplausibleParameter, path: Path, field: str, line: int | None = None
) -> CaptureError:
    """Return the error for a calibration with a parameter that no camera has.

    Args:
        found: The parameter.
        path: Path of the calibration file or of the job.
        field: Name of the field that holds the parameters.
        line: Number of the field's line in the file; None if it is not known.
    """
    return CaptureError(
        f"the calibration is not plausible: {found.message}",
        path=path,
        line=line,
        field=f"{field}.{found.position}",
        hint="calibrate this camera again (`bodycap calibrate`), or use calibration: auto",
    )


def _read_object(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise CaptureError(
                "the file is too large for a calibration",
                path=path,
                hint="give a calib.json that `bodycap calibrate` wrote",
            )
        data = json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise CaptureError(
            f"the file is not valid JSON: {error.msg}",
            path=path,
            line=error.lineno,
            hint="correct the file, or use `calibration: auto`",
        ) from error
    except (OSError, ValueError, RecursionError) as error:
        raise CaptureError(
            f"the calibration cannot be read ({error})",
            path=path,
            hint="give a calib.json, or use `calibration: auto`",
        ) from error
    if not isinstance(data, dict):
        raise CaptureError(
            "the calibration is not a JSON object",
            path=path,
            hint="write the calibration like this example: "
            '{"model": "PINHOLE", "params": [fx, fy, cx, cy], "width": 1920, "height": 1080}',
        )
    return data


def _no_such_camera(path: Path, camera: str, cameras: object) -> CaptureError:
    names = [str(name) for name in cameras] if isinstance(cameras, dict) else []
    near = difflib.get_close_matches(camera, names, n=1)
    return CaptureError(
        f"the file has no calibration of a camera named {camera!r}",
        path=path,
        field="cameras",
        hint=f"did you mean {near[0]!r}?"
        if near
        else f"use one of the camera names in the file: {', '.join(names) or 'none'}",
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
