"""Place keyframes in a map that stands: the many of a long capture that see nothing new."""

from __future__ import annotations

from typing import Any

from bodycap_batch.mapping.database import DATABASE_NAME, image_ids
from bodycap_batch.mapping.incremental import place
from bodycap_batch.mapping.matching import match_pairs
from bodycap_batch.mapping.pairs import PairChooser
from bodycap_batch.mapping.repair import Workshop, cut_doubtful
from bodycap_batch.mapping.solve import refine, ticker

_ITERATIONS = 10
"""Of an adjustment by squares: what stands off by more than a pixel is out of the last one's reach."""


def place_others(models: list[Any], chooser: PairChooser, shop: Workshop) -> dict[str, object]:
    """Place keyframes that carry no part of the maps in them, in place; no pose that stands is moved.

    Args:
        models: Reconstructions from some of the chooser's keyframes, the largest first; changed in place.
        chooser: Of all keyframes.
        shop: Workspace, lenses, settings.

    Returns:
        An account for the log.
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
    cut: list[str] = []
    for number, model in enumerate(models):
        placed = place(shop.workspace, shop.settings(), model, left, tick)
        left -= placed
        if placed:
            refine(model, shop.settings(), shop.constant, _ITERATIONS)
            models[number], names = cut_doubtful(model, shop)
            cut += names
    return {
        "carrying": len(carrying),
        "placed": len(wanted) - len(left),
        "cut": cut,
        "placing_pairs": len(pairs),
        "placing_pairs_verified": len(held),
    }
