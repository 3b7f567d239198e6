"""Convert COLMAP's reconstructions and cameras into `Map` and `Camera`."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.mapping.matching.database import ImageRef, read_detected_px, read_keypoint_colours
from bodycap_batch.mapping.reconstruction.camera_motion import CameraMotion
from bodycap_batch.mapping.reconstruction.keyframe_covariance import keyframe_covariances
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert, make_transform
from bodycap_batch.model.scene import Map

if TYPE_CHECKING:
    import pycolmap


def observed_px(model: pycolmap.Reconstruction) -> dict[int, FloatArray]:
    """Return the positions (N,2), px, of the observations of each image, by image id.

    They are in the order of the observations of `map_from_reconstruction`.
    """
    out = {}
    for image_id in model.reg_image_ids():
        image = model.image(image_id)
        seen = [image.point2D(index).xy for index in image.get_observation_point2D_idxs()]
        out[image_id] = np.array(seen, dtype=np.float64).reshape(-1, 2)
    return out


def map_from_reconstruction(
    model: pycolmap.Reconstruction,
    workspace: Path,
    adjusted_px: Mapping[int, FloatArray] | None = None,
    motions: Mapping[str, CameraMotion] | None = None,
) -> Map:
    """Convert a reconstruction into a `Map`, with keyframes and points in a fixed order.

    Args:
        model: The reconstruction.
        workspace: Folder of the reconstruction's database, from which the keypoints' colours are read.
        adjusted_px: The positions of the observations, from `observed_px`, to which the reconstruction was
            adjusted, if they have been moved since then.
        motions: The motions of the cameras with rolling shutters, by camera name, whose errors are contained
            in the covariances.
    """
    positions = observed_px(model)
    images = sorted(
        ((ImageRef.parse(model.image(image_id).name), image_id) for image_id in model.reg_image_ids()),
    )
    point_ids = sorted(model.point3D_ids())
    row_of_point = {point_id: row for row, point_id in enumerate(point_ids)}
    poses, keyframe_rows, point_rows, features, pixels, adjusted = [], [], [], [], [], []
    colour_sum = np.zeros((len(point_ids), 3))
    for row, (_, image_id) in enumerate(images):
        image = model.image(image_id)
        cam_from_map = np.asarray(image.cam_from_world().matrix())
        poses.append(make_transform(cam_from_map[:, :3], cam_from_map[:, 3]))
        colours = read_keypoint_colours(workspace, image_id)
        feature = np.array(image.get_observation_point2D_idxs(), dtype=np.int64)
        rows = np.array(
            [row_of_point[image.point2D(index).point3D_id] for index in feature.tolist()], dtype=np.int64
        )
        keyframe_rows.append(np.full(len(rows), row))
        point_rows.append(rows)
        features.append(feature)
        detected = read_detected_px(workspace, image_id)
        used = positions[image_id]
        adjusted.append(used if adjusted_px is None else adjusted_px[image_id])
        pixels.append(used if detected is None else detected[feature])
        np.add.at(colour_sum, rows, colours[feature])
    obs_point = _concatenate(point_rows)
    counts = np.bincount(obs_point, minlength=len(point_ids))
    map_from_cam = invert(np.array(poses))
    scene_map = Map(
        gauge=_gauge_id(map_from_cam),
        cameras={ref.camera: camera_from_pycolmap(model.image(image_id).camera) for ref, image_id in images},
        keyframe_camera=tuple(ref.camera for ref, _ in images),
        keyframe_frame=np.array([ref.frame for ref, _ in images], dtype=np.int64),
        map_from_cam=map_from_cam,
        points=np.array([model.point3D(point_id).xyz for point_id in point_ids]).reshape(-1, 3),
        colors=np.round(colour_sum / np.maximum(counts, 1)[:, None]).astype(np.uint8),
        point_error_px=np.array([model.point3D(point_id).error for point_id in point_ids]),
        obs_keyframe=_concatenate(keyframe_rows),
        obs_point=obs_point,
        obs_feature=_concatenate(features),
        obs_px=np.concatenate([np.zeros((0, 2)), *pixels]),
    )
    covariance = keyframe_covariances(scene_map, np.concatenate([np.zeros((0, 2)), *adjusted]), motions)
    return replace(scene_map, keyframe_covariance=covariance)


def _concatenate(parts: list[IntArray]) -> IntArray:
    """Concatenate arrays (possibly zero arrays) into one array."""
    return np.concatenate([np.zeros(0, dtype=np.int64), *parts])


def _gauge_id(map_from_cam: FloatArray) -> str:
    """Return the id of a map's gauge: a digest of the map's keyframe poses (K,4,4)."""
    return hashlib.sha256(np.ascontiguousarray(map_from_cam).tobytes()).hexdigest()[:12]


def camera_from_pycolmap(camera: Any) -> Camera:
    """Convert a camera of a COLMAP reconstruction into a `Camera`."""
    return Camera(
        model=camera.model.name,
        width_px=int(camera.width),
        height_px=int(camera.height),
        params=np.asarray(camera.params),
    )
