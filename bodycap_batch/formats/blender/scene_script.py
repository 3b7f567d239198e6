"""Build a Blender scene from the results of bodycap: body, room, cameras with their videos, and markers.

Blender 4.2 LTS to 5.x. There are three ways to run this file:

- in Blender: open it in the text editor, and press Run Script;
- without a window: ``blender --background --python blender_scene.py -- --save scene.blend``;
- as an extension (``bodycap_blender.zip``): File > Import > bodycap results (.json).

It reads the files beside it: ``blender_scene.json``, ``motion.glb`` or ``motion.bvh``, ``map.ply``,
``trajectories/*.tum``, and the videos that ``blender_scene.json`` or ``run.json`` names. Files that are
missing are left out.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

SCENE_FILE = "blender_scene.json"
SCRIPT_FILE = "blender_scene.py"
RUN_FILE = "run.json"

FIRST_FRAME = 1
"""Frame of the first tick of the motion. Blender's scenes and its BVH importer begin at this frame, too."""

_IMPORT_FPS = 30
"""Rate of the scene while motion.glb is imported: a whole number, since Blender's importer needs one."""

_POINT_RADIUS_M = 0.006
"""Radius of the points of the room, metres. It only changes how the room looks."""

_SENSOR_MM = 36.0
"""Width of Blender's default sensor, millimetres. Only its ratio to the focal length matters."""

_SOLID = 1e-4
"""Largest distance, metres, between the end of a bone and its child's start that is connected."""

_MARKER_LENGTH = 63
"""Most bytes of a name in Blender."""

_CAMERA_SIZE_M = 0.15
"""Size of the drawn cameras, metres."""

_SOURCE_COLOURS = {"measured": (0.10, 0.65, 0.60), "filled": (0.95, 0.50, 0.10)}
"""Colours of the bones, RGB, 0 to 1, by the source of their motion, which is also the name of their
collection. Teal and orange differ for people with any colour vision deficiency."""

FILLED_TRACK = "filled"
"""Name of the NLA track with the filled bones that carry no measured bone."""

_RATE_TOLERANCE = 1e-3
"""Relative difference of the rates of video and motion above which the video's frame is keyed."""


def build_scene(folder: Path) -> list[str]:
    """Add body, room, cameras and markers to the current scene.

    Args:
        folder: The folder of results, with ``blender_scene.json``.

    Returns:
        What was added and what is missing, one line each.
    """
    import bpy

    data = json.loads((folder / SCENE_FILE).read_text(encoding="utf-8"))
    scene = bpy.context.scene
    collection = bpy.data.collections.new(data["name"])
    scene.collection.children.link(collection)
    for key in ("take", "rate", "start_timecode"):
        if key in data:
            collection[key] = data[key]
    notes = [_add_body(folder, data, collection), _add_room(folder, collection)]
    _set_time(scene, data["fps"], data["frames"])
    scene.unit_settings.system = "METRIC"
    videos = _videos(folder, data)
    for name, camera in data["cameras"].items():
        notes.append(_add_camera(folder, name, camera, data, collection, videos.get(name, [])))
    notes.append(_add_markers(scene, data["spans"]))
    scene.frame_set(FIRST_FRAME)
    return notes


def _set_time(scene: Any, fps: float, frames: int) -> None:
    """Set the rate and the range of a scene to those of the motion."""
    scene.render.fps = max(1, round(fps))
    scene.render.fps_base = scene.render.fps / fps
    scene.frame_start, scene.frame_end = FIRST_FRAME, FIRST_FRAME + frames - 1
    scene.frame_preview_start, scene.frame_preview_end = scene.frame_start, scene.frame_end


def _operator(operator: Any, **values: Any) -> None:
    """Call an operator with those of the values that this version of Blender knows."""
    known = operator.get_rna_type().properties.keys()
    operator(**{name: value for name, value in values.items() if name in known})


def _new_objects(before: set[Any], collection: Any) -> list[Any]:
    """Move the objects that an importer made into a collection, and return them."""
    import bpy

    found = [item for item in bpy.data.objects if item not in before]
    for item in found:
        for other in list(item.users_collection):
            other.objects.unlink(item)
        collection.objects.link(item)
    return found


def _add_body(folder: Path, data: dict[str, Any], collection: Any) -> str:
    """Import the body, with a key at every frame."""
    import bpy

    before = set(bpy.data.objects)
    scene = bpy.context.scene
    if (folder / "motion.glb").is_file():
        scene.render.fps, scene.render.fps_base = _IMPORT_FPS, 1.0
        _operator(
            bpy.ops.import_scene.gltf,
            filepath=str(folder / "motion.glb"),
            bone_heuristic="BLENDER",
            disable_bone_shape=True,
        )
        factor, shift = data["fps"] / _IMPORT_FPS, FIRST_FRAME
    elif (folder / "motion.bvh").is_file():
        _operator(
            bpy.ops.import_anim.bvh,
            filepath=str(folder / "motion.bvh"),
            global_scale=data["bvh_scale"],
            frame_start=FIRST_FRAME,
        )
        factor, shift = 1.0, 0
    else:
        return "body: missing (there is neither motion.glb nor motion.bvh)"
    found = _new_objects(before, collection)
    (body,) = [item for item in found if item.type == "ARMATURE"]
    body.name = "Body"
    for curve in curves_of(body):
        points = curve.keyframe_points
        values = [0.0] * (2 * len(points))
        points.foreach_get("co", values)
        values[::2] = [float(round(at * factor) + shift) for at in values[::2]]
        points.foreach_set("co", values)
        points.foreach_set("interpolation", [1] * len(points))  # 1: linear
        curve.update()
    _fit_bones(body, data["bones"])
    body.show_in_front = True
    for bone in body.pose.bones:
        if bone.name in data["bones"]:
            bone["measured_share"] = data["bones"][bone.name]["measured_share"]
    _sort_bones(body, data["bones"])
    layer = {name for name, fact in data["bones"].items() if fact.get("in_filled_layer")}
    _separate_layer(body, layer)
    bones = f"{len(body.data.bones)} bones, {len(layer)} of them in the NLA track {FILLED_TRACK!r}"
    return f"body: {bones}, {data['frames']} frames at {data['fps']:g} per second"


def _sort_bones(body: Any, bones: dict[str, Any]) -> None:
    """Put the bones into a collection for each source of their motion, and give each its colour."""
    collections: dict[str, Any] = {}
    for bone in body.data.bones:
        source = bones.get(bone.name, {}).get("source")
        if source is None:
            continue
        if source not in collections:
            collections[source] = body.data.collections.new(source)
        collections[source].assign(bone)
        body.pose.bones[bone.name]["motion_source"] = source
        normal = _SOURCE_COLOURS[source]
        bone.color.palette = "CUSTOM"
        bone.color.custom.normal = normal
        bone.color.custom.select = [min(1.0, 0.5 + 0.5 * value) for value in normal]
        bone.color.custom.active = (1.0, 1.0, 1.0)


def _separate_layer(body: Any, names: set[str]) -> None:
    """Move the curves of these bones from the body's action into an NLA track, which can be muted."""
    action = body.animation_data.action if body.animation_data is not None else None
    if action is None or not names:
        return
    paths = tuple(f'pose.bones["{name}"].' for name in names)
    filled = action.copy()
    filled.name = f"{action.name} {FILLED_TRACK}"
    for each, is_layer in ((action, False), (filled, True)):
        for curves in _curve_collections(each):
            for curve in list(curves):
                if curve.data_path.startswith(paths) != is_layer:
                    curves.remove(curve)
    tracks = body.animation_data.nla_tracks
    for track in list(tracks):  # the glTF importer adds the body's action as a muted track
        tracks.remove(track)
    track = tracks.new()
    track.name = FILLED_TRACK
    strip = track.strips.new(FILLED_TRACK, FIRST_FRAME, filled)
    if hasattr(filled, "slots"):
        strip.action_slot = filled.slots[0]


def curves_of(item: Any) -> Iterable[Any]:
    """Return the animation curves of an object, in every version of Blender."""
    if item.animation_data is None or item.animation_data.action is None:
        return []
    return [curve for curves in _curve_collections(item.animation_data.action) for curve in curves]


def _curve_collections(action: Any) -> list[Any]:
    """Return the collections of curves of an action, in every version of Blender."""
    if not hasattr(action, "slots"):  # before Blender 4.4
        return [action.fcurves]
    return [bag.fcurves for layer in action.layers for strip in layer.strips for bag in strip.channelbags]


def _new_curves(owner: Any, name: str) -> Any:
    """Give an object or data block a new action, and return its collection of curves."""
    import bpy

    action = bpy.data.actions.new(name)
    animation = owner.animation_data_create()
    animation.action = action
    if not hasattr(action, "slots"):  # before Blender 4.4
        return action.fcurves
    slot = action.slots.new(id_type=owner.id_type, name=owner.name)
    animation.action_slot = slot
    strip = action.layers.new("Layer").strips.new(type="KEYFRAME")
    return strip.channelbag(slot, ensure=True).fcurves


def _fit_bones(body: Any, bones: dict[str, Any]) -> None:
    """Let each bone end where its child begins, and connect the two. No bone changes its direction."""
    import bpy

    bpy.context.view_layer.objects.active = body
    bpy.ops.object.mode_set(mode="EDIT")
    edited = body.data.edit_bones
    for bone in edited:
        fact = bones.get(bone.name)
        if fact is not None and fact["length_m"] > 0.0:
            bone.length = fact["length_m"]
    for bone in edited:
        fact = bones.get(bone.name)
        free = fact is None or fact["moves_freely"] or bone.parent is None
        if not free and (bone.head - bone.parent.tail).length < _SOLID:
            bone.use_connect = True
    bpy.ops.object.mode_set(mode="OBJECT")


def _add_room(folder: Path, collection: Any) -> str:
    """Import the points of the room, drawn as small spheres in their colours."""
    import bpy

    if not (folder / "map.ply").is_file():
        return "room: missing (there is no map.ply)"
    before = set(bpy.data.objects)
    _operator(bpy.ops.wm.ply_import, filepath=str(folder / "map.ply"))
    (room,) = _new_objects(before, collection)
    room.name = "Room"
    material = bpy.data.materials.new("Room")
    material.use_nodes = True
    nodes = material.node_tree.nodes
    colour = nodes.new("ShaderNodeAttribute")
    colour.attribute_name = room.data.color_attributes[0].name if len(room.data.color_attributes) else ""
    shader = next(node for node in nodes if node.type == "BSDF_PRINCIPLED")
    material.node_tree.links.new(colour.outputs["Color"], shader.inputs["Base Color"])
    room.data.materials.append(material)
    group = bpy.data.node_groups.new("Room points", "GeometryNodeTree")
    group.interface.new_socket(name="Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    group.interface.new_socket(name="Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    start, end = group.nodes.new("NodeGroupInput"), group.nodes.new("NodeGroupOutput")
    points, paint = group.nodes.new("GeometryNodeMeshToPoints"), group.nodes.new("GeometryNodeSetMaterial")
    points.inputs["Radius"].default_value = _POINT_RADIUS_M
    paint.inputs["Material"].default_value = material
    group.links.new(start.outputs[0], points.inputs[0])
    group.links.new(points.outputs[0], paint.inputs[0])
    group.links.new(paint.outputs[0], end.inputs[0])
    room.modifiers.new("Points", "NODES").node_group = group
    return f"room: {len(room.data.vertices)} points"


def read_tum(path: Path) -> list[list[float]]:
    """Return the rows of a TUM file: time, position, quaternion x, y, z, w."""
    rows = (line.split() for line in path.read_text(encoding="utf-8").splitlines())
    return [[float(word) for word in row] for row in rows if row and not row[0].startswith("#")]


def _add_camera(
    folder: Path,
    name: str,
    facts: dict[str, Any],
    data: dict[str, Any],
    collection: Any,
    videos: list[Path],
) -> str:
    """Add a body camera that follows its solved path, with its video behind the view."""
    import bpy

    path = folder / "trajectories" / f"{name}.tum"
    rows = read_tum(path) if path.is_file() else []
    if not rows:
        return f"camera {name}: missing (there is no path in the world)"
    lens = bpy.data.cameras.new(name)
    item = bpy.data.objects.new(name, lens)
    collection.objects.link(item)
    width, height, focal = facts["width_px"], facts["height_px"], facts["focal_px"]
    longest = max(width, height)
    lens.sensor_width, lens.sensor_fit = _SENSOR_MM, "AUTO"
    lens.lens = focal / longest * _SENSOR_MM
    lens.shift_x = (width / 2.0 - facts["centre_px"][0]) / longest
    lens.shift_y = (facts["centre_px"][1] - height / 2.0) / longest
    lens.clip_start, lens.display_size = 0.01, _CAMERA_SIZE_M
    frames = [
        FIRST_FRAME + (row[0] * facts["clock_rate"] + facts["offset_s"] - data["start_s"]) * data["fps"]
        for row in rows
    ]
    item.rotation_mode = "QUATERNION"
    curves = _new_curves(item, name)
    columns = list(zip(*(_blender_pose(row) for row in rows), strict=True))
    _keep_sign(columns)
    for index in range(3):
        _fill_curve(curves.new("location", index=index), frames, columns[index])
    for index in range(4):
        _fill_curve(curves.new("rotation_quaternion", index=index), frames, columns[3 + index])
    if bpy.context.scene.camera is None:
        bpy.context.scene.camera = item
    video = next((each for each in videos if each.is_file()), None)
    if video is None:
        return f"camera {name}: {len(rows)} poses; its video was not found"
    _add_background(lens, video, facts, data)
    more = f" (the first of {len(videos)} files)" if len(videos) > 1 else ""
    return f"camera {name}: {len(rows)} poses, video {video.name}{more}"


def _blender_pose(row: list[float]) -> list[float]:
    """Convert a row of a TUM file to position and quaternion (w, x, y, z) of a Blender camera.

    A Blender camera looks along −Z with Y up; ours looks along +Z with Y down. So it is turned about X.
    """
    _, px, py, pz, x, y, z, w = row
    return [px, py, pz, -x, w, z, -y]


def _keep_sign(columns: list[Any]) -> None:
    """Change the signs of quaternions in place, so that successive ones are near each other."""
    turns = [list(each) for each in zip(*columns[3:], strict=True)]
    for number in range(1, len(turns)):
        if sum(a * b for a, b in zip(turns[number - 1], turns[number], strict=True)) < 0.0:
            turns[number] = [-value for value in turns[number]]
    columns[3:] = list(zip(*turns, strict=True))


def _fill_curve(curve: Any, frames: list[float], values: Any, constant: bool = False) -> None:
    """Add a key for each frame to an empty curve."""
    points = curve.keyframe_points
    points.add(len(frames))
    points.foreach_set("co", [each for pair in zip(frames, values, strict=True) for each in pair])
    points.foreach_set("interpolation", [0 if constant else 1] * len(frames))  # 0: constant, 1: linear
    curve.update()


def _add_background(lens: Any, video: Path, facts: dict[str, Any], data: dict[str, Any]) -> None:
    """Show a video behind the view of a camera, at the motion's instants."""
    import bpy

    picture = bpy.data.images.load(str(video), check_existing=True)
    picture.source = "MOVIE"
    lens.show_background_images = True
    back = lens.background_images.new()
    back.source, back.image, back.alpha, back.frame_method = "IMAGE", picture, 1.0, "FIT"
    user = back.image_user
    user.frame_duration = max(picture.frame_duration, 1)
    user.use_auto_refresh = True
    # Blender shows picture (frame − frame_start + 1 + frame_offset) of the video, counted from 1.
    user.frame_start = FIRST_FRAME
    each, first = facts["frames_per_tick"], facts["frame_at_start"]
    user.frame_offset = round(first)
    if abs(each - 1.0) <= _RATE_TOLERANCE:
        return
    ticks = range(data["frames"])
    offsets = [round(first + each * tick) - tick for tick in ticks]
    curve = _new_curves(lens, f"{lens.name} video").new("background_images[0].image_user.frame_offset")
    _fill_curve(curve, [float(FIRST_FRAME + tick) for tick in ticks], offsets, constant=True)


def _videos(folder: Path, data: dict[str, Any]) -> dict[str, list[Path]]:
    """Return the videos of each camera, from the data of the scene or the record of the run nearby."""
    if "videos" in data:
        return {name: [Path(each) for each in files] for name, files in data["videos"].items()}
    for parent in (folder, folder.parent):
        try:
            record = json.loads((parent / RUN_FILE).read_text(encoding="utf-8"))
            return {name: [parent / each for each in files] for name, files in record["videos"].items()}
        except (OSError, ValueError, KeyError, AttributeError, TypeError):
            continue
    return {}


def _add_markers(scene: Any, spans: list[dict[str, Any]]) -> str:
    """Add a marker wherever a part of the body begins or ceases to be measured."""
    texts: dict[tuple[int, str], list[str]] = {}
    for span in spans:
        if span["first"] > 0 or span["state"] != "measured":
            texts.setdefault((span["first"], span["state"]), []).append(span["part"])
    for (tick, state), parts in sorted(texts.items()):
        line = f"{state}: {', '.join(parts)}"
        scene.timeline_markers.new(line[:_MARKER_LENGTH], frame=FIRST_FRAME + tick)
    return f"markers: {len(texts)}"


def results_folder() -> Path:
    """Return the folder of this script, also where Blender's text editor runs it."""
    import bpy

    for text in bpy.data.texts:
        path = Path(bpy.path.abspath(text.filepath)) if text.filepath else None
        if path is not None and path.name == SCRIPT_FILE and (path.parent / SCENE_FILE).is_file():
            return path.parent
    return Path(__file__).resolve().parent


def main(arguments: list[str]) -> None:
    """Build the scene; with ``--save FILE.blend``, in an empty file that is then saved."""
    import bpy

    target = arguments[arguments.index("--save") + 1] if "--save" in arguments else None
    folder = results_folder()
    if target is not None:
        bpy.ops.wm.read_factory_settings(use_empty=True)
    notes = build_scene(folder)
    sys.stdout.write("".join(f"bodycap: {note}\n" for note in notes))
    if target is not None:
        bpy.ops.wm.save_as_mainfile(filepath=str(Path(target).resolve()), compress=True, relative_remap=False)


_registered: list[Any] = []
"""The operator class, while the extension is switched on."""


def _draw_menu(menu: Any, _context: Any) -> None:
    menu.layout.operator("import_scene.bodycap", text="bodycap results (.json)")


def register() -> None:
    """Add File > Import > bodycap results to Blender."""
    import bpy
    from bpy_extras.io_utils import ImportHelper

    class ImportBodycap(bpy.types.Operator, ImportHelper):  # type: ignore[misc]
        """Import body, room and cameras from a folder of results."""

        bl_idname = "import_scene.bodycap"
        bl_label = "Import bodycap results"
        bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender reads the class
        filename_ext = ".json"
        # Blender evaluates annotations, which this module keeps as text, so this one is given as a value.
        __annotations__ = {
            "filter_glob": bpy.props.StringProperty(default=f"*{Path(SCENE_FILE).suffix}", options={"HIDDEN"})
        }

        def execute(self, _context: Any) -> set[str]:
            """Build the scene from the chosen file's folder."""
            for note in build_scene(Path(self.filepath).parent):
                self.report({"INFO"}, note)
            return {"FINISHED"}

    bpy.utils.register_class(ImportBodycap)
    bpy.types.TOPBAR_MT_file_import.append(_draw_menu)
    _registered.append(ImportBodycap)


def unregister() -> None:
    """Remove the menu entry."""
    import bpy

    bpy.types.TOPBAR_MT_file_import.remove(_draw_menu)
    bpy.utils.unregister_class(_registered.pop())


if __name__ == "__main__":
    main(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:])
