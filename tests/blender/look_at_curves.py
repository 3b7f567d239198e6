"""Print the bones with changing rotation curves, and the videos, in a file. Runs in the Python of Blender."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import bpy


def curves_of(action: Any) -> list[Any]:
    """Return the curves of an action, in every version of Blender."""
    if not hasattr(action, "slots"):
        return list(action.fcurves)
    bags = [bag for layer in action.layers for strip in layer.strips for bag in strip.channelbags]
    return [curve for bag in bags for curve in bag.fcurves]


def main(path: str) -> None:
    """Open a .blend file or import an FBX file, and print a JSON line."""
    if path.endswith(".blend"):
        bpy.ops.wm.open_mainfile(filepath=path)
    else:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        bpy.ops.import_scene.fbx(filepath=path)
    turning = [
        curve for action in bpy.data.actions for curve in curves_of(action) if "rotation" in curve.data_path
    ]
    bones = set()
    for curve in turning:
        values = [point.co[1] for point in curve.keyframe_points]
        if curve.data_path.startswith("pose.bones") and max(values) - min(values) > 1e-3:
            bones.add(curve.data_path.split('"')[1])
    videos = [str(Path(bpy.path.abspath(image.filepath)).resolve()) for image in bpy.data.images]
    print(json.dumps({"bones": sorted(bones), "videos": videos}))


main(sys.argv[-1])
