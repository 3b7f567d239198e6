"""The tasks that build, extend and refine a job's map."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bodycap_batch.config.options import MapOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import NO_MOTION_HINT, EstimationError
from bodycap_batch.formats.dataclass_files import write_dataclass
from bodycap_batch.model.scene import MapResult
from bodycap_batch.tasks.inputs import ArtefactRef, CaptureRef
from bodycap_batch.tasks.loading import load_capture, load_keyframes, load_map, load_registration
from bodycap_batch.tasks.stage import write_summary


@dataclass(frozen=True, slots=True, kw_only=True)
class MapTask:
    """Build the map of all keyframes.

    Attributes:
        options: The stage's options.
        capture: The videos of all cameras.
        keyframes: The selected keyframes of each camera, by camera name.
        may_be_empty: Store an empty map if there is none, because rotations alone are a result, too.
    """

    options: MapOptions
    capture: CaptureRef
    keyframes: Mapping[str, ArtefactRef]
    may_be_empty: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class ExtendTask:
    """Extend a map by further keyframes, to localise frames that were lost.

    Attributes:
        options: The stage's options.
        capture: The videos of all cameras.
        keyframes: The selected keyframes of each camera, by camera name.
        map: The map to extend.
        extra: For each camera name, indices of the frames to add as keyframes.
    """

    options: MapOptions
    capture: CaptureRef
    keyframes: Mapping[str, ArtefactRef]
    map: ArtefactRef
    extra: Mapping[str, tuple[int, ...]]


@dataclass(frozen=True, slots=True, kw_only=True)
class RefineTask:
    """Correct the deformation that rolling shutters cause in a map.

    Attributes:
        options: The stage's options.
        capture: The videos of all cameras.
        map: The map to refine.
        registrations: The registration of each camera against this map, by camera name.
    """

    options: MapOptions
    capture: CaptureRef
    map: ArtefactRef
    registrations: Mapping[str, ArtefactRef]


def run_map(task: MapTask, context: StageContext, files: Path) -> None:
    """Build the map and store it."""
    from bodycap_batch.mapping import build_map, empty_map

    selections = [load_keyframes(artefact.path) for artefact in task.keyframes.values()]
    capture = load_capture(task.capture, task.keyframes, threads=context.threads)
    try:
        result = build_map(capture, selections, task.options, context)
    except EstimationError as error:
        if not task.may_be_empty or error.hint == NO_MOTION_HINT:
            raise
        save_map(empty_map(capture, selections, context, error), files)
    else:
        save_map(result, files)


def run_extend(task: ExtendTask, context: StageContext, files: Path) -> None:
    """Extend the map and store it."""
    from bodycap_batch.mapping import extend_map, with_estimated_lenses

    extra = {name: np.asarray(frames, dtype=np.int64) for name, frames in task.extra.items()}
    previous = load_map(task.map.path)
    selections = [load_keyframes(artefact.path) for artefact in task.keyframes.values()]
    capture = load_capture(task.capture, task.keyframes, threads=context.threads)
    capture = with_estimated_lenses(capture, selections)
    save_map(extend_map(capture, previous, extra, task.options, context), files)


def run_refine(task: RefineTask, context: StageContext, files: Path) -> None:
    """Refine the map and store it."""
    from bodycap_batch.mapping import refine_map

    paths = [load_registration(artefact.path).trajectory for artefact in task.registrations.values()]
    previous = load_map(task.map.path)
    capture = load_capture(task.capture, threads=context.threads)
    result = refine_map(capture, previous, paths, task.options, context)
    save_map(result, files)


def save_map(result: MapResult, files: Path) -> None:
    """Store a map with its workspace. Extending the map later needs the workspace.

    Args:
        result: The map.
        files: Folder of the artefact.
    """
    from bodycap_batch.mapping.intrinsics.intrinsics_check import misfit_note
    from bodycap_batch.mapping.matching.flipped_cameras import flip_notes
    from bodycap_batch.mapping.validation.epipolar_consistency import contradicting_camera_note

    workspace = files / "workspace"
    os.rename(result.workspace, workspace)
    write_dataclass(dataclasses.replace(result, workspace=workspace), files, "map")
    largest = result.maps[0]
    diagnostics = result.diagnostics
    corrected = sorted({name for scene_map in result.maps for name in scene_map.readout_s})
    write_summary(
        files,
        keyframes=len(largest.keyframe_camera),
        points=len(largest.points),
        corrected=corrected,
        rolling=bool(corrected or diagnostics.uncorrected_shutters),
        failure=result.log.get("failure"),
        further=len(result.log.get("further_maps", ())),
        notes=[
            *flip_notes(diagnostics),
            *map(contradicting_camera_note, diagnostics.contradicting_cameras),
            *(
                misfit_note(camera, factor, freed=camera in diagnostics.recalibrated)
                for camera, factor in sorted((diagnostics.misfit_factors or {}).items())
            ),
        ],
    )
