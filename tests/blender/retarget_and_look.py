"""Run by Blender's Python: retarget a walk onto another armature and tell where its joints go.

python retarget_and_look.py results_folder metarig|character.glb facts.json
"""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from typing import Any

import bpy
from mathutils import Vector

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "blender_retarget.py"


def load_example() -> Any:
    spec = importlib.util.spec_from_file_location("blender_retarget", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def main(folder: str, character: str, target: str) -> None:
    example = load_example()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    body = example.import_body(Path(folder))
    before = set(bpy.data.objects)
    if character == "metarig":
        bpy.ops.preferences.addon_enable(module="rigify")
        bpy.ops.object.armature_human_metarig_add()
        names = example.METARIG
    else:
        bpy.ops.import_scene.gltf(filepath=character, disable_bone_shape=True)
        names = example.MIXAMO
    (other,) = [item for item in set(bpy.data.objects) - before if item.type == "ARMATURE"]
    other.animation_data_clear()
    scene = bpy.context.scene
    work = example.retarget(body, other, names, scene.frame_start, scene.frame_end)
    joints: dict[str, list[Any]] = {role: [] for role in names}
    wanted: dict[str, list[Any]] = {role: [] for role in names}
    turns: dict[str, list[Any]] = {role: [] for role in names}
    for frame in range(scene.frame_start, scene.frame_end + 1):
        scene.frame_set(frame)
        for role, name in names.items():
            bone = other.pose.bones[name]
            joints[role].append(list((other.matrix_world @ bone.matrix).translation))
            wanted[role].append(list(work.at(role)))
            turns[role].append(list(bone.rotation_quaternion))
        # a hand's place is that of the source, scaled by the arms, as seen from the middle of the shoulders
        ours = (Vector(joints["LeftArm"][-1]) + Vector(joints["RightArm"][-1])) / 2
        at = {role: (body.matrix_world @ body.pose.bones[role].matrix).translation for role in names}
        for hand in ("LeftHand", "RightHand"):
            place = at[hand] - (at["LeftArm"] + at["RightArm"]) / 2
            wanted[hand][-1] = list(ours + work.arm_scale * place)
    facts = {"scale": work.scale, "joints": joints, "wanted": wanted, "turns": turns}
    Path(target).write_text(json.dumps(facts), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
