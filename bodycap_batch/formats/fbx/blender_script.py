"""Write FBX and Alembic files, and report what they contain. This script runs in Blender's Python.

    python blender_script.py scene.json out.fbx report.json

The first file holds either a motion, as the path of a GLB file, or animated cameras. The suffix of the second
file chooses the format. There is a key at every whole frame.
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

GLB_FPS = 30.0
"""Frames per second of the GLB file to convert, whatever the rate of the motion is. Derivation: Blender's
glTF importer places keys on whole frames only at a whole number of frames per second."""

_BIND_FRAME = -1
"""Frame of the bind pose while Blender writes the file. Derivation: the motion starts at frame 0, and frames
before it are not written."""

_COMPARED_FRAMES = 20
"""Number of frames whose joint centres are written to the report. Evidence: none; this number of frames is
enough to detect a wrong frame rate or a wrong axis."""

_FIRST_FRAME = 1
"""Frame of the first pose in a scene that imports the file. Blender's scenes begin at this frame."""

_WRITTEN_FIRST_FRAME = {".fbx": 0, ".abc": 1}
"""Frame of the first pose in the scene that is exported, by suffix of the file. FBX times start at 0, and
Blender's importer adds a frame. Alembic times are frame numbers over the rate."""


def write_motion(data: dict[str, Any], target: str) -> None:
    """Import the GLB file and export the FBX file, without leaf bones and with a key at every frame.

    The unit of length of the scene is the centimetre. Blender's glTF importer converts metres to centimetres,
    so the FBX file needs no scale.

    Args:
        data: ``glb``: path of the GLB file, with a frame every 1 / `GLB_FPS` seconds; ``rate``: frames per
            second of the motion; ``frames``: number of frames; ``facts``: name of the take, exact rate and
            timecode, as custom properties of the armature.
        target: Path of the FBX file.
    """
    import bpy

    facts = data["facts"]
    scene = _empty_scene(
        facts.get("take", "Motion"), GLB_FPS
    )  # the name is that of the animation in the file
    scene.unit_settings.system, scene.unit_settings.scale_length = "METRIC", 0.01
    bpy.ops.import_scene.gltf(filepath=data["glb"], disable_bone_shape=True)
    _set_rate(scene, data["rate"])
    body = _armature()
    for key, value in facts.items():
        body[key] = value
    scene.frame_start, scene.frame_end = 0, data["frames"] - 1
    _go_to_bind_pose(scene, body)
    _export_fbx(
        target,
        object_types={"ARMATURE", "MESH"},
        use_space_transform=False,
        apply_unit_scale=True,
        apply_scale_options="FBX_SCALE_NONE",
        add_leaf_bones=False,
    )


def _empty_scene(name: str | None, rate: float | Fraction) -> Any:
    """Empty the scene, give it a name and a frame rate, and return it."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    if name is not None:
        scene.name = name
    _set_rate(scene, rate)
    return scene


def _set_rate(scene: Any, rate: float | Fraction) -> None:
    """Set the frame rate of a scene. Blender stores it as a whole number and a divisor: 30 and 1.001."""
    scene.render.fps = max(1, round(rate))
    scene.render.fps_base = float(scene.render.fps / rate)


def _armature() -> Any:
    """Return the only armature of the scene."""
    import bpy

    (body,) = [item for item in bpy.data.objects if item.type == "ARMATURE"]
    return body


def _go_to_bind_pose(scene: Any, body: Any) -> None:
    """Key the bind pose before the first frame, and make this frame the current one.

    The exporter writes the current pose as the pose of the nodes. Programs that ignore the bind pose of the
    skin, such as Unity, take the T-pose from the nodes.
    """
    for bone in body.pose.bones:
        bone.matrix_basis.identity()
        for channel in ("location", "rotation_quaternion", "scale"):
            bone.keyframe_insert(channel, frame=_BIND_FRAME)
    scene.frame_set(_BIND_FRAME)


def _export_fbx(target: str, **options: Any) -> None:
    """Export the scene with a key at every frame; equal scenes give equal bytes."""
    import bpy

    export_fbx_bin: Any = importlib.import_module("io_scene_fbx.export_fbx_bin")
    header = export_fbx_bin.fbx_header_elements
    # Blender would write the current time into the header. Therefore the time is replaced by a constant.
    export_fbx_bin.fbx_header_elements = functools.partial(header, time=dt.datetime(1970, 1, 1))
    bpy.ops.export_scene.fbx(
        filepath=target,
        axis_up="Y",
        axis_forward="-Z",
        bake_anim=True,
        bake_anim_use_nla_strips=False,
        bake_anim_use_all_actions=False,
        bake_anim_step=1.0,
        bake_anim_simplify_factor=0.0,
        use_custom_props=True,
        use_metadata=False,
        **options,
    )


def look_at_motion(target: str, fps: float) -> dict[str, Any]:
    """Import the FBX file into an empty scene and return its joint centres.

    Returns:
        A mapping with these keys. ``first`` and ``last``: first and last frame of the motion. ``frames``:
        numbers of the reported frames, counted from the first frame. ``joints``: by joint name, the joint
        centres at the reported frames, metres, Z up. ``rest``: by joint name, the centre in the bind pose.
    """
    import bpy

    scene = _empty_scene(None, fps)
    bpy.ops.import_scene.fbx(filepath=target)
    body = _armature()
    # The importer places keys as if the rate were a whole number of frames per second.
    frames_each = round(fps) / fps
    first, last = (float(frame) for frame in body.animation_data.action.frame_range)
    count = round((last - first) / frames_each)
    sampled = sorted({round(k * count / (_COMPARED_FRAMES - 1)) for k in range(_COMPARED_FRAMES)})
    joints: dict[str, list[list[float]]] = {bone.name: [] for bone in body.pose.bones}
    for frame in sampled:
        _go_to(scene, first + frame * frames_each)
        for bone in body.pose.bones:
            joints[bone.name].append(list(body.matrix_world @ bone.head))
    rest = {bone.name: list(body.matrix_world @ bone.head_local) for bone in body.data.bones}
    return {"first": first, "last": first + count, "frames": sampled, "joints": joints, "rest": rest}


def _go_to(scene: Any, frame: float) -> None:
    """Make a frame, which need not be whole, the current one."""
    scene.frame_set(int(frame), subframe=frame - int(frame))


def write_cameras(data: dict[str, Any], target: str) -> None:
    """Build the cameras in an empty scene and export it.

    Args:
        data: Content of the file with the cameras.
        target: Path of the file to write.
    """
    import bpy

    scene = _empty_scene(data["name"], Fraction(data["rate"]))
    # As for the motion, the unit of an FBX scene is the centimetre, so the file needs no scale.
    units = 100.0 if target.endswith(".fbx") else 1.0
    scene.unit_settings.system, scene.unit_settings.scale_length = "METRIC", 1.0 / units
    first = _WRITTEN_FIRST_FRAME[Path(target).suffix]
    scene.frame_start, scene.frame_end = first, first + data["frames"] - 1
    for name, camera in data["cameras"].items():
        _add_camera(scene, name, camera, units)
    scene.frame_set(first)
    if target.endswith(".fbx"):
        _export_fbx(target, object_types={"CAMERA"})
    else:
        bpy.ops.wm.alembic_export(
            filepath=target, start=scene.frame_start, end=scene.frame_end, export_custom_properties=True
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


def look_at_cameras(target: str, rate: Fraction, frames: int) -> dict[str, Any]:
    """Import the file into an empty scene and return, by camera, its lens and its poses at all frames."""
    import bpy

    scene = _empty_scene(None, rate)
    if target.endswith(".abc"):
        bpy.ops.wm.alembic_import(filepath=target, as_background_job=False)
    else:
        bpy.ops.import_scene.fbx(filepath=target)
    # Blender's FBX importer places keys as if the rate were a whole number of frames per second.
    step = 1.0 if target.endswith(".abc") else round(rate) / float(rate)
    items = [item for item in bpy.data.objects if item.type == "CAMERA"]
    poses: dict[str, list[Any]] = {item.name: [] for item in items}
    for number in range(frames):
        _go_to(scene, _FIRST_FRAME + number * step)
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


def main(source: str, target: str, report: str) -> None:
    """Write a file, read the result back and write the report."""
    data = json.loads(Path(source).read_text(encoding="utf-8"))
    if "glb" in data:
        write_motion(data, target)
        found = look_at_motion(target, data["rate"])
    else:
        write_cameras(data, target)
        found = look_at_cameras(target, Fraction(data["rate"]), data["frames"])
    Path(report).write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    words = sys.argv
    main(*(words[words.index("--") + 1 :] if "--" in words else words[1:]))
