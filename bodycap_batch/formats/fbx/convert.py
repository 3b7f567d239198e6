"""Run by Blender's Python: a GLB becomes an FBX, which is read back for comparison.

    python convert.py in.glb out.fbx report.json fps frames

Blender's unit is the centimetre here: its glTF importer turns metres into it, the FBX needs no scale.
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


def convert(source: str, target: str, fps: float, frames: int) -> None:
    """Import the GLB and export the FBX: no leaf bones, every frame a key."""
    import bpy

    export_fbx_bin: Any = importlib.import_module("io_scene_fbx.export_fbx_bin")

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    _set_rate(scene, fps)
    scene.unit_settings.system, scene.unit_settings.scale_length = "METRIC", 0.01
    bpy.ops.import_scene.gltf(filepath=source, disable_bone_shape=True)
    scene.frame_start, scene.frame_end = 0, frames - 1
    header = export_fbx_bin.fbx_header_elements
    # The one place that would hold the time of day.
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
    """Import the FBX into an empty scene: where its joints are at some frames, in metres, Z up."""
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
    scene.render.fps = max(1, round(fps))
    scene.render.fps_base = scene.render.fps / fps


def main(arguments: list[str]) -> None:
    """Convert, read back, report."""
    source, target, report, fps, frames = arguments
    convert(source, target, float(fps), int(frames))
    Path(report).write_text(json.dumps(read_back(target, float(fps))), encoding="utf-8")


if __name__ == "__main__":
    words = sys.argv
    main(words[words.index("--") + 1 :] if "--" in words else words[1:])
