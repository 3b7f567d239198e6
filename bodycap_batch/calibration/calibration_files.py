"""Write the results of a calibration: the calibration file for jobs, and a preview picture."""

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
    """Write a calibration file that jobs read, with COLMAP's pixel origin and the errors of the fit.

    Args:
        result: The calibration.
        path: Path of the file. If `camera` is given and the file exists, the entry of this camera is added
            or replaced. If `camera` is None, an existing file is replaced.
        camera: Name of the camera to which the calibration applies; None if it applies to all cameras.

    Raises:
        JobError: The existing file cannot be read, or does not hold one entry for each camera.
        StoreError: The file cannot be written.
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
            "focal_of_halves_px": result.halves_px and [round(value, 4) for value in result.halves_px],
            "coverage": round(result.coverage, 3),
            "camera": result.mode.model,
            "lens_mode": result.mode.lens_mode,
            "notes": list(result.notes),
        },
    }


def _read_camera_entries(path: Path) -> dict[str, Any]:
    """Return the content of a calibration file with one entry for each camera; empty if there is no file."""
    if not path.exists():
        return {}
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise JobError(
            f"the file cannot be read ({error})", path=path, hint="choose another file with --out"
        ) from error
    if not isinstance(content, dict) or not isinstance(content.get("cameras"), dict):
        raise JobError(
            "the file contains one calibration for all cameras, so the calibration of a single camera "
            "cannot be added",
            path=path,
            field="--camera",
            hint="choose another file with --out, or delete this file",
        )
    return content


def write_preview(result: CalibrationResult, path: Path) -> None:
    """Write a preview: a picture of the clip (left) and the same picture without distortion (right).

    A line that is straight in the room must also be straight in the picture without distortion. Otherwise the
    calibration is wrong.

    Raises:
        StoreError: The file cannot be written.
    """
    fit, matrix, undistorted_matrix = result.fit, result.fit.matrix, result.fit.matrix.copy()
    if fit.model == "OPENCV_FISHEYE":
        # An undistorted picture of a fisheye lens's full view would be infinitely large. Only the middle of
        # the view is shown.
        undistorted_matrix[:2, :2] *= 0.6
    module: Any = cv2.fisheye if fit.model == "OPENCV_FISHEYE" else cv2
    maps = module.initUndistortRectifyMap(
        matrix, fit.distortion, np.eye(3), undistorted_matrix, result.size, cv2.CV_32FC1
    )
    flat = cv2.remap(result.preview, maps[0], maps[1], cv2.INTER_LINEAR)
    with atomic_replacement(path) as temporary:
        _, encoded = cv2.imencode(".png", np.hstack([result.preview, flat]))
        temporary.write_bytes(encoded.tobytes())
