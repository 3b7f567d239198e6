"""Reconstruct the first models from the best initial pairs, with camera models that fit the images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from bodycap_batch.config import MapOptions
from bodycap_batch.mapping.camera_intrinsics import CameraIntrinsics
from bodycap_batch.mapping.intrinsics.intrinsics_check import update_camera_models
from bodycap_batch.mapping.mapping_context import MappingContext
from bodycap_batch.mapping.reconstruction.initial_pair import (
    InitialPair,
    find_user_pair,
    rank_initial_pairs,
)
from bodycap_batch.mapping.reconstruction.reconstruct import reconstruct

_INITIAL_PAIRS = 3
"""Maximum number of ranked pairs that are tried before COLMAP's own search for an initial pair. COLMAP's
search requires an angle of at least 16 degrees between rays. If few pairs have such an angle, the search is
slow, because it verifies hundreds of pairs. Maps from ranked pairs have the same accuracy.
Evidence: docs/decisions/mapping.md."""

_LOGGED_CANDIDATES = 5
"""Maximum number of ranked pairs in the log if the first attempt failed. The log also holds the most likely
reason why each pair fails."""


def reconstruct_with_intrinsics(
    context: MappingContext, options: MapOptions, uncalibrated: Mapping[int, str], total: int
) -> tuple[list[Any], dict[str, Any]]:
    """Reconstruct models. If uncalibrated cameras need other camera models, reconstruct the models again.

    Args:
        context: Workspace, intrinsics, mapper options.
        options: The stage's options.
        uncalibrated: Names of the cameras whose intrinsics are refined, by database id.
        total: Number of keyframes to reconstruct.

    Returns:
        The models, largest first; entries for the log.
    """
    models, log = _reconstruct_from_pairs(context, options, total)
    changed, decentred = dict[str, CameraIntrinsics](), None
    for _ in range(2 if uncalibrated else 0):
        better, decentred = update_camera_models(
            context.workspace, models, context.mapper_options(), uncalibrated, decentred
        )
        if not better:
            break
        changed |= better
        context = replace(context, intrinsics={**context.intrinsics, **changed})
        models, log = _reconstruct_from_pairs(context, options, total)
        log["better_lenses"] = {name: item.camera.model for name, item in sorted(changed.items())}
    return models, log


def _reconstruct_from_pairs(
    context: MappingContext, options: MapOptions, total: int
) -> tuple[list[Any], dict[str, Any]]:
    """Reconstruct models from the user's initial pair and the best ranked pairs.

    Returns:
        The models, largest first; entries for the log, with the result of each attempt.
    """
    pairs, log = _initial_pairs(context, options)
    models, attempts = reconstruct(context.workspace, context.mapper_options(), context.stage, total, pairs)
    log["initial_pair_ladder"] = attempts
    if len(attempts) > 1:
        best = rank_initial_pairs(context.workspace, context.intrinsics)[:_LOGGED_CANDIDATES]
        log["initial_candidates"] = [{**pair.to_log(), "doubt": pair.rejection_reason} for pair in best]
    return models, log


def _initial_pairs(context: MappingContext, options: MapOptions) -> tuple[list[InitialPair], dict[str, Any]]:
    """Return the initial pairs to try, and entries for the log.

    If the user names a pair and its two keyframes have verified matches, this pair is the first one. The best
    ranked pairs follow. The log entries describe the pair that the user names.
    """
    ranking = rank_initial_pairs(context.workspace, context.intrinsics)
    ranked = [pair for pair in ranking[:_INITIAL_PAIRS] if pair.is_usable]
    if options.init_frames is None:
        return ranked, {}
    pair = find_user_pair(context.workspace, options.init_frames, context.intrinsics, context.frame_numbers)
    logged = {"failed": "no verified matches"} if pair is None else pair.to_log()
    return ranked if pair is None else [pair, *ranked], {"named_initial_pair": logged}
