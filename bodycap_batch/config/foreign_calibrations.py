"""Read calibration files of other programs as entries in the format of ``calib.json``.

A file is recognised by its content, whatever its name: OpenCV (YAML, XML, JSON), ROS, Kalibr, COLMAP
(``cameras.txt``), Gyroflow, Caliscope, OpenImuCameraCalibrator and files with similar keys. A lens is read if
a camera model of COLMAP expresses it exactly.

Sources: OpenCV, ``calibrateCamera`` and ``fisheye``; Kalibr, "Supported models"; COLMAP, sensor/models.h;
TheiaSfM, camera models; Gyroflow, lens profiles.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import yaml

from bodycap_batch.core.errors import CaptureError
from bodycap_batch.core.text_encoding import decode_text

CALIBRATION_EXAMPLE = (
    'write the calibration like this example: {"model": "PINHOLE", "params": [fx, fy, cx, cy], '
    '"width": 1920, "height": 1080}'
)
"""Advice on how to write a calibration."""
_BINARY_FORMATS = {
    b"PK\x03\x04": "NumPy (.npz)", b"\x93NUMPY": "NumPy (.npy)", b"\x80": "Python (pickle)",
    b"MATLAB": "MATLAB (.mat)",
}  # fmt: skip
"""Name of each binary format by the first bytes of its files."""
_OTHER_FORMATS = {
    "projection_type": "OpenSfM", "value0": "Basalt", "projection": "Agisoft Metashape",
    "sfmData": "Meshroom", "featuresFolders": "Meshroom",
}  # fmt: skip
"""Name of each text format that is not read, by a key that only its files have."""
_COLMAP_LINE = re.compile(r"\s*(\d+)\s+([A-Z_]+)\s+(\d+)\s+(\d+)((?:\s+[-+.\deE]+)+)\s*")
_COLMAP_UNDISTORTED = {"SIMPLE_FISHEYE": ("SIMPLE_RADIAL_FISHEYE", 1), "FISHEYE": ("OPENCV_FISHEYE", 4)}
"""Models of COLMAP without distortion: the same model with distortion, and its number of distortion terms."""
_MATRIX = re.compile(r"((camera|intrinsic)?matrix|intrinsics?)(rowmajor)?|mtx|k")
_COEFFICIENTS = re.compile(r"dist(ortion)?s?(coeff?(icient)?s?)?|coeffs|d")
_SIZE = re.compile(r"(camera|image|img|frame|calib)?(size|resolution|dimensions?)")
_RMS = re.compile(r"(rms|avg|mean|final)?(reproj(ection)?)?error|rms")
_NAMES = {
    "fx": ("fx", "flx", "fu", "focallength"), "fy": ("fy", "fly", "fv"),
    "cx": ("cx", "ppx", "principalptx"), "cy": ("cy", "ppy", "principalpty"),
    "p1": ("p1", "tangentialdistortion1"), "p2": ("p2", "tangentialdistortion2"),
}  # fmt: skip
"""Names of intrinsics that stand alone, in small letters without separators, as all keys below."""
_TERMS = {"brown": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), "fisheye": ("k1", "k2", "k3", "k4")}
"""Distortion terms of each kind of lens, in OpenCV's order."""
_NESTED = ("intrinsics", "intrinsic", "fisheyeparams")
"""Keys whose content is read like that of the camera itself."""
_LENSES = {
    **dict.fromkeys(
        ("", "pinhole", "simplepinhole", "none", "perspective", "opencv", "opencvstandard", "radtan", "brown",
         "radialtangential", "plumbbob", "rationalpolynomial", "pinholeradialtangential", "brownconrady"),
        "brown",
    ),
    **dict.fromkeys(
        ("fisheye", "opencvfisheye", "equidistant", "equi", "kannalabrandt", "kannalabrandt4", "kb4"),
        "fisheye",
    ),
    **dict.fromkeys(("eucm", "extendedunified"), "eucm"),
    **dict.fromkeys(("omni", "mei", "unified"), "omni"),
    "fov": "fov", "atan": "fov",
}  # fmt: skip
"""Kind of each lens model that can be expressed, by its name in small letters without separators."""
_MAX_DEPTH = 20
"""Maximum nesting depth (levels) of a file. Real files have six levels. Evidence: none."""
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
    known = next((name for start, name in _BINARY_FORMATS.items() if data.startswith(start)), "")
    try:
        text = "" if known else decode_text(data)
    except UnicodeDecodeError:
        known = "binary"
    if known or "\0" in text:
        raise CaptureError(
            f"a calibration in the format {known or 'binary'} cannot be read",
            path=path,
            hint="export it as text (COLMAP: cameras.txt; OpenCV: YAML, XML or JSON), or "
            + CALIBRATION_EXAMPLE,
        )
    try:
        content = _parsed(text)
    except (ValueError, RecursionError, yaml.YAMLError, ET.ParseError) as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or getattr(error, "msg", None) or error
        kind = "JSON" if isinstance(error, json.JSONDecodeError) else "text"
        raise CaptureError(
            f"the file is not valid {kind}: {problem}",
            path=path,
            line=mark.line + 1 if mark is not None else getattr(error, "lineno", None),
            hint="correct the file, or use `calibration: auto`",
        ) from error
    if isinstance(content, dict):
        return content
    raise CaptureError("the file contains no calibration", path=path, hint=CALIBRATION_EXAMPLE)


def _parsed(text: str) -> object:
    levels = itertools.accumulate((letter in "[{") - (letter in "]}") for letter in text)
    if max(levels, default=0) > _MAX_DEPTH:
        raise ValueError(f"its blocks are nested deeper than {_MAX_DEPTH} levels")
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

    A file with a single camera has the name "".
    """
    if _is_camera(content):
        return {"": dict(content)}
    group = content.get("cameras", content)
    if isinstance(group, list):
        group = {
            str(each.get("name", each.get("id", index))): each
            for index, each in enumerate(group)
            if isinstance(each, dict)
        }
    if not isinstance(group, dict):
        return {}
    return {str(name): each for name, each in group.items() if isinstance(each, dict) and _is_camera(each)}


def _is_camera(content: Mapping[str, Any]) -> bool:
    if "params" in content:
        return "colmap_id" in content
    keys = _flat(content)
    return _first(keys, _MATRIX) is not None or any(name in keys for name in _NAMES["fx"])


def _flat(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values by key in small letters without separators, with those of nested intrinsics."""
    out: dict[str, Any] = {}
    for key, value in content.items():
        name = _plain(key)
        out.update(_flat(value) if name in _NESTED and isinstance(value, dict) else {name: value})
    return out


def _plain(text: object) -> str:
    return re.sub(r"[^a-z0-9]", "", str(text or "").lower())


def _first(keys: Mapping[str, Any], pattern: re.Pattern[str]) -> Any:
    return next((value for key, value in keys.items() if pattern.fullmatch(key) and value is not None), None)


def _numbers(value: Any) -> list[float]:
    """Return the numbers of a list, of nested lists, of a matrix of OpenCV, or of a text with spaces."""
    if isinstance(value, dict):
        value = value["data"]
    if isinstance(value, str):
        value = value.replace(",", " ").split()
    if not isinstance(value, list):
        return [float(value)]
    return [
        number for part in value for number in (_numbers(part) if isinstance(part, list) else [float(part)])
    ]


def in_own_format(camera: Mapping[str, Any], path: Path, field: str) -> dict[str, Any]:
    """Return a camera of `cameras_of` with the keys of `Calibration`; its other keys are kept.

    Args:
        camera: The camera.
        path: Path of the file, for errors.
        field: Key of the camera in the file; "" for a file with a single camera.

    Raises:
        CaptureError: No camera model of COLMAP expresses the lens, or a value is missing or wrong.
    """
    if "colmap_id" in camera:
        return dict(camera)
    keys = _flat(camera)
    try:
        lens = _lens(camera, keys)
    except (ValueError, TypeError, LookupError, ArithmeticError) as error:
        reason = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) else str(error)
        raise CaptureError(
            f"this calibration of {_program(camera)} cannot be used: {reason}",
            path=path,
            field=field or None,
            hint="calibrate with a lens model that COLMAP has, too: OpenCV's terms k1 to k6, p1 and p2, "
            "equidistant (fisheye), FOV, EUCM, or omni without distortion (Kalibr: pinhole-radtan, "
            f"pinhole-equi, pinhole-fov, eucm-none); or {CALIBRATION_EXAMPLE}",
        ) from error
    made: dict[str, Any] = {}
    if "camerabrand" in keys:
        brand = " ".join(str(keys[key]) for key in ("camerabrand", "cameramodel") if keys.get(key))
        made = {"camera": brand, "lens_mode": str(keys.get("lensmodel") or "")}
    with contextlib.suppress(ValueError, TypeError):
        made["rms_px"] = float(_first(keys, _RMS))
    return {**camera, **lens, "calibrated_with": made or None}


def _program(camera: Mapping[str, Any]) -> str:
    """Return the name of the program that writes the keys of a camera."""
    names = {"fisheye_params": "Gyroflow", "rostopic": "Kalibr", "distortion_coeffs": "Kalibr"}
    names |= {"intrinsic_type": "OpenImuCameraCalibrator", "cam_id": "Caliscope"}
    return next((name for key, name in names.items() if key in camera), "OpenCV or ROS")


def _lens(camera: Mapping[str, Any], keys: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys of `Calibration` for a camera. Raises `ValueError` if no model expresses the lens."""
    kind = _kind(camera, keys)
    width, height = _picture_size(keys)
    extra, (fx, fy, cx, cy), skew = _matrix(keys, kind)
    if abs(skew) * 0.5 * height / fy > _MAX_SKEW_PX:
        raise ValueError(f"its axes are not perpendicular (skew {skew:g} px)")
    coefficients = _first(keys, _COEFFICIENTS)
    terms = _numbers(coefficients) if coefficients is not None else _named_terms(keys, kind)
    model, params = _colmap_model(kind, extra, terms)
    if kind == "omni":
        fx, fy = fx / (1.0 + extra[0]), fy / (1.0 + extra[0])
    # Gyroflow stretches the pictures of some lenses before it calibrates.
    x, y = (_stretch(keys.get(f"input{axis}stretch")) for axis in ("horizontal", "vertical"))
    centre = [(cx + 0.5) / x - 0.5, (cy + 0.5) / y - 0.5]
    return {
        "model": model,
        "params": [fx / x, fy / y, *centre, *params],
        "width": round(width / x),
        "height": round(height / y),
        "pixel_origin": "colmap" if "flx" in keys else "opencv",  # nerfstudio has COLMAP's
    }


def _stretch(value: Any) -> float:
    return float(value) if value and float(value) > 0.01 else 1.0


def _kind(camera: Mapping[str, Any], keys: Mapping[str, Any]) -> str:
    """Return the kind of a lens: a value of `_LENSES`. Raises `ValueError` for any other lens."""
    distortion = _plain(keys.get("distortionmodel"))
    projection = _plain(keys.get("cameramodel") or keys.get("intrinsictype") or keys.get("cameratype"))
    if "fisheye_params" in camera:  # Gyroflow, whose camera_model is a product
        projection, distortion = "", distortion or "fisheye"
        if keys.get("digitallens"):
            raise ValueError(f"the camera warps the pictures ({keys['digitallens']})")
    elif str(keys.get("fisheye", keys.get("fisheyemodel", 0))).lower() in ("1", "true"):
        distortion = "fisheye"
    own = _LENSES.get(projection)
    kind = own if own in ("eucm", "omni") else _LENSES.get(distortion or projection)
    if own is None or kind is None:
        name = keys.get("distortionmodel") if own is not None else projection
        raise ValueError(f"COLMAP has no lens model {name!r}")
    return kind


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


def _matrix(keys: Mapping[str, Any], kind: str) -> tuple[list[float], list[float], float]:
    """Return the parameters of the projection, the focal lengths with the principal point, and the skew."""
    found = _first(keys, _MATRIX)
    if found is not None:
        numbers = _numbers(found)
        if len(numbers) == 9:
            return [], [numbers[0], numbers[4], numbers[2], numbers[5]], numbers[1]
        return numbers[:-4], numbers[-4:], 0.0
    fx = _named(keys, "fx")
    fy = fx * float(keys.get("aspectratio", 1.0)) if "focallength" in keys else _named(keys, "fy")
    extra = {"eucm": ("alpha", "beta"), "omni": ("xi",)}.get(kind, ())
    centre = [_named(keys, "cx"), _named(keys, "cy")]
    return [float(keys[name]) for name in extra], [fx, fy, *centre], float(keys.get("skew", 0.0))


def _named(keys: Mapping[str, Any], name: str, default: float | None = None) -> float:
    for key in _NAMES.get(name, (name, f"radialdistortion{name[1:]}")):
        if keys.get(key) is not None:
            return float(keys[key])
    if default is None:
        raise KeyError(name)
    return default


def _named_terms(keys: Mapping[str, Any], kind: str) -> list[float]:
    if kind == "fov":
        return [float(keys[name]) for name in ("w", "omega", "radialdistortion1") if name in keys][:1]
    return [_named(keys, name, 0.0) for name in _TERMS.get(kind, ())]


def _colmap_model(kind: str, extra: Sequence[float], terms: Sequence[float]) -> tuple[str, list[float]]:
    """Return COLMAP's model of a lens, and its parameters after the principal point."""
    limit = {"brown": 8, "fisheye": 4, "fov": 1}.get(kind, 0)
    if any(terms[limit:]):
        name = "with thin-prism or tilt terms" if kind == "brown" else f"{kind} with this distortion"
        raise ValueError(f"COLMAP has no lens model {name} ({', '.join(f'{term:g}' for term in terms)})")
    if kind == "fov":
        return "FOV", [terms[0]]
    if kind == "eucm":
        alpha, beta = extra
        return "EUCM", [alpha, beta]
    if kind == "omni":  # the unified model is the enhanced one with beta = 1
        return "EUCM", [extra[0] / (1.0 + extra[0]), 1.0]
    if kind == "fisheye":
        return "OPENCV_FISHEYE", [*terms, *[0.0] * 4][:4]
    if any(terms[4:]):
        return "FULL_OPENCV", [*terms, *[0.0] * 8][:8]
    return ("OPENCV", [*terms, *[0.0] * 4][:4]) if any(terms) else ("PINHOLE", [])


def name_of_format(content: Mapping[str, Any]) -> str:
    """Return the name of a known format that is not read; "" for any other content."""
    parts = [content, *(part for part in content.values() if isinstance(part, dict))]
    return next((name for key, name in _OTHER_FORMATS.items() if any(key in part for part in parts)), "")
