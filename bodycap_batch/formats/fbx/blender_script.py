"""Convert a GLB file to FBX and report the joints of the result. This script runs in Blender's Python.

    python blender_script.py in.glb out.fbx report.json fps frames facts

The unit of length of the Blender scene is the centimetre. Blender's glTF importer converts metres to
centimetres, so the FBX file needs no scale.
"""

from __future__ import annotations

import datetime as dt
import functools
import importlib
import json
import sys
from pathlib import Path
from typing import Any

GLB_FPS = 30.0
"""Frames per second of the GLB file to convert, whatever the rate of the motion is. Derivation: Blender's
glTF importer places keys on whole frames only at a whole number of frames per second."""

_BIND_FRAME = -1
"""Frame of the bind pose while Blender writes the file. Derivation: the motion starts at frame 0, and frames
before it are not written."""

_COMPARED_FRAMES = 20
"""Number of frames whose joint centres are written to the report. Evidence: none; this number of frames is
enough to detect a wrong frame rate or a wrong axis."""


def convert(source: str, target: str, fps: float, frames: int, facts: dict[str, Any]) -> None:
    """Import the GLB file and export the FBX file, without leaf bones and with a key at every frame.

    Args:
        source: Path of the GLB file, with a frame every 1 / `GLB_FPS` seconds.
        target: Path of the FBX file.
        fps: Frames per second of the motion.
        frames: Number of frames.
        facts: Name of the take, exact rate and timecode, as custom properties of the armature.
    """
    import bpy

    export_fbx_bin: Any = importlib.import_module("io_scene_fbx.export_fbx_bin")

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.name = facts.get("take", "Motion")  # the name of the animation in the file
    _set_rate(scene, GLB_FPS)
    scene.unit_settings.system, scene.unit_settings.scale_length = "METRIC", 0.01
    bpy.ops.import_scene.gltf(filepath=source, disable_bone_shape=True)
    _set_rate(scene, fps)
    (body,) = [item for item in bpy.data.objects if item.type == "ARMATURE"]
    for key, value in facts.items():
        body[key] = value
    scene.frame_start, scene.frame_end = 0, frames - 1
    _go_to_bind_pose(scene)
    header = export_fbx_bin.fbx_header_elements
    # Blender would write the current time into the header, and equal motions would give different bytes.
    # Therefore the time is replaced by a constant.
    export_fbx_bin.fbx_header_elements = functools.partial(header, time=dt.datetime(1970, 1, 1))
    bpy.ops.export_scene.fbx(
        filepath=target,
        object_types={"ARMATURE", "MESH"},
        use_space_transform=False,
        axis_up="Y",
        axis_forward="-Z",
        apply_unit_scale=True,
        apply_scale_options="FBX_SCALE_NONE",
        add_leaf_bones=False,
        bake_anim=True,
        bake_anim_use_nla_strips=False,
        bake_anim_use_all_actions=False,
        bake_anim_step=1.0,
        bake_anim_simplify_factor=0.0,
        use_custom_props=True,
        use_metadata=False,
    )


def _go_to_bind_pose(scene: Any) -> None:
    """Key the bind pose before the first frame, and make this frame the current one.

    The exporter writes the current pose as the pose of the nodes. Programs that ignore the bind pose of the
    skin, such as Unity, take the T-pose from the nodes.
    """
    import bpy

    (body,) = [item for item in bpy.data.objects if item.type == "ARMATURE"]
    for bone in body.pose.bones:
        bone.matrix_basis.identity()
        for channel in ("location", "rotation_quaternion", "scale"):
            bone.keyframe_insert(channel, frame=_BIND_FRAME)
    scene.frame_set(_BIND_FRAME)


def read_back(target: str, fps: float) -> dict[str, Any]:
    """Import the FBX file into an empty scene and return its joint centres.

    Returns:
        A mapping with these keys. ``first`` and ``last``: first and last frame of the motion. ``frames``:
        numbers of the reported frames, counted from the first frame. ``joints``: by joint name, the joint
        centres at the reported frames, metres, Z up. ``rest``: by joint name, the centre in the bind pose.
    """
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    _set_rate(scene, fps)
    bpy.ops.import_scene.fbx(filepath=target)
    (body,) = [item for item in bpy.data.objects if item.type == "ARMATURE"]
    # The importer places keys as if the rate were a whole number of frames per second.
    frames_each = round(fps) / fps
    first, last = (float(frame) for frame in body.animation_data.action.frame_range)
    count = round((last - first) / frames_each)
    sampled = sorted({round(k * count / (_COMPARED_FRAMES - 1)) for k in range(_COMPARED_FRAMES)})
    joints: dict[str, list[list[float]]] = {bone.name: [] for bone in body.pose.bones}
    for frame in sampled:
        at = first + frame * frames_each
        scene.frame_set(int(at), subframe=at - int(at))
        for bone in body.pose.bones:
            joints[bone.name].append(list(body.matrix_world @ bone.head))
    rest = {bone.name: list(body.matrix_world @ bone.head_local) for bone in body.data.bones}
    return {"first": first, "last": first + count, "frames": sampled, "joints": joints, "rest": rest}


def _set_rate(scene: Any, fps: float) -> None:
    """Set the frame rate of a scene. Blender stores the frame rate as an integer and a divisor."""
    scene.render.fps = max(1, round(fps))
    scene.render.fps_base = scene.render.fps / fps


def main(arguments: list[str]) -> None:
    """Convert a file, read the result back and write the report."""
    source, target, report, fps, frames, facts = arguments
    convert(source, target, float(fps), int(frames), json.loads(facts))
    Path(report).write_text(json.dumps(read_back(target, float(fps))), encoding="utf-8")


if __name__ == "__main__":
    words = sys.argv
    main(words[words.index("--") + 1 :] if "--" in words else words[1:])
