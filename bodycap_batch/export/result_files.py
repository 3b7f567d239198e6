"""Write all result files of a job.

``metrics.json`` is written last. If this file exists, all other files were written.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from bodycap_batch.config.options import ExportOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.export.blender_scene import collect_blender_scene
from bodycap_batch.export.camera_animation import collect_camera_scene
from bodycap_batch.export.camera_files import (
    CAMERA_FACTS_FILE,
    CAMERA_FORMATS,
    camera_writers,
    write_camera_facts,
)
from bodycap_batch.export.earth import earth_of_world
from bodycap_batch.export.export_inputs import ExportInputs
from bodycap_batch.export.fill_report import FILL_FILE, write_fill_report
from bodycap_batch.export.layout import added_root, apply_layout
from bodycap_batch.export.metrics import collect_metrics
from bodycap_batch.export.motion_files import (
    points_from_motion,
    sigma_in_layout,
    verified,
    without_unsolved_branches,
)
from bodycap_batch.export.scene_files import write_colmap, write_maps, write_trajectories
from bodycap_batch.export.tables import write_frame_table, write_joint_arrays, write_joint_table
from bodycap_batch.export.take_time import take_of_motion
from bodycap_batch.formats.atomic_files import write_text
from bodycap_batch.formats.blender import write_blender_files
from bodycap_batch.formats.bvh import read_bvh, write_bvh
from bodycap_batch.formats.c3d import write_c3d
from bodycap_batch.formats.fbx import write_fbx
from bodycap_batch.formats.gltf import read_glb, write_glb
from bodycap_batch.formats.optional_libraries import require_libraries
from bodycap_batch.formats.trc import write_trc
from bodycap_batch.formats.usd import read_usd, write_usd
from bodycap_batch.model.bone_axes import align_axes_with_bones
from bodycap_batch.model.merge_data import MergeResult
from bodycap_batch.model.skeleton import Motion, with_file_zero_pose, with_outer_joints

Steps = dict[str, list[Callable[[], list[Path]]]]
"""The functions that write the files of each format."""

LEFT_OUT = "left_out"
"""Name of the list in ``metrics.json`` with a sentence about each empty part that the files leave out."""


def export_results(inputs: ExportInputs, options: ExportOptions, context: StageContext) -> tuple[Path, ...]:
    """Write the result files of a job to ``inputs.out_dir``. Each file is written atomically.

    The options select among ``map.ply``, ``trajectories/<camera>.tum``, ``colmap/<n>/``, ``frames.csv``,
    ``joints.csv``, ``motion.bvh``, ``motion.glb`` and further formats. ``metrics.json`` is always written.
    With a body, the poses and points in the files are in the world. Maps and cameras that merging did not
    place in the world are the exception. An empty part of the results, such as a map without points, is left
    out, and ``metrics.json`` says so (`LEFT_OUT`).

    Args:
        inputs: The results of the earlier stages.
        options: The selected formats, and the layout of the motion files.
        context: The context of the stage, which receives the progress and can cancel the stage.

    Returns:
        The paths of the written files, relative to ``inputs.out_dir``.

    Raises:
        JobError: A format needs a library or a program that is not installed.
        StoreError: A file cannot be written, or it differs from the motion when it is read back.
    """
    require_libraries(options.formats)
    left_out: list[str] = []
    motion, gap = _exported_motion(inputs, options, left_out)
    animated = None if motion is None else apply_layout(_with_all_joints(inputs, motion, options), options)
    steps: Steps = {"tum": [lambda: write_trajectories(inputs, left_out)]}
    if inputs.maps:
        steps |= {"ply": [lambda: write_maps(inputs, left_out)], "colmap": [lambda: write_colmap(inputs)]}
    steps["csv"] = [lambda: [write_frame_table(inputs.out_dir / "frames.csv", inputs)]]
    merge = inputs.merge
    if merge is not None and motion is not None and animated is not None:
        of_motion = _motion_writers(inputs, merge, motion, animated, options, left_out)
        steps["csv"] += of_motion.pop("csv")
        steps |= of_motion
    steps = {name: writers for name, writers in steps.items() if name in options.formats}
    _add_cameras(steps, inputs, animated, options, left_out)
    if merge is not None and merge.fill is not None:
        steps["fill"] = [lambda: [write_fill_report(inputs.out_dir / FILL_FILE, merge)]]
    steps["metrics"] = [lambda: [_write_metrics(inputs, motion, gap, left_out)]]
    written: list[Path] = []
    for number, (name, writers) in enumerate(steps.items()):
        context.check_cancelled()
        context.progress(number, len(steps), name)
        written += [path for write in writers for path in write()]
    context.progress(len(steps), len(steps), "")
    return tuple(path.relative_to(inputs.out_dir) for path in written)


def _add_cameras(
    steps: Steps,
    inputs: ExportInputs,
    animated: Motion | None,
    options: ExportOptions,
    left_out: list[str],
) -> None:
    """Add the files of the animated cameras to the steps of their formats."""
    chosen = [name for name in CAMERA_FORMATS if name in options.formats]
    scene = collect_camera_scene(inputs, animated, options.fps, left_out) if chosen else None
    if scene is None:
        return
    writers = camera_writers(inputs.out_dir, scene)
    for name in chosen:
        steps.setdefault(name, []).append(writers[name])
    steps["cameras"] = [lambda: [write_camera_facts(inputs.out_dir / CAMERA_FACTS_FILE, scene)]]


def _motion_writers(
    inputs: ExportInputs,
    merge: MergeResult,
    motion: Motion,
    animated: Motion,
    options: ExportOptions,
    left_out: list[str],
) -> Steps:
    """Return, for each motion format, a function that writes its file.

    The animation formats (BVH, GLB, FBX, USD) contain the motion in the layout that the options select. In
    GLB and FBX files, the joints' axes follow the bones, because programs draw bones along these axes. The
    measurement formats (C3D, TRC, NPZ) contain the solved motion.
    """
    kept = [merge.skeleton.joints.index(name) for name in motion.skeleton.joints]
    folder, measured, sigma_m = inputs.out_dir, merge.solved[kept], merge.joint_sigma_m()[:, kept]
    take, solved_take = take_of_motion(inputs, animated), take_of_motion(inputs, motion)
    centres = points_from_motion(motion, measured, sigma_m)
    sigma = sigma_in_layout(motion, animated, sigma_m)
    aligned, place = align_axes_with_bones(animated), earth_of_world(inputs)
    earth = None if place is None else place.figures()
    markers = points_from_motion(motion, None if options.filled_markers else measured)

    def trc() -> list[Path]:
        if markers.measured_points().any():
            return [write_trc(folder / "joints.trc", markers)]
        left_out.append("joints.trc is not written: no exported joint was measured")
        return []

    def bvh() -> list[Path]:
        write_bvh(folder / "motion.bvh", animated, units=options.units, euler_order=options.euler_order)
        return verified(folder / "motion.bvh", animated, lambda file: read_bvh(file, units=options.units)[1])

    def glb() -> list[Path]:
        write_glb(folder / "motion.glb", aligned, earth=earth, take=take, sigma_m=sigma)
        return verified(folder / "motion.glb", aligned, read_glb)

    def usd() -> list[Path]:
        write_usd(folder / "motion.usd", animated, earth, take=take, sigma_m=sigma)
        return verified(folder / "motion.usd", animated, read_usd)

    return {
        "csv": [lambda: [write_joint_table(folder / "joints.csv", motion, sigma_m)]],
        "bvh": [bvh],
        "glb": [glb],
        "fbx": [lambda: [write_fbx(folder / "motion.fbx", aligned, take)]],
        "usd": [usd],
        "c3d": [lambda: [write_c3d(folder / "joints.c3d", centres, solved_take)]],
        "trc": [trc],
        "npz": [lambda: [write_joint_arrays(folder / "joints.npz", motion, sigma_m, solved_take)]],
        "blender": [lambda: write_blender_files(folder, collect_blender_scene(inputs, aligned, options))],
    }


def _with_all_joints(inputs: ExportInputs, motion: Motion, options: ExportOptions) -> Motion:
    """Return a complete motion with the joints of the user's file that are no part of the body.

    A root on the floor that the layout adds replaces them.
    """
    merge = inputs.merge
    if merge is None or motion.skeleton.joints != merge.skeleton.joints or added_root(motion, options):
        return motion
    return with_file_zero_pose(with_outer_joints(merge.motion))


def _write_metrics(
    inputs: ExportInputs, motion: Motion | None, gap: Mapping[str, Any], left_out: list[str]
) -> Path:
    """Write ``metrics.json``, and return the path of the file."""
    path = inputs.out_dir / "metrics.json"
    metrics = {**collect_metrics(inputs, motion, gap), LEFT_OUT: left_out}
    write_text(path, json.dumps(metrics, indent=2, allow_nan=False, ensure_ascii=False) + "\n")
    return path


def _exported_motion(
    inputs: ExportInputs, options: ExportOptions, left_out: list[str]
) -> tuple[Motion | None, dict[str, Any]]:
    """Return the motion to export, and its difference from the motion graph and the cameras.

    The difference is `Projection.gap`. Without a body, the motion is None and the difference is empty.
    """
    if inputs.merge is None:
        return None, {}
    if not len(inputs.merge.motion.root_in_world_m):
        left_out.append("the files of the motion are not written: the motion has no frames")
        return None, {}
    motion = with_file_zero_pose(inputs.merge.motion)
    fill = inputs.merge.fill
    if options.hierarchy == "solved" or (fill is not None and fill.mode == "none"):
        motion = without_unsolved_branches(motion, inputs.merge.solved)
    return motion, dict(inputs.merge.projection_gap)
