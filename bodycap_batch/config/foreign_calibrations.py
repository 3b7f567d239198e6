"""Read calibration files of other programs as entries in the format of ``calib.json``.

A file is recognised by its content, whatever its name: OpenCV (YAML, XML, JSON), ROS, Kalibr, COLMAP
(``cameras.txt``), Gyroflow, Caliscope and files with similar keys. A lens is read if a camera model of COLMAP
expresses it exactly.

Sources: OpenCV, ``calibrateCamera`` and ``fisheye``; Kalibr, "Supported models"; COLMAP, sensor/models.h;
Gyroflow, lens profiles.
"""

from __future__ import annotations

import itertools
import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import yaml

from bodycap_batch.config.yaml_source import MAX_DEPTH
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.core.text_encoding import decode_text

CALIBRATION_EXAMPLE = (
    'write the calibration like this example: {"model": "PINHOLE", "params": [fx, fy, cx, cy], '
    '"width": 1920, "height": 1080}'
)
"""Advice on how to write a calibration."""
_OTHER_FORMATS = {
    "projection_type": "OpenSfM", "value0": "Basalt", "projection": "Agisoft Metashape",
    "intrinsic_type": "OpenImuCameraCalibrator", "fl_x": "nerfstudio", "sfmData": "Meshroom",
}  # fmt: skip
"""Name of each text format that is not read, by a key that only its files have."""
_PROGRAMS = {"fisheye_params": "Gyroflow", "distortion_coeffs": "Kalibr", "cam_id": "Caliscope"}
"""Name of each program by a key of its cameras; other files are of OpenCV or ROS."""
_COLMAP_LINE = re.compile(r"\s*(\d+)\s+([A-Z_]+)\s+(\d+)\s+(\d+)((?:\s+[-+.\deE]+)+)\s*")
_COLMAP_UNDISTORTED = {"SIMPLE_FISHEYE": ("SIMPLE_RADIAL_FISHEYE", 1), "FISHEYE": ("OPENCV_FISHEYE", 4)}
"""Models of COLMAP without distortion: the same model with distortion, and its number of distortion terms."""
_MATRIX = re.compile(r"((camera|intrinsic)?matrix|intrinsics?)(rowmajor)?|mtx|k")
_COEFFICIENTS = re.compile(r"dist(ortion)?s?(coeff?(icient)?s?)?|coeffs|d")
_SIZE = re.compile(r"(camera|image|img|frame|calib)?(size|resolution|dimensions?)")
_RMS = re.compile(r"(rms|avg|mean|final)?(reproj(ection)?)?error|rms")
"""Keys in small letters without separators, as in `_flat`."""
_LENSES = {
    **dict.fromkeys(
        ("", "pinhole", "simplepinhole", "none", "perspective", "opencv", "opencvstandard", "radtan", "brown",
         "radialtangential", "plumbbob", "rationalpolynomial", "brownconrady"),
        "brown",
    ),
    **dict.fromkeys(
        ("fisheye", "opencvfisheye", "equidistant", "equi", "kannalabrandt", "kannalabrandt4", "kb4"),
        "fisheye",
    ),
    "eucm": "eucm", "omni": "omni", "fov": "fov",
}  # fmt: skip
"""Kind of each lens model that can be expressed, by its name in small letters without separators."""
_MAX_SKEW_PX = 0.1
"""Maximum displacement (pixels) at the edge of the picture by axes that are not perpendicular. The axes of
COLMAP's models are perpendicular. Derivation: a third of the noise of a keypoint."""


class _OpencvLoader(yaml.SafeLoader):
    """PyYAML's safe loader, which also reads matrices of OpenCV as dictionaries."""


def _matrix_content(loader: _OpencvLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


_OpencvLoader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix_content)


def parse_calibration(data: bytes, path: Path) -> dict[str, Any]:
    """Return the content of a calibration file as a dictionary.

    Args:
        data: The bytes of the file.
        path: Path of the file, for errors.

    Raises:
        CaptureError: The file is no text, or no dictionary in a format that is read.
    """
    try:
        content = _parsed(decode_text(data))
    except (ValueError, RecursionError, yaml.YAMLError, ET.ParseError) as error:
        mark = getattr(error, "problem_mark", None)
        kind = "JSON" if isinstance(error, json.JSONDecodeError) else "text"
        problem = getattr(error, "problem", None) or getattr(error, "msg", None) or error
        raise CaptureError(
            f"the file is not valid {kind}: {problem}",
            path=path,
            line=mark.line + 1 if mark is not None else getattr(error, "lineno", None),
            hint="correct the file, or use `calibration: auto`; from a binary format (NumPy, MATLAB, pickle, "
            "COLMAP's cameras.bin), export text (COLMAP: cameras.txt)",
        ) from error
    if isinstance(content, dict):
        return content
    raise CaptureError("the file contains no calibration", path=path, hint=CALIBRATION_EXAMPLE)


def _parsed(text: str) -> object:
    if "\0" in text:
        raise ValueError("it is binary")
    levels = itertools.accumulate((letter in "[{") - (letter in "]}") for letter in text)
    if max(levels, default=0) > MAX_DEPTH:
        raise ValueError(f"its blocks are nested deeper than {MAX_DEPTH} levels")
    start = text.lstrip()[:1]
    if start == "{":
        return json.loads(text)
    if start == "<":
        if "<!" in text.replace("<!--", ""):
            raise ValueError("the XML declares a document type")
        return _xml_content(ET.fromstring(text))  # noqa: S314 - entities were refused
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    rows = [_COLMAP_LINE.fullmatch(line) for line in lines]
    if rows and all(rows):
        return {"cameras": {row[1]: _colmap_camera(row) for row in rows if row}}
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        plain = re.sub(r"\A\s*%YAML[^\n]*\n", "", text)
        return yaml.load(plain, Loader=_OpencvLoader)  # noqa: S506 - a safe loader


def _xml_content(element: ET.Element) -> Any:
    return {child.tag: _xml_content(child) for child in element} if len(element) else element.text or ""


def _colmap_camera(row: re.Match[str]) -> dict[str, Any]:
    model, zeros = _COLMAP_UNDISTORTED.get(row[2], (row[2], 0))
    params = [*map(float, row[5].split()), *[0.0] * zeros]
    return {
        "model": model,
        "params": params,
        "width": int(row[3]),
        "height": int(row[4]),
        "colmap_id": row[1],
    }


def cameras_of(content: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the cameras of another program's calibration, by name; empty if there are none.

    The camera of a file without names has the name "".
    """
    if _is_camera(content):
        return {"": dict(content)}
    group = content.get("cameras", content)
    named = group.items() if isinstance(group, dict) else ()
    return {str(name): each for name, each in named if isinstance(each, dict) and _is_camera(each)}


def _is_camera(content: Mapping[str, Any]) -> bool:
    if "params" in content:
        return "colmap_id" in content
    return "intrinsic_type" not in content and _first(_flat(content), _MATRIX) is not None


def _flat(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values by key in small letters without separators, with those of a profile of Gyroflow."""
    inner = content.get("fisheye_params")
    both = {**content, **inner} if isinstance(inner, dict) else content
    return {_plain(key): value for key, value in both.items()}


def _plain(text: object) -> str:
    return re.sub(r"[^a-z0-9]", "", str(text or "").lower())


def _first(keys: Mapping[str, Any], pattern: re.Pattern[str]) -> Any:
    return next((value for key, value in keys.items() if pattern.fullmatch(key) and value is not None), None)


def _numbers(value: Any) -> list[float]:
    """Return the numbers of a number, of nested lists, of a matrix of OpenCV, or of a text with spaces."""
    if isinstance(value, dict):
        return _numbers(value["data"])
    if isinstance(value, str) and (" " in value or "," in value):
        value = value.replace(",", " ").split()
    if isinstance(value, list):
        return [number for part in value for number in _numbers(part)]
    return [float(value)]


def in_own_format(camera: Mapping[str, Any], path: Path, field: str) -> dict[str, Any]:
    """Return a camera of `cameras_of` with the keys of `Calibration`; its other keys are kept.

    Args:
        camera: The camera.
        path: Path of the file, for errors.
        field: Key of the camera in the file; "" for a file without names.

    Raises:
        CaptureError: No camera model of COLMAP expresses the lens, or a value is missing or wrong.
    """
    if "colmap_id" in camera:
        return dict(camera)
    keys = _flat(camera)
    try:
        made: dict[str, Any] = {}
        if "camerabrand" in keys:  # Gyroflow
            made["camera"] = f"{keys['camerabrand']} {keys.get('cameramodel') or ''}"
            made["lens_mode"] = str(keys.get("lensmodel") or "")
        if (rms := _first(keys, _RMS)) is not None:
            made["rms_px"] = _numbers(rms)[0]
        return {**camera, **_lens(camera, keys), "calibrated_with": made}
    except (ValueError, TypeError, LookupError, ArithmeticError) as error:
        program = next((name for key, name in _PROGRAMS.items() if key in camera), "OpenCV or ROS")
        reason = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) else str(error)
        raise CaptureError(
            f"this calibration of {program} cannot be used: {reason}",
            path=path,
            field=field or None,
            hint="calibrate with a lens model that COLMAP has, too: OpenCV's terms k1 to k6, p1 and p2, "
            "equidistant (fisheye), FOV, EUCM, or omni without distortion (Kalibr: pinhole-radtan, "
            f"pinhole-equi, pinhole-fov, eucm-none); or {CALIBRATION_EXAMPLE}",
        ) from error


def _lens(camera: Mapping[str, Any], keys: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys of `Calibration` for a camera. Raises `ValueError` if no model expresses the lens."""
    kind = _kind(camera, keys)
    width, height = _picture_size(keys)
    *extra, fx, fy, cx, cy = _intrinsics(keys, height)
    model, params = _colmap_model(kind, extra, _numbers(_first(keys, _COEFFICIENTS) or []))
    if kind == "omni":
        fx, fy = fx / (1.0 + extra[0]), fy / (1.0 + extra[0])
    # Gyroflow stretches the pictures of some lenses before it calibrates.
    x, y = (float(keys.get(f"input{axis}stretch") or 1.0) for axis in ("horizontal", "vertical"))
    return {
        "model": model,
        "params": [fx / x, fy / y, (cx + 0.5) / x - 0.5, (cy + 0.5) / y - 0.5, *params],
        "width": round(width / x),
        "height": round(height / y),
        "pixel_origin": "opencv",
    }


def _kind(camera: Mapping[str, Any], keys: Mapping[str, Any]) -> str:
    """Return the kind of a lens: a value of `_LENSES`. Raises `ValueError` for any other lens."""
    distortion = _plain(keys.get("distortionmodel"))
    projection = _plain(keys.get("cameramodel"))
    if "fisheye_params" in camera:  # Gyroflow, whose camera_model is a product
        projection, distortion = _plain(keys.get("digitallens")), distortion or "fisheye"
    elif str(keys.get("fisheye", keys.get("fisheyemodel", 0))).lower() in ("1", "true"):
        distortion = "fisheye"
    for name in (projection, distortion):
        if name not in _LENSES:
            raise ValueError(f"COLMAP has no lens model {name!r}")
    special = _LENSES[projection] in ("eucm", "omni")
    return _LENSES[projection if special else distortion or projection]


def _picture_size(keys: Mapping[str, Any]) -> tuple[float, float]:
    for names in (("imagewidth", "imageheight"), ("width", "height"), ("w", "h")):
        if all(name in keys for name in names):
            return float(keys[names[0]]), float(keys[names[1]])
    size = _first(keys, _SIZE)
    if size is None:
        raise ValueError("it does not state the size of the pictures (add image_width and image_height)")
    if isinstance(size, dict):
        return _picture_size(_flat(size))
    width, height = _numbers(size)
    return width, height


def _intrinsics(keys: Mapping[str, Any], height: float) -> list[float]:
    """Return the parameters of the projection, if there are any, then fx, fy, cx, cy."""
    numbers = _numbers(_first(keys, _MATRIX))
    if len(numbers) != 9:
        return numbers
    fx, skew, cx, _, fy, cy = numbers[:6]
    if abs(skew) * 0.5 * height / fy > _MAX_SKEW_PX:
        raise ValueError(f"its axes are not perpendicular (skew {skew:g} px)")
    return [fx, fy, cx, cy]


def _colmap_model(kind: str, extra: Sequence[float], terms: Sequence[float]) -> tuple[str, list[float]]:
    """Return COLMAP's model of a lens, and its parameters after the principal point."""
    if any(terms[{"brown": 8, "fisheye": 4, "fov": 1}.get(kind, 0) :]):
        name = "with thin-prism or tilt terms" if kind == "brown" else f"{kind} with this distortion"
        raise ValueError(f"COLMAP has no lens model {name} ({', '.join(f'{term:g}' for term in terms)})")
    if kind == "brown" and not any(terms):
        return "PINHOLE", []
    if kind == "brown" and any(terms[4:]):
        return "FULL_OPENCV", [*terms, *[0.0] * 8][:8]
    return {
        "brown": ("OPENCV", [*terms, *[0.0] * 4][:4]),
        "fisheye": ("OPENCV_FISHEYE", [*terms, *[0.0] * 4][:4]),
        "fov": ("FOV", [*terms]),
        "eucm": ("EUCM", [*extra]),
        "omni": ("EUCM", [extra[0] / (1.0 + extra[0]) if extra else 0.0, 1.0]),  # the unified model
    }[kind]


def name_of_format(content: Mapping[str, Any]) -> str:
    """Return the name of a known format that is not read; "" for any other content."""
    parts = [content, *(part for part in content.values() if isinstance(part, dict))]
    return next((name for key, name in _OTHER_FORMATS.items() if any(key in part for part in parts)), "")
