"""Stage 2: one sparse map from the keyframes of all cameras."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bodycap_batch.capture import Capture
from bodycap_batch.config import MapOptions
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.mapping.intrinsics.intrinsics_check import change_lenses, misfitting_lenses
from bodycap_batch.mapping.intrinsics.readout_time import RollingModel, readouts, with_readouts
from bodycap_batch.mapping.intrinsics.recalibration import as_mapped, freed_where_contradicted
from bodycap_batch.mapping.matching.database import (
    DATABASE_NAME,
    ImageRef,
    add_camera,
    add_keyframes,
    camera_ids,
    image_ids,
)
from bodycap_batch.mapping.matching.flipped_cameras import explained, without_mirrored
from bodycap_batch.mapping.matching.pair_selection import PairChooser, link_keyframes
from bodycap_batch.mapping.matching.skeletal_set import MANY
from bodycap_batch.mapping.reconstruction.conversion import to_map
from bodycap_batch.mapping.reconstruction.initial_pair import Start, named_start, rank_starts
from bodycap_batch.mapping.reconstruction.reconstruct import (
    MODELS_NAME,
    mapper_options,
    reconstruct,
    refine,
    settle,
    write_models,
)
from bodycap_batch.mapping.reconstruction.two_step_adjustment import refine_large
from bodycap_batch.mapping.validation.camera_distance_check import Reach, check_reach
from bodycap_batch.mapping.validation.epipolar_consistency import inconsistent, too_few
from bodycap_batch.mapping.validation.remaining_keyframes import place_others
from bodycap_batch.mapping.validation.repair import Workshop, cut_doubtful, place_again, repair
from bodycap_batch.mapping.validation.transient_points import drop_unconfirmed
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.optical_flow import pixel_scale
from bodycap_batch.model.scene import KeyframeSelection, MapResult, Trajectory

if TYPE_CHECKING:
    import pycolmap

__all__ = ["build_map", "extend_map", "refine_map"]

_STARTS = 3
"""Pairs tried before COLMAP's own search, which verifies hundreds of pairs where few have its 16 degrees
between rays (5 of 25 CPU seconds on tum_fr1_xyz, 1.4 of 11 on walk12). Maps are as exact."""
_CANDIDATES_TOLD = 5
"""Pairs told of, with what speaks against each, where the first start did not hold."""


def build_map(
    capture: Capture,
    selections: Sequence[KeyframeSelection],
    options: MapOptions,
    context: StageContext,
    reach: Reach | None = None,
    *,
    many: int = MANY,
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
    result, refused = _build(capture, selections, options, context, reach, many)
    apart = replace(context, work_dir=context.work_dir / "freed")

    def again(other: Capture) -> MapResult:
        found, unusable = _build(other, selections, options, apart, reach, many)
        if unusable is not None:
            raise unusable
        return found

    return freed_where_contradicted(result, capture, again, refused)


def _build(
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
    selections, options, mirror = without_mirrored(workspace, selections, options)
    cameras = camera_ids(workspace)
    refs = [ImageRef(item.camera, int(frame)) for item in selections for frame in item.frames]
    chooser = PairChooser(workspace, refs, _common_ns(capture), options, context)
    carrying = chooser.spanning() if len(refs) > many else chooser
    tried, linked = link_keyframes(carrying, workspace, _lenses(capture), context)
    constant = _constant(capture, cameras)
    shop = _shop(workspace, capture, options, constant, context)
    guessed = {number: name for name, number in cameras.items() if capture.camera(name).camera.refine}
    models, begun = _begun(shop, options, guessed, len(carrying.refs))
    log: dict[str, Any] = {"keyframes": len(refs), **linked, **begun, **mirror}
    if models:
        models[0], log["repair"] = repair(models[0], tried, shop, carrying.refs)
        placed: Sequence[set[int] | None] = [None] * len(models)
        if carrying is not chooser:
            placed, log["placed"] = place_others(models, chooser, tried, shop)
        log["unconfirmed_points"] = _settled(models, shop, capture, placed)
    refused = too_few(models, len(refs), log.get("initial_candidates", log["initial_pair_ladder"]), options)
    refused = explained(refused, mirror)
    if refused is not None and not models:
        raise refused
    write_models(workspace, models)
    given = {number: name for name, number in cameras.items() if capture.camera(name).calibrated}
    log["misfitting_lenses"] = misfitting_lenses(models[0], shop.settings(), given)
    result = _result(models, workspace, log)
    verdict = check_reach(result.maps[0], _common_ns(capture), reach).to_log() if reach else None
    shares = [log[step]["contradicted_share"] for step in ("repair", "placed") if step in log]
    refused = refused or explained(inconsistent(max(shares), verdict), mirror)
    return replace(result, log={**result.log, "reach": verdict}), refused


def _shop(
    workspace: Path, capture: Capture, options: MapOptions, constant: Sequence[int], context: StageContext
) -> Workshop:
    """What mending a model takes: the workspace, the lenses and the mapper's settings."""
    scale = _scale(capture)
    return Workshop(
        workspace=workspace,
        lenses=_lenses(capture),
        settings=lambda: mapper_options(options, constant, scale),
        constant=constant,
        context=context,
        frame_numbers={camera.name: camera.frame_numbers for camera in capture.cameras},
    )


def _settled(
    models: Sequence[Any], shop: Workshop, capture: Capture, placed: Sequence[set[int] | None]
) -> int:
    """Take unconfirmed points out of models, in place, and adjust what is left once more; how many.

    Where it is told which images of a model were placed in it after it had settled, these alone.
    """
    times_ns = _common_ns(capture)
    total = 0
    for number, (model, mine) in enumerate(zip(models, placed, strict=True)):
        shop.context.progress(number, len(models), "maps adjusted")
        total += drop_unconfirmed(model, times_ns)
        only = None if mine is None else mine & set(map(int, model.reg_image_ids()))
        if only is None or only:
            settle(model, shop.settings(), shop.constant, only)
    return total


def _starts(shop: Workshop, options: MapOptions) -> tuple[list[Start], dict[str, object]]:
    """The pair the user named, if it can be used, then the best ranked; what to tell of the first."""
    ranked = [start for start in rank_starts(shop.workspace, shop.lenses)[:_STARTS] if start.usable]
    if options.init_frames is None:
        return ranked, {}
    start = named_start(shop.workspace, options.init_frames, shop.lenses, shop.frame_numbers)
    told = {"failed": "no verified matches"} if start is None else start.to_log()
    return ranked if start is None else [start, *ranked], {"named_initial_pair": told}


def _begun(
    shop: Workshop, options: MapOptions, guessed: Mapping[int, str], total: int
) -> tuple[list[Any], dict[str, Any]]:
    """The first models, built anew where guessed lenses (names by id) need others; how they came about."""
    models, log = _started(shop, options, total)
    found, decentred = dict[str, tuple[Camera, bool]](), None
    for _ in range(2 if guessed else 0):
        better, decentred = change_lenses(shop.workspace, models, shop.settings(), guessed, decentred)
        if not better:
            break
        found |= better
        models, log = _started(shop := replace(shop, lenses={**shop.lenses, **found}), options, total)
        log["better_lenses"] = {name: lens.model for name, (lens, _) in sorted(found.items())}
    return models, log


def _started(shop: Workshop, options: MapOptions, total: int) -> tuple[list[Any], dict[str, Any]]:
    """Models from the pair the user named or the best ranked, and what each of the pairs gave."""
    starts, named = _starts(shop, options)
    models, ladder = reconstruct(shop.workspace, shop.settings(), shop.context, total, starts)
    log: dict[str, Any] = {**named, "initial_pair_ladder": ladder}
    if len(ladder) > 1:
        best = rank_starts(shop.workspace, shop.lenses)[:_CANDIDATES_TOLD]
        log["initial_candidates"] = [{**start.to_log(), "doubt": start.doubt} for start in best]
    return models, log


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

    capture = as_mapped(capture, previous)
    workspace = context.work_dir / "workspace"
    shutil.copytree(previous.workspace, workspace)
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        known = image_ids(database)
    cameras = camera_ids(workspace)
    new = [ref for ref in _refs(extra_frames) if ref not in known]
    wanted = [
        (capture.camera(name), cameras[name], np.array(sorted(r.frame for r in new if r.camera == name)))
        for name in sorted({ref.camera for ref in new})
    ]
    add_keyframes(workspace, wanted, options, context)
    chooser = PairChooser(workspace, new, _common_ns(capture), options, context)
    _, linked = link_keyframes(chooser, workspace, _lenses(capture), context)
    constant = _constant(capture, cameras)
    doubted = {known[ref] for ref in _refs(extra_frames) if ref in known}
    shop = _shop(workspace, capture, options, constant, context)
    models, cut, placed = [], list[str](), list[set[int] | None]()
    for number in range(len(previous.maps)):
        model = pycolmap.Reconstruction(str(workspace / MODELS_NAME / str(number)))
        standing = set(map(int, model.reg_image_ids())) - doubted
        inside = set(map(int, model.reg_image_ids())) & doubted
        model, names = cut_doubtful(place_again(model, inside, shop, len(known) + len(new)), shop)
        models.append(model)
        cut += names
        placed.append(set(map(int, model.reg_image_ids())) - standing if len(standing) > MANY else None)
    dropped = _settled(models, shop, capture, placed)
    write_models(workspace, models)
    told = {"placed_again": len(doubted), "cut": cut, "unconfirmed_points": dropped}
    entry = {"new_keyframes": len(new), **told, **linked}
    growth = [*previous.log.get("growth", []), entry]
    log = {**previous.log, "keyframes": len(known) + len(new), "growth": growth}
    return _result(models, workspace, log)


def _refs(frames: Mapping[str, IntArray]) -> list[ImageRef]:
    return [ImageRef(name, int(frame)) for name, mine in sorted(frames.items()) for frame in mine]


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

    capture = as_mapped(capture, previous)
    workspace = context.work_dir / "workspace"
    shutil.copytree(previous.workspace, workspace)
    settings, constant = _settings(capture, workspace, options)
    cameras = {camera.name: camera for camera in capture.cameras}
    models, found_in = [], []
    for number, scene_map in enumerate(previous.maps):
        context.check_cancelled()
        context.progress(number, len(previous.maps), "maps refined")
        model = pycolmap.Reconstruction(str(workspace / MODELS_NAME / str(number)))
        paths = {path.camera: path for path in trajectories if path.gauge == scene_map.gauge}
        rolling = RollingModel(model, paths, cameras)
        rolling, found = readouts(rolling, cameras, settings, constant)
        readout_s = {name: each.seconds for name, each in found.items() if each.seconds}
        if readout_s:
            moved = rolling.moved(readout_s)
            if moved.num_reg_images() > MANY:
                refine_large(moved, settings, constant)
            else:
                refine(moved, settings, constant)
                settle(moved, settings, constant)
            rolling.move(moved, {})
            model = moved
        models.append(model)
        found_in.append(found)
    write_models(workspace, models)
    log = {"rolling_shutter": [{name: asdict(each) for name, each in found.items()} for found in found_in]}
    result = _result(models, workspace, {**previous.log, **log})
    maps = [with_readouts(item, each) for item, each in zip(result.maps, found_in, strict=True)]
    return replace(result, maps=tuple(maps))


def _settings(
    capture: Capture, workspace: Path, options: MapOptions
) -> tuple[pycolmap.IncrementalPipelineOptions, list[int]]:
    """The mapper's settings for a workspace that exists, and the ids of its calibrated cameras."""
    constant = _constant(capture, camera_ids(workspace))
    return mapper_options(options, constant, _scale(capture)), constant


def _common_ns(capture: Capture) -> dict[str, IntArray]:
    return {camera.name: camera.common_times_ns() for camera in capture.cameras}


def _lenses(capture: Capture) -> dict[str, tuple[Camera, bool]]:
    return {item.name: (item.camera, item.calibrated) for item in capture.cameras}


def _scale(capture: Capture) -> float:
    """Factor on pixel thresholds: that of the largest image."""
    return max(pixel_scale(item.camera.width_px, item.camera.height_px) for item in capture.cameras)


def _constant(capture: Capture, ids: Mapping[str, int]) -> list[int]:
    """Database ids of the calibrated cameras."""
    return sorted(number for name, number in ids.items() if capture.camera(name).calibrated)


def _result(models: Sequence[Any], workspace: Path, log: dict[str, Any]) -> MapResult:
    maps = tuple(to_map(model, workspace) for model in models)
    log = {
        **log,
        "models": [
            {
                "gauge": item.gauge,
                "keyframes": len(item.keyframe_camera),
                "points": len(item.points),
                "mean_error_px": round(item.mean_error_px(), 4),
            }
            for item in maps
        ],
    }
    return MapResult(maps=maps, workspace=workspace, log=log)
