"""Build further maps from the keyframes whose frames have no pose."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from bodycap_batch.capture import Capture
from bodycap_batch.config import MapOptions
from bodycap_batch.config.lost_frames import LEAST_MAPPED
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.mapping.inputs import calibrated_camera_ids, make_mapping_context, with_lenses_of_maps
from bodycap_batch.mapping.intrinsics.readout_time import map_with_readouts
from bodycap_batch.mapping.intrinsics.shutters import readouts_of_maps
from bodycap_batch.mapping.mapping_context import MappingContext
from bodycap_batch.mapping.matching.database import (
    count_features,
    read_camera_ids,
    update_camera,
)
from bodycap_batch.mapping.matching.skeletal_set import SKELETAL_ABOVE
from bodycap_batch.mapping.reconstruction.conversion import map_from_reconstruction
from bodycap_batch.mapping.reconstruction.model_files import keyframe_names, model_order
from bodycap_batch.mapping.reconstruction.reconstruct import reconstruct
from bodycap_batch.mapping.results import finalise_models
from bodycap_batch.mapping.validation.repair import remove_without_adjustment
from bodycap_batch.model.scene import Map, MapResult, Trajectory


def map_lost_keyframes(
    capture: Capture,
    previous: MapResult,
    paths: Sequence[Trajectory],
    options: MapOptions,
    context: StageContext,
) -> MapResult:
    """Build further maps from the keyframes whose frames have no pose.

    A part of a video that the matches of other places contradict, or that nothing joins to the map of the
    path, gets a map of its own. Its place in the other maps is unknown. All cameras keep their lenses.

    Args:
        capture: All cameras.
        previous: The maps to which the paths refer. The workspace is not changed.
        paths: The trajectory of each camera.
        options: The options of the stage `map`.
        context: Work folder, threads, progress.

    Returns:
        The largest map and the maps of the paths, then the further maps, the largest first. Each of the
        further maps has a gauge of its own, and no keyframe is in two of them. The workspace is empty:
        these maps are final.
    """
    used = {path.gauge for path in paths}
    kept = [item for number, item in enumerate(previous.maps) if number == 0 or item.gauge in used]
    further = _further_maps(capture, previous, paths, options, context)
    final = context.work_dir / "final"
    final.mkdir()
    sizes = [len(item.keyframe_frame) for item in further]
    return replace(
        previous,
        maps=(*kept, *further),
        workspace=final,
        log={**previous.log, "further_maps": sizes},
    )


def _further_maps(
    capture: Capture,
    previous: MapResult,
    paths: Sequence[Trajectory],
    options: MapOptions,
    context: StageContext,
) -> list[Map]:
    """Return the further maps, the largest first."""
    workspace = context.work_dir / "workspace"
    # SQLite may write to a database that it only reads, and a stored workspace must not change.
    shutil.copytree(previous.workspace, workspace)
    left = _lost_keyframes(workspace, paths)
    ids = read_camera_ids(workspace)
    capture = with_lenses_of_maps(capture, previous)
    for name, number in ids.items():
        update_camera(workspace, number, capture.camera(name))
    calibrated_ids = calibrated_camera_ids(capture, ids)
    mapping = make_mapping_context(workspace, capture, options, calibrated_ids, context, SKELETAL_ABOVE)
    models = list[Any]()
    while len(left) >= LEAST_MAPPED:
        context.check_cancelled()
        found = _consistent_models(left, mapping)
        if not found:
            break
        models += found
        left -= set[str]().union(*map(keyframe_names, found))
    readouts = readouts_of_maps(previous.maps)
    return [
        map_with_readouts(map_from_reconstruction(model, workspace), readouts)
        for model in sorted(models, key=model_order)
    ]


def _lost_keyframes(workspace: Path, paths: Sequence[Trajectory]) -> set[str]:
    """Return the image names of the keyframes in a database whose frames have no pose."""
    lost = {path.camera: ~path.localised for path in paths}
    refs = count_features(workspace)
    return {ref.name for ref in refs if ref.camera in lost and lost[ref.camera][ref.frame]}


def _consistent_models(names: set[str], mapping: MappingContext) -> Sequence[Any]:
    """Return models of some keyframes, without the keyframes that contradict them, the largest first."""
    settings = mapping.mapper_options()
    settings.image_names = sorted(names)
    models, _ = reconstruct(mapping.workspace, settings, mapping.stage, len(names))
    taken, out = set[str](), list[Any]()
    for model in models:
        if model.num_reg_images() < LEAST_MAPPED or not model.num_points3D():
            continue
        kept, _, _ = remove_without_adjustment(model, mapping)
        if keyframe_names(kept) & taken:
            continue  # The models of one search may share keyframes. The next search builds the rest.
        try:
            finalise_models([kept], mapping, [None])
        except EstimationError:
            continue  # No point is left: the model consisted of things that move by themselves.
        if kept.num_reg_images() >= LEAST_MAPPED:
            taken |= keyframe_names(kept)
            out.append(kept)
    return out
