"""What a calibration leaves behind: the file that jobs read, and a picture to look at."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bodycap_batch.calibration.clip_calibration import CalibrationResult
from bodycap_batch.core.errors import JobError
from bodycap_batch.formats.atomic_files import atomic_replacement, write_text


def write_calibration(result: CalibrationResult, path: Path, camera: str | None) -> None:
    """Write ``calib.json`` as jobs read it, in COLMAP's pixel origin, with the error beside the lens.

    Args:
        result: The lens.
        path: The file. With `camera` it may exist: that camera's entry is added or replaced.
        camera: Name of the camera it holds for; None: for all.

    Raises:
        JobError: The file that is there holds something else.
        StoreError: It cannot be written.
    """
    entry = _calibration_entry(result)
    content = entry
    if camera is not None:
        content = _read_camera_entries(path)
        content["cameras"] = {**content.get("cameras", {}), camera: entry}
    write_text(path, json.dumps(content, indent=1) + "\n")


def _calibration_entry(result: CalibrationResult) -> dict[str, Any]:
    fit = result.fit
    return {
        "model": fit.model,
        "params": fit.params,
        "width": result.size[0],
        "height": result.size[1],
        "pixel_origin": "COLMAP (centre of first pixel = 0.5)",
        "calibrated_with": {
            "board": str(result.board),
            "views": len(fit.kept),
            "rms_px": round(fit.rms_px, 4),
            "view_rms_px": [round(value, 4) for value in fit.view_rms_px],
            "focal_sigma_px": [round(value, 4) for value in fit.focal_sigma_px],
            "coverage": round(result.coverage, 3),
            "notes": list(result.notes),
        },
    }


def _read_camera_entries(path: Path) -> dict[str, Any]:
    """The file's content where it holds several cameras, empty where there is no file."""
    if not path.exists():
        return {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise JobError(f"cannot be added to ({error})", path=path, hint="another --out") from error
    if not isinstance(content, dict) or not isinstance(content.get("cameras"), dict):
        raise JobError(
            "holds one calibration for all cameras; a camera's own cannot be added",
            path=path,
            field="--camera",
            hint="another --out, or delete the file",
        )
    return content


def write_preview(result: CalibrationResult, path: Path) -> None:
    """Write a picture of the clip (left) and the same without distortion (right): lines must be straight.

    Raises:
        StoreError: It cannot be written.
    """
    fit, (width, height) = result.fit, result.size
    matrix, straight = fit.matrix, fit.matrix.copy()
    if fit.model == "OPENCV_FISHEYE":
        # A flat picture of all that a fisheye sees is endless: show its middle.
        straight[:2, :2] *= 0.6
        maps = cv2.fisheye.initUndistortRectifyMap(
            matrix, fit.distortion, np.eye(3), straight, (width, height), cv2.CV_32FC1
        )
    else:
        maps = cv2.initUndistortRectifyMap(
            matrix, fit.distortion, np.eye(3), straight, (width, height), cv2.CV_32FC1
        )
    flat = cv2.remap(result.preview, maps[0], maps[1], cv2.INTER_LINEAR)
    with atomic_replacement(path) as temporary:
        _, encoded = cv2.imencode(".png", np.hstack([result.preview, flat]))
        temporary.write_bytes(encoded.tobytes())
