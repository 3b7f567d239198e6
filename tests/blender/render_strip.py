"""Run by Blender's Python: pictures of a moving body from the side and the front, on a floor of squares.

    python render_strip.py pictures_folder motion.glb [frames]

The pictures side.png and front.png show the body at some frames, one after the other. The front is the
direction of the path, or -Y if the body stays in its place. Left limbs are blue, right ones are red.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import bpy
from mathutils import Matrix, Vector

SAMPLES, PIXELS = 3, 140
SQUARE_M = 0.25
STAYS_M = 0.7
HEIGHT_M, WIDTH_M = 2.0, 1.3


def bring_in(path: Path) -> Any:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=str(path))
    (body,) = [item for item in bpy.data.objects if item.type == "ARMATURE"]
    return body


def material(name: str, colour: tuple[float, float, float]) -> Any:
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    made.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (*colour, 1.0)
    return made


def build_floor() -> None:
    """Add a chequered floor at the height z = 0, so that feet below it are hidden."""
    bpy.ops.mesh.primitive_plane_add(size=40.0)
    floor = bpy.context.object
    made = material("floor", (0.5, 0.5, 0.5))
    nodes, links = made.node_tree.nodes, made.node_tree.links
    checker = nodes.new("ShaderNodeTexChecker")
    checker.inputs["Scale"].default_value = 1.0 / SQUARE_M
    checker.inputs["Color1"].default_value = (0.75, 0.75, 0.75, 1.0)
    checker.inputs["Color2"].default_value = (0.45, 0.45, 0.45, 1.0)
    place = nodes.new("ShaderNodeTexCoord")
    links.new(place.outputs["Object"], checker.inputs["Vector"])
    links.new(checker.outputs["Color"], nodes["Principled BSDF"].inputs["Base Color"])
    floor.data.materials.append(made)


def paint(body: Any) -> None:
    """Give the two sides of the body different colours, so that left and right can be told apart."""
    colours = [
        material("middle", (0.8, 0.7, 0.55)),
        material("left", (0.15, 0.35, 0.8)),
        material("right", (0.75, 0.2, 0.15)),
    ]
    for item in bpy.data.objects:
        if item.type != "MESH" or item.find_armature() is not body:
            continue
        item.data.materials.clear()
        for each in colours:
            item.data.materials.append(each)
        names = {group.index: group.name.lower() for group in item.vertex_groups}
        for polygon in item.data.polygons:
            votes = [0, 0, 0]
            for vertex in polygon.vertices:
                groups = item.data.vertices[vertex].groups
                name = names[max(groups, key=lambda each: each.weight).group] if len(groups) else ""
                is_left = name.startswith("left") or (name[:1] == "l" and name[1:2].isupper())
                is_right = name.startswith("right") or (name[:1] == "r" and name[1:2].isupper())
                votes[1 if is_left else 2 if is_right else 0] += 1
            polygon.material_index = votes.index(max(votes))


def hips_of(body: Any) -> Vector:
    root = next(bone for bone in body.pose.bones if bone.parent is None)
    return body.matrix_world @ root.head


def still_copy(body: Any) -> list[Any]:
    """Return copies of the body's meshes as they are at the current frame, in world coordinates."""
    graph = bpy.context.evaluated_depsgraph_get()
    out = []
    for item in bpy.data.objects:
        if item.type == "MESH" and item.find_armature() is body:
            shown = item.evaluated_get(graph)
            mesh = bpy.data.meshes.new_from_object(shown)
            mesh.transform(shown.matrix_world)
            out.append(bpy.data.objects.new("still", mesh))
    return out


def main(folder: str, file: str, count: str = "12") -> None:
    body = bring_in(Path(file))
    scene = bpy.context.scene
    paint(body)
    start, end = (round(edge) for edge in body.animation_data.action.frame_range)
    stills, places = [], []
    for k in range(int(count)):
        scene.frame_set(round(start + (end - start) * k / (int(count) - 1)))
        places.append(hips_of(body).copy())
        stills.append(still_copy(body))
    for item in scene.objects:
        item.hide_render = True
    for item in (each for still in stills for each in still):
        scene.collection.objects.link(item)
    build_floor()
    way = places[-1] - places[0]
    heading = math.atan2(way.y, way.x) if math.hypot(way.x, way.y) > STAYS_M else -0.5 * math.pi
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.type = "ORTHO"
    camera.data.ortho_scale = len(stills) * WIDTH_M
    scene.collection.objects.link(camera)
    scene.camera = camera
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy = 3.0
    sun.rotation_euler = (0.7, 0.3, 0.5)
    scene.collection.objects.link(sun)
    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.9, 0.93, 1.0, 1.0)
    scene.render.engine = "CYCLES"
    scene.cycles.samples = SAMPLES
    scene.cycles.max_bounces = 1
    scene.cycles.device = "CPU"
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    # A person on stairs rises out of a picture of the height of a person.
    height_m = HEIGHT_M + max(place.z for place in places) - places[0].z
    scene.render.resolution_x = len(stills) * PIXELS
    scene.render.resolution_y = round(PIXELS * height_m / WIDTH_M)
    for view, turn in (("side", -0.5 * math.pi), ("front", 0.0)):
        angle = heading + turn
        out = Vector((math.cos(angle), math.sin(angle), 0.0))
        right = Vector((-math.sin(angle), math.cos(angle), 0.0))
        for number, still in enumerate(stills):
            column = (number - 0.5 * (len(stills) - 1)) * WIDTH_M
            for item in still:
                item.location = column * right - Vector((places[number].x, places[number].y, 0.0))
        eye = 20.0 * out + Vector((0.0, 0.0, 0.46 * height_m + 2.0))
        look = (Vector((0.0, 0.0, 0.46 * height_m)) - eye).to_track_quat("-Z", "Y").to_matrix().to_4x4()
        camera.matrix_world = Matrix.Translation(eye) @ look
        scene.render.filepath = str(Path(folder) / f"{view}.png")
        bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
