"""Find keyframes in the wrong place or left out, match them again, place them again, or cut them out."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from bodycap_batch.mapping.matching.database import DATABASE_NAME, ImageRef, Pair, read_image_ids
from bodycap_batch.mapping.matching.pair_matching import match_pairs
from bodycap_batch.mapping.matching.skeletal_set import SKELETAL_ABOVE
from bodycap_batch.mapping.reconstruction.bundle_adjustment import sub_model, adjust_and_filter
from bodycap_batch.mapping.reconstruction.reconstruct import register_new_images
from bodycap_batch.mapping.validation.epipolar_consistency import (
    inconsistent_match_ratio,
    find_misregistered_images,
    evaluate_pairs,
)
from bodycap_batch.mapping.workspace import MappingContext

if TYPE_CHECKING:
    import pycolmap

_ROUNDS = 2
_MIN_PAIR_BUDGET = 2000
"""Pairs that may be matched again, where fewer were matched in the first place."""


def repair_model(
    model: pycolmap.Reconstruction,
    tried: set[Pair],
    shop: MappingContext,
    among: Collection[ImageRef] | None = None,
) -> tuple[Any, dict[str, object]]:
    """Take doubtful keyframes out, match them and the unregistered ones again, place them again or cut them.

    Args:
        model: The largest model; not changed.
        tried: Pairs that were matched; those matched here are added.
        shop: Workspace, lenses, settings.
        among: Keyframes that belong in it; by default all of the database.

    Returns:
        The better of the old and the new model without what is doubtful still, and an account for the log.
    """
    import pycolmap

    log: list[dict[str, object]] = []
    with pycolmap.Database.open(str(shop.workspace / DATABASE_NAME)) as database:
        ids = read_image_ids(database)
    if among is not None:
        ids = {ref: ids[ref] for ref in among}
    links = evaluate_pairs(shop.workspace, model)
    suspects = find_misregistered_images(links)
    for _ in range(_ROUNDS):
        placed = set(map(int, model.reg_image_ids()))
        missing = set(ids.values()) - placed
        if not suspects | missing:
            break
        fresh = _untried_pairs(ids, suspects | missing, tried)
        if len(fresh) > max(_MIN_PAIR_BUDGET, len(tried)):
            # Where many are missing they saw too little: matching them with all would cost the most.
            fresh = _untried_pairs(ids, suspects, tried)
        tried |= set(fresh)
        held = match_pairs(shop.workspace, fresh, shop.lenses, shop.context)
        entry: dict[str, object] = {
            "doubtful": [ref.name for ref, number in sorted(ids.items()) if number in suspects],
            "unregistered": len(missing),
            "pairs": len(fresh),
            "verified_pairs": len(held),
        }
        log.append(entry)
        if not held and not suspects:
            break
        other = re_register_images(model, suspects, shop, len(ids))
        other_links = evaluate_pairs(shop.workspace, other)
        left = find_misregistered_images(other_links)
        sound_before = len(placed - suspects)
        sound_after = len(set(map(int, other.reg_image_ids())) - left)
        entry |= {"sound_before": sound_before, "sound_after": sound_after}
        if sound_after < sound_before or (sound_after == sound_before and len(left) >= len(suspects)):
            break
        model, suspects, links = other, left, other_links
    share = round(inconsistent_match_ratio(links), 4)
    model, cut = _remove_images(model, suspects)
    if cut:
        _adjust_unless_large(model, shop)
    return model, {"rounds": log, "cut": cut, "contradicted_share": share}


def remove_misregistered(model: pycolmap.Reconstruction, shop: MappingContext) -> tuple[Any, list[str]]:
    """The model without keyframes that contradict it, adjusted then, and their names."""
    kept, cut, _ = remove_without_adjustment(model, shop)
    if cut:
        _adjust_unless_large(kept, shop)
    return kept, cut


def remove_without_adjustment(
    model: pycolmap.Reconstruction, shop: MappingContext
) -> tuple[Any, list[str], float]:
    """`remove_misregistered` with all poses left as they are, and the share of links that contradicted the model."""
    links = evaluate_pairs(shop.workspace, model)
    return *_remove_images(model, find_misregistered_images(links)), round(inconsistent_match_ratio(links), 4)


def _remove_images(model: Any, suspects: set[int]) -> tuple[Any, list[str]]:
    """Points that only suspects see go with them; tracking finds their frames' poses from what is left."""
    cut = sorted(model.image(number).name for number in suspects)
    return sub_model(model, set(map(int, model.reg_image_ids())) - suspects) if cut else model, cut


def _untried_pairs(ids: Mapping[ImageRef, int], images: set[int], tried: set[Pair]) -> list[Pair]:
    refs: Sequence[ImageRef] = sorted(ids)
    chosen = [ref for ref in refs if ids[ref] in images]
    return sorted({(min(a, b), max(a, b)) for a in chosen for b in refs if a != b} - tried)


def re_register_images(
    model: pycolmap.Reconstruction, suspects: Collection[int], shop: MappingContext, total: int
) -> Any:
    """The model with suspects taken out, they and new keyframes registered against what is left, all refined.

    Args:
        model: A reconstruction; not changed.
        suspects: Ids of images.
        shop: Workspace, lenses, settings.
        total: Keyframes there are.
    """
    rest = sub_model(model, set(model.reg_image_ids()) - set(suspects))
    grown = register_new_images(shop.workspace, rest, shop.settings(), shop.context, total)
    _adjust_unless_large(grown, shop)
    return grown


def _adjust_unless_large(model: pycolmap.Reconstruction, shop: MappingContext) -> None:
    """Refine a model in place; in one of very many keyframes only what is new to it is, at the end."""
    if model.num_reg_images() <= SKELETAL_ABOVE:
        adjust_and_filter(model, shop.settings(), shop.constant)
