"""Put the body and its room into a new Blender file.

    blender --background --python examples/blender_import.py -- out/cpl_lab scene.blend

Blender's own importers are used with their default axes. BVH is in centimetres, hence the scale.
"""

import sys
from pathlib import Path

import bpy


def main(results: Path, blend: Path) -> None:
    """Import `map.ply` and `motion.bvh` from the folder of results and save the file."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.ply_import(filepath=str(results / "map.ply"))
    bpy.ops.import_anim.bvh(
        filepath=str(results / "motion.bvh"),
        global_scale=0.01,
        update_scene_fps=True,
        update_scene_duration=True,
    )
    bpy.ops.wm.save_as_mainfile(filepath=str(blend.resolve()))


if __name__ == "__main__":
    folder, target = sys.argv[sys.argv.index("--") + 1 :]
    main(Path(folder), Path(target))
