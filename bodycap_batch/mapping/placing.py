"""Place keyframes in a map that stands: the many of a long capture that see nothing new."""

from __future__ import annotations

from typing import Any

from bodycap_batch.mapping.database import DATABASE_NAME, image_ids
from bodycap_batch.mapping.incremental import place
from bodycap_batch.mapping.matching import match_pairs
from bodycap_batch.mapping.pairs import PairChooser
from bodycap_batch.mapping.repair import Workshop, cut_doubtful
from bodycap_batch.mapping.solve import refine, settle, ticker


def place_others(
    models: list[Any], chooser: PairChooser, shop: Workshop
) -> tuple[list[set[int]], dict[str, object]]:
    """Settle maps, and place the keyframes in them, in place, that carry none; no pose that stands is moved.

    All at once would be adjusted by passes over millions of observations, hundreds of them: so who was placed
    is adjusted alone, to points that stay.

    Args:
        models: Reconstructions from some of the chooser's keyframes, the largest first; changed in place.
        chooser: Of all keyframes.
        shop: Workspace, lenses, settings.

    Returns:
        Ids of the images placed in each of the models, and an account for the log.
    """
    import pycolmap

    with pycolmap.Database.open(str(shop.workspace / DATABASE_NAME)) as database:
        ids = image_ids(database)
    inside = {int(number) for model in models for number in model.reg_image_ids()}
    carrying = [ref for ref in chooser.refs if ids[ref] in inside]
    wanted = [ref for ref in chooser.refs if ids[ref] not in inside]
    pairs = chooser.placing(carrying, wanted)
    held = match_pairs(shop.workspace, pairs, shop.lenses, shop.context)
    left = {ids[ref] for ref in wanted}
    tick = ticker(shop.context, len(ids), shop.context.check_cancelled, len(carrying))
    cut, count = list[str](), len(left)
    placed = list[set[int]]()
    for number, model in enumerate(models):
        settle(model, shop.settings(), shop.constant)
        found = place(shop.workspace, shop.settings(), model, left, tick)
        left -= found
        if found:
            refine(model, shop.settings(), shop.constant, found)
            models[number], names = cut_doubtful(model, shop)
            cut += names
        placed.append(found)
    return placed, {
        "carrying": len(carrying),
        "placed": count - len(left),
        "cut": cut,
        "placing_pairs": len(pairs),
        "placing_pairs_verified": len(held),
    }
