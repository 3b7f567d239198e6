"""Finish models with a last adjustment, and create the stage's result."""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
from bodycap_batch.mapping.intrinsics.intrinsics_check import contradicts
from bodycap_batch.mapping.mapping_context import MappingContext
from bodycap_batch.mapping.matching.database import ImageRef
from bodycap_batch.mapping.reconstruction.bundle_adjustment import (
    adjust_robustly,
    bundle_adjust,
    loss_width_px,
    restore,
)
from bodycap_batch.mapping.reconstruction.camera_motion import CameraMotion
from bodycap_batch.mapping.reconstruction.conversion import map_from_reconstruction
from bodycap_batch.mapping.reconstruction.model_files import keyframe_names, registered_ids
from bodycap_batch.mapping.reconstruction.reprojection import residuals_px
from bodycap_batch.mapping.validation.dominant_points import remove_dominant_points
from bodycap_batch.mapping.validation.transient_points import remove_transient_points
from bodycap_batch.mapping.validation.wearer_points import remove_points_on_wearer
from bodycap_batch.model.scene import MapResult

_MAX_LENS_SIGMAS = 5.0
"""Maximum change of a focal length in the last adjustment, in standard deviations of the one from tracks.
With a larger change, the model does not determine the lens. Evidence: docs/decisions/mapping.md."""


def finalise_models(
    models: list[Any],
    context: MappingContext,
    resected: Sequence[set[int] | None],
    given: Collection[int] = (),
) -> int:
    """Remove transient points, points on the wearer and dominant points, and adjust robustly, in place.

    A model that is left without points is removed from the list: its keyframes saw nothing but transient
    points, or contradict each other. The last adjustment of the largest model refines the lenses that tracks
    determined, and the given lenses that it contradicts (`_adjust`). The other models keep these lenses.

    Args:
        models: Reconstructions, the largest first. The list and the reconstructions are changed in place.
        context: Workspace, mapper options.
        resected: For each model, the ids of the images to adjust: the images that were resected after the
            model's last robust adjustment. None: all images of the model are adjusted.
        given: Ids of the cameras whose given lens is compared with the one that the model determines.

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
            _adjust(model, context, lenses, only, given)
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
    model: Any,
    context: MappingContext,
    known: Mapping[int, Any],
    only: Collection[int] | None,
    given: Collection[int],
) -> None:
    """Adjust a model robustly for the last time, in place.

    A lens that tracks determined is refined, unless the model leads to one that the tracks exclude.

    A given lens is a measurement, and so is the lens that the model determines. The given one is more exact
    if it is right, so it stays if both agree, or if the model does not determine the lens.

    Args:
        model: A reconstruction. It is changed in place.
        context: Mapper options, and the cameras whose lens tracks determined.
        known: Parameters of the lenses that a larger model determined, by camera id.
        only: Ids of the images to adjust; None: all images.
        given: Ids of the cameras whose given lens is compared.
    """
    settings, own = context.mapper_options(), set(model.cameras)
    estimated, compared = context.lens_sigma.keys() & own, set(given) & own
    for number in (estimated | compared) & known.keys():
        model.camera(number).params = known[number]
    freed = estimated - known.keys()
    held, before = set(context.calibrated_ids) - freed, copy.deepcopy(model)
    adjust_robustly(model, settings, sorted(held), only)
    absurd = {
        number
        for number in freed
        if abs(_log_focal_ratio(model, before, number)) > _MAX_LENS_SIGMAS * context.lens_sigma[number]
    }
    if absurd:
        restore(model, before)
        held |= absurd
        adjust_robustly(model, settings, sorted(held), only)
    compared -= known.keys()
    if only is not None or not compared or not is_on(Mechanism.RECALIBRATION):
        return
    free, constant, width_px = copy.deepcopy(model), copy.deepcopy(model), loss_width_px(model)
    bundle_adjust(free, settings, sorted(held - compared), loss_px=width_px)
    wrong = {
        number
        for number in compared
        if contradicts(free.camera(number).mean_focal_length() / model.camera(number).mean_focal_length())
    }
    if wrong:
        # Both have the same observations and as many steps, so only the lenses make the difference.
        bundle_adjust(constant, settings, sorted(held), loss_px=width_px)
        wrong &= _likelier_lenses(free, constant, width_px)
    record_act(Mechanism.RECALIBRATION, len(wrong))
    if wrong:
        restore(model, free)
        for number in compared - wrong:
            model.camera(number).params = constant.camera(number).params
        adjust_robustly(model, settings, sorted(held - wrong))


def _log_focal_ratio(model: Any, before: Any, number: int) -> float:
    """Return the logarithm of the ratio of a camera's focal lengths in two models."""
    ratio = model.camera(number).mean_focal_length() / before.camera(number).mean_focal_length()
    return float(np.log(ratio))


def _likelier_lenses(free: Any, constant: Any, width_px: float) -> set[int]:
    """Return the ids of the cameras whose residuals justify a free lens (Bayesian information criterion).

    The residuals have a Cauchy distribution in two dimensions. The points and poses fit its noise in part,
    so it is wider than the residuals.

    Args:
        free: A model that was adjusted with free lenses.
        constant: The same model after the same adjustment with constant lenses.
        width_px: Width of the residuals.

    Source: Schwarz, "Estimating the dimension of a model", 1978.
    """
    after, before = residuals_px(free), residuals_px(constant)
    count = 2 * sum(map(len, before.values()))
    redundancy = count - 3 * free.num_points3D() - 6 * free.num_reg_images() + 7
    variance_px2 = width_px**2 * count / max(redundancy, 1)
    out = set[int]()
    for number, residuals in before.items():
        one, other = (
            3.0 * np.log1p((item**2).sum(axis=1) / variance_px2).sum() for item in (residuals, after[number])
        )
        lens = free.camera(number)
        parameters = len(lens.focal_length_idxs()) + len(lens.extra_params_idxs())
        if one - other > parameters * np.log(len(residuals)):
            out.add(number)
    return out


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
