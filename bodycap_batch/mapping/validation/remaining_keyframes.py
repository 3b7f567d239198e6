"""Place keyframes in a map that stands: the many of a long capture that see nothing new."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from bodycap_batch.mapping.matching.database import DATABASE_NAME, Pair, read_image_ids
from bodycap_batch.mapping.matching.pair_matching import match_pairs
from bodycap_batch.mapping.matching.pair_selection import PairGenerator
from bodycap_batch.mapping.reconstruction.bundle_adjustment import adjust_and_filter, adjust_robustly
from bodycap_batch.mapping.reconstruction.incremental_mapper import resect_images
from bodycap_batch.mapping.reconstruction.reconstruct import model_order, progress_counter
from bodycap_batch.mapping.validation.repair import remove_without_adjustment
from bodycap_batch.mapping.workspace import MappingContext


def resect_remaining(
    models: list[Any], chooser: PairGenerator, tried: Collection[Pair], shop: MappingContext
) -> tuple[list[set[int]], dict[str, object]]:
    """Settle maps, and place the keyframes in them, in place, that carry none; no pose that stands is moved.

    All at once would be adjusted by passes over millions of observations, hundreds of them: so who was placed
    is adjusted alone, to points that stay.

    Args:
        models: Reconstructions from some of the chooser's keyframes; changed in place, and put in order, the
            largest first.
        chooser: Of all keyframes.
        tried: Pairs that were matched.
        shop: Workspace, lenses, settings.

    Returns:
        Ids of the images placed in each of the models, and an account for the log; ``contradicted_share`` in
        it is the largest model's.
    """
    import pycolmap

    with pycolmap.Database.open(str(shop.workspace / DATABASE_NAME)) as database:
        ids = read_image_ids(database)
    carrying = {int(number) for model in models for number in model.reg_image_ids()}
    wanted = [ref for ref in chooser.refs if ids[ref] not in carrying]
    chosen = chooser.placing([ref for ref in chooser.refs if ids[ref] in carrying], wanted)
    pairs = [pair for pair in chosen if pair not in tried]
    held = match_pairs(shop.workspace, pairs, shop.lenses, shop.context)
    left = {ids[ref] for ref in wanted}
    tick = progress_counter(shop.context, len(ids), shop.context.check_cancelled, len(carrying))
    cut = list[str]()
    made = list[tuple[Any, set[int], float]]()
    for model in models:
        adjust_robustly(model, shop.settings(), shop.constant)
        found = resect_images(shop.workspace, shop.settings(), model, left, tick)
        kept, names, share = model, list[str](), 0.0
        if found:
            adjust_and_filter(model, shop.settings(), shop.constant, found)
            kept, names, share = remove_without_adjustment(model, shop)
        cut += names
        found &= set(map(int, kept.reg_image_ids()))
        left -= found
        made.append((kept, found, share))
    made.sort(key=lambda item: model_order(item[0]))
    models[:] = [model for model, _, _ in made]
    placed = [found for _, found, _ in made]
    return placed, {
        "carrying": sum(model.num_reg_images() - len(found) for model, found, _ in made),
        "placed": sum(map(len, placed)),
        "cut": cut,
        "contradicted_share": made[0][2] if made else 0.0,
        "placing_pairs": len(pairs),
        "placing_pairs_verified": len(held),
    }
