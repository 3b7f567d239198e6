"""Reconstruct models without a previous map.

Several initial pairs are tried, with thresholds that become less strict.
"""

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
from bodycap_batch.mapping.reconstruction.model_files import keyframe_names, model_order

if TYPE_CHECKING:
    import pycolmap

_RELAXATION_STEPS = (
    {"init_min_tri_angle": 16.0, "init_min_num_inliers": 100, "init_max_forward_motion": 0.95},
    {"init_min_tri_angle": 6.0, "init_min_num_inliers": 50, "init_max_forward_motion": 0.99},
    {"init_min_tri_angle": 2.0, "init_min_num_inliers": 25, "init_max_forward_motion": 1.0},
)
"""Thresholds for the initial pair in each step: minimum angle (degrees) between rays, minimum number of
inliers, maximum fraction of forward motion. The first step has COLMAP's defaults. Later steps are less
strict; evidence for their values: none."""

_MAX_SEARCH_TRIALS = 200
"""Maximum number of images that COLMAP tries in its own search for an initial pair. COLMAP's default."""
_MIN_REGISTERED_RATIO = 0.25
"""Minimum size of a model that starts from a given initial pair, as a fraction of all keyframes. If the model
is smaller, the next initial pair is tried. Evidence: none."""


def reconstruct(
    workspace: Path,
    settings: pycolmap.IncrementalPipelineOptions,
    context: StageContext,
    total: int,
    initial_pairs: Sequence[InitialPair] = (),
) -> tuple[list[Any], list[dict[str, object]]]:
    """Reconstruct models without a previous map.

    The given initial pairs are tried first. If no model from them is large enough, COLMAP's own search for an
    initial pair follows. If the search finds no model, the thresholds for the initial pair are relaxed and
    all attempts are repeated.

    Args:
        workspace: Folder of the database.
        settings: The mapper's options; changed in place.
        context: Progress and cancellation.
        total: Number of all keyframes.
        initial_pairs: Initial pairs to try, the best first.

    Returns:
        The models, largest first; the result of each attempt, for the log.
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
                attempts[-1]["failed"] = pair.rejection_reason if not models else "few keyframes were added"
            elif models:
                return models, attempts
    return [], attempts


def _reconstruct_from_search(
    workspace: Path, settings: pycolmap.IncrementalPipelineOptions, context: StageContext, total: int
) -> list[Any]:
    """Return the models that start from initial pairs of COLMAP's own search, largest first."""
    settings.init_image_id1, settings.init_image_id2 = -1, -1
    settings.init_num_trials, settings.multiple_models = _MAX_SEARCH_TRIALS, True
    models = _run_colmap(workspace, settings, context, total)
    if models:
        models[0] = _with_registered_images(models[0], workspace, settings, context, total)
    return sorted(models, key=model_order)


def _reconstruct_from_pair(
    pair: InitialPair,
    workspace: Path,
    settings: pycolmap.IncrementalPipelineOptions,
    context: StageContext,
    total: int,
) -> list[Any]:
    """Return the model that starts from a given pair, and models of the remaining keyframes, largest first.

    The first model starts from the given pair. Further models are built from the keyframes that are not in
    the first model. Then all keyframes that fit are registered in the largest further model. So a keyframe
    can be in two models. COLMAP does this too, because a part of the room may be connected to the rest on one
    side only. If the largest further model contains all keyframes of the first model, the first model is
    removed.
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
    """Register all images that fit in a copy of a model.

    Return the copy if it is at least as large as the model, else the model.
    """
    extended = copy.deepcopy(model)
    count_one = progress_counter(context, total, context.check_cancelled, extended.num_reg_images())
    register_images(workspace, settings, extended, count_one)
    return min([extended, model], key=model_order)


def _run_colmap(
    workspace: Path, settings: pycolmap.IncrementalPipelineOptions, context: StageContext, total: int
) -> list[Any]:
    """Run COLMAP's incremental mapping and return the models, largest first.

    No image is registered without points of the map, because COLMAP would change the intrinsics of constant
    cameras. Evidence: docs/decisions/mapping.md.
    """
    import pycolmap

    settings.structure_less_registration_fallback = False
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
    settings.structure_less_registration_fallback = True
    shutil.rmtree(target, ignore_errors=True)
    context.check_cancelled()
    return sorted(found.values(), key=model_order)
