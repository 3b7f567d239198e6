"""Remove points that alone determine the pose of a keyframe in some direction.

A false match can give a point very close before the lens. A small step of the camera moves such a point
across the whole picture, so it determines the camera's place more exactly than hundreds of distant points.
The pose follows it, and its residual is almost zero, whatever the loss: nothing else in the picture can
contradict it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
from bodycap_batch.mapping.reconstruction.conversion import camera_from_pycolmap
from bodycap_batch.model.geometry import transform_points
from bodycap_batch.model.reprojection_derivatives import pose_derivatives, projection_jacobian

if TYPE_CHECKING:
    import pycolmap

_MAX_LEVERAGE = 0.5
"""Maximum part of an error of one observation that the pose of its keyframe may take up, from 0 to 1.
Derivation: of a larger part, less than half of the error is left in the residual, so no loss can find it.
Evidence: docs/decisions/mapping.md."""
_MIN_OBSERVATIONS = 24
"""Minimum number of observations of a keyframe whose points are judged. Derivation: the six unknowns of a
pose have a mean leverage of 6 / 24 of each observation, half of `_MAX_LEVERAGE`."""


def remove_dominant_points(model: pycolmap.Reconstruction) -> int:
    """Remove points that alone determine the pose of a keyframe, and return the number of removed points.

    The leverage of an observation is the part of its error that the pose takes up, if the points are known.
    After a removal, the leverages of the other points of the keyframe are larger. So it is repeated until no
    point is removed.

    Args:
        model: A reconstruction, changed in place. The caller adjusts it afterwards.

    Source: Baarda, "A testing procedure for use in geodetic networks", 1968: the redundancy number of an
        observation is 1 minus its leverage.
    """
    if not is_on(Mechanism.DOMINANT_POINTS):
        return 0
    removed = 0
    images = set(map(int, model.reg_image_ids()))
    while images:
        dominant = {number for image in sorted(images) for number in _dominant_points(model, image)}
        images = {
            int(element.image_id) for number in dominant for element in model.point3D(number).track.elements
        }
        for number in sorted(dominant):
            model.delete_point3D(number)
        removed += len(dominant)
    record_act(Mechanism.DOMINANT_POINTS, removed)
    return removed


def _dominant_points(model: pycolmap.Reconstruction, number: int) -> list[int]:
    """Return the ids of the points that alone determine the pose of an image."""
    image = model.image(number)
    feature = image.get_observation_point2D_idxs()
    if len(feature) < _MIN_OBSERVATIONS:
        return []
    points = image.points2D
    ids: IntArray = np.array([points[index].point3D_id for index in feature], dtype=np.int64)
    in_map = np.array([model.point3D(point).xyz for point in ids.tolist()])
    pose = np.vstack([image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])
    in_cam = transform_points(pose, in_map)
    ids, in_cam = ids[in_cam[:, 2] > 0.0], in_cam[in_cam[:, 2] > 0.0]
    if len(ids) < _MIN_OBSERVATIONS:
        return []
    rays = in_cam[:, :2] / in_cam[:, 2:]
    px_from_ray = projection_jacobian(camera_from_pycolmap(image.camera), rays)
    valid = np.isfinite(px_from_ray).all(axis=(1, 2))
    ids, in_cam, rays = ids[valid], in_cam[valid], rays[valid]
    # In units of the usual depth, rotations and translations have derivatives of the same size.
    inverse_depth = float(np.median(in_cam[:, 2])) / in_cam[:, 2]
    jacobian = pose_derivatives(rays[:, 0], rays[:, 1], inverse_depth, px_from_ray[valid].transpose(1, 2, 0))
    return [int(point) for point in ids[_leverages(jacobian) > _MAX_LEVERAGE]]


def _leverages(jacobian: FloatArray) -> FloatArray:
    """Return the largest leverage (N,) of each observation, in any direction of the picture.

    Args:
        jacobian: (2,6,N) derivatives of the pixels with respect to the pose.
    """
    hessian = np.einsum("din,djn->ij", jacobian, jacobian)
    hat = np.einsum("din,ij,ejn->nde", jacobian, np.linalg.pinv(hessian, hermitian=True), jacobian)
    return np.asarray(np.linalg.eigvalsh(hat)[:, -1])
