"""Run by Blender's Python: import a file with animated cameras, and report where they show points.

    python look_at_cameras.py report.json file rate frames points.json width height

The report holds, for each camera and each frame, the pixels of the points as Blender's own projection gives
them, with the origin at the top left corner of the picture.
"""

from __future__ import annotations

import json
import sys
from fractions import Fraction
from pathlib import Path

import bpy
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

FIRST_FRAME = {".glb": 0, ".usd": 0, ".fbx": 1, ".abc": 1}
"""Frame of the scene that shows the first pose, by suffix, as Blender's importers place it."""


def main() -> None:
    report, file, rate_text, frames, points_file, width, height = sys.argv[1:]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene, rate, suffix = bpy.context.scene, Fraction(rate_text), Path(file).suffix
    scene.render.fps, step = round(rate), 1.0
    scene.render.fps_base = float(scene.render.fps / rate)
    scene.render.resolution_x, scene.render.resolution_y = int(width), int(height)
    if suffix == ".glb":
        # Blender's glTF importer places keys on whole frames only at a whole number of frames per second.
        scene.render.fps_base, step = 1.0, round(rate) / float(rate)
        bpy.ops.import_scene.gltf(filepath=file)
    elif suffix == ".usd":
        bpy.ops.wm.usd_import(filepath=file)
    elif suffix == ".fbx":
        step = round(rate) / float(rate)
        bpy.ops.import_scene.fbx(filepath=file)
    else:
        bpy.ops.wm.alembic_import(filepath=file, as_background_job=False)
    points = [Vector(point) for point in json.loads(Path(points_file).read_text())]
    cameras = [item for item in bpy.data.objects if item.type == "CAMERA"]
    seen = {camera.name: [] for camera in cameras}
    for number in range(int(frames)):
        at = FIRST_FRAME[suffix] + number * step
        scene.frame_set(int(at), subframe=at - int(at))
        for camera in cameras:
            found = [world_to_camera_view(scene, camera, point) for point in points]
            seen[camera.name].append(
                [[view.x * int(width), (1.0 - view.y) * int(height), view.z] for view in found]
            )
    room = [item.name for item in bpy.data.objects if item.type not in ("CAMERA", "EMPTY")]
    Path(report).write_text(json.dumps({"seen": seen, "room": room}))


main()
