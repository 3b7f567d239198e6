"""Add keyframes to a map. This repeats stage 2 after registration."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from bodycap_batch.capture import Capture
from bodycap_batch.config import MapOptions
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping.inputs import (
    calibrated_camera_ids,
    frame_times_ns,
    intrinsics_of,
    make_mapping_context,
    with_map_lenses,
)
from bodycap_batch.mapping.intrinsics.readout_time import map_with_readouts
from bodycap_batch.mapping.intrinsics.recalibration import with_map_intrinsics
from bodycap_batch.mapping.intrinsics.shutters import read_shutters, readouts_of_maps
from bodycap_batch.mapping.matching.database import (
    DATABASE_NAME,
    ImageRef,
    count_features,
    read_camera_ids,
    read_image_ids,
)
from bodycap_batch.mapping.matching.keyframe_features import CameraKeyframes, add_keyframes
from bodycap_batch.mapping.matching.pair_selection import PairGenerator, match_keyframes
from bodycap_batch.mapping.matching.skeletal_set import SKELETAL_ABOVE
from bodycap_batch.mapping.re_registration import re_register_images
from bodycap_batch.mapping.reconstruction.model_files import (
    model_order,
    read_model,
    registered_ids,
    write_models,
)
from bodycap_batch.mapping.results import finalise_models, make_result, misplaced_frames
from bodycap_batch.mapping.validation.repair import remove_without_adjustment
from bodycap_batch.mapping.validation.wearer_points import remove_points_on_wearer
from bodycap_batch.model.scene import MapResult


def extend_map(
    capture: Capture,
    previous: MapResult,
    extra_frames: Mapping[str, IntArray],
    options: MapOptions,
    context: StageContext,
    *,
    skeletal_above: int = SKELETAL_ABOVE,
) -> MapResult:
    """Add keyframes to a map.

    First, the new keyframes are registered, and those of the database that the map lacks, for example removed
    ones; the existing poses do not change. Then misregistered keyframes are removed. Last, all poses are
    adjusted. In a large map, only the poses of the keyframes that were registered here are adjusted.

    Args:
        capture: All cameras.
        previous: The map so far. Its workspace is copied, not changed.
        extra_frames: Frame indices by camera name. A frame that is not in the map is added as a keyframe. A
            frame that is already a keyframe of the map is removed from the map and registered again.
        options: The stage's options.
        context: Work folder, threads, progress.
        skeletal_above: Maximum number of keyframes of a map that is not large (`MappingContext.is_large`).

    Returns:
        The extended models, largest first, each in a new gauge.
    """
    import pycolmap

    capture = with_map_intrinsics(with_map_lenses(capture, previous), previous)
    workspace = context.work_dir / "workspace"
    shutil.copytree(previous.workspace, workspace)
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        existing = read_image_ids(database)
    ids = read_camera_ids(workspace)
    new = [ref for ref in _image_refs(extra_frames) if ref not in existing]
    names = sorted({ref.camera for ref in new})
    readouts = readouts_of_maps(previous.maps)
    shutters = read_shutters(workspace, names)
    keyframes = [
        CameraKeyframes(
            capture.camera(name),
            ids[name],
            np.array(sorted(ref.frame for ref in new if ref.camera == name)),
            shutter=shutters.get(name),
        )
        for name in names
    ]
    counts = count_features(workspace)
    for item in keyframes:
        richest = max(number for ref, number in counts.items() if ref.camera == item.camera.name)
        more = options.model_copy(update={"features": max(options.features, richest)})
        add_keyframes(workspace, [item], more, context)
    generator = PairGenerator(workspace, new, frame_times_ns(capture), options, context)
    _, match_log = match_keyframes(generator, workspace, intrinsics_of(capture), context)
    calibrated_ids = calibrated_camera_ids(capture, ids)
    again = {existing[ref] for ref in _image_refs(extra_frames) if ref in existing}
    mapping = make_mapping_context(workspace, capture, options, calibrated_ids, context, skeletal_above)
    models, removed, resected = [], list[str](), list[set[int] | None]()
    for number in range(len(previous.maps)):
        model = read_model(workspace, number)
        kept = registered_ids(model) - again
        inside = registered_ids(model) & again
        extended = re_register_images(model, inside, mapping, len(existing) + len(new))
        model, cut, _ = remove_without_adjustment(extended, mapping)
        models.append(model)
        removed += cut
        resected.append(registered_ids(model) - kept if mapping.is_large(len(kept)) else None)
    transient = finalise_models(models, mapping, resected)
    for number, model in enumerate(models):
        models[number], names, _ = remove_without_adjustment(model, mapping)
        removed += names
        # A removed keyframe may have connected others with the room.
        transient += remove_points_on_wearer(models[number])
    models.sort(key=model_order)
    write_models(workspace, models)
    entry = {
        "new_keyframes": len(new),
        "placed_again": len(again),
        "cut": removed,
        "unconfirmed_points": transient,
        **match_log,
    }
    diagnostics = previous.diagnostics
    before = [
        ImageRef(name, frame).name for name, frames in diagnostics.misplaced.items() for frame in frames
    ]
    diagnostics = replace(
        diagnostics,
        misplaced=misplaced_frames([*before, *removed], models),
        extensions=(*diagnostics.extensions, entry),
        details={**diagnostics.details, "keyframes": len(existing) + len(new)},
    )
    result = make_result(models, workspace, diagnostics.to_log())
    return replace(result, maps=tuple(map_with_readouts(item, readouts) for item in result.maps))


def _image_refs(frames: Mapping[str, IntArray]) -> list[ImageRef]:
    """Return one `ImageRef` for each frame index, sorted by camera name."""
    return [ImageRef(name, int(frame)) for name, indices in sorted(frames.items()) for frame in indices]
