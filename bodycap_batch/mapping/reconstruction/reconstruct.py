"""Run COLMAP's incremental mapper over a database: from nothing, or on from an existing model."""

from __future__ import annotations

import copy
import shutil
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bodycap_batch.config import MapOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping.matching.database import DATABASE_NAME, read_matched_names
from bodycap_batch.mapping.matching.skeletal_set import SKELETAL_ABOVE
from bodycap_batch.mapping.reconstruction.incremental_mapper import register_images
from bodycap_batch.mapping.reconstruction.initial_pair import InitialPair

if TYPE_CHECKING:
    import pycolmap

MODELS_FOLDER = "sparse"
_RELAXATION_STEPS = (
    {"init_min_tri_angle": 16.0, "init_min_num_inliers": 100, "init_max_forward_motion": 0.95},
    {"init_min_tri_angle": 6.0, "init_min_num_inliers": 50, "init_max_forward_motion": 0.99},
    {"init_min_tri_angle": 2.0, "init_min_num_inliers": 25, "init_max_forward_motion": 1.0},
)
"""Demands on the initial pair, relaxed step by step; the first are COLMAP's own."""

_MIN_MODEL_KEYFRAMES = 3
_MAX_SEARCH_TRIALS = 200
"""Pairs that COLMAP's own search looks at: its default."""
_MIN_REGISTERED_RATIO = 0.25
"""Share of the keyframes that a map from a chosen pair must reach; else the next pair is tried."""
_ADJUSTMENT_TOLERANCE = 1e-5
"""Relative change of the cost that ends a bundle adjustment: COLMAP's 0 runs every one to its last
iteration, which on 299 violent keyframes took 3.7 times as long (206 to 55 CPU seconds) for the same map."""


_GLOBAL_GROWTH = 1.4
_GLOBAL_REFINEMENTS = 2
_LOCAL_REFINEMENTS = 1
"""The whole map is adjusted when it has grown by this factor (COLMAP: 1.1), with fewer rounds (COLMAP:
5 and 2). Keyframes are as exact as with COLMAP's numbers (walk12 0.51 and 0.49 cm, room12 0.71 and 0.70,
tum_fr1_xyz 0.87 and 0.87, walk131 0.66 and 0.80), in 55 to 85 % of the time. One round, a tolerance of 1e-4
and no redundant points save another 1 to 3 seconds, but left a palm's block of room131 36 cm off."""

_MIN_RESECTION_INLIERS = 20
"""Points of the map that place a keyframe. With COLMAP's 30, 20 and 15 on room131: 152, 167, 182 of 271
keyframes, then 307, 311, 322 frames registered at 1.38, 1.35, 1.82 cm."""


_MAX_EXTRA_PARAM = 1e3
"""A given calibration is trusted: COLMAP's own limit of 1 drops lenses with k3 > 1 silently."""


def mapper_options(
    options: MapOptions, constant_cameras: Collection[int], scale: float
) -> pycolmap.IncrementalPipelineOptions:
    """Settings of the mapper: seeded, reproducible, given intrinsics held fixed.

    Args:
        options: The stage's options.
        constant_cameras: Ids of calibrated cameras.
        scale: Factor on pixel thresholds.

    One thread: several add up residuals in an order that changes from run to run, and so does the map.
    """
    import pycolmap

    settings = pycolmap.IncrementalPipelineOptions()
    settings.random_seed = options.seed
    settings.num_threads = 1
    settings.ba_min_num_residuals_for_cpu_multi_threading = 2**31 - 1
    settings.ba_local_function_tolerance = _ADJUSTMENT_TOLERANCE
    settings.ba_global_function_tolerance = _ADJUSTMENT_TOLERANCE
    settings.ba_global_frames_ratio = settings.ba_global_points_ratio = _GLOBAL_GROWTH
    settings.ba_global_max_refinements = _GLOBAL_REFINEMENTS
    settings.ba_local_max_refinements = _LOCAL_REFINEMENTS
    settings.extract_colors = False
    settings.min_model_size = _MIN_MODEL_KEYFRAMES
    settings.constant_cameras = set(constant_cameras)
    settings.ba_refine_sensor_from_rig = False
    for part in (settings, settings.mapper, settings.triangulation):
        part.max_extra_param = _MAX_EXTRA_PARAM
    settings.mapper.abs_pose_min_num_inliers = _MIN_RESECTION_INLIERS
    settings.mapper.abs_pose_max_error *= scale
    settings.mapper.init_max_error *= scale
    settings.mapper.filter_max_reproj_error *= scale
    return settings


def reconstruct(
    workspace: Path,
    settings: pycolmap.IncrementalPipelineOptions,
    context: StageContext,
    total: int,
    starts: Sequence[InitialPair] = (),
) -> tuple[list[Any], list[dict[str, object]]]:
    """Build models from nothing, easing the demands on the initial pair until one stands.

    Args:
        workspace: Folder of the database.
        settings: The mapper's settings; changed.
        context: Progress and cancellation.
        total: Keyframes there are.
        starts: Pairs to start from, the best first; COLMAP's own search where none of them holds.

    Returns:
        Reconstructions, largest first, and what each step of the ladder gave.
    """
    steps: list[dict[str, object]] = []
    for step in _RELAXATION_STEPS:
        for name, value in step.items():
            setattr(settings.mapper, name, value)
        for start in (*starts, None):
            if start is None:
                models = _reconstruct_from_search(workspace, settings, context, total)
            else:
                models = _reconstruct_from_pair(start, workspace, settings, context, total)
            entry = {**step, "models": [model.num_reg_images() for model in models]}
            steps.append({**entry, **start.to_log()} if start else entry)
            if models and models[0].num_reg_images() >= _MIN_REGISTERED_RATIO * total:
                return models, steps
            if start:
                steps[-1]["failed"] = start.doubt if not models else "few keyframes followed"
            elif models:
                return models, steps
    return [], steps


def _reconstruct_from_search(
    workspace: Path, settings: pycolmap.IncrementalPipelineOptions, context: StageContext, total: int
) -> list[Any]:
    """Models from the pairs that COLMAP finds."""
    settings.init_image_id1, settings.init_image_id2 = -1, -1
    settings.init_num_trials, settings.multiple_models = _MAX_SEARCH_TRIALS, True
    return _run_colmap(workspace, settings, context, total)


def _reconstruct_from_pair(
    start: InitialPair,
    workspace: Path,
    settings: pycolmap.IncrementalPipelineOptions,
    context: StageContext,
    total: int,
) -> list[Any]:
    """The model from a chosen pair, and those of the keyframes it does not hold.

    The largest of these takes what it can of the first one's keyframes, as COLMAP's own further models do: a
    part of the room can be reached from one side alone.
    """
    import pycolmap

    settings.init_image_id1, settings.init_image_id2 = start.ids
    first = pycolmap.Reconstruction()
    if not register_images(
        workspace, settings, first, progress_counter(context, total, context.check_cancelled)
    ):
        return []
    models = [first]
    if first.num_reg_images() < _MIN_REGISTERED_RATIO * total:
        return models
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        left = sorted(read_matched_names(database) - _keyframe_names(models[0]))
    if len(left) >= _MIN_MODEL_KEYFRAMES:
        settings.image_names = left
        further = _reconstruct_from_search(workspace, settings, context, total)
        settings.image_names = []
        if further:
            further[0] = _with_registered_images(further[0], workspace, settings, context, total)
            models = [model for model in models if not _keyframe_names(model) <= _keyframe_names(further[0])]
        models += further
    return sorted(models, key=model_order)


def _keyframe_names(model: Any) -> set[str]:
    """Names of a model's keyframes."""
    return {model.image(number).name for number in model.reg_image_ids()}


def _with_registered_images(
    model: Any,
    workspace: Path,
    settings: pycolmap.IncrementalPipelineOptions,
    context: StageContext,
    total: int,
) -> Any:
    """A model with all keyframes that find a place in it."""
    grown = copy.deepcopy(model)
    register_images(workspace, settings, grown, progress_counter(context, total, context.check_cancelled))
    return min([grown, model], key=model_order)


def register_new_images(
    workspace: Path,
    model: Any,
    settings: pycolmap.IncrementalPipelineOptions,
    context: StageContext,
    total: int,
) -> Any:
    """A model with the database's new images registered in it; its own poses stay where they are."""
    settings.fix_existing_frames = True
    grown = copy.deepcopy(model)
    few = model.num_reg_frames() <= SKELETAL_ABOVE  # all of very many are adjusted once, at the end
    register_images(
        workspace, settings, grown, progress_counter(context, total, context.check_cancelled), whole=few
    )
    return grown


def _run_colmap(
    workspace: Path,
    settings: pycolmap.IncrementalPipelineOptions,
    context: StageContext,
    total: int,
) -> list[Any]:
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


def model_order(model: Any) -> tuple[int, int]:
    """Sorts the largest model first."""
    return -model.num_reg_images(), -model.num_points3D()


def progress_counter(
    context: StageContext, total: int, stop: Callable[[], None], done: int = 0
) -> Callable[[], None]:
    """What tells of one more keyframe in the map each time it is called, and calls `stop` once it should."""

    def tick() -> None:
        nonlocal done
        done += 1
        context.progress(min(done, total), total, "keyframes in the map")
        if context.cancelled():
            stop()

    return tick


def write_models(workspace: Path, models: list[Any]) -> None:
    """Write the models to ``sparse/<n>``, replacing what was there."""
    folder = workspace / MODELS_FOLDER
    shutil.rmtree(folder, ignore_errors=True)
    for number, model in enumerate(models):
        (folder / str(number)).mkdir(parents=True)
        model.write(str(folder / str(number)))
