"""Stage 2, after registration: correct a map for rolling shutters."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from bodycap_batch.capture import Capture
from bodycap_batch.config import MapOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping.intrinsics.readout_time import (
    RollingShutterModel,
    estimate_readouts,
    map_with_readouts,
)
from bodycap_batch.mapping.intrinsics.recalibration import with_map_intrinsics
from bodycap_batch.mapping.matching.database import (
    read_camera_ids,
)
from bodycap_batch.mapping.matching.skeletal_set import SKELETAL_ABOVE
from bodycap_batch.mapping.reconstruction.bundle_adjustment import adjust_and_filter, adjust_robustly
from bodycap_batch.mapping.reconstruction.reconstruct import MODELS_FOLDER, mapper_options, write_models
from bodycap_batch.mapping.reconstruction.two_step_adjustment import adjust_in_two_steps
from bodycap_batch.model.scene import MapResult, Trajectory

if TYPE_CHECKING:
    import pycolmap
from bodycap_batch.mapping.inputs import calibrated_camera_ids, threshold_scale
from bodycap_batch.mapping.results import make_result


def refine_map(
    capture: Capture,
    previous: MapResult,
    trajectories: Sequence[Trajectory],
    options: MapOptions,
    context: StageContext,
) -> MapResult:
    """Take a rolling shutter's bending out of the map, with the motion that registration found.

    Keypoints are moved to the instant of their image's middle row with the velocity that the neighbouring
    frames' poses give, and all is adjusted once. A readout time that was not stated is estimated from the
    keyframes themselves. Observations stay where they were found; `Map.readout_s` says how to move them.

    Args:
        capture: All cameras.
        previous: The map so far; its workspace is copied, not changed.
        trajectories: Every frame's pose in one of the previous map's gauges, by camera.
        options: The stage's options.
        context: Work folder.

    Returns:
        The refined models, each in a new gauge; those without a rolling shutter as they were.

    Raises:
        EstimationError: The adjustment failed.

    Source: Hedborg et al., "Rolling shutter bundle adjustment", CVPR 2012, for the idea; velocities come
        from the neighbouring frames instead of extra unknowns.
    """
    import pycolmap

    capture = with_map_intrinsics(capture, previous)
    workspace = context.work_dir / "workspace"
    shutil.copytree(previous.workspace, workspace)
    settings, constant = _settings(capture, workspace, options)
    cameras = {camera.name: camera for camera in capture.cameras}
    models, found_in = [], []
    for number, scene_map in enumerate(previous.maps):
        context.check_cancelled()
        context.progress(number, len(previous.maps), "maps refined")
        model = pycolmap.Reconstruction(str(workspace / MODELS_FOLDER / str(number)))
        paths = {path.camera: path for path in trajectories if path.gauge == scene_map.gauge}
        rolling = RollingShutterModel(model, paths, cameras)
        rolling, found = estimate_readouts(rolling, cameras, settings, constant)
        readout_s = {name: each.seconds for name, each in found.items() if each.seconds}
        if readout_s:
            moved = rolling.moved(readout_s)
            if moved.num_reg_images() > SKELETAL_ABOVE:
                adjust_in_two_steps(moved, settings, constant)
            else:
                adjust_and_filter(moved, settings, constant)
                adjust_robustly(moved, settings, constant)
            rolling.move(moved, {})
            model = moved
        models.append(model)
        found_in.append(found)
    write_models(workspace, models)
    log = {"rolling_shutter": [{name: asdict(each) for name, each in found.items()} for found in found_in]}
    result = make_result(models, workspace, {**previous.log, **log})
    maps = [map_with_readouts(item, each) for item, each in zip(result.maps, found_in, strict=True)]
    return replace(result, maps=tuple(maps))


def _settings(
    capture: Capture, workspace: Path, options: MapOptions
) -> tuple[pycolmap.IncrementalPipelineOptions, list[int]]:
    """The mapper's settings for a workspace that exists, and the ids of its calibrated cameras."""
    constant = calibrated_camera_ids(capture, read_camera_ids(workspace))
    return mapper_options(options, constant, threshold_scale(capture)), constant
