"""Adjust a large map in two steps: first the skeletal keyframes, then all other keyframes.

The skeletal keyframes are a subset of the keyframes, against which all other keyframes can be resected (the
skeletal set of Snavely et al.).
"""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.mapping.matching.database import ImageRef
from bodycap_batch.mapping.matching.skeletal_set import select_skeletal_keyframes
from bodycap_batch.mapping.reconstruction.bundle_adjustment import (
    adjust_and_filter,
    adjust_robustly,
    sub_model,
)
from bodycap_batch.mapping.reconstruction.model_files import registered_ids

if TYPE_CHECKING:
    import pycolmap

_MIN_SHARED_POINTS = 60
"""Minimum number of common points of two overlapping keyframes. Two keyframes with fewer common points are
not treated as overlapping. Evidence: none."""


def adjust_in_two_steps(
    model: Any, settings: pycolmap.IncrementalPipelineOptions, calibrated_ids: Collection[int]
) -> None:
    """Adjust a large model in place; the result approximates `adjust_and_filter` and `adjust_robustly`.

    One adjustment of all keyframes would take hours. So first the skeletal keyframes and their points are
    adjusted as a separate model. Then all other keyframes are adjusted, together with the points that no
    skeletal keyframe observes. The points of the first step stay constant in the second step.

    Args:
        model: A reconstruction, changed in place. The adjustment gives it a new gauge.
        settings: The mapper's options.
        calibrated_ids: Database ids of the calibrated cameras.

    Raises:
        EstimationError: An adjustment failed.
    """
    images = np.array(sorted(model.reg_image_ids()), dtype=np.int64)
    rows = select_skeletal_keyframes(
        _count_shared_points(model, images), _time_order(model, images), min_matches=_MIN_SHARED_POINTS
    )
    skeletal = set(images[rows].tolist())
    part = sub_model(model, skeletal)
    adjust_and_filter(part, settings, calibrated_ids)
    adjust_robustly(part, settings, calibrated_ids)
    _copy_back(model, part, skeletal)
    others = registered_ids(model) - skeletal
    if others:
        adjust_and_filter(model, settings, calibrated_ids, others)
        adjust_robustly(model, settings, calibrated_ids, others & registered_ids(model))


def _count_shared_points(model: Any, images: IntArray) -> npt.NDArray[np.int16]:
    """Return the number (N,N) of points that both images of each pair observe."""
    from scipy import sparse  # Most maps are not large, and the import takes half a second.

    observed = [
        np.array([points[index].point3D_id for index in image.get_observation_point2D_idxs()], dtype=np.int64)
        for image in map(model.image, images.tolist())
        for points in [image.points2D]
    ]
    columns = np.unique(np.concatenate(observed), return_inverse=True)[1]
    starts = np.concatenate([[0], np.cumsum([len(points) for points in observed])])
    rows = sparse.csr_array((np.ones(len(columns), np.int16), columns, starts))
    return np.asarray((rows @ rows.T).toarray(), dtype=np.int16)


def _time_order(model: Any, images: IntArray) -> IntArray:
    """Return the frame index of each image (N,), a sort key that approximates the order in time.

    The order is not exact, because cameras may have different frame rates.
    """
    return np.array([ImageRef.parse(model.image(number).name).frame for number in images.tolist()])


def _copy_back(model: Any, part: Any, image_ids: Collection[int]) -> None:
    """Copy poses, intrinsics and points of an adjusted part of a model into the whole model.

    Observations that are removed in the part are also removed in the whole model.

    Args:
        model: The whole model, changed in place.
        part: The adjusted part of the model.
        image_ids: Ids of the part's registered images.
    """
    for number, camera in part.cameras.items():
        model.camera(number).params = camera.params
    for number in part.point3D_ids():
        model.point3D(number).xyz = part.point3D(number).xyz
    for number in sorted(image_ids):
        image, adjusted = model.image(number), part.image(number)
        model.frame(image.frame_id).set_cam_from_world(image.camera_id, adjusted.cam_from_world())
        for feature in map(int, image.get_observation_point2D_idxs()):
            if image.points2D[feature].has_point3D() and not adjusted.points2D[feature].has_point3D():
                model.delete_observation(number, feature)
