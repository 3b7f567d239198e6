"""The order of the files; figures come last, so that they stand for files that are there."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from bodycap_batch.config.options import ExportOptions
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.export.inputs import ExportInputs
from bodycap_batch.export.joint_tables import write_joint_arrays, write_joint_table
from bodycap_batch.export.layout import lay_out
from bodycap_batch.export.metrics import collect_metrics
from bodycap_batch.export.motion import joint_centres, only_solved, write_figure, write_motion, write_stage
from bodycap_batch.export.projection import project_motion
from bodycap_batch.export.scene_files import write_colmap, write_maps, write_trajectories
from bodycap_batch.export.tables import write_frames
from bodycap_batch.formats.c3d import write_c3d
from bodycap_batch.formats.fbx import write_fbx
from bodycap_batch.formats.files import write_text
from bodycap_batch.formats.needs import require_libraries
from bodycap_batch.formats.trc import write_trc
from bodycap_batch.model.merge_data import MergeResult
from bodycap_batch.model.skeleton import Motion, as_in_file


def export_results(inputs: ExportInputs, options: ExportOptions, context: StageContext) -> tuple[Path, ...]:
    """Write a job's results into ``inputs.out_dir``, each file whole or not at all, and verify them.

    ``map.ply``, ``trajectories/<camera>.tum``, ``colmap/<n>/``, ``frames.csv``, ``joints.csv``,
    ``motion.bvh``, ``motion.glb`` and further formats (as the options ask) and always ``metrics.json``.
    Everything is in the world where there is one.

    Args:
        inputs: Maps, trajectories and the merged body.
        options: Which files, and how the BVH is laid out.
        context: Progress and cancelling.

    Returns:
        The files written, relative to the folder.

    Raises:
        JobError: A format takes a library or a program that is not installed.
        StoreError: A file cannot be written, or read back it differs from what was meant.
    """
    require_libraries(options.formats)
    motion, gap = _project(inputs, options)
    sigma_m = None if inputs.merge is None or motion is None else _sigma_m(inputs.merge, motion)
    steps: dict[str, Callable[[], list[Path]]] = {"tum": lambda: write_trajectories(inputs)}
    if inputs.maps:
        steps |= {"ply": lambda: write_maps(inputs), "colmap": lambda: write_colmap(inputs)}
    steps["csv"] = lambda: [write_frames(inputs.out_dir / "frames.csv", inputs)]
    if motion is not None:
        steps |= _motion_steps(inputs.out_dir, motion, options, sigma_m)
        steps["csv"] = lambda: [
            write_frames(inputs.out_dir / "frames.csv", inputs),
            write_joint_table(inputs.out_dir / "joints.csv", motion, sigma_m),
        ]
    steps = {name: write for name, write in steps.items() if name in options.formats}
    steps["metrics"] = lambda: [_write_metrics(inputs, motion, gap)]
    written: list[Path] = []
    for number, (name, write) in enumerate(steps.items()):
        context.check_cancelled()
        context.progress(number, len(steps), name)
        written += write()
    context.progress(len(steps), len(steps), "")
    return tuple(path.relative_to(inputs.out_dir) for path in written)


def _motion_steps(
    folder: Path, motion: Motion, options: ExportOptions, sigma_m: FloatArray | None
) -> dict[str, Callable[[], list[Path]]]:
    """The files of the motion: for animation as it is laid out, for measuring as it was solved."""
    animated, centres = lay_out(motion, options), joint_centres(motion)
    return {
        "bvh": lambda: [write_motion(folder / "motion.bvh", animated, options)],
        "glb": lambda: [write_figure(folder / "motion.glb", animated)],
        "fbx": lambda: [write_fbx(folder / "motion.fbx", animated)],
        "usd": lambda: [write_stage(folder / "motion.usd", animated)],
        "c3d": lambda: [write_c3d(folder / "joints.c3d", centres)],
        "trc": lambda: [write_trc(folder / "joints.trc", centres)],
        "npz": lambda: [write_joint_arrays(folder / "joints.npz", motion, sigma_m)],
    }


def _sigma_m(merge: MergeResult, motion: Motion) -> FloatArray:
    """(T,J) how well each exported joint's centre is known, NaN where nothing measured it."""
    kept = [merge.skeleton.joints.index(name) for name in motion.skeleton.joints]
    return merge.joint_sigma_m()[:, kept]


def _write_metrics(inputs: ExportInputs, motion: Motion | None, gap: Mapping[str, Any]) -> Path:
    path = inputs.out_dir / "metrics.json"
    metrics = collect_metrics(inputs, motion, gap)
    write_text(path, json.dumps(metrics, indent=2, allow_nan=False, ensure_ascii=False) + "\n")
    return path


def _project(inputs: ExportInputs, options: ExportOptions) -> tuple[Motion | None, dict[str, Any]]:
    """The motion to export and its distance from the graph; None without a body."""
    if inputs.merge is None:
        return None, {}
    projection = project_motion(inputs.merge, inputs.clocks, inputs.row_fraction)
    motion = as_in_file(projection.motion)
    if options.hierarchy == "solved":
        motion = only_solved(motion, inputs.merge.solved)
    return motion, dict(projection.gap)
