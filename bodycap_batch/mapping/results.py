"""Finish models with a last adjustment, and create the stage's result."""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.mapping.mapping_context import MappingContext
from bodycap_batch.mapping.matching.database import ImageRef
from bodycap_batch.mapping.reconstruction.bundle_adjustment import adjust_robustly, restore
from bodycap_batch.mapping.reconstruction.camera_motion import CameraMotion
from bodycap_batch.mapping.reconstruction.conversion import map_from_reconstruction
from bodycap_batch.mapping.reconstruction.model_files import keyframe_names, registered_ids
from bodycap_batch.mapping.validation.dominant_points import remove_dominant_points
from bodycap_batch.mapping.validation.transient_points import remove_transient_points
from bodycap_batch.mapping.validation.wearer_points import remove_points_on_wearer
from bodycap_batch.model.scene import MapResult

_MAX_LENS_SIGMAS = 5.0
"""Maximum change of a focal length in the last adjustment, in standard deviations of the one from tracks.
With a larger change, the model does not determine the lens. Evidence: docs/decisions/mapping.md."""


def finalise_models(models: list[Any], context: MappingContext, resected: Sequence[set[int] | None]) -> int:
    """Remove transient points, points on the wearer and dominant points, and adjust robustly, in place.

    A model that is left without points is removed from the list: its keyframes saw nothing but transient
    points, or contradict each other. The last adjustment of the largest model refines the lenses that tracks
    determined (`_adjust`). The other models keep these lenses.

    Args:
        models: Reconstructions, the largest first. The list and the reconstructions are changed in place.
        context: Workspace, mapper options.
        resected: For each model, the ids of the images to adjust: the images that were resected after the
            model's last robust adjustment. None: all images of the model are adjusted.

    Returns:
        Number of points removed from all models.
    """
    total = 0
    kept = list[Any]()
    lenses = dict[int, Any]()
    for number, (model, image_ids) in enumerate(zip(models, resected, strict=True)):
        context.stage.progress(number, len(models), "maps adjusted")
        total += remove_points_on_wearer(model)
        total += remove_transient_points(model, context.times_ns)
        total += remove_dominant_points(model)
        if not model.num_points3D():
            continue
        only = None if image_ids is None else image_ids & registered_ids(model)
        if only is None or only:
            _adjust(model, context, lenses, only)
        kept.append(model)
        lenses |= {
            number: kept[-1].camera(number).params for number in kept[-1].cameras if number not in lenses
        }
    if not kept:
        raise EstimationError(
            "the map is empty: no point of the room was seen long enough from different places",
            hint="move the cameras sideways past things with texture that do not move by themselves",
        )
    models[:] = kept
    return total


def _adjust(
    model: Any, context: MappingContext, known: Mapping[int, Any], only: Collection[int] | None
) -> None:
    """Adjust a model robustly for the last time, in place.

    A lens that tracks determined is refined, unless the model leads to one that the tracks exclude.

    Args:
        model: A reconstruction. It is changed in place.
        context: Mapper options, and the cameras whose lens tracks determined.
        known: Parameters of the lenses that a larger model determined, by camera id.
        only: Ids of the images to adjust; None: all images.
    """
    estimated = context.lens_sigma.keys() & set(model.cameras)
    for number in estimated & known.keys():
        model.camera(number).params = known[number]
    freed = estimated - known.keys()
    held, before = set(context.calibrated_ids) - freed, copy.deepcopy(model)
    adjust_robustly(model, context.mapper_options(), sorted(held), only)
    absurd = {
        number
        for number in freed
        if abs(_log_focal_ratio(model, before, number)) > _MAX_LENS_SIGMAS * context.lens_sigma[number]
    }
    if absurd:
        restore(model, before)
        adjust_robustly(model, context.mapper_options(), sorted(held | absurd), only)


def _log_focal_ratio(model: Any, before: Any, number: int) -> float:
    """Return the logarithm of the ratio of a camera's focal lengths in two models."""
    ratio = model.camera(number).mean_focal_length() / before.camera(number).mean_focal_length()
    return float(np.log(ratio))


def misplaced_frames(names: Collection[str], models: Sequence[Any]) -> dict[str, tuple[int, ...]]:
    """Return the frame indices of the removed keyframes that no model contains, by camera name.

    Args:
        names: Image names of keyframes that were removed because they contradict a model.
        models: The final models.
    """
    inside = set[str]().union(*(keyframe_names(model) for model in models))
    refs = sorted(ImageRef.parse(name) for name in set(names) - inside)
    cameras = sorted({ref.camera for ref in refs})
    return {camera: tuple(ref.frame for ref in refs if ref.camera == camera) for camera in cameras}


def make_result(
    models: Sequence[Any],
    workspace: Path,
    log: dict[str, Any],
    adjusted_px: Sequence[Mapping[int, FloatArray]] | None = None,
    motions: Sequence[Mapping[str, CameraMotion]] | None = None,
) -> MapResult:
    """Return the stage's result; add the size and mean reprojection error of each model to the log.

    Args:
        models: Reconstructions, the largest first.
        workspace: Folder of the database of their keypoints.
        log: Diagnostics of the stage.
        adjusted_px: For each model, the positions to which it was adjusted; see `map_from_reconstruction`.
        motions: For each model, the motions of its cameras with rolling shutters, by camera name.
    """
    adjusted = [None] * len(models) if adjusted_px is None else adjusted_px
    maps = tuple(
        map_from_reconstruction(model, workspace, px, moving)
        for model, px, moving in zip(models, adjusted, motions or [{}] * len(models), strict=True)
    )
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
