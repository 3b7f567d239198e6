"""Repair a model: match further pairs of misregistered and missing keyframes, and register them again.

Keyframes that are still misregistered are removed.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
from bodycap_batch.mapping.mapping_context import MappingContext
from bodycap_batch.mapping.matching.database import DATABASE_NAME, ImageRef, Pair, read_image_ids
from bodycap_batch.mapping.matching.pair_matching import match_pairs
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

_ROUNDS = 2
"""Maximum number of rounds of a repair. Evidence: none."""
_MIN_PAIR_BUDGET = 2000
"""Number of untried pairs that a round of a repair may match in any case. The round may match a larger number
of untried pairs only if at least that number of pairs was matched before. Otherwise the round matches only
the pairs of misregistered keyframes. Evidence: none."""
_CONFIRMED_ERROR_RATIO = 2.0
"""Maximum error of a match that confirms the pose of a keyframe, as a multiple of the mapper's maximum
reprojection error. Of 6, 8 and 12 px, all confirm the same keyframes within a few percent. Evidence:
docs/decisions/mapping.md."""


def repair_model(
    model: pycolmap.Reconstruction,
    tried: set[Pair],
    context: MappingContext,
    keyframes: Collection[ImageRef] | None = None,
) -> tuple[Any, dict[str, object]]:
    """Match untried pairs of misregistered and missing keyframes, and register these keyframes again.

    A round is accepted if it increases the number of correctly registered keyframes. If this number stays the
    same, the round is accepted if it decreases the number of misregistered keyframes. At the end, all
    keyframes that are still misregistered are removed, unless a second registration from the points of the
    other keyframes finds them in the same place. The model is not adjusted after this removal: the stage
    adjusts it at its end (`finalise_models`). Evidence: docs/decisions/mapping.md.

    Args:
        model: The largest model; not changed.
        tried: Pairs that were already matched; the pairs that the repair matches are added to this set.
        context: Workspace, intrinsics, mapper options.
        keyframes: Keyframes that the model should contain; by default all keyframes in the database.

    Returns:
        The given model, or the model of the last accepted round, without misregistered keyframes; entries
        for the log.
    """
    import pycolmap

    log: list[dict[str, object]] = []
    with pycolmap.Database.open(str(context.workspace / DATABASE_NAME)) as database:
        ids = read_image_ids(database)
    if keyframes is not None:
        ids = {ref: ids[ref] for ref in keyframes}
    pairs = evaluate_pairs(context.workspace, model, context.times_ns)
    wrong = find_wrong_images(context, model, pairs)
    for _ in range(_ROUNDS if is_on(Mechanism.REPAIR) else 0):
        registered = registered_ids(model)
        missing = set(ids.values()) - registered
        if not wrong | missing:
            break
        untried = _untried_pairs(ids, wrong | missing, tried)
        if len(untried) > max(_MIN_PAIR_BUDGET, len(tried)):
            # If many keyframes are missing, most of the missing keyframes show too little of the room to be
            # registered, and matching them takes long. So only misregistered keyframes are matched.
            untried = _untried_pairs(ids, wrong, tried)
        tried |= set(untried)
        verified = match_pairs(context.workspace, untried, context.intrinsics, context.stage)
        entry: dict[str, object] = {
            "doubtful": [ref.name for ref, number in sorted(ids.items()) if number in wrong],
            "unregistered": len(missing),
            "pairs": len(untried),
            "verified_pairs": len(verified),
        }
        log.append(entry)
        if not verified and not wrong:
            break
        # Most keyframes that are registered from their matches alone are removed again.
        other = re_register_images(model, wrong, context, len(ids), structure_less=False)
        other_pairs = evaluate_pairs(context.workspace, other, context.times_ns)
        still_wrong = find_wrong_images(context, other, other_pairs)
        sound_before = len(registered - wrong)
        sound_after = len(registered_ids(other) - still_wrong)
        entry |= {"sound_before": sound_before, "sound_after": sound_after}
        if sound_after < sound_before or (sound_after == sound_before and len(still_wrong) >= len(wrong)):
            break
        model, wrong, pairs = other, still_wrong, other_pairs
        record_act(Mechanism.REPAIR)
    ratio = round(inconsistent_match_ratio(pairs), 4)
    cameras = {
        int(number): ImageRef.parse(model.image(number).name).camera for number in model.reg_image_ids()
    }
    camera = find_contradicting_camera(pairs, cameras)
    model, removed = _remove_images(model, _without_confirmed(context, model, pairs, wrong))
    entries = {"rounds": log, "cut": removed, "contradicted_share": ratio}
    return model, {**entries, "contradicting_camera": camera} if camera else entries


def remove_without_adjustment(
    model: pycolmap.Reconstruction, context: MappingContext
) -> tuple[Any, list[str], float]:
    """Remove misregistered keyframes from a model and keep all other poses unchanged.

    Returns:
        The model without misregistered keyframes; the image names of the removed keyframes; the fraction of
        matches in inconsistent pairs that is left.
    """
    pairs = evaluate_pairs(context.workspace, model, context.times_ns)
    wrong = find_wrong_images(context, model, pairs)
    kept, removed = _remove_images(model, _without_confirmed(context, model, pairs, wrong))
    left = registered_ids(kept)
    rest = [pair for pair in pairs if pair.first in left and pair.second in left]
    return kept, removed, round(inconsistent_match_ratio(rest), 4)


def left_contradicted(repair: Mapping[str, Any], ratio: float) -> float:
    """Return the fraction of contradicting matches that decides whether a map is usable.

    Args:
        repair: The log entries of `repair_model`.
        ratio: The fraction that is left after all removals. If one camera explains the contradictions, the
            fraction before the removals decides: the map is then built without this camera.
    """
    return float(repair["contradicted_share"]) if "contradicting_camera" in repair else ratio


def find_wrong_images(
    context: MappingContext, model: pycolmap.Reconstruction, pairs: Sequence[PairConsistency]
) -> set[int]:
    """Return the ids of the images whose pose or points contradict matches.

    If no part of the model agrees with itself, only the images that contradict the poses are returned.

    Args:
        context: Workspace.
        model: The model.
        pairs: The verified pairs of the model (`evaluate_pairs`).
    """
    wrong = find_misregistered_images(pairs)
    agreement = evaluate_agreement(context.workspace, model, context.times_ns)
    misplaced = find_misplaced_images(agreement, image_sequences(model))
    if model.num_reg_images() - len(wrong | misplaced) < MIN_MODEL_KEYFRAMES:
        return wrong
    return wrong | misplaced


def _without_confirmed(
    context: MappingContext,
    model: pycolmap.Reconstruction,
    pairs: Sequence[PairConsistency],
    wrong: Collection[int],
) -> set[int]:
    """Return the ids of the wrong images without those whose pose a second registration confirms.

    An image whose pose contradicts its matches is never confirmed.

    Args:
        context: Workspace, mapper options.
        model: The model.
        pairs: The verified pairs of the model.
        wrong: Ids of the images whose matches contradict the model.
    """
    if not is_on(Mechanism.SECOND_REGISTRATION):
        return set(wrong)
    max_error_px = _CONFIRMED_ERROR_RATIO * context.mapper_options().mapper.filter_max_reproj_error
    confirmed = confirm_images(context.workspace, model, wrong, image_sequences(model), max_error_px)
    acquitted = confirmed - find_misregistered_images(pairs)
    record_act(Mechanism.SECOND_REGISTRATION, len(acquitted))
    return set(wrong) - acquitted


def _remove_images(model: Any, image_ids: set[int]) -> tuple[Any, list[str]]:
    """Return the model without some images, and the sorted names of the removed images.

    Points that only the removed images observe are removed too. The poses of the removed frames are not lost:
    registration (stage 3) estimates them later from the remaining points.
    """
    removed = sorted(model.image(number).name for number in image_ids)
    return sub_model(model, registered_ids(model) - image_ids) if removed else model, removed


def _untried_pairs(ids: Mapping[ImageRef, int], images: set[int], tried: set[Pair]) -> list[Pair]:
    """Return all pairs that contain one of the given images and were not matched yet.

    Args:
        ids: Database ids of all keyframes.
        images: Database ids of the images whose pairs are returned.
        tried: Pairs that were already matched.
    """
    refs: Sequence[ImageRef] = sorted(ids)
    chosen = [ref for ref in refs if ids[ref] in images]
    return sorted({(min(a, b), max(a, b)) for a in chosen for b in refs if a != b} - tried)
