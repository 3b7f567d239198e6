"""The task that solves the motion of the skeleton."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bodycap_batch.config.options import MarkerBoard, MergeOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.formats.dataclass_files import write_dataclass
from bodycap_batch.model.merge_data import MergeInputs
from bodycap_batch.model.scene import FrameStatus
from bodycap_batch.tasks.body import load_body
from bodycap_batch.tasks.inputs import ArtefactRef, BodyInput, CaptureRef, paths_of
from bodycap_batch.tasks.loading import load_capture, load_clocks, load_map
from bodycap_batch.tasks.motion import MOTION_NAME
from bodycap_batch.tasks.registered_cameras import RegisteredCameras
from bodycap_batch.tasks.stage import write_summary


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardFootage:
    """The images in which merging searches for the marker board.

    Attributes:
        capture: The videos of all cameras.
        keyframes: The selected keyframes of each camera, by camera name.
    """

    capture: CaptureRef
    keyframes: Mapping[str, ArtefactRef]


@dataclass(frozen=True, slots=True, kw_only=True)
class MergeTask:
    """Solve the motion of the skeleton in the world.

    Attributes:
        options: The stage's options.
        map: The map.
        registrations: The registration of each camera, by camera name.
        clocks: The clocks of all cameras.
        body: The body.
        footage: The images in which the marker board is searched for; None if the job names no marker board.
    """

    options: MergeOptions
    map: ArtefactRef
    registrations: Mapping[str, ArtefactRef]
    clocks: ArtefactRef
    body: BodyInput
    footage: BoardFootage | None


def run_merge(task: MergeTask, context: StageContext, files: Path) -> None:
    """Solve the motion and store it."""
    from bodycap_batch.merging import merge_trajectories

    inputs = _merge_inputs(task)
    if task.footage is not None and task.options.marker_board is not None:
        inputs = _with_board(inputs, task, task.footage, task.options.marker_board, context)
    try:
        result = merge_trajectories(inputs, task.options, context)
    except EstimationError as error:
        from bodycap_batch.mapping.matching.flipped_cameras import add_flip_hint

        add_flip_hint(error, load_map(task.map.path).diagnostics)
        raise
    write_dataclass(result, files, MOTION_NAME)
    notes = [f"camera {name} is not used for the body: {why}" for name, why in result.unused_cameras.items()]
    notes += [result.report.exchanged_sides.says] if result.report.exchanged_sides is not None else []
    notes += [result.report.inverted_cameras.says] if result.report.inverted_cameras is not None else []
    notes += [result.report.slipped_mounts.says] if result.report.slipped_mounts is not None else []
    write_summary(files, unused_cameras=dict(result.unused_cameras), notes=notes)


def _merge_inputs(task: MergeTask) -> MergeInputs:
    scene = load_map(task.map.path)
    found = RegisteredCameras.load(
        paths_of(task.registrations.values()), scene.maps, load_clocks(task.clocks.path)
    )
    skeleton, mounts = load_body(task.body)
    mounted = {mount.camera for mount in mounts}
    return MergeInputs(
        trajectories=tuple(path for path in found.trajectories if path.camera in mounted),
        not_worn=tuple(path for path in found.trajectories if path.camera not in mounted),
        clocks=found.clocks,
        skeleton=skeleton,
        mounts=mounts,
        skeleton_is_measured=task.body.skeleton_file is not None,
        height_m=task.body.height_m,
        activity=task.body.activity,
        map_points={item.gauge: item.points for item in scene.maps},
        row_fraction=found.row_fraction,
        force_windows={
            name: item.windows for name, item in found.inertial.items() if item.windows is not None
        },
        picture_turns={name: item.turns for name, item in found.inertial.items() if item.turns is not None},
    )


def _with_board(
    inputs: MergeInputs, task: MergeTask, footage: BoardFootage, board: MarkerBoard, context: StageContext
) -> MergeInputs:
    """Search the keyframes for the marker board, and return the inputs completed with its views."""
    from bodycap_batch.calibration.board_views import find_board_views

    frames, lenses = {}, {}
    maps = {item.gauge: item for item in load_map(task.map.path).maps}
    for path in inputs.trajectories:
        keyframes = np.array([status is FrameStatus.KEYFRAME for status in path.status], dtype=bool)
        if keyframes.any():
            frames[path.camera] = np.flatnonzero(keyframes)
            lenses[path.camera] = maps[path.gauge].cameras[path.camera]
    capture = load_capture(footage.capture, footage.keyframes, threads=context.threads)
    views = find_board_views(capture, frames, lenses, board, context)
    return dataclasses.replace(inputs, board_views=views)
