"""Run by Blender's Python: import files with Blender's own importers and tell what is in the scene.

    python look.py report.json fps file [file ...] [--picture preview.png]

The report holds the armature at rest and, of every frame, the world positions and matrices of its bones.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import bpy
from mathutils import Vector


def bring_in(path: Path) -> None:
    """Import a file as a user would: defaults, but for the scale of a BVH in centimetres."""
    name = str(path)
    if path.suffix == ".bvh":
        scale = 1.0 if path.stem.endswith("_m") else 0.01
        bpy.ops.import_anim.bvh(
            filepath=name, global_scale=scale, update_scene_fps=True, update_scene_duration=True
        )
    elif path.suffix == ".glb":
        bpy.ops.import_scene.gltf(filepath=name)
    elif path.suffix == ".fbx":
        bpy.ops.import_scene.fbx(filepath=name)
    elif path.suffix == ".ply":
        bpy.ops.wm.ply_import(filepath=name)
    else:
        bpy.ops.wm.usd_import(filepath=name)


def armature() -> Any:
    """The one armature of the scene."""
    (found,) = [item for item in bpy.data.objects if item.type == "ARMATURE"]
    return found


def rows(matrix: Any) -> list[list[float]]:
    return [list(row) for row in matrix]


def frames_of(body: Any) -> tuple[int, int]:
    """First and last frame of the action that moves the armature."""
    start, end = body.animation_data.action.frame_range
    return round(start), round(end)


def curves(body: Any) -> list[Any]:
    """The animation curves of the armature."""
    action = body.animation_data.action
    return [
        curve
        for layer in action.layers
        for strip in layer.strips
        for bag in strip.channelbags
        for curve in bag.fcurves
    ]


def report() -> dict[str, Any]:
    """What the scene holds."""
    rate = bpy.context.scene.render
    out: dict[str, Any] = {"clouds": {}, "colors": {}, "fps": rate.fps / rate.fps_base}
    for item in bpy.data.objects:
        if item.type == "MESH" and not item.data.polygons:
            out["clouds"][item.name] = [list(item.matrix_world @ vertex.co) for vertex in item.data.vertices]
            out["colors"][item.name] = [
                list(entry.color_srgb) for entry in item.data.color_attributes[0].data
            ]
    body = armature()
    out["armature"] = rows(body.matrix_world)
    out["joints"] = [bone.name for bone in body.data.bones]
    out["parents"] = {bone.name: bone.parent.name if bone.parent else None for bone in body.data.bones}
    out["sources"] = {bone.name: bone.get("motion_source") for bone in body.pose.bones}
    out["objects"] = sorted(
        f"{item.type} {item.name}"
        for item in bpy.data.objects
        if not any(c.name == "glTF_not_exported" for c in item.users_collection)
    )
    out["keys"] = sorted({point.co.x for curve in curves(body) for point in curve.keyframe_points})
    out["tails"] = {bone.name: list(body.matrix_world @ bone.tail_local) for bone in body.data.bones}
    out["rest"] = {bone.name: rows(body.matrix_world @ bone.matrix_local) for bone in body.data.bones}
    out["frames"] = first, last = frames_of(body)
    out["world"] = {bone.name: [] for bone in body.pose.bones}
    for frame in range(first, last + 1):
        bpy.context.scene.frame_set(frame)
        for bone in body.pose.bones:
            out["world"][bone.name].append(rows(body.matrix_world @ bone.matrix))
    figures = [item for item in bpy.data.objects if item.type == "MESH" and item.find_armature() == body]
    out["figure"] = {}
    for item in figures:
        seen = item.evaluated_get(bpy.context.evaluated_depsgraph_get())
        out["figure"][item.name] = [list(item.matrix_world @ vertex.co) for vertex in seen.data.vertices]
    return out


def draw(picture: Path) -> None:
    """Render the last frame from the front, a little from the left and above."""
    scene = bpy.context.scene
    body = armature()
    heads = [body.matrix_world @ bone.head for bone in body.pose.bones]
    middle = sum(heads, Vector()) / len(heads)
    if not any(item.type == "MESH" and item.find_armature() == body for item in bpy.data.objects):
        for bone in body.pose.bones:
            start, end = body.matrix_world @ bone.head, body.matrix_world @ bone.tail
            bpy.ops.mesh.primitive_cone_add(
                radius1=0.02, radius2=0.004, depth=max((end - start).length, 1e-3), location=(start + end) / 2
            )
            bpy.context.object.rotation_mode = "QUATERNION"
            bpy.context.object.rotation_quaternion = (end - start).to_track_quat("Z", "Y")
    bpy.ops.mesh.primitive_plane_add(size=8, location=(middle.x, middle.y, 0.0))
    camera = bpy.data.objects.new("view", bpy.data.cameras.new("view"))
    scene.collection.objects.link(camera)
    camera.location = middle + Vector((1.6, -3.6, 1.0))
    camera.rotation_mode = "QUATERNION"
    camera.rotation_quaternion = (middle - camera.location).to_track_quat("-Z", "Y")
    scene.camera = camera
    light = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    light.data.energy = 3.0
    light.rotation_euler = (0.6, 0.3, 0.0)
    scene.collection.objects.link(light)
    scene.world = scene.world or bpy.data.worlds.new("world")
    scene.world.color = (0.25, 0.27, 0.3)
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 4
    scene.cycles.device = "CPU"
    scene.render.resolution_x, scene.render.resolution_y = 320, 320
    scene.render.filepath = str(picture)
    bpy.ops.render.render(write_still=True)


def main(arguments: list[str]) -> None:
    picture = None
    if "--picture" in arguments:
        at = arguments.index("--picture")
        picture = Path(arguments[at + 1])
        del arguments[at : at + 2]
    target, fps, *files = arguments
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = round(float(fps))
    for file in files:
        bring_in(Path(file))
    Path(target).write_text(json.dumps(report()), encoding="utf-8")
    if picture is not None:
        draw(picture)


if __name__ == "__main__":
    main(sys.argv[1:])
