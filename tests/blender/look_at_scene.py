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
    tracks = item.animation_data.nla_tracks
    actions = [item.animation_data.action, *(strip.action for track in tracks for strip in track.strips)]
    return [curve for action in actions for curve in curves_in(action)]


def curves_in(action: Any) -> list[Any]:
    if not hasattr(action, "slots"):
        return list(action.fcurves)
    return [c for layer in action.layers for s in layer.strips for bag in s.channelbags for c in bag.fcurves]


def poses_of(body: Any) -> dict[str, list[Any]]:
    """Return the poses of all bones in the world at every frame of the scene."""
    scene = bpy.context.scene
    poses: dict[str, list[Any]] = {bone.name: [] for bone in body.pose.bones}
    for frame in range(scene.frame_start, scene.frame_end + 1):
        scene.frame_set(frame)
        for bone in body.pose.bones:
            poses[bone.name].append([list(row) for row in body.matrix_world @ bone.matrix])
    return poses


def without_the_filled_layer(body: Any) -> dict[str, list[Any]]:
    """Return the poses of all bones after an animator has muted the layer and cleared its bones."""
    tracks = body.animation_data.nla_tracks
    tracks["filled"].mute = True
    layer = {curve.data_path.split('"')[1] for curve in curves_in(tracks["filled"].strips[0].action)}
    for name in layer:
        body.pose.bones[name].matrix_basis.identity()
    return poses_of(body)


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
    layer = curves_in(body.animation_data.nla_tracks["filled"].strips[0].action)
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
        "collections": {
            each.name: {
                "bones": sorted(bone.name for bone in each.bones),
                "colours": sorted({tuple(bone.color.custom.normal) for bone in each.bones}),
            }
            for each in body.data.collections_all
        },
        "properties": {bone.name: bone.get("motion_source") for bone in body.pose.bones},
        "tracks": [track.name for track in body.animation_data.nla_tracks],
        "filled_actions": sorted({curve.data_path.split('"')[1] for curve in layer}),
        "poses": poses_of(body),
    }
    facts["muted"] = without_the_filled_layer(body)
    Path(target).write_text(json.dumps(facts), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
