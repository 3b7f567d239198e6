"""Write animated cameras with Blender: FBX files, and Alembic files."""

from __future__ import annotations

import json
import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.core.errors import StoreError
from bodycap_batch.formats.atomic_files import atomic_replacement
from bodycap_batch.formats.fbx.blender_process import run_script
from bodycap_batch.model.animated_camera import FAR_PLANE, NEAR_PLANE, CameraScene

_CAMERA_SCRIPT = Path(__file__).with_name("camera_script.py")

_WRITTEN_AT = re.compile(rb"_ai_DateWritten=[^;]{24}")
_CONSTANT_TIME = b"_ai_DateWritten=Thu Jan  1 00:00:00 1970"
"""Time in the header of an Alembic file, of the same length, so that equal cameras give equal bytes."""

_TOLERANCE = 1e-5
"""Maximum difference of the elements of the poses that are read back, relative to the largest distance from
the origin. Derivation: Blender stores single-precision numbers, and FBX angles in degrees."""


def write_cameras_with_blender(path: Path, scene: CameraScene) -> Path:
    """Write cameras as an FBX file (``.fbx``) or an Alembic file (``.abc``), and read the file back.

    A frame that is not valid keeps the last pose. The custom properties of each camera hold the take, the
    exact rate, the start timecode and the valid frames. The points of the room are not in the file.

    Args:
        path: Path of the file, which is replaced atomically.
        scene: The cameras. For equal bytes, an Alembic file must have one camera only.

    Returns:
        The path of the file.

    Raises:
        JobError: Blender was not found.
        StoreError: Blender failed, or the cameras that it reads back differ from the cameras.
    """
    with tempfile.TemporaryDirectory() as folder, atomic_replacement(path) as temporary:
        source, report = Path(folder) / "cameras.json", Path(folder) / "report.json"
        source.write_text(json.dumps(_content(scene)), encoding="utf-8")
        done = run_script(_CAMERA_SCRIPT, [str(source), str(temporary), str(report)])
        if done.returncode != 0 or not report.is_file():
            last = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
            raise StoreError(
                f"Blender could not write the file: {last}", path=path, hint="check the disk for errors"
            )
        differing = _differing_cameras(json.loads(report.read_text(encoding="utf-8")), scene)
        if differing:
            raise StoreError(
                f"the cameras in the written file differ from the solved cameras: {', '.join(differing)}",
                path=path,
                hint="check the disk; if the disk has no errors, report this as a bug",
            )
        if path.suffix == ".abc":
            temporary.write_bytes(_WRITTEN_AT.sub(_CONSTANT_TIME, temporary.read_bytes()))
    return path


def _content(scene: CameraScene) -> dict[str, Any]:
    """Return what the script in Blender needs, as plain JSON values."""
    facts = scene.figures()
    return {
        "name": scene.take.name or "Cameras",
        "rate": str(scene.take.rate),
        "frames": scene.frame_count,
        "cameras": {
            camera.name: {
                "focal_mm": camera.focal_mm,
                "sensor_mm": camera.figures()["sensor_mm"],
                "range": [NEAR_PLANE, FAR_PLANE],
                "size_px": [camera.pinhole.width_px, camera.pinhole.height_px],
                "properties": {
                    **facts,
                    "width_px": camera.pinhole.width_px,
                    "height_px": camera.pinhole.height_px,
                    "valid_frames": json.dumps(camera.figures()["valid_frames"]),
                },
                "scene_from_gl": camera.scene_from_gl()[:, :3].tolist(),
            }
            for camera in scene.cameras
        },
    }


def _differing_cameras(report: dict[str, Any], scene: CameraScene) -> list[str]:
    """Return the names of the cameras that are missing in Blender's report, or have other poses or lenses."""
    out = []
    for camera in scene.cameras:
        found, expected = report.get(camera.name), camera.scene_from_gl()[:, :3]
        if found is None:
            out.append(camera.name)
            continue
        off = np.abs(np.array(found["scene_from_gl"]) - expected).max()
        ratio = (
            found["focal_mm"] / found["sensor_mm"][0] / (camera.pinhole.focal_px / camera.pinhole.width_px)
        )
        reach = max(1.0, float(np.abs(expected[..., 3]).max()))
        if not (off <= _TOLERANCE * reach and abs(ratio - 1.0) <= _TOLERANCE):
            out.append(camera.name)
    return out
