"""In a long capture, resect the keyframes that are not skeletal keyframes.

Skeletal keyframes are the reduced set of keyframes, Snavely's skeletal set.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from bodycap_batch.mapping.mapping_context import MappingContext
from bodycap_batch.mapping.matching.database import DATABASE_NAME, Pair, read_image_ids
from bodycap_batch.mapping.matching.pair_matching import match_pairs
from bodycap_batch.mapping.matching.pair_selection import PairGenerator
from bodycap_batch.mapping.reconstruction.bundle_adjustment import adjust_and_filter, adjust_robustly
from bodycap_batch.mapping.reconstruction.incremental_mapper import progress_counter, resect_images
from bodycap_batch.mapping.reconstruction.model_files import model_order, registered_ids
from bodycap_batch.mapping.validation.repair import remove_without_adjustment


def resect_remaining(
    models: list[Any], generator: PairGenerator, tried: Collection[Pair], context: MappingContext
) -> tuple[list[set[int]], dict[str, object]]:
    """Adjust models robustly, then resect the keyframes that no model contains.

    An adjustment of all keyframes together would need hundreds of passes over millions of observations. So
    after resection only the resected keyframes are adjusted. The poses of the other keyframes stay constant.
    The points that the other keyframes observe stay constant too. Misregistered keyframes are removed.

    Args:
        models: Reconstructions from some of the keyframes. They are changed in place, and the list is sorted,
            the largest model first.
        generator: Generator of pairs among all keyframes.
        tried: Pairs that were already matched.
        context: Workspace, intrinsics, mapper options.

    Returns:
        For each model, the ids of the images that were resected; entries for the log. The log entry
        ``contradicted_share`` is the fraction of inconsistent matches of the largest model.
    """
    import pycolmap

    with pycolmap.Database.open(str(context.workspace / DATABASE_NAME)) as database:
        ids = read_image_ids(database)
    registered = {int(number) for model in models for number in model.reg_image_ids()}
    missing = [ref for ref in generator.refs if ids[ref] not in registered]
    chosen = generator.resection_pairs([ref for ref in generator.refs if ids[ref] in registered], missing)
    pairs = [pair for pair in chosen if pair not in tried]
    verified = match_pairs(context.workspace, pairs, context.intrinsics, context.stage)
    left = {ids[ref] for ref in missing}
    count_one = progress_counter(context.stage, len(ids), context.stage.check_cancelled, len(registered))
    removed = list[str]()
    extended = list[tuple[Any, set[int], float]]()
    for model in models:
        adjust_robustly(model, context.mapper_options(), context.calibrated_ids)
        resected = resect_images(context.workspace, context.mapper_options(), model, left, count_one)
        kept, names, ratio = model, list[str](), 0.0
        if resected:
            adjust_and_filter(model, context.mapper_options(), context.calibrated_ids, resected)
            kept, names, ratio = remove_without_adjustment(model, context)
        removed += names
        resected &= registered_ids(kept)
        left -= resected
        extended.append((kept, resected, ratio))
    extended.sort(key=lambda item: model_order(item[0]))
    models[:] = [model for model, _, _ in extended]
    all_resected = [resected for _, resected, _ in extended]
    return all_resected, {
        "carrying": sum(model.num_reg_images() - len(resected) for model, resected, _ in extended),
        "placed": sum(map(len, all_resected)),
        "cut": removed,
        "contradicted_share": extended[0][2] if extended else 0.0,
        "placing_pairs": len(pairs),
        "placing_pairs_verified": len(verified),
    }
