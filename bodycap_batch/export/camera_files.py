"""Write the animated cameras in all formats, and verify the files by reading them back."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import StoreError
from bodycap_batch.formats.atomic_files import write_text
from bodycap_batch.formats.chan import read_chan, write_chan
from bodycap_batch.formats.fbx import write_cameras_with_blender
from bodycap_batch.formats.gltf import read_camera_glb, write_camera_glb
from bodycap_batch.formats.usd_cameras import read_camera_usd, write_camera_usd
from bodycap_batch.model.animated_camera import CameraScene

Writer = Callable[[Path, CameraScene], Path]
Reader = Callable[[Path], dict[str, tuple[float, FloatArray]]]

CAMERA_FORMATS = ("glb", "usd", "fbx", "chan", "abc")
"""Formats that hold animated cameras."""
CAMERA_FACTS_FILE = "cameras.json"
"""Name of the file with all that some of the formats have no place for."""
_TOLERANCE = 1e-6
"""Maximum difference of the elements of the poses that are read back, relative to the largest distance from
the origin. Derivation: the formats store single-precision numbers or eight decimals."""


def camera_writers(folder: Path, scene: CameraScene) -> dict[str, Callable[[], list[Path]]]:
    """Return, for each format of animated cameras, a function that writes its files.

    Args:
        folder: Folder of the files.
        scene: The cameras and the room.
    """

    def whole(name: str, write: Writer, read: Reader) -> list[Path]:
        path = write(folder / name, scene)
        _verify(path, scene, read(path))
        return [path]

    def chan() -> list[Path]:
        written = []
        for camera in scene.cameras:
            if camera.valid.any():
                path = write_chan(folder / "cameras" / f"{camera.name}.chan", camera)
                frames, fov, poses = read_chan(path)
                held = camera.scene_from_gl().copy()
                held[frames] = poses
                _verify(path, replace(scene, cameras=(camera,)), {camera.name: (fov, held)})
                written.append(path)
        return written

    return {
        "glb": lambda: whole("cameras.glb", write_camera_glb, read_camera_glb),
        "usd": lambda: whole("cameras.usd", write_camera_usd, read_camera_usd),
        "fbx": lambda: [write_cameras_with_blender(folder / "cameras.fbx", scene)],
        "chan": chan,
        # Blender writes several cameras into an Alembic file in another order each time.
        "abc": lambda: [
            write_cameras_with_blender(
                folder / "cameras" / f"{camera.name}.abc", replace(scene, cameras=(camera,))
            )
            for camera in scene.cameras
        ],
    }


def write_camera_facts(path: Path, scene: CameraScene) -> Path:
    """Write take, rate, timecode and frame of reference, and the lens and the frames of each camera.

    For each frame, the file states whether it is valid, the frame of the video, and the standard deviation.

    Returns:
        The path of the file.

    Raises:
        StoreError: The file cannot be written.
    """
    content = {
        **scene.figures(),
        "frames": scene.frame_count,
        "cameras": {camera.name: camera.figures() for camera in scene.cameras},
    }
    write_text(path, json.dumps(content, allow_nan=False, ensure_ascii=False) + "\n")
    return path


def _verify(path: Path, scene: CameraScene, found: dict[str, tuple[float, FloatArray]]) -> None:
    """Compare cameras that were read back with the written cameras. A file that differs is deleted.

    Raises:
        StoreError: A camera is missing, or its field of view or a pose differs too much.
    """
    for camera in scene.cameras:
        expected = camera.scene_from_gl()
        fov, poses = found.get(camera.name, (np.nan, np.full_like(expected, np.nan)))
        reach = max(1.0, float(np.abs(expected[:, :3, 3]).max()))
        same = poses.shape == expected.shape and np.abs(poses - expected).max() <= _TOLERANCE * reach
        if not (same and abs(fov - camera.vertical_fov_rad) <= _TOLERANCE):
            path.unlink(missing_ok=True)
            raise StoreError(
                f"the camera {camera.name} in the written file differs from the solved camera",
                path=path,
                hint="check the disk; if the disk has no errors, report this as a bug",
            )
