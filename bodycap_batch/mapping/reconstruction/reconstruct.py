"""Reconstruct models from nothing: try initial pairs, relax the demands on them, search further models."""

from __future__ import annotations

import copy
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping.matching.database import DATABASE_NAME, read_matched_names
from bodycap_batch.mapping.reconstruction.incremental_mapper import progress_counter, register_images
from bodycap_batch.mapping.reconstruction.initial_pair import InitialPair
from bodycap_batch.mapping.reconstruction.mapper_options import MIN_MODEL_KEYFRAMES
from bodycap_batch.mapping.reconstruction.models import keyframe_names, model_order

if TYPE_CHECKING:
    import pycolmap

_RELAXATION_STEPS = (
    {"init_min_tri_angle": 16.0, "init_min_num_inliers": 100, "init_max_forward_motion": 0.95},
    {"init_min_tri_angle": 6.0, "init_min_num_inliers": 50, "init_max_forward_motion": 0.99},
    {"init_min_tri_angle": 2.0, "init_min_num_inliers": 25, "init_max_forward_motion": 1.0},
)
"""Demands on the initial pair, relaxed step by step: degrees between rays, inliers, largest forward share of
the motion. The first step is COLMAP's default. Evidence for the others: none."""

_MAX_SEARCH_TRIALS = 200
"""Images that COLMAP's own search for an initial pair tries; its default."""
_MIN_REGISTERED_RATIO = 0.25
"""Ratio of the keyframes that a model from a given initial pair must hold; else the next pair is tried.
Evidence: none."""


def reconstruct(
    workspace: Path,
    settings: pycolmap.IncrementalPipelineOptions,
    context: StageContext,
    total: int,
    initial_pairs: Sequence[InitialPair] = (),
) -> tuple[list[Any], list[dict[str, object]]]:
    """Reconstruct models from nothing; relax the demands on the initial pair until one model is good enough.

    Args:
        workspace: Folder of the database.
        settings: The mapper's options; changed.
        context: Progress and cancellation.
        total: Number of keyframes.
        initial_pairs: Pairs to start from, the best first. COLMAP's own search follows if none succeeds.

    Returns:
        The models, largest first, and the result of each attempt for the log.
    """
    attempts: list[dict[str, object]] = []
    for demands in _RELAXATION_STEPS:
        for name, value in demands.items():
            setattr(settings.mapper, name, value)
        for pair in (*initial_pairs, None):
            if pair is None:
                models = _reconstruct_from_search(workspace, settings, context, total)
            else:
                models = _reconstruct_from_pair(pair, workspace, settings, context, total)
            entry = {**demands, "models": [model.num_reg_images() for model in models]}
            attempts.append({**entry, **pair.to_log()} if pair else entry)
            if models and models[0].num_reg_images() >= _MIN_REGISTERED_RATIO * total:
                return models, attempts
            if pair:
                attempts[-1]["failed"] = pair.rejection_reason if not models else "few keyframes followed"
            elif models:
                return models, attempts
    return [], attempts


def _reconstruct_from_search(
    workspace: Path, settings: pycolmap.IncrementalPipelineOptions, context: StageContext, total: int
) -> list[Any]:
    """Return models from the initial pairs that COLMAP finds, largest first."""
    settings.init_image_id1, settings.init_image_id2 = -1, -1
    settings.init_num_trials, settings.multiple_models = _MAX_SEARCH_TRIALS, True
    return _run_colmap(workspace, settings, context, total)


def _reconstruct_from_pair(
    pair: InitialPair,
    workspace: Path,
    settings: pycolmap.IncrementalPipelineOptions,
    context: StageContext,
    total: int,
) -> list[Any]:
    """Return the model from a given pair and the models of the keyframes outside it, largest first.

    The largest further model also registers keyframes of the first one, as COLMAP's further models do: a part
    of the room may be reachable from one side only.
    """
    import pycolmap

    settings.init_image_id1, settings.init_image_id2 = pair.ids
    first = pycolmap.Reconstruction()
    if not register_images(
        workspace, settings, first, progress_counter(context, total, context.check_cancelled)
    ):
        return []
    models = [first]
    if first.num_reg_images() < _MIN_REGISTERED_RATIO * total:
        return models
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        left = sorted(read_matched_names(database) - keyframe_names(models[0]))
    if len(left) >= MIN_MODEL_KEYFRAMES:
        settings.image_names = left
        further = _reconstruct_from_search(workspace, settings, context, total)
        settings.image_names = []
        if further:
            further[0] = _with_registered_images(further[0], workspace, settings, context, total)
            inside = keyframe_names(further[0])
            models = [model for model in models if not keyframe_names(model) <= inside]
        models += further
    return sorted(models, key=model_order)


def _with_registered_images(
    model: Any,
    workspace: Path,
    settings: pycolmap.IncrementalPipelineOptions,
    context: StageContext,
    total: int,
) -> Any:
    """Return a copy of a model with all images that fit it; the model itself if it is the larger one."""
    extended = copy.deepcopy(model)
    register_images(workspace, settings, extended, progress_counter(context, total, context.check_cancelled))
    return min([extended, model], key=model_order)


def _run_colmap(
    workspace: Path, settings: pycolmap.IncrementalPipelineOptions, context: StageContext, total: int
) -> list[Any]:
    """Run COLMAP's incremental mapping and return its models, largest first."""
    import pycolmap

    target = workspace / "mapper"
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir()
    token = pycolmap.CancellationToken()
    images = workspace / "images"
    images.mkdir(exist_ok=True)
    found = pycolmap.incremental_mapping(
        str(workspace / DATABASE_NAME),
        str(images),
        str(target),
        settings,
        next_image_callback=progress_counter(context, total, token.cancel),
        cancellation_token=token,
    )
    shutil.rmtree(target, ignore_errors=True)
    context.check_cancelled()
    return sorted(found.values(), key=model_order)
