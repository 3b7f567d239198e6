"""Repair a model: register keyframes that contradict it once more, and remove those that still do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

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
from bodycap_batch.mapping.validation.track_agreement import (
    evaluate_agreement,
    find_misplaced_images,
    image_sequences,
)

if TYPE_CHECKING:
    import pycolmap


def repair_model(
    model: pycolmap.Reconstruction, context: MappingContext, total: int | None
) -> tuple[Any, dict[str, Any]]:
    """Register misregistered keyframes once more, and remove those that still contradict the model.

    Without them, the points that they bent are right, so most find their true place. The model is not
    adjusted after the removal: the stage adjusts it at its end (`finalise_models`). Each growth of the map
    tries the removed keyframes again.

    Args:
        model: The largest model; not changed.
        context: Workspace, intrinsics, mapper options.
        total: Number of all keyframes, for the progress; None to register none again.

    Returns:
        The model; entries for the log: the keyframes that were registered again and those that were removed,
        the fraction of matches in inconsistent pairs before the removal, and a camera that explains them.
    """
    kept, doubtful, _ = remove_without_adjustment(model, context)
    if doubtful and total is not None:
        model = re_register_images(kept, [], context, total)
    pairs = evaluate_pairs(context.workspace, model, context.times_ns)
    cameras = {
        int(number): ImageRef.parse(model.image(number).name).camera for number in model.reg_image_ids()
    }
    camera = find_contradicting_camera(pairs, cameras)
    kept, removed = _without_wrong(model, context, pairs)
    entries: dict[str, Any] = {
        "doubtful": doubtful,
        "cut": removed,
        "contradicted_share": round(inconsistent_match_ratio(pairs), 4),
    }
    return kept, {**entries, "contradicting_camera": camera} if camera else entries


def remove_without_adjustment(
    model: pycolmap.Reconstruction, context: MappingContext
) -> tuple[Any, list[str], float]:
    """Remove misregistered keyframes from a model and keep all other poses unchanged.

    Returns:
        The model without misregistered keyframes; the image names of the removed keyframes; the fraction of
        matches in inconsistent pairs that is left.
    """
    pairs = evaluate_pairs(context.workspace, model, context.times_ns)
    kept, removed = _without_wrong(model, context, pairs)
    left = registered_ids(kept)
    rest = [pair for pair in pairs if pair.first in left and pair.second in left]
    return kept, removed, round(inconsistent_match_ratio(rest), 4)


def left_contradicted(removal: Mapping[str, Any], ratio: float) -> float:
    """Return the fraction of contradicting matches that decides whether a map is usable.

    Args:
        removal: The log entries of `repair_model`.
        ratio: The fraction that is left after all removals. If one camera explains the contradictions, the
            fraction before the removals decides: the map is then built without this camera.
    """
    return float(removal["contradicted_share"]) if "contradicting_camera" in removal else ratio


def _without_wrong(
    model: pycolmap.Reconstruction, context: MappingContext, pairs: Sequence[PairConsistency]
) -> tuple[Any, list[str]]:
    """Return the model without the images that contradict it, and the sorted names of these images.

    These are the images whose pose or points contradict matches. If no part of the model agrees with itself,
    they are the images that contradict the poses alone. Points that only the removed images observe are
    removed too. Registration (stage 3) estimates the poses of single removed frames from the other points.

    Args:
        model: The model.
        context: Workspace.
        pairs: The verified pairs of the model.
    """
    wrong = find_misregistered_images(pairs)
    agreement = evaluate_agreement(context.workspace, model, context.times_ns)
    misplaced = find_misplaced_images(agreement, image_sequences(model))
    if model.num_reg_images() - len(wrong | misplaced) >= MIN_MODEL_KEYFRAMES:
        wrong |= misplaced
    removed = sorted(model.image(number).name for number in wrong)
    return sub_model(model, registered_ids(model) - wrong) if removed else model, removed
