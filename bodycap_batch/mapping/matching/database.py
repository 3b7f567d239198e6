"""Read and write COLMAP's database of a workspace: cameras, and keyframes with their features.

Cameras and images are written in a fixed order, so the same input always gives the same ids.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import FloatArray

if TYPE_CHECKING:
    import pycolmap

DATABASE_NAME = "database.db"
"""File name of the database in the workspace folder."""
COLOURS_FOLDER = "colours"
"""Name of the folder with the colours of the keypoints, in the workspace folder. Each image has one file."""
DETECTED_FOLDER = "detected"
"""Name of the folder with the detected positions of the keypoints, in the workspace folder. Each image whose
keypoints were moved to the instant of the middle row has one file."""


@dataclass(frozen=True, slots=True, order=True)
class ImageRef:
    """Reference to one keyframe: the name of its camera, and the frame index in that camera's video."""

    camera: str
    frame: int

    @property
    def name(self) -> str:
        """The image name of the keyframe in the database."""
        return f"{self.camera}/{self.frame:07d}"

    @staticmethod
    def parse(name: str) -> ImageRef:
        """Return the keyframe that has the image name `name` in the database."""
        camera, _, frame = name.rpartition("/")
        return ImageRef(camera, int(frame))


Pair = tuple[ImageRef, ImageRef]
"""Two different keyframes, the smaller `ImageRef` first."""


def read_image_ids(database: pycolmap.Database) -> dict[ImageRef, int]:
    """Return the image id of every keyframe in the database."""
    return {ImageRef.parse(image.name): int(image.image_id) for image in database.read_all_images()}


def read_camera_ids(workspace: Path) -> dict[str, int]:
    """Return the database id of each camera that has keyframes, by camera name."""
    import pycolmap

    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        images = database.read_all_images()
    return {ImageRef.parse(image.name).camera: int(image.camera_id) for image in images}


def count_features(workspace: Path) -> dict[ImageRef, int]:
    """Return the number of features of every keyframe in the database."""
    import pycolmap

    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        return {
            ref: int(database.num_keypoints_for_image(number))
            for ref, number in read_image_ids(database).items()
        }


def read_matched_names(database: pycolmap.Database) -> set[str]:
    """Return the image names of all keyframes that belong to at least one verified pair."""
    import pycolmap

    pairs, _ = database.read_two_view_geometry_num_inliers()
    matched = {int(number) for pair in pairs for number in pycolmap.pair_id_to_image_pair(pair)}
    return {image.name for image in database.read_all_images() if image.image_id in matched}


def add_camera(database: pycolmap.Database, camera: CaptureCamera) -> int:
    """Write one camera to the database and return its id.

    Each camera has a separate rig, so the map does not assume that cameras expose at the same instants.
    """
    model = camera.camera.to_pycolmap()
    # COLMAP searches an initial pair only among fisheye cameras with a prior focal length.
    model.has_prior_focal_length = camera.calibrated or camera.camera.model.endswith("FISHEYE")
    return _write_camera(database, model)


def update_camera(workspace: Path, camera_id: int, camera: CaptureCamera) -> None:
    """Replace the intrinsics of a camera in the database of a workspace."""
    import pycolmap

    model = camera.camera.to_pycolmap()
    model.camera_id, model.has_prior_focal_length = camera_id, True
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        database.update_camera(model)


def _write_camera(database: pycolmap.Database, model: pycolmap.Camera) -> int:
    """Write one camera and a separate rig for it, and return the camera's id."""
    import pycolmap

    camera_id = database.write_camera(model)
    rig = pycolmap.Rig()
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id))
    database.write_rig(rig)
    return int(camera_id)


def read_detected_px(workspace: Path, image_id: int) -> FloatArray | None:
    """Return the detected positions (N,2) of the keypoints of an image, px.

    The result is None if the keypoints of the image were not moved.
    """
    path = workspace / DETECTED_FOLDER / f"{image_id}.npy"
    return np.asarray(np.load(path), dtype=np.float64) if path.exists() else None


def rewrite_without_cameras(workspace: Path, cameras: Collection[str]) -> None:
    """Rewrite the database without some cameras.

    The new ids are the same as in a database to which these cameras were never added.

    Args:
        workspace: Folder of a database that holds keyframes and features, but no matches yet.
        cameras: Names of the cameras to remove. The features of all other cameras are copied unchanged.
    """
    import pycolmap

    folders = [workspace / name for name in (COLOURS_FOLDER, DETECTED_FOLDER)]
    before = (workspace / DATABASE_NAME).rename(workspace / f"whole_{DATABASE_NAME}")
    with (
        pycolmap.Database.open(str(before)) as source,
        pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database,
        pycolmap.DatabaseTransaction(database),
    ):
        images = sorted((number, ref) for ref, number in read_image_ids(source).items())
        camera_of = {number: int(source.read_image(number).camera_id) for number, _ in images}
        removed = {camera_of[number] for number, ref in images if ref.camera in cameras}
        models = sorted(source.read_all_cameras(), key=lambda model: int(model.camera_id))
        kept = {int(model.camera_id): model for model in models if model.camera_id not in removed}
        new_ids = {number: _write_camera(database, model) for number, model in kept.items()}
        for number, ref in images:
            files = [folder / f"{number}.npy" for folder in folders if (folder / f"{number}.npy").exists()]
            if ref.camera in cameras:
                for file in files:
                    file.unlink()
                continue
            image_id = write_image(database, ref, new_ids[camera_of[number]])
            database.write_keypoints(image_id, source.read_keypoints(number))
            database.write_descriptors(image_id, source.read_descriptors(number))
            # A new id is never larger than the old id of the same image. So this rename never overwrites the
            # file of another image: the files with smaller old ids were already renamed or removed.
            for file in files:
                file.rename(file.with_name(f"{image_id}.npy"))
    before.unlink()


def read_keypoint_colours(workspace: Path, image_id: int) -> npt.NDArray[np.uint8]:
    """Return the RGB colours (N,3), 0 to 255, at the keypoints of an image."""
    return np.asarray(np.load(workspace / COLOURS_FOLDER / f"{image_id}.npy"), dtype=np.uint8)


def write_image(database: pycolmap.Database, ref: ImageRef, camera_id: int) -> int:
    """Write one keyframe to the database, as a frame of its camera's rig, and return the image id."""
    import pycolmap

    image = pycolmap.Image(name=ref.name, camera_id=camera_id)
    image_id = int(database.write_image(image))
    frame = pycolmap.Frame()
    frame.rig_id = camera_id
    sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)
    frame.add_data_id(pycolmap.data_t(sensor, image_id))
    database.write_frame(frame)
    return image_id
