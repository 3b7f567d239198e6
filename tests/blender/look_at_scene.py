"""Run by Blender's Python: tell what the scene holds that the script of the results built.

python look_at_scene.py scene.blend facts.json
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import bpy
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

FRAMES = (1, 31, 60)


def curves(item: Any) -> list[Any]:
    action = item.animation_data.action
    if not hasattr(action, "slots"):
        return list(action.fcurves)
    return [c for layer in action.layers for s in layer.strips for bag in s.channelbags for c in bag.fcurves]


def main(blend: str, target: str) -> None:
    bpy.ops.wm.open_mainfile(filepath=blend)
    scene = bpy.context.scene
    body = bpy.data.objects["Body"]
    cameras = {item.name: item for item in bpy.data.objects if item.type == "CAMERA"}
    joints: dict[str, list[Any]] = {bone.name: [] for bone in body.pose.bones}
    poses: dict[str, list[Any]] = {name: [] for name in cameras}
    for frame in FRAMES:
        scene.frame_set(frame)
        for bone in body.pose.bones:
            joints[bone.name].append(list(body.matrix_world @ bone.head))
        for name, item in cameras.items():
            poses[name].append([list(row) for row in item.matrix_world])
    scene.render.resolution_x, scene.render.resolution_y = 640, 480
    in_view = {
        name: list(world_to_camera_view(scene, item, item.matrix_world @ Vector((0, 0, -2.0))))[:2]
        for name, item in cameras.items()
    }
    facts = {
        "fps": scene.render.fps / scene.render.fps_base,
        "range": [scene.frame_start, scene.frame_end],
        "objects": {item.name: item.type for item in bpy.data.objects},
        "keys": sorted({round(p.co.x, 4) for curve in curves(body) for p in curve.keyframe_points}),
        "joints": joints,
        "cameras": poses,
        "videos": {
            name: Path(item.data.background_images[0].image.filepath).name
            for name, item in cameras.items()
            if item.data.background_images
        },
        "connected": sum(bone.use_connect for bone in body.data.bones),
        "markers": sorted([marker.frame, marker.name] for marker in scene.timeline_markers),
        "axis_in_view": in_view,
    }
    Path(target).write_text(json.dumps(facts), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
