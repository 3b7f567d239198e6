"""Stage 2, again: add keyframes to a map."""

from __future__ import annotations

import shutil
from collections.abc import Mapping

import numpy as np

from bodycap_batch.capture import Capture
from bodycap_batch.config import MapOptions
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping.inputs import (
    common_times_ns,
    calibrated_camera_ids,
    intrinsics_of,
    make_mapping_context,
)
from bodycap_batch.mapping.intrinsics.recalibration import with_map_intrinsics
from bodycap_batch.mapping.matching.database import (
    DATABASE_NAME,
    ImageRef,
    add_keyframes,
    read_camera_ids,
    read_image_ids,
)
from bodycap_batch.mapping.matching.pair_selection import PairGenerator, match_keyframes
from bodycap_batch.mapping.matching.skeletal_set import SKELETAL_ABOVE
from bodycap_batch.mapping.reconstruction.reconstruct import MODELS_FOLDER, write_models
from bodycap_batch.mapping.results import make_result, finalise_models
from bodycap_batch.mapping.validation.repair import remove_misregistered, re_register_images
from bodycap_batch.model.scene import MapResult


def extend_map(
    capture: Capture,
    previous: MapResult,
    extra_frames: Mapping[str, IntArray],
    options: MapOptions,
    context: StageContext,
) -> MapResult:
    """Add keyframes to a map: existing poses are held while the new ones register, then all are refined.

    Keyframes that contradict the map afterwards are cut out.

    Args:
        capture: All cameras.
        previous: The map so far; its workspace is copied, not changed.
        extra_frames: Frame indices by camera: new keyframes, and old ones to be taken out and placed again.
        options: The stage's options.
        context: Work folder, threads, progress.

    Returns:
        The grown models, each in a new gauge.
    """
    import pycolmap

    capture = with_map_intrinsics(capture, previous)
    workspace = context.work_dir / "workspace"
    shutil.copytree(previous.workspace, workspace)
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        known = read_image_ids(database)
    cameras = read_camera_ids(workspace)
    new = [ref for ref in _refs(extra_frames) if ref not in known]
    wanted = [
        (capture.camera(name), cameras[name], np.array(sorted(r.frame for r in new if r.camera == name)))
        for name in sorted({ref.camera for ref in new})
    ]
    add_keyframes(workspace, wanted, options, context)
    chooser = PairGenerator(workspace, new, common_times_ns(capture), options, context)
    _, linked = match_keyframes(chooser, workspace, intrinsics_of(capture), context)
    constant = calibrated_camera_ids(capture, cameras)
    doubted = {known[ref] for ref in _refs(extra_frames) if ref in known}
    shop = make_mapping_context(workspace, capture, options, constant, context)
    models, cut, placed = [], list[str](), list[set[int] | None]()
    for number in range(len(previous.maps)):
        model = pycolmap.Reconstruction(str(workspace / MODELS_FOLDER / str(number)))
        standing = set(map(int, model.reg_image_ids())) - doubted
        inside = set(map(int, model.reg_image_ids())) & doubted
        model, names = remove_misregistered(
            re_register_images(model, inside, shop, len(known) + len(new)), shop
        )
        models.append(model)
        cut += names
        placed.append(
            set(map(int, model.reg_image_ids())) - standing if len(standing) > SKELETAL_ABOVE else None
        )
    dropped = finalise_models(models, shop, capture, placed)
    write_models(workspace, models)
    told = {"placed_again": len(doubted), "cut": cut, "unconfirmed_points": dropped}
    entry = {"new_keyframes": len(new), **told, **linked}
    growth = [*previous.log.get("growth", []), entry]
    log = {**previous.log, "keyframes": len(known) + len(new), "growth": growth}
    return make_result(models, workspace, log)


def _refs(frames: Mapping[str, IntArray]) -> list[ImageRef]:
    return [ImageRef(name, int(frame)) for name, mine in sorted(frames.items()) for frame in mine]
