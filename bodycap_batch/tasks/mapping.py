"""The tasks that build, extend and refine a job's map."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import TYPE_CHECKING

from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.loading import load_capture, load_keyframes, load_map, load_registration
from bodycap_batch.tasks.stage import SEEING, VISION, Json, Stage, write_summary

if TYPE_CHECKING:
    from bodycap_batch.model.scene import MapResult


def _map(options: Json, arguments: Json, context: StageContext, files: Path) -> None:
    from bodycap_batch.config import MapOptions
    from bodycap_batch.mapping import build_map

    selections = [load_keyframes(path) for path in arguments["selections"]]
    reach = {(first, second): (low, high) for first, second, low, high in arguments.get("reach", ())}
    options_ = MapOptions.model_validate(options)
    result = build_map(load_capture(arguments), selections, options_, context, reach or None)
    _save_map(result, files)


def _extend(options: Json, arguments: Json, context: StageContext, files: Path) -> None:
    import numpy as np

    from bodycap_batch.config import MapOptions
    from bodycap_batch.mapping import extend_map

    extra = {name: np.asarray(frames, dtype=np.int64) for name, frames in arguments["extra"].items()}
    previous = load_map(arguments["previous"])
    options_ = MapOptions.model_validate(options)
    _save_map(extend_map(load_capture(arguments), previous, extra, options_, context), files)


def _refine(options: Json, arguments: Json, context: StageContext, files: Path) -> None:
    from bodycap_batch.config import MapOptions
    from bodycap_batch.mapping import refine_map

    paths = [load_registration(path).trajectory for path in arguments["registrations"]]
    previous = load_map(arguments["previous"])
    options_ = MapOptions.model_validate(options)
    _save_map(refine_map(load_capture(arguments), previous, paths, options_, context), files)


def _save_map(result: MapResult, files: Path) -> None:
    """Keep a map together with the workspace that is needed to extend it."""
    from bodycap_batch.formats.bundle import write_bundle
    from bodycap_batch.mapping.intrinsics.intrinsics_check import misfit_note
    from bodycap_batch.mapping.matching.flipped_cameras import flip_notes

    workspace = files / "workspace"
    os.rename(result.workspace, workspace)
    write_bundle(dataclasses.replace(result, workspace=workspace), files, "map")
    largest = result.maps[0]
    diagnostics = result.diagnostics
    write_summary(
        files,
        keyframes=len(largest.keyframe_camera),
        points=len(largest.points),
        notes=[
            *flip_notes(diagnostics),
            *(
                misfit_note(camera, factor, freed=camera in diagnostics.recalibrated)
                for camera, factor in sorted((diagnostics.misfit_factors or {}).items())
            ),
        ],
    )


_LIBRARIES = (*VISION, "pycolmap")
_MODULES = (*SEEING, "pycolmap")
# 1,080 frames of an easy walk took 341 MB, a violent one has four times the keyframes.
_MEMORY_MB = 1500
MAP = Stage(function=_map, libraries=_LIBRARIES, modules=_MODULES, memory_mb=_MEMORY_MB)
EXTEND = Stage(function=_extend, libraries=_LIBRARIES, modules=_MODULES, memory_mb=_MEMORY_MB)
REFINE = Stage(function=_refine, libraries=_LIBRARIES, modules=_MODULES, memory_mb=_MEMORY_MB)
