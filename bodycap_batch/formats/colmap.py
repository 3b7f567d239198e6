"""Write a map as COLMAP's binary sparse model.

COLMAP, add-ons for Blender, nerfstudio and tools for Gaussian splatting read this format.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.formats.atomic_files import atomic_replacement, store_error_from_os_error
from bodycap_batch.model.geometry import Similarity, invert
from bodycap_batch.model.scene import Map

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
    import pycolmap

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
    model = pycolmap.Reconstruction()
    for index, name in enumerate(names, start=1):
        camera = scene.cameras[name].to_pycolmap()
        camera.camera_id = index
        model.add_camera_with_trivial_rig(camera)
    for index, keyframe in enumerate(order):
        image = pycolmap.Image(
            name=image_names[index],
            keypoints=scene.obs_px[by_image[starts[index] : starts[index + 1]]],
            camera_id=names.index(scene.keyframe_camera[keyframe]) + 1,
            image_id=index + 1,
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(cam_from_target[index, :3]))
    points = scene.obs_point[by_image]
    by_point = np.argsort(points, kind="stable")
    bounds = np.searchsorted(points[by_point], np.arange(len(scene.points) + 1))
    place = np.arange(len(by_image)) - starts[images - 1]
    for index, position in enumerate(transform.apply(scene.points)):
        track = pycolmap.Track()
        for observation in by_point[bounds[index] : bounds[index + 1]]:
            track.add_element(images[observation], place[observation])
        added = model.add_point3D(position, track, scene.colors[index])
        model.point3D(added).error = scene.point_error_px[index]
    written = tuple(folder / file for file in MODEL_FILES)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # COLMAP reports no full disk. The copies are written to the same disk, and fail if it is full.
        with tempfile.TemporaryDirectory(dir=folder) as made:
            model.write_binary(made)
            for path in written:
                with atomic_replacement(path) as temporary:
                    temporary.write_bytes((Path(made) / path.name).read_bytes())
    except OSError as error:
        raise store_error_from_os_error(error, folder) from error
    return written
