"""The task that solves the skeleton's motion."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.tasks.body import load_body
from bodycap_batch.tasks.loading import load_capture, load_map
from bodycap_batch.tasks.registered import Registered
from bodycap_batch.tasks.stage import VISION, Json, Stage, write_summary

if TYPE_CHECKING:
    from bodycap_batch.config.options import MarkerBoard
    from bodycap_batch.model.merge_data import MergeInputs


def _merge(options: Json, arguments: Json, context: StageContext, files: Path) -> None:
    from bodycap_batch.config import MergeOptions
    from bodycap_batch.formats.bundle import write_bundle
    from bodycap_batch.merging import merge_trajectories

    inputs, options_ = _merge_inputs(arguments), MergeOptions.model_validate(options)
    if options_.marker_board is not None:
        inputs = _with_board(inputs, arguments, options_.marker_board, context)
    try:
        result = merge_trajectories(inputs, options_, context)
    except EstimationError as error:
        from bodycap_batch.mapping.matching.flipped_cameras import add_flip_hint

        add_flip_hint(error, load_map(arguments["map"]).diagnostics)
        raise
    write_bundle(result, files, "merge")
    doubts = [*result.report.get("doubted_clocks", {}).values(), result.report.get("exchanged_sides", {})]
    notes = [f"camera {name} is no part of the body: {why}" for name, why in result.unused_cameras.items()]
    notes += [str(doubt["says"]) for doubt in doubts if doubt]
    write_summary(files, unused_cameras=dict(result.unused_cameras), notes=notes)


def _merge_inputs(arguments: Json) -> MergeInputs:
    from bodycap_batch.model.merge_data import MergeInputs

    scene = load_map(arguments["map"])
    found = Registered.load(arguments["registrations"], scene.maps)
    skeleton, mounts = load_body(arguments)
    return MergeInputs(
        trajectories=found.trajectories,
        clocks=found.clocks,
        skeleton=skeleton,
        mounts=mounts,
        skeleton_is_measured=arguments["skeleton_file"] is not None,
        height_m=arguments["height_m"],
        activity=arguments["activity"],
        map_points={item.gauge: item.points for item in scene.maps},
        row_fraction=found.row_fraction,
    )


def _with_board(
    inputs: MergeInputs, arguments: Json, wanted: MarkerBoard, context: StageContext
) -> MergeInputs:
    """The inputs with every keyframe's view of the board."""
    import dataclasses

    import numpy as np

    from bodycap_batch.calibration.in_room import find_board_views
    from bodycap_batch.model.scene import FrameStatus

    frames, lenses = {}, {}
    maps = {item.gauge: item for item in load_map(arguments["map"]).maps}
    for path in inputs.trajectories:
        keyframes = np.array([status is FrameStatus.KEYFRAME for status in path.status], dtype=bool)
        if keyframes.any():
            frames[path.camera] = np.flatnonzero(keyframes)
            lenses[path.camera] = maps[path.gauge].cameras[path.camera]
    views = find_board_views(load_capture(arguments), frames, lenses, wanted, context)
    return dataclasses.replace(inputs, board=views)


MERGE = Stage(
    function=_merge,
    libraries=("scipy", "gtsam", *VISION),
    modules=("bodycap_batch.merging", "gtsam", "scipy.optimize", "scipy.spatial.transform"),
)
