"""Camera calibrations: given inline in the job, or read from a ``calib.json``."""

from __future__ import annotations

import difflib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from bodycap_batch.core.errors import CaptureError
from bodycap_batch.model.camera import CAMERA_MODELS, CV2_PIXEL_OFFSET_PX, Camera, parameter_count

_MAX_BYTES = 1 << 20
"""Maximum size (bytes) of a calibration file. Real calibration files have a few kilobytes. Evidence: none."""
_MAX_SECONDS = 1e10
"""Maximum absolute value (seconds) of a time in a calibration file. Every Unix time is smaller.
Evidence: none."""
_CENTRE_INDEX = {
    "SIMPLE_PINHOLE": 1,
    "SIMPLE_RADIAL": 1,
    "RADIAL": 1,
    "SIMPLE_RADIAL_FISHEYE": 1,
    "RADIAL_FISHEYE": 1,
}
"""Index, in a camera model's parameters, of the x coordinate of the principal point. The table lists the
models with one focal length. For all other models the index is 2."""


class Calibration(BaseModel):
    """Intrinsics of a camera at the size of its calibration images.

    The images are upright, as a video player shows them.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    model: str = Field(description="COLMAP camera model")
    params: tuple[float, ...] = Field(
        description="parameters of the camera model in COLMAP's order, in pixels"
    )
    width: int = Field(
        gt=0, le=65536, description="width of the pictures used for the calibration, in pixels"
    )
    height: int = Field(
        gt=0, le=65536, description="height of the pictures used for the calibration, in pixels"
    )
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
        if self.params[0] <= 0 or (self.model not in _CENTRE_INDEX and self.params[1] <= 0):
            raise ValueError("the focal length must be positive")
        return self

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
        offset_s: Clock offset (seconds): common time = camera time + offset.
        rolling_shutter_s: Time (seconds) from the exposure of the first row to the exposure of the last row;
            None if the file does not give it.
    """

    calibration: Calibration
    offset_s: float
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
    offsets = data.get("offsets_s", {})
    offset = data.get("offset_s", offsets.get(camera, 0.0) if isinstance(offsets, dict) else offsets)
    return CalibrationEntry(
        calibration=calibration,
        offset_s=_seconds(offset, path, f"{field}offsets_s"),
        rolling_shutter_s=None
        if data.get("rolling_shutter_s") is None
        else _seconds(data["rolling_shutter_s"], path, f"{field}rolling_shutter_s"),
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


def _seconds(value: object, path: Path, field: str) -> float:
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < _MAX_SECONDS:
        return float(value)
    raise CaptureError(
        f"{value!r:.40} is not a time in seconds",
        path=path,
        field=field,
        hint="give a number, for example 0.12",
    )
