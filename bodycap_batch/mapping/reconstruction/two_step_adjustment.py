"""Adjust a map of very many keyframes: first those that see all there is, then the others to these."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy import sparse

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.mapping.matching.database import ImageRef
from bodycap_batch.mapping.matching.skeletal_set import select_skeletal_keyframes
from bodycap_batch.mapping.reconstruction.bundle_adjustment import (
    sub_model,
    adjust_and_filter,
    adjust_robustly,
)

if TYPE_CHECKING:
    import pycolmap

_MIN_SHARED_POINTS = 60
"""Points that two keyframes share which surely show the same."""


def adjust_in_two_steps(
    model: Any, settings: pycolmap.IncrementalPipelineOptions, constant_cameras: Collection[int]
) -> None:
    """`adjust_and_filter` and `adjust_robustly` for very many keyframes, in place: all at once they would take hours.

    Those that see all there is are adjusted together, as a map of their own. The others follow, to points
    that stay; a point that the first map does not hold is theirs alone.

    Args:
        model: A reconstruction; the gauge moves.
        settings: The mapper's settings.
        constant_cameras: Ids of calibrated cameras.

    Raises:
        EstimationError: An adjustment failed.
    """
    images = np.array(sorted(model.reg_image_ids()), dtype=np.int64)
    carrying = set(
        images[
            select_skeletal_keyframes(
                _count_shared_points(model, images), _time_order(model, images), sure=_MIN_SHARED_POINTS
            )
        ].tolist()
    )
    part = sub_model(model, carrying)
    adjust_and_filter(part, settings, constant_cameras)
    adjust_robustly(part, settings, constant_cameras)
    _copy_back(model, part, carrying)
    others = set(map(int, model.reg_image_ids())) - carrying
    if others:
        adjust_and_filter(model, settings, constant_cameras, others)
        adjust_robustly(model, settings, constant_cameras, others & set(map(int, model.reg_image_ids())))


def _count_shared_points(model: Any, images: IntArray) -> npt.NDArray[np.int16]:
    """(N,N) how many points two keyframes share."""
    seen = [
        np.array([points[index].point3D_id for index in image.get_observation_point2D_idxs()], dtype=np.int64)
        for image in map(model.image, images.tolist())
        for points in [image.points2D]
    ]
    columns = np.unique(np.concatenate(seen), return_inverse=True)[1]
    starts = np.concatenate([[0], np.cumsum([len(mine) for mine in seen])])
    rows = sparse.csr_array((np.ones(len(columns), np.int16), columns, starts))
    return np.asarray((rows @ rows.T).toarray(), dtype=np.int16)


def _time_order(model: Any, images: IntArray) -> IntArray:
    """(N,) where each keyframe stands in the order of time, about: cameras may differ in their rates."""
    return np.array([ImageRef.parse(model.image(number).name).frame for number in images.tolist()])


def _copy_back(model: Any, part: Any, carrying: Collection[int]) -> None:
    """Poses, lenses, points and outliers of a part's adjustment, for the whole model, in place."""
    for number, camera in part.cameras.items():
        model.camera(number).params = camera.params
    for number in part.point3D_ids():
        model.point3D(number).xyz = part.point3D(number).xyz
    for number in sorted(carrying):
        image, mine = model.image(number), part.image(number)
        model.frame(image.frame_id).set_cam_from_world(image.camera_id, mine.cam_from_world())
        for feature in map(int, image.get_observation_point2D_idxs()):
            if image.points2D[feature].has_point3D() and not mine.points2D[feature].has_point3D():
                model.delete_observation(number, feature)
