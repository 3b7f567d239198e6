"""Stage 2: build one sparse map from the keyframes of all cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bodycap_batch.capture import Capture
from bodycap_batch.config import MapOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.mapping.inputs import (
    common_times_ns,
    calibrated_camera_ids,
    intrinsics_of,
    make_mapping_context,
)
from bodycap_batch.mapping.intrinsics.intrinsics_check import update_camera_models, find_misfit_intrinsics
from bodycap_batch.mapping.intrinsics.recalibration import recalibrate_if_misfit
from bodycap_batch.mapping.matching.database import (
    DATABASE_NAME,
    ImageRef,
    add_camera,
    add_keyframes,
    read_camera_ids,
)
from bodycap_batch.mapping.matching.flipped_cameras import add_flip_hint, exclude_flipped_cameras
from bodycap_batch.mapping.matching.pair_selection import PairGenerator, match_keyframes
from bodycap_batch.mapping.matching.skeletal_set import SKELETAL_ABOVE
from bodycap_batch.mapping.reconstruction.initial_pair import InitialPair, find_user_pair, rank_initial_pairs
from bodycap_batch.mapping.reconstruction.reconstruct import reconstruct, write_models
from bodycap_batch.mapping.results import make_result, finalise_models
from bodycap_batch.mapping.validation.camera_distance_check import Reach, check_distances
from bodycap_batch.mapping.validation.epipolar_consistency import check_consistency, check_coverage
from bodycap_batch.mapping.validation.remaining_keyframes import resect_remaining
from bodycap_batch.mapping.validation.repair import repair_model
from bodycap_batch.mapping.workspace import MappingContext
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.scene import KeyframeSelection, MapResult

_INITIAL_PAIRS = 3
"""Pairs tried before COLMAP's own search, which verifies hundreds of pairs where few have its 16 degrees
between rays (5 of 25 CPU seconds on tum_fr1_xyz, 1.4 of 11 on walk12). Maps are as exact."""

_LOGGED_CANDIDATES = 5
"""Pairs told of, with what speaks against each, where the first start did not hold."""


def build_map(
    capture: Capture,
    selections: Sequence[KeyframeSelection],
    options: MapOptions,
    context: StageContext,
    reach: Reach | None = None,
    *,
    many: int = SKELETAL_ABOVE,
) -> MapResult:
    """Reconstruct the room and the keyframes' poses by incremental structure from motion.

    Args:
        capture: All cameras.
        selections: Keyframes of each camera.
        options: The stage's options.
        context: Work folder (holds the database and models afterwards), threads, progress.
        reach: How near and how far two cameras can be on the body; without it that is not checked.
        many: Keyframes beyond which the map is built from some of them; the others are placed in it.

    Returns:
        The models, largest first, each in its own gauge.

    Raises:
        EstimationError: No initial pair held, too few keyframes were registered, or they contradict the map.

    Source: Schönberger, Frahm, "Structure-from-motion revisited", CVPR 2016 (COLMAP).
    """
    result, refused = build_map_once(capture, selections, options, context, reach, many)
    apart = replace(context, work_dir=context.work_dir / "freed")

    def again(other: Capture) -> MapResult:
        found, unusable = build_map_once(other, selections, options, apart, reach, many)
        if unusable is not None:
            raise unusable
        return found

    return recalibrate_if_misfit(result, capture, again, refused)


def build_map_once(
    capture: Capture,
    selections: Sequence[KeyframeSelection],
    options: MapOptions,
    context: StageContext,
    reach: Reach | None,
    many: int,
) -> tuple[MapResult, EstimationError | None]:
    """`build_map` with the lenses as the capture has them: held where calibrated, else refined.

    Where the map holds too few keyframes or they contradict it, what to say of it comes with it: other lenses
    may give one that can be used.
    """
    import pycolmap

    workspace = context.work_dir / "workspace"
    workspace.mkdir(parents=True, exist_ok=True)
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        cameras = {item.camera: add_camera(database, capture.camera(item.camera)) for item in selections}
    wanted = [
        (capture.camera(item.camera), cameras[item.camera], np.asarray(item.frames)) for item in selections
    ]
    add_keyframes(workspace, wanted, options, context)
    selections, options, mirror = exclude_flipped_cameras(workspace, selections, options)
    cameras = read_camera_ids(workspace)
    refs = [ImageRef(item.camera, int(frame)) for item in selections for frame in item.frames]
    chooser = PairGenerator(workspace, refs, common_times_ns(capture), options, context)
    carrying = chooser.spanning() if len(refs) > many else chooser
    tried, linked = match_keyframes(carrying, workspace, intrinsics_of(capture), context)
    constant = calibrated_camera_ids(capture, cameras)
    shop = make_mapping_context(workspace, capture, options, constant, context)
    guessed = {number: name for name, number in cameras.items() if capture.camera(name).camera.refine}
    models, begun = reconstruct_with_intrinsics(shop, options, guessed, len(carrying.refs))
    log: dict[str, Any] = {"keyframes": len(refs), **linked, **begun, **mirror}
    if models:
        models[0], log["repair"] = repair_model(models[0], tried, shop, carrying.refs)
        placed: Sequence[set[int] | None] = [None] * len(models)
        if carrying is not chooser:
            placed, log["placed"] = resect_remaining(models, chooser, tried, shop)
        log["unconfirmed_points"] = finalise_models(models, shop, capture, placed)
    refused = check_coverage(
        models, len(refs), log.get("initial_candidates", log["initial_pair_ladder"]), options
    )
    refused = add_flip_hint(refused, mirror)
    if refused is not None and not models:
        raise refused
    write_models(workspace, models)
    given = {number: name for name, number in cameras.items() if capture.camera(name).calibrated}
    log["misfitting_lenses"] = find_misfit_intrinsics(models[0], shop.settings(), given)
    result = make_result(models, workspace, log)
    verdict = check_distances(result.maps[0], common_times_ns(capture), reach).to_log() if reach else None
    shares = [log[step]["contradicted_share"] for step in ("repair", "placed") if step in log]
    refused = refused or add_flip_hint(check_consistency(max(shares), verdict), mirror)
    return replace(result, log={**result.log, "reach": verdict}), refused


def _initial_pairs(shop: MappingContext, options: MapOptions) -> tuple[list[InitialPair], dict[str, object]]:
    """The pair the user named, if it can be used, then the best ranked; what to tell of the first."""
    ranked = [
        start for start in rank_initial_pairs(shop.workspace, shop.lenses)[:_INITIAL_PAIRS] if start.usable
    ]
    if options.init_frames is None:
        return ranked, {}
    start = find_user_pair(shop.workspace, options.init_frames, shop.lenses, shop.frame_numbers)
    told = {"failed": "no verified matches"} if start is None else start.to_log()
    return ranked if start is None else [start, *ranked], {"named_initial_pair": told}


def reconstruct_with_intrinsics(
    shop: MappingContext, options: MapOptions, guessed: Mapping[int, str], total: int
) -> tuple[list[Any], dict[str, Any]]:
    """The first models, built anew where guessed lenses (names by id) need others; how they came about."""
    models, log = _reconstruct_from_pairs(shop, options, total)
    found, decentred = dict[str, tuple[Camera, bool]](), None
    for _ in range(2 if guessed else 0):
        better, decentred = update_camera_models(shop.workspace, models, shop.settings(), guessed, decentred)
        if not better:
            break
        found |= better
        models, log = _reconstruct_from_pairs(
            shop := replace(shop, lenses={**shop.lenses, **found}), options, total
        )
        log["better_lenses"] = {name: lens.model for name, (lens, _) in sorted(found.items())}
    return models, log


def _reconstruct_from_pairs(
    shop: MappingContext, options: MapOptions, total: int
) -> tuple[list[Any], dict[str, Any]]:
    """Models from the pair the user named or the best ranked, and what each of the pairs gave."""
    starts, named = _initial_pairs(shop, options)
    models, ladder = reconstruct(shop.workspace, shop.settings(), shop.context, total, starts)
    log: dict[str, Any] = {**named, "initial_pair_ladder": ladder}
    if len(ladder) > 1:
        best = rank_initial_pairs(shop.workspace, shop.lenses)[:_LOGGED_CANDIDATES]
        log["initial_candidates"] = [{**start.to_log(), "doubt": start.doubt} for start in best]
    return models, log
