"""COLMAP's database of a workspace: cameras, keyframes and their SIFT features, with ids in a fixed order."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.config import MapOptions
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping.matching.sift import extract_features

if TYPE_CHECKING:
    import pycolmap

DATABASE_NAME = "database.db"
"""File name of the database in its workspace."""
_COLOURS_FOLDER = "colours"
"""Folder of the keypoints' colours beside the database: one array for each image."""


@dataclass(frozen=True, slots=True, order=True)
class ImageRef:
    """One keyframe: its camera's name and the index of the frame in that camera."""

    camera: str
    frame: int

    @property
    def name(self) -> str:
        """The image name of the keyframe in the database."""
        return f"{self.camera}/{self.frame:07d}"

    @staticmethod
    def parse(name: str) -> ImageRef:
        """Return the keyframe with an image name."""
        camera, _, frame = name.rpartition("/")
        return ImageRef(camera, int(frame))


Pair = tuple[ImageRef, ImageRef]
"""Two different keyframes, in increasing order."""


@dataclass(frozen=True, slots=True)
class CameraKeyframes:
    """Keyframes of one camera that are added to a database.

    Attributes:
        camera: The camera.
        camera_id: Its id in the database, which is the id of its rig too.
        frames: (K,) frame indices, increasing.
    """

    camera: CaptureCamera
    camera_id: int
    frames: IntArray


def read_image_ids(database: pycolmap.Database) -> dict[ImageRef, int]:
    """Return the image id of every keyframe in the database."""
    return {ImageRef.parse(image.name): int(image.image_id) for image in database.read_all_images()}


def read_camera_ids(workspace: Path) -> dict[str, int]:
    """Return the database id of each camera with keyframes, by camera name."""
    import pycolmap

    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        images = database.read_all_images()
    return {ImageRef.parse(image.name).camera: int(image.camera_id) for image in images}


def read_matched_names(database: pycolmap.Database) -> set[str]:
    """Return the image names of the keyframes that are part of a verified pair."""
    import pycolmap

    pairs, _ = database.read_two_view_geometry_num_inliers()
    matched = {int(number) for pair in pairs for number in pycolmap.pair_id_to_image_pair(pair)}
    return {image.name for image in database.read_all_images() if image.image_id in matched}


def add_camera(database: pycolmap.Database, camera: CaptureCamera) -> int:
    """Write one camera and return its id; its rig holds no other camera, so no synchrony is assumed."""
    model = camera.camera.to_pycolmap()
    model.has_prior_focal_length = camera.calibrated
    return _write_camera(database, model)


def _write_camera(database: pycolmap.Database, model: pycolmap.Camera) -> int:
    """Write one camera with a rig of its own, and return its id."""
    import pycolmap

    camera_id = database.write_camera(model)
    rig = pycolmap.Rig()
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id))
    database.write_rig(rig)
    return int(camera_id)


def add_keyframes(
    workspace: Path,
    keyframes: Sequence[CameraKeyframes],
    options: MapOptions,
    context: StageContext,
) -> None:
    """Extract the SIFT features of keyframes and write them, camera by camera, frame by frame.

    Args:
        workspace: Folder of the database.
        keyframes: The keyframes of each camera.
        options: The stage's options: the number of features.
        context: Threads, progress, cancellation.

    Source: Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004, as
        implemented in OpenCV.
    """
    import pycolmap

    total = sum(len(item.frames) for item in keyframes)
    colours = workspace / _COLOURS_FOLDER
    colours.mkdir(exist_ok=True)
    done = 0
    sift = pycolmap.FeatureExtractorType.SIFT
    with (
        pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database,
        pycolmap.DatabaseTransaction(database),
    ):
        for item in keyframes:
            for index, features in extract_features(item.camera, item.frames, options.features, context):
                image_id = write_image(database, ImageRef(item.camera.name, index), item.camera_id)
                database.write_keypoints(image_id, features.keypoints)
                descriptors = pycolmap.FeatureDescriptors(sift, features.descriptors)
                database.write_descriptors(image_id, descriptors)
                np.save(colours / f"{image_id}.npy", features.rgb)
                done += 1
                context.progress(done, total, "features")
    context.progress(0, 0, "choosing pairs")


def rewrite_without_cameras(workspace: Path, cameras: Collection[str]) -> None:
    """Rewrite the database without some cameras, with ids as if these cameras had never been in it.

    Args:
        workspace: Folder of a database that holds keyframes and features, but no matches yet.
        cameras: Names of the cameras to remove; the features of all others are kept as they are.
    """
    import pycolmap

    colours = workspace / _COLOURS_FOLDER
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
            colour_file = colours / f"{number}.npy"
            if ref.camera in cameras:
                colour_file.unlink()
                continue
            image_id = write_image(database, ref, new_ids[camera_of[number]])
            database.write_keypoints(image_id, source.read_keypoints(number))
            database.write_descriptors(image_id, source.read_descriptors(number))
            # No new id is larger than the old one, so this file name is free by now.
            colour_file.rename(colours / f"{image_id}.npy")
    before.unlink()


def read_keypoint_colours(workspace: Path, image_id: int) -> npt.NDArray[np.uint8]:
    """Return the colour (N,3) RGB at each keypoint of an image."""
    return np.asarray(np.load(workspace / _COLOURS_FOLDER / f"{image_id}.npy"), dtype=np.uint8)


def write_image(database: pycolmap.Database, ref: ImageRef, camera_id: int) -> int:
    """Write one keyframe as a frame of its camera's own rig, and return the image id."""
    import pycolmap

    image = pycolmap.Image(name=ref.name, camera_id=camera_id)
    image_id = int(database.write_image(image))
    frame = pycolmap.Frame()
    frame.rig_id = camera_id
    sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)
    frame.add_data_id(pycolmap.data_t(sensor, image_id))
    database.write_frame(frame)
    return image_id
