"""Write animated cameras as FBX or Alembic, and report the cameras of the file. Blender's Python runs this.

    python camera_script.py cameras.json out.fbx report.json

The suffix of the second file chooses the format. The cameras have a key at every whole frame.
"""

from __future__ import annotations

import datetime as dt
import functools
import importlib
import json
import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

FIRST_FRAME = 1
"""Frame of the first pose in a scene that imports the file. Blender's scenes begin at this frame."""

_WRITTEN_FIRST_FRAME = {".fbx": 0, ".abc": 1}
"""Frame of the first pose in the scene that is exported, by suffix of the file. FBX times start at 0, and
Blender's importer adds a frame. Alembic times are frame numbers over the rate."""


def write_cameras(data: dict[str, Any], target: str) -> None:
    """Build the cameras in an empty scene and export it.

    Args:
        data: Content of the file with the cameras.
        target: Path of the file to write.
    """
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.name = data["name"]
    set_rate(scene, Fraction(data["rate"]))
    # As for the motion, the unit of an FBX scene is the centimetre, so the file needs no scale.
    units = 100.0 if target.endswith(".fbx") else 1.0
    scene.unit_settings.system, scene.unit_settings.scale_length = "METRIC", 1.0 / units
    first = _WRITTEN_FIRST_FRAME[Path(target).suffix]
    scene.frame_start, scene.frame_end = first, first + data["frames"] - 1
    for name, camera in data["cameras"].items():
        _add_camera(scene, name, camera, units)
    scene.frame_set(first)
    if target.endswith(".abc"):
        bpy.ops.wm.alembic_export(
            filepath=target, start=scene.frame_start, end=scene.frame_end, export_custom_properties=True
        )
        return
    export_fbx_bin: Any = importlib.import_module("io_scene_fbx.export_fbx_bin")
    header = export_fbx_bin.fbx_header_elements
    # The time in the header is replaced by a constant, so that equal cameras give equal bytes.
    export_fbx_bin.fbx_header_elements = functools.partial(header, time=dt.datetime(1970, 1, 1))
    bpy.ops.export_scene.fbx(
        filepath=target,
        object_types={"CAMERA"},
        axis_up="Y",
        axis_forward="-Z",
        bake_anim=True,
        bake_anim_use_nla_strips=False,
        bake_anim_use_all_actions=False,
        bake_anim_step=1.0,
        bake_anim_simplify_factor=0.0,
        use_custom_props=True,
        use_metadata=False,
    )


def _add_camera(scene: Any, name: str, camera: dict[str, Any], units: float) -> None:
    """Add a camera with a key at every frame. ``units`` is the number of units of the scene per metre."""
    import bpy

    matrix: Any = importlib.import_module("mathutils").Matrix

    lens = bpy.data.cameras.new(name)
    lens.sensor_fit = "HORIZONTAL"
    lens.sensor_width, lens.sensor_height = camera["sensor_mm"]
    lens.lens = camera["focal_mm"]
    lens.clip_start, lens.clip_end = (units * each for each in camera["range"])
    scene.render.resolution_x, scene.render.resolution_y = camera["size_px"]
    item = bpy.data.objects.new(name, lens)
    scene.collection.objects.link(item)
    for key, value in camera["properties"].items():
        item[key] = value
    item.rotation_mode = "QUATERNION"
    last = None
    for number, rows in enumerate(camera["scene_from_gl"]):
        place, turn, _ = matrix([*rows, [0.0, 0.0, 0.0, 1.0]]).decompose()
        if last is not None:
            turn.make_compatible(last)
        last = turn
        item.location, item.rotation_quaternion = place * units, turn
        for channel in ("location", "rotation_quaternion"):
            item.keyframe_insert(channel, frame=scene.frame_start + number)


def read_back(target: str, rate: Fraction, frames: int) -> dict[str, Any]:
    """Import the file into an empty scene and return, by camera, its lens and its poses at all frames."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    set_rate(scene, rate)
    if target.endswith(".abc"):
        bpy.ops.wm.alembic_import(filepath=target, as_background_job=False)
    else:
        bpy.ops.import_scene.fbx(filepath=target)
    # Blender's FBX importer places keys as if the rate were a whole number of frames per second.
    step = 1.0 if target.endswith(".abc") else round(rate) / float(rate)
    return look_at_cameras(scene, frames, step)


def look_at_cameras(scene: Any, frames: int, step: float = 1.0) -> dict[str, Any]:
    """Return, by camera of a scene, its field of view and its poses at all frames.

    Args:
        scene: The scene.
        frames: Number of frames.
        step: Frames of the scene from one pose to the next.
    """
    import bpy

    items = [item for item in bpy.data.objects if item.type == "CAMERA"]
    poses: dict[str, list[Any]] = {item.name: [] for item in items}
    for number in range(frames):
        at = FIRST_FRAME + number * step
        scene.frame_set(int(at), subframe=at - int(at))
        for item in items:
            # An importer may scale a camera to the unit of the file, which changes nothing of its view.
            place, turn, _ = item.matrix_world.decompose()
            rows = turn.to_matrix()
            poses[item.name].append([[*rows[axis], place[axis]] for axis in range(3)])
    return {
        item.name: {
            "focal_mm": item.data.lens,
            "sensor_mm": [item.data.sensor_width, item.data.sensor_height],
            "scene_from_gl": poses[item.name],
        }
        for item in items
    }


def set_rate(scene: Any, rate: Fraction) -> None:
    """Set the frame rate of a scene. Blender stores it as a whole number and a divisor: 30 and 1.001."""
    scene.render.fps = max(1, round(rate))
    scene.render.fps_base = float(scene.render.fps / rate)


def main(arguments: list[str]) -> None:
    """Write a file, read it back and write the report."""
    source, target, report = arguments
    data = json.loads(Path(source).read_text(encoding="utf-8"))
    write_cameras(data, target)
    found = read_back(target, Fraction(data["rate"]), data["frames"])
    Path(report).write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    words = sys.argv
    main(words[words.index("--") + 1 :] if "--" in words else words[1:])
