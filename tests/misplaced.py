"""Misplace a block of keyframes of a map, as a mapper does that has lost the scale or the place."""

from __future__ import annotations

import copy
from collections.abc import Collection
from typing import Any

import numpy as np
import pycolmap

from bodycap_batch.model.geometry import Similarity

MAX_ERROR_PX = 4.0
"""Maximum reprojection error (px) of an observation of the map. COLMAP's default."""


def misplace(model: Any, block: Collection[int], other_from_map: Similarity) -> Any:
    """Return a copy of a model in which the images `block` are moved by a similarity.

    Every point that the block observes is triangulated by the block alone and by the rest alone. A point
    stays one point if each side then sees the other side's point. So the epipolar geometry inside the block
    and inside the rest is the same as before.
    """
    out = copy.deepcopy(model)
    for image_id in block:
        image = out.image(image_id)
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().inverse().matrix()
        moved = other_from_map.apply_to_poses(pose[None])[0]
        image.frame.rig_from_world = pycolmap.Rigid3d(np.linalg.inv(moved)[:3])
    for point_id in list(out.point3D_ids()):
        elements = [(int(e.image_id), int(e.point2D_idx)) for e in out.point3D(point_id).track.elements]
        inside = [element for element in elements if element[0] in block]
        if not inside or len(inside) == len(elements):
            if inside:
                out.point3D(point_id).xyz = other_from_map.apply(out.point3D(point_id).xyz[None])[0]
            continue
        moved = other_from_map.apply(out.point3D(point_id).xyz[None])[0]
        if all(_error_px(out, element, out.point3D(point_id).xyz) < MAX_ERROR_PX for element in inside):
            continue
        for element in inside:
            if out.exists_point3D(point_id) and out.image(element[0]).point2D(element[1]).has_point3D():
                out.delete_observation(*element)
        if len({image for image, _ in inside}) > 1:
            track = pycolmap.Track()
            for element in inside:
                track.add_element(*element)
            out.add_point3D(moved, track)
    return out


def _error_px(model: Any, element: tuple[int, int], point: Any) -> float:
    image = model.image(element[0])
    projected = image.project_point(point)
    return np.inf if projected is None else float(np.linalg.norm(projected - image.point2D(element[1]).xy))
