"""Register images again: the images removed from a model, and those of the database that it lacks."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING, Any

from bodycap_batch.mapping.mapping_context import MappingContext
from bodycap_batch.mapping.reconstruction.bundle_adjustment import adjust_and_filter, sub_model
from bodycap_batch.mapping.reconstruction.incremental_mapper import with_new_images

if TYPE_CHECKING:
    import pycolmap


def re_register_images(
    model: pycolmap.Reconstruction,
    image_ids: Collection[int],
    context: MappingContext,
    total: int,
    *,
    structure_less: bool = True,
) -> Any:
    """Remove some images from a model. Then register all images of the database that it lacks.

    Args:
        model: A reconstruction; not changed.
        image_ids: Ids of the images to remove and to register again.
        context: Workspace, intrinsics, mapper options.
        total: Number of all keyframes, for the progress.
        structure_less: Whether images that see no points of the map are registered from their matches.

    Returns:
        A copy of the model in which these images are registered, as far as they fit. All poses of the copy
        are adjusted if the model is not large.
    """
    rest = sub_model(model, set(model.reg_image_ids()) - set(image_ids))
    settings = context.mapper_options()
    settings.structure_less_registration_fallback = structure_less
    extended = with_new_images(
        context.workspace,
        rest,
        settings,
        context.stage,
        total,
        adjust_globally=not context.is_large(rest.num_reg_frames()),
    )
    adjust_unless_large(extended, context)
    return extended


def adjust_unless_large(model: pycolmap.Reconstruction, context: MappingContext) -> None:
    """Adjust a model in place, unless the model is large or has no points.

    At the end of the stage, the new images of a large model are adjusted (`finalise_models`).
    """
    if model.num_points3D() and not context.is_large(model.num_reg_images()):
        adjust_and_filter(model, context.mapper_options(), context.calibrated_ids)
