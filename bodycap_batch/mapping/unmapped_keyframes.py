"""Models of the keyframes that no model contains yet."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from bodycap_batch.config.lost_frames import LEAST_MAPPED
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
from bodycap_batch.mapping.mapping_context import MappingContext
from bodycap_batch.mapping.matching.database import ImageRef
from bodycap_batch.mapping.reconstruction.model_files import keyframe_names, model_order
from bodycap_batch.mapping.reconstruction.reconstruct import reconstruct
from bodycap_batch.mapping.results import finalise_models
from bodycap_batch.mapping.validation.repair import remove_without_adjustment


def with_larger_model(
    models: Sequence[Any], names: set[str], contradicted: float, mapping: MappingContext
) -> tuple[list[Any], set[str]]:
    """Add a model of the keyframes that are in none, if it is larger than the largest model.

    Then the first keyframes were too few or too far apart, or the largest model contradicts most of them. If
    it also contradicts itself, places that look the same are in it, and nothing is added.

    Args:
        models: Reconstructions, the largest first.
        names: Image names of all keyframes.
        contradicted: Fraction of the matches of the largest model that contradict it.
        mapping: Workspace, mapper options, and how each camera turns.

    Returns:
        The models, the largest first. The image names of those keyframes of the model that was the largest
        whose camera has more keyframes in the added one: they contradict the map of their camera.
    """
    unmapped = names - set[str]().union(*map(keyframe_names, models))
    is_base = not contradicted and is_on(Mechanism.LARGER_MODEL)
    if not models or not is_base or len(unmapped) <= models[0].num_reg_images():
        return list(models), set()
    found = min(reconstruct_unmapped(unmapped, mapping), key=model_order, default=models[0])
    if model_order(found) >= model_order(models[0]):
        return list(models), set()
    record_act(Mechanism.LARGER_MODEL)
    before, now = _cameras_of(models[0]), _cameras_of(found)
    moved = {camera for camera in before if now[camera] > before[camera]}
    displaced = {name for name in keyframe_names(models[0]) if ImageRef.parse(name).camera in moved}
    return [found, *models], displaced


def _cameras_of(model: Any) -> Counter[str]:
    """Return the number of keyframes of each camera in a model."""
    return Counter(ImageRef.parse(name).camera for name in keyframe_names(model))


def reconstruct_unmapped(names: set[str], mapping: MappingContext) -> list[Any]:
    """Return models of keyframes that are in no other model, until too few are left for a further one."""
    left, models = set(names), list[Any]()
    while len(left) >= LEAST_MAPPED:
        mapping.stage.check_cancelled()
        found = _consistent_models(left, mapping)
        if not found:
            break
        models += found
        left -= set[str]().union(*map(keyframe_names, found))
    return models


def _consistent_models(names: set[str], mapping: MappingContext) -> Sequence[Any]:
    """Return models of some keyframes, without the keyframes that contradict them, the largest first."""
    settings = mapping.mapper_options()
    settings.image_names = sorted(names)
    models, _ = reconstruct(mapping.workspace, settings, mapping.stage, len(names))
    taken, out = set[str](), list[Any]()
    for model in models:
        if model.num_reg_images() < LEAST_MAPPED or not model.num_points3D():
            continue
        kept, _, _ = remove_without_adjustment(model, mapping)
        if keyframe_names(kept) & taken:
            continue  # The models of one search may share keyframes. The next search builds the rest.
        try:
            finalise_models([kept], mapping, [None])
        except EstimationError:
            continue  # No point is left: the model consisted of things that move by themselves.
        if kept.num_reg_images() >= LEAST_MAPPED:
            taken |= keyframe_names(kept)
            out.append(kept)
    return out
