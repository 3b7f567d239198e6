"""Stage 2: build one sparse map from the keyframes of all cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.capture import Capture
from bodycap_batch.config import MapOptions
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import NO_MOTION_HINT, EstimationError
from bodycap_batch.core.mechanisms import Mechanism, record_act
from bodycap_batch.mapping.initial_models import reconstruct_with_intrinsics
from bodycap_batch.mapping.inputs import (
    calibrated_camera_ids,
    frame_times_ns,
    intrinsics_of,
    make_mapping_context,
    with_estimated_lenses,
)
from bodycap_batch.mapping.intrinsics.intrinsics_check import find_misfit_intrinsics
from bodycap_batch.mapping.intrinsics.readout_profile import estimate_from_matches
from bodycap_batch.mapping.intrinsics.readout_time import Readout, map_with_readouts
from bodycap_batch.mapping.intrinsics.recalibration import recalibrate_if_misfit
from bodycap_batch.mapping.intrinsics.shutters import (
    known_readouts,
    possible_readouts,
    turning_shutters,
    uncorrected_shutters,
    with_gyroscopes,
    write_shutters,
)
from bodycap_batch.mapping.matching.database import (
    DATABASE_NAME,
    add_camera,
    count_features,
    read_camera_ids,
)
from bodycap_batch.mapping.matching.flipped_cameras import add_flip_hint, exclude_flipped_cameras
from bodycap_batch.mapping.matching.keyframe_features import CameraKeyframes, add_keyframes
from bodycap_batch.mapping.matching.pair_selection import PairGenerator, match_keyframes
from bodycap_batch.mapping.matching.skeletal_set import SKELETAL_ABOVE
from bodycap_batch.mapping.reconstruction.mapper_options import MIN_RESECTION_INLIERS
from bodycap_batch.mapping.reconstruction.model_files import write_models
from bodycap_batch.mapping.results import finalise_models, make_result, misplaced_frames
from bodycap_batch.mapping.validation.epipolar_consistency import check_consistency, check_coverage
from bodycap_batch.mapping.validation.remaining_keyframes import resect_remaining
from bodycap_batch.mapping.validation.repair import left_contradicted, remove_without_adjustment, repair_model
from bodycap_batch.mapping.validation.wearer_points import remove_points_on_wearer
from bodycap_batch.model.map_diagnostics import MapDiagnostics
from bodycap_batch.model.rotation_path import TurningShutter
from bodycap_batch.model.scene import KeyframeSelection, MapResult

WORKSPACE = "workspace"
"""Name of the folder of a map's database, in the work folder."""
_MIN_MOTION_PX = 2.0
"""Minimum motion of the picture of a camera that moves, px of an image with a long side of 640 px. Evidence:
docs/decisions/mapping.md."""


def build_map(
    capture: Capture,
    selections: Sequence[KeyframeSelection],
    options: MapOptions,
    context: StageContext,
    *,
    skeletal_above: int = SKELETAL_ABOVE,
) -> MapResult:
    """Reconstruct the room and the keyframe poses by incremental structure from motion.

    If the map contradicts a given calibration, the map is built again with refined intrinsics. If the matches
    of one camera contradict the matches of the other cameras, the map is built again without this camera.

    Args:
        capture: All cameras.
        selections: Keyframes of each camera.
        options: The stage's options.
        context: Work folder, threads, progress. The database and the models are written to the work folder.
        skeletal_above: Maximum number of keyframes of a map that is built from all keyframes at once. A
            larger map is built from skeletal keyframes (the reduced set of keyframes, Snavely's skeletal
            set), and the other keyframes are resected.

    Returns:
        The models, largest first, each in a separate gauge.

    Raises:
        EstimationError: No camera moves, no initial pair succeeded, too few keyframes were registered, or the
            matches contradict the map.

    Source: Schönberger, Frahm, "Structure-from-motion revisited", CVPR 2016 (COLMAP).
    """
    _require_motion(selections)
    capture = with_estimated_lenses(capture, selections)
    result, refused = build_map_once(capture, selections, options, context, skeletal_above)
    # A map that is built again has the same features.
    features = context.work_dir / WORKSPACE
    second_context = replace(context, work_dir=context.work_dir / "freed")

    def build_again(other: Capture) -> MapResult:
        again, unusable = build_map_once(other, selections, options, second_context, skeletal_above, features)
        if unusable is not None:
            raise unusable
        return again

    try:
        return recalibrate_if_misfit(result, capture, build_again, refused)
    except EstimationError as error:
        camera = result.diagnostics.details.get("repair", {}).get("contradicting_camera")
        if error is not refused or camera is None:
            raise
        without, unusable = build_map_once(
            capture,
            [item for item in selections if item.camera != camera],
            _without_initial_pair_of(camera, options),
            replace(context, work_dir=context.work_dir / "without"),
            skeletal_above,
            features,
        )
        if unusable is not None:
            raise
    return replace(without, log=replace(without.diagnostics, contradicting_cameras=(camera,)).to_log())


def _without_initial_pair_of(camera: str, options: MapOptions) -> MapOptions:
    """Return the options without the initial pair, if one of its frames belongs to a camera."""
    if camera not in {name.rpartition(":")[0] for name in options.init_frames or ()}:
        return options
    return options.model_copy(update={"init_frames": None})


def _require_motion(selections: Sequence[KeyframeSelection]) -> None:
    """Raise an error if the pictures of all cameras stand still: a map needs a camera that moves."""
    motion_px = [item.motion_px for item in selections]
    if motion_px and max(motion_px) < _MIN_MOTION_PX:
        raise EstimationError(
            "no camera moves: in the pictures of all cameras, nothing moves by more than "
            f"{max(motion_px):.1f} px, so there is no motion and no map",
            hint=NO_MOTION_HINT,
        )


def build_map_once(
    capture: Capture,
    selections: Sequence[KeyframeSelection],
    options: MapOptions,
    context: StageContext,
    skeletal_above: int,
    earlier: Path | None = None,
) -> tuple[MapResult, EstimationError | None]:
    """Build a map with the capture's intrinsics: calibrated intrinsics stay constant, others are refined.

    The arguments are the same as in `build_map`; `earlier` is the workspace of an earlier map of the same
    pictures, which holds the features, or None.

    Returns:
        The map; an error with the reason why the map is unusable (too few keyframes, or matches that
        contradict the map), or None if the map is usable. The error is returned, not raised, because other
        intrinsics may give a usable map.

    Raises:
        EstimationError: No model was reconstructed.
    """
    workspace = context.work_dir / WORKSPACE
    workspace.mkdir(parents=True, exist_ok=True)
    estimated = with_gyroscopes(estimate_from_matches(capture, selections), selections)
    readouts = {**known_readouts(capture), **estimated}
    used = {**readouts, **possible_readouts(capture, selections, readouts)}
    shutters = turning_shutters(capture, selections, used)
    write_shutters(workspace, shutters)
    keyframes = _keyframes_of(workspace, capture, selections, shutters, earlier)
    add_keyframes(workspace, keyframes, options, context)
    selections, options, flips = exclude_flipped_cameras(workspace, selections, options)
    ids = read_camera_ids(workspace)
    features = count_features(workspace)
    refs = sorted(features)
    calibrated_ids = calibrated_camera_ids(capture, ids)
    mapping = make_mapping_context(workspace, capture, options, calibrated_ids, context, skeletal_above)
    generator = PairGenerator(workspace, refs, frame_times_ns(capture), options, context)
    skeletal = generator.reduced() if mapping.is_large(len(refs)) else generator
    record_act(Mechanism.SKELETAL_SET, int(skeletal is not generator))
    tried, match_log = match_keyframes(skeletal, workspace, intrinsics_of(capture), context)
    uncalibrated = {number: name for name, number in ids.items() if capture.camera(name).camera.refine}
    models, initial_log = reconstruct_with_intrinsics(mapping, options, uncalibrated, len(skeletal.refs))
    log: dict[str, Any] = {"keyframes": len(refs), **match_log, **initial_log, **flips.to_log()}
    if models:
        total = len(refs) if skeletal is generator else None
        models[0], log["repair"] = repair_model(models[0], mapping, total)
        resected: Sequence[set[int] | None] = [None] * len(models)
        if skeletal is not generator:
            resected, log["placed"] = resect_remaining(models, generator, tried, mapping)
        log["unconfirmed_points"] = finalise_models(models, mapping, resected)
        models[0], log["contradicting"], ratio = remove_without_adjustment(models[0], mapping)
        # A removed keyframe may have connected others with the room.
        log["unconfirmed_points"] += sum(map(remove_points_on_wearer, models))
    attempts = log.get("initial_candidates", log["initial_pair_ladder"])
    # A keyframe of a covered lens shows nothing, so it cannot be part of a map.
    textured = sum(count >= MIN_RESECTION_INLIERS for count in features.values())
    refused = add_flip_hint(check_coverage(models, len(refs), textured, attempts, options), flips)
    if refused is not None and not models:
        raise refused
    write_models(workspace, models)
    calibrated = {number: name for name, number in ids.items() if number in mapping.given_ids}
    misfits = find_misfit_intrinsics(models[0], mapping.mapper_options(), calibrated)
    # `misplaced_frames` leaves out those that were found when they were registered again.
    removed = list(log["repair"]["doubtful"]) if models and "repair" in log else []
    removed += [name for step in ("repair", "placed") if step in log for name in log[step]["cut"]]
    misplaced = misplaced_frames([*removed, *log.get("contradicting", ())], models)
    if readouts:
        log["readouts_from_matches"] = {name: asdict(item) for name, item in sorted(readouts.items())}
    selected = replace(capture, cameras=tuple(capture.camera(item.camera) for item in selections))
    uncorrected = uncorrected_shutters(selected, readouts, shutters.keys())
    log = MapDiagnostics(
        misfit_factors=misfits, misplaced=misplaced, uncorrected_shutters=uncorrected, details=log
    ).to_log()
    result = make_result(models, workspace, log)
    result = _with_readouts(result, {name: used[name] for name in shutters})
    return result, refused or add_flip_hint(check_consistency(left_contradicted(log["repair"], ratio)), flips)


def _with_readouts(result: MapResult, readouts: Mapping[str, Readout]) -> MapResult:
    """Return a map whose keypoints were corrected for readout times, by camera name."""
    return replace(result, maps=tuple(map_with_readouts(item, readouts) for item in result.maps))


def _keyframes_of(
    workspace: Path,
    capture: Capture,
    selections: Sequence[KeyframeSelection],
    shutters: Mapping[str, TurningShutter],
    earlier: Path | None,
) -> list[CameraKeyframes]:
    """Write the cameras to a new database, and return the keyframes that are added to it.

    Args:
        workspace: Folder of the database.
        capture: All cameras.
        selections: Keyframes of each camera.
        shutters: By camera name, what corrects the keypoints for a rolling shutter.
        earlier: Workspace of an earlier map of the same pictures; None if there is none.
    """
    import pycolmap

    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        ids = {item.camera: add_camera(database, capture.camera(item.camera)) for item in selections}
    return [
        CameraKeyframes(
            capture.camera(item.camera),
            ids[item.camera],
            np.asarray(item.frames),
            _usable_sharpness(item),
            shutters.get(item.camera),
            earlier,
        )
        for item in selections
    ]


def _usable_sharpness(selection: KeyframeSelection) -> FloatArray:
    """Return the sharpness (N,) of each frame of a video, NaN for a damaged or a frozen frame."""
    sharpness = np.where(selection.frozen, np.nan, selection.sharpness)
    sharpness[selection.damaged] = np.nan
    return sharpness
