"""Convert a GLB file to FBX and report the joints of the result. This script runs in Blender's Python.

    python blender_script.py in.glb out.fbx report.json fps frames

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

_COMPARED_FRAMES = 20
"""Number of frames whose joint centres are written to the report. Evidence: none; this number of frames is
enough to detect a wrong frame rate or a wrong axis."""


def convert(source: str, target: str, fps: float, frames: int) -> None:
    """Import the GLB file and export the FBX file, without leaf bones and with a key at every frame.

    Args:
        source: Path of the GLB file.
        target: Path of the FBX file.
        fps: Frames per second.
        frames: Number of frames.
    """
    import bpy

    export_fbx_bin: Any = importlib.import_module("io_scene_fbx.export_fbx_bin")

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    _set_rate(scene, fps)
    scene.unit_settings.system, scene.unit_settings.scale_length = "METRIC", 0.01
    bpy.ops.import_scene.gltf(filepath=source, disable_bone_shape=True)
    scene.frame_start, scene.frame_end = 0, frames - 1
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
        use_metadata=False,
    )


def read_back(target: str, fps: float) -> dict[str, Any]:
    """Import the FBX file into an empty scene and return its joint centres.

    Returns:
        A mapping with these keys. ``first`` and ``last``: first and last frame of the motion. ``frames``:
        numbers of the reported frames, counted from the first frame. ``joints``: by joint name, the joint
        centres at the reported frames, metres, Z up.
    """
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    _set_rate(scene, fps)
    bpy.ops.import_scene.fbx(filepath=target)
    (body,) = [item for item in bpy.data.objects if item.type == "ARMATURE"]
    first, last = (round(frame) for frame in body.animation_data.action.frame_range)
    sampled = sorted(
        {first + round(k * (last - first) / (_COMPARED_FRAMES - 1)) for k in range(_COMPARED_FRAMES)}
    )
    joints: dict[str, list[list[float]]] = {bone.name: [] for bone in body.pose.bones}
    for frame in sampled:
        scene.frame_set(frame)
        for bone in body.pose.bones:
            joints[bone.name].append(list(body.matrix_world @ bone.head))
    return {"first": first, "last": last, "frames": [frame - first for frame in sampled], "joints": joints}


def _set_rate(scene: Any, fps: float) -> None:
    """Set the frame rate of a scene. Blender stores the frame rate as an integer and a divisor."""
    scene.render.fps = max(1, round(fps))
    scene.render.fps_base = scene.render.fps / fps


def main(arguments: list[str]) -> None:
    """Convert a file, read the result back and write the report."""
    source, target, report, fps, frames = arguments
    convert(source, target, float(fps), int(frames))
    Path(report).write_text(json.dumps(read_back(target, float(fps))), encoding="utf-8")


if __name__ == "__main__":
    words = sys.argv
    main(words[words.index("--") + 1 :] if "--" in words else words[1:])
