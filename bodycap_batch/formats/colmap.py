"""Write a map as COLMAP's binary sparse model.

COLMAP, add-ons for Blender, nerfstudio and tools for Gaussian splatting read this format.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.formats.atomic_files import atomic_replacement
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import Similarity, invert, quat_xyzw_from_rotation
from bodycap_batch.model.scene import Map

_COLMAP_MODEL_IDS = {
    "SIMPLE_PINHOLE": 0,
    "PINHOLE": 1,
    "SIMPLE_RADIAL": 2,
    "RADIAL": 3,
    "OPENCV": 4,
    "OPENCV_FISHEYE": 5,
    "FULL_OPENCV": 6,
    "FOV": 7,
    "SIMPLE_RADIAL_FISHEYE": 8,
    "RADIAL_FISHEYE": 9,
    "THIN_PRISM_FISHEYE": 10,
    "EUCM": 16,
}
"""Number of each camera model in COLMAP's binary files. The keys are the names of the models. Source: COLMAP,
sensor/models.h."""

_POINT2D = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
"""Type of one 2D point of an image in images.bin: pixel position, and id of the 3D point."""

_TRACK = np.dtype([("image", "<i4"), ("index", "<i4")])
"""Type of one element of a 3D point's track in points3D.bin: the id of an image, and the index among the 2D
points of this image."""

MODEL_FILES = ("cameras.bin", "images.bin", "points3D.bin")


def image_name(camera: str, frame_number: int) -> str:
    """Return the image name of a keyframe: the camera is the folder, the frame number is the file name."""
    return f"{camera}/{frame_number:06d}.png"


def write_colmap_model(
    folder: Path,
    scene: Map,
    target_from_map: Similarity | None = None,
    frame_numbers: Mapping[str, IntArray] | None = None,
) -> tuple[Path, ...]:
    """Write a map as cameras.bin, images.bin and points3D.bin.

    An image contains only those 2D points that belong to a 3D point of the map. Ids start at 1. Cameras are
    ordered by name, and images by camera and frame. Points are in the same order as in the map.

    Args:
        folder: Folder for the files of the model.
        scene: The map.
        target_from_map: Similarity from the map to another frame of reference, usually the world. None for
            the identity.
        frame_numbers: (N,) number of each frame in the video, for each camera. The keys are camera names. The
            names of the images contain these numbers. For a camera without an entry, the names contain the
            frame index.

    Returns:
        The paths of the written files.

    Raises:
        StoreError: A file cannot be written.
    """
    transform = target_from_map or Similarity(1.0, np.eye(3), np.zeros(3))
    numbers = frame_numbers or {}
    names = sorted(scene.cameras)
    order = sorted(
        range(len(scene.keyframe_camera)), key=lambda k: (scene.keyframe_camera[k], scene.keyframe_frame[k])
    )
    image_names = []
    for keyframe in order:
        camera, frame = scene.keyframe_camera[keyframe], int(scene.keyframe_frame[keyframe])
        image_names.append(image_name(camera, int(numbers[camera][frame]) if camera in numbers else frame))
    image_of = np.empty(len(order), dtype=np.int64)
    image_of[order] = np.arange(1, len(order) + 1)
    by_image = np.lexsort((scene.obs_feature, image_of[scene.obs_keyframe]))
    images = image_of[scene.obs_keyframe][by_image]
    starts = np.searchsorted(images, np.arange(1, len(order) + 2))
    cam_from_target = invert(transform.apply_to_poses(scene.map_from_cam[order]))
    blobs = (
        _encode_cameras([(index, scene.cameras[name]) for index, name in enumerate(names, start=1)]),
        _encode_images(
            cam_from_target,
            [names.index(scene.keyframe_camera[keyframe]) + 1 for keyframe in order],
            image_names,
            _encode_observations(scene, by_image, starts),
        ),
        _encode_points(scene, transform.apply(scene.points), by_image, images, starts),
    )
    written = []
    for file, blob in zip(MODEL_FILES, blobs, strict=True):
        written.append(folder / file)
        with atomic_replacement(written[-1]) as temporary:
            temporary.write_bytes(blob)
    return tuple(written)


def _encode_cameras(cameras: list[tuple[int, Camera]]) -> bytes:
    """Return the content of cameras.bin for pairs of camera id and camera."""
    parts = [struct.pack("<Q", len(cameras))]
    for index, camera in cameras:
        parts.append(
            struct.pack("<iiQQ", index, _COLMAP_MODEL_IDS[camera.model], camera.width_px, camera.height_px)
        )
        parts.append(np.asarray(camera.params, dtype="<f8").tobytes())
    return b"".join(parts)


def _encode_observations(scene: Map, by_image: IntArray, starts: IntArray) -> list[bytes]:
    """Return the encoded 2D points of each image.

    Args:
        scene: The map.
        by_image: (M,) indices of the map's observations, ordered by image.
        starts: (K+1,) position in `by_image` at which each image begins, followed by M.
    """
    table = np.empty(len(by_image), dtype=_POINT2D)
    table["x"], table["y"] = scene.obs_px[by_image].T
    table["point"] = scene.obs_point[by_image] + 1
    return [table[start:end].tobytes() for start, end in pairwise(starts)]


def _encode_images(
    cam_from_target: FloatArray, camera_ids: list[int], image_names: list[str], points2d: list[bytes]
) -> bytes:
    """Return the content of images.bin.

    Args:
        cam_from_target: (K,4,4) pose of each image: the transform from the target frame to the camera.
        camera_ids: (K,) camera id of each image.
        image_names: (K,) name of each image.
        points2d: (K,) encoded 2D points of each image.
    """
    quats = np.roll(quat_xyzw_from_rotation(cam_from_target[:, :3, :3]), 1, axis=-1)
    parts = [struct.pack("<Q", len(image_names))]
    for index, name in enumerate(image_names):
        pose = (*quats[index], *cam_from_target[index, :3, 3])
        parts.append(struct.pack("<i7di", index + 1, *pose, camera_ids[index]))
        parts.append(name.encode("utf-8") + b"\0")
        parts.append(struct.pack("<Q", len(points2d[index]) // _POINT2D.itemsize) + points2d[index])
    return b"".join(parts)


def _encode_points(
    scene: Map, positions: FloatArray, by_image: IntArray, images: IntArray, starts: IntArray
) -> bytes:
    """Return the content of points3D.bin.

    Args:
        scene: The map.
        positions: (P,3) positions of the map's points in the target frame.
        by_image: (M,) indices of the map's observations, ordered by image.
        images: (M,) image id of each observation, in the order of `by_image`.
        starts: (K+1,) position in `by_image` at which each image begins, followed by M.
    """
    track = np.empty(len(by_image), dtype=_TRACK)
    track["image"] = images
    track["index"] = np.arange(len(by_image)) - starts[images - 1]
    points = scene.obs_point[by_image]
    by_point = np.argsort(points, kind="stable")
    track, bounds = track[by_point], np.searchsorted(points[by_point], np.arange(len(positions) + 1))
    parts = [struct.pack("<Q", len(positions))]
    for index, position in enumerate(positions):
        elements = track[bounds[index] : bounds[index + 1]]
        color = scene.colors[index].tolist()
        parts.append(struct.pack("<Q3d3Bd", index + 1, *position, *color, scene.point_error_px[index]))
        parts.append(struct.pack("<Q", len(elements)) + elements.tobytes())
    return b"".join(parts)
