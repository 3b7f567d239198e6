"""Write FBX files for Maya, Unreal and Unity, which do not read BVH files, and Alembic files of cameras."""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.core.errors import StoreError
from bodycap_batch.formats.atomic_files import atomic_replacement
from bodycap_batch.formats.fbx.blender_process import run_script
from bodycap_batch.formats.fbx.blender_script import GLB_FPS
from bodycap_batch.formats.gltf import write_glb
from bodycap_batch.model.animated_camera import FAR_PLANE, NEAR_PLANE, CameraScene
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.skeleton import Motion, rest_pose
from bodycap_batch.model.take import Take

POSITION_TOLERANCE_M = 1e-4
"""Maximum distance, metres, between a joint that is read back from a file and the same joint in the motion.
Derivation: it is larger than the rounding of all formats, and an animator cannot see it."""

_CAMERA_TOLERANCE = 1e-5
"""Maximum difference of the elements of the poses that are read back, relative to the largest distance from
the origin. Derivation: Blender stores single-precision numbers, and FBX angles in degrees."""

_SCRIPT = Path(__file__).with_name("blender_script.py")

_BEFORE_BLENDER_IMPORT = (-np.pi / 2, 0.0, 0.0)
"""Rotation vector (radians) of the whole scene in the GLB file. Blender's glTF importer rotates the scene by
90° about X. Both rotations cancel, so the axes of the joints are unchanged."""

_WRITTEN_AT = re.compile(rb"_ai_DateWritten=[^;]{24}")
_CONSTANT_TIME = b"_ai_DateWritten=Thu Jan  1 00:00:00 1970"
"""Time in the header of an Alembic file, of the same length, so that equal cameras give equal bytes."""


def write_fbx(path: Path, motion: Motion, take: Take | None = None) -> Path:
    """Write a motion as an FBX file.

    Blender converts a GLB file to FBX and reads the FBX file back. Then the joint centres are compared with
    the motion. The file is in centimetres, Y up, facing +Z. The armature has neither scale nor rotation. The
    bind pose is the T-pose.

    Args:
        path: Path of the file, which is replaced atomically.
        motion: The motion, in world axes and metres.
        take: Name, exact rate and timecode: the name of the animation, and custom properties of the armature.
            None if they are unknown.

    Returns:
        The path of the file.

    Raises:
        JobError: Blender was not found.
        StoreError: Blender failed, or the file differs from the motion by more than 0.1 mm.
    """

    def difference(report: dict[str, Any]) -> str:
        off_m = _max_joint_difference_m(report, motion)
        if off_m <= POSITION_TOLERANCE_M:
            return ""
        return f"the joints in the written file differ from the solved joints by {off_m * 1000:.3g} mm"

    with tempfile.TemporaryDirectory() as folder:
        figure = Path(folder) / "figure.glb"
        write_glb(figure, replace(motion, fps=GLB_FPS), file_from_up=so3_exp(_BEFORE_BLENDER_IMPORT))
        facts = {} if take is None else take.figures()
        frames = len(motion.root_in_world_m)
        data = {"glb": str(figure), "rate": motion.fps, "frames": frames, "facts": facts}
        return _write_with_blender(path, data, difference)


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

    def difference(report: dict[str, Any]) -> str:
        differing = _differing_cameras(report, scene)
        if not differing:
            return ""
        return f"the cameras in the written file differ from the solved cameras: {', '.join(differing)}"

    return _write_with_blender(path, _camera_data(scene), difference)


def _write_with_blender(
    path: Path, data: Mapping[str, Any], difference: Callable[[dict[str, Any]], str]
) -> Path:
    """Let Blender write a file and read it back, and return the path of the file.

    Args:
        path: Path of the file, which is replaced atomically.
        data: What the script in Blender needs, as plain JSON values.
        difference: Returns how Blender's report on the file differs from what was written; "" if it does not.
    """
    with tempfile.TemporaryDirectory() as folder, atomic_replacement(path) as temporary:
        source, report = Path(folder) / "scene.json", Path(folder) / "report.json"
        source.write_text(json.dumps(data), encoding="utf-8")
        run_script(_SCRIPT, [str(source), str(temporary), str(report)], made=report, path=path)
        if problem := difference(json.loads(report.read_text(encoding="utf-8"))):
            hint = "check the disk; if the disk has no errors, report this as a bug"
            raise StoreError(problem, path=path, hint=hint)
        if path.suffix == ".abc":
            temporary.write_bytes(_WRITTEN_AT.sub(_CONSTANT_TIME, temporary.read_bytes()))
    return path


def _max_joint_difference_m(report: dict[str, Any], motion: Motion) -> float:
    """Return the largest distance, metres, between a joint in Blender's report and in the motion or T-pose.

    The distance is infinite if the joint names or the frame ranges differ.
    """
    joints, frames = report["joints"], report["frames"]
    count = len(motion.root_in_world_m)
    if set(joints) != set(motion.skeleton.joints) or (report["first"], report["last"]) != (1, count):
        return np.inf
    found = np.array([joints[name] for name in motion.skeleton.joints]).swapaxes(0, 1)
    rest = np.array([report["rest"][name] for name in motion.skeleton.joints])
    moving = np.linalg.norm(found - motion.world_from_joint()[frames][..., :3, 3], axis=-1)
    bound = np.linalg.norm(rest - rest_pose(motion.skeleton)[:, :3, 3], axis=-1)
    return float(max(moving.max(), bound.max()))


def _camera_data(scene: CameraScene) -> dict[str, Any]:
    """Return what the script in Blender needs to know about cameras, as plain JSON values."""
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
        if not (off <= _CAMERA_TOLERANCE * reach and abs(ratio - 1.0) <= _CAMERA_TOLERANCE):
            out.append(camera.name)
    return out
