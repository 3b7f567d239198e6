"""Repair a model: register keyframes that contradict it once more, and remove those that still do."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
from bodycap_batch.mapping.mapping_context import MappingContext
from bodycap_batch.mapping.matching.database import ImageRef
from bodycap_batch.mapping.re_registration import re_register_images
from bodycap_batch.mapping.reconstruction.bundle_adjustment import sub_model
from bodycap_batch.mapping.reconstruction.mapper_options import MIN_MODEL_KEYFRAMES
from bodycap_batch.mapping.reconstruction.model_files import registered_ids
from bodycap_batch.mapping.validation.epipolar_consistency import (
    PairConsistency,
    evaluate_pairs,
    find_contradicting_camera,
    find_misregistered_images,
    inconsistent_match_ratio,
)
from bodycap_batch.mapping.validation.second_registration import confirm_images
from bodycap_batch.mapping.validation.track_agreement import (
    evaluate_agreement,
    find_misplaced_images,
    image_sequences,
)

if TYPE_CHECKING:
    import pycolmap

_CONFIRMED_ERROR_RATIO = 2.0
"""Maximum error of a match that confirms the pose of a keyframe, as a multiple of the mapper's maximum
reprojection error. Of 6, 8 and 12 px, all confirm the same keyframes within a few percent. Evidence:
docs/decisions/mapping.md."""


def repair_model(
    model: pycolmap.Reconstruction, context: MappingContext, total: int | None
) -> tuple[Any, dict[str, object]]:
    """Register misregistered keyframes once more, and remove those that still contradict the model.

    The keyframes leave the model before they are registered again. Points that they had moved are right
    without them, so most find their true place. If fewer keyframes agree with the model then, the model
    without the misregistered keyframes is kept. The model is not adjusted after the last removal: the stage
    adjusts it at its end (`finalise_models`). Evidence: docs/decisions/mapping.md.

    Args:
        model: The largest model; not changed.
        context: Workspace, intrinsics, mapper options.
        total: Number of all keyframes, for the progress. None to register none again: the cut keyframes of a
            large map are placed with those that it left out (`resect_remaining`).

    Returns:
        The model; entries for the log: the keyframes that were registered again and those that were removed,
        the fraction of matches in inconsistent pairs before the removal, and a camera that explains them.
    """
    pairs, wrong = _find_contradictions(model, context)
    doubtful = _names(model, wrong)
    if wrong and total is not None and is_on(Mechanism.REPAIR):
        # Most keyframes that are registered from their matches alone are removed again.
        other = re_register_images(model, wrong, context, total, structure_less=False)
        other_pairs, still_wrong = _find_contradictions(other, context)
        if other.num_reg_images() - len(still_wrong) >= model.num_reg_images() - len(wrong):
            model, pairs, wrong = other, other_pairs, still_wrong
            record_act(Mechanism.REPAIR)
    cameras = {
        int(number): ImageRef.parse(model.image(number).name).camera for number in model.reg_image_ids()
    }
    camera = find_contradicting_camera(pairs, cameras)
    entries: dict[str, object] = {
        "doubtful": doubtful,
        "cut": _names(model, wrong),
        "contradicted_share": round(inconsistent_match_ratio(pairs), 4),
    }
    return _without(model, wrong), {**entries, "contradicting_camera": camera} if camera else entries


def remove_without_adjustment(
    model: pycolmap.Reconstruction, context: MappingContext
) -> tuple[Any, list[str], float]:
    """Remove misregistered keyframes from a model and keep all other poses unchanged.

    Returns:
        The model without misregistered keyframes; the image names of the removed keyframes; the fraction of
        matches in inconsistent pairs that is left.
    """
    pairs, wrong = _find_contradictions(model, context)
    kept = _without(model, wrong)
    left = registered_ids(kept)
    rest = [pair for pair in pairs if pair.first in left and pair.second in left]
    return kept, _names(model, wrong), round(inconsistent_match_ratio(rest), 4)


def left_contradicted(repair: Mapping[str, Any], ratio: float) -> float:
    """Return the fraction of contradicting matches that decides whether a map is usable.

    Args:
        repair: The log entries of `repair_model`.
        ratio: The fraction that is left after all removals. If one camera explains the contradictions, the
            fraction before the removals decides: the map is then built without this camera.
    """
    return float(repair["contradicted_share"]) if "contradicting_camera" in repair else ratio


def _find_contradictions(
    model: pycolmap.Reconstruction, context: MappingContext
) -> tuple[list[PairConsistency], set[int]]:
    """Return the verified pairs of a model, and the ids of the images that contradict it.

    These are the images whose pose or points contradict matches; if no part of the model agrees with itself,
    only those whose pose does. An image whose points alone contradict matches is not among them if a
    second registration confirms its pose.
    """
    pairs = evaluate_pairs(context.workspace, model, context.times_ns)
    misregistered = find_misregistered_images(pairs)
    agreement = evaluate_agreement(context.workspace, model, context.times_ns)
    wrong = misregistered | find_misplaced_images(agreement, image_sequences(model))
    if model.num_reg_images() - len(wrong) < MIN_MODEL_KEYFRAMES:
        wrong = misregistered
    if not is_on(Mechanism.SECOND_REGISTRATION):
        return pairs, wrong
    max_error_px = _CONFIRMED_ERROR_RATIO * context.mapper_options().mapper.filter_max_reproj_error
    confirmed = confirm_images(context.workspace, model, wrong, image_sequences(model), max_error_px)
    confirmed -= misregistered
    record_act(Mechanism.SECOND_REGISTRATION, len(confirmed))
    return pairs, wrong - confirmed


def _names(model: pycolmap.Reconstruction, image_ids: Collection[int]) -> list[str]:
    """Return the sorted names of images."""
    return sorted(model.image(number).name for number in image_ids)


def _without(model: Any, image_ids: Collection[int]) -> Any:
    """Return the model without some images, and without the points that only these images observe.

    The poses of the removed frames are not lost: registration (stage 3) estimates them later from the
    remaining points.
    """
    return sub_model(model, registered_ids(model) - set(image_ids)) if image_ids else model
