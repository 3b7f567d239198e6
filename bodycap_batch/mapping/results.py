"""Final adjustment of models, and the stage's result."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bodycap_batch.capture import Capture
from bodycap_batch.mapping.inputs import common_times_ns
from bodycap_batch.mapping.reconstruction.bundle_adjustment import adjust_robustly
from bodycap_batch.mapping.reconstruction.conversion import map_from_reconstruction
from bodycap_batch.mapping.validation.transient_points import remove_transient_points
from bodycap_batch.mapping.workspace import MappingContext
from bodycap_batch.model.scene import MapResult


def finalise_models(
    models: Sequence[Any], shop: MappingContext, capture: Capture, placed: Sequence[set[int] | None]
) -> int:
    """Take unconfirmed points out of models, in place, and adjust what is left once more; how many.

    Where it is told which images of a model were placed in it after it had settled, these alone.
    """
    times_ns = common_times_ns(capture)
    total = 0
    for number, (model, mine) in enumerate(zip(models, placed, strict=True)):
        shop.context.progress(number, len(models), "maps adjusted")
        total += remove_transient_points(model, times_ns)
        only = None if mine is None else mine & set(map(int, model.reg_image_ids()))
        if only is None or only:
            adjust_robustly(model, shop.settings(), shop.constant, only)
    return total


def make_result(models: Sequence[Any], workspace: Path, log: dict[str, Any]) -> MapResult:
    """The stage's result, with the size and the mean reprojection error of each model in its log."""
    maps = tuple(map_from_reconstruction(model, workspace) for model in models)
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
