"""Write FBX files for Maya, Unreal and Unity. These programs do not read BVH files."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.core.errors import StoreError
from bodycap_batch.formats.atomic_files import atomic_replacement
from bodycap_batch.formats.fbx.blender_process import run_script
from bodycap_batch.formats.fbx.blender_script import GLB_FPS
from bodycap_batch.formats.gltf import write_glb
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.skeleton import Motion, rest_pose
from bodycap_batch.model.take import Take

POSITION_TOLERANCE_M = 1e-4
"""Maximum distance, metres, between a joint that is read back from the file and the same joint in the motion.
Derivation: FBX and GLB store single-precision numbers, and an animator cannot see such a small distance."""

_CONVERT_SCRIPT = Path(__file__).with_name("blender_script.py")

_BEFORE_BLENDER_IMPORT = (-np.pi / 2, 0.0, 0.0)
"""Rotation vector (radians) of the whole scene in the GLB file. Blender's glTF importer rotates the scene by
90° about X. Both rotations cancel, so the axes of the joints are unchanged."""


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
    with tempfile.TemporaryDirectory() as folder, atomic_replacement(path) as temporary:
        figure, report = Path(folder) / "figure.glb", Path(folder) / "report.json"
        write_glb(figure, replace(motion, fps=GLB_FPS), file_from_up=so3_exp(_BEFORE_BLENDER_IMPORT))
        frames, facts = len(motion.root_in_world_m), json.dumps({} if take is None else take.figures())
        done = run_script(
            _CONVERT_SCRIPT,
            [str(figure), str(temporary), str(report), repr(motion.fps), str(frames), facts],
        )
        if done.returncode != 0 or not report.is_file():
            last = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
            raise StoreError(
                f"Blender could not write the file: {last}", path=path, hint="check the disk for errors"
            )
        off_m = _max_joint_difference_m(json.loads(report.read_text(encoding="utf-8")), motion)
        if not off_m <= POSITION_TOLERANCE_M:
            hint = "check the disk; if the disk has no errors, report this as a bug"
            raise StoreError(
                f"the joints in the written file differ from the solved joints by {off_m * 1000:.3g} mm",
                path=path,
                hint=hint,
            )
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
