"""COLMAP's database of keyframes: cameras, images and SIFT features, ids in a fixed order."""

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
from bodycap_batch.mapping.matching.sift import features_of

if TYPE_CHECKING:
    import pycolmap

DATABASE_NAME = "database.db"
_COLOURS = "colours"


@dataclass(frozen=True, slots=True, order=True)
class ImageRef:
    """One keyframe in the database."""

    camera: str
    frame: int

    @property
    def name(self) -> str:
        """Its image name."""
        return f"{self.camera}/{self.frame:07d}"

    @staticmethod
    def parse(name: str) -> ImageRef:
        """The keyframe behind an image name."""
        camera, _, frame = name.rpartition("/")
        return ImageRef(camera, int(frame))


Pair = tuple[ImageRef, ImageRef]


def image_ids(database: pycolmap.Database) -> dict[ImageRef, int]:
    """Image id of every keyframe in the database."""
    return {ImageRef.parse(image.name): int(image.image_id) for image in database.read_all_images()}


def camera_ids(workspace: Path) -> dict[str, int]:
    """Database id of each camera that has keyframes."""
    import pycolmap

    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        images = database.read_all_images()
    return {ImageRef.parse(image.name).camera: int(image.camera_id) for image in images}


def matched_names(database: pycolmap.Database) -> set[str]:
    """Names of the keyframes that hold to another one."""
    import pycolmap

    pairs, _ = database.read_two_view_geometry_num_inliers()
    held = {int(number) for pair in pairs for number in pycolmap.pair_id_to_image_pair(pair)}
    return {image.name for image in database.read_all_images() if image.image_id in held}


def add_camera(database: pycolmap.Database, camera: CaptureCamera) -> int:
    """Write one camera with a rig of its own (no synchrony is assumed); returns the camera id."""
    model = camera.camera.to_pycolmap()
    model.has_prior_focal_length = camera.calibrated
    return _write_camera(database, model)


def _write_camera(database: pycolmap.Database, model: pycolmap.Camera) -> int:
    import pycolmap

    camera_id = database.write_camera(model)
    rig = pycolmap.Rig()
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id))
    database.write_rig(rig)
    return int(camera_id)


def add_keyframes(
    workspace: Path,
    wanted: Sequence[tuple[CaptureCamera, int, IntArray]],
    options: MapOptions,
    context: StageContext,
) -> None:
    """Extract SIFT features of keyframes and write them, camera by camera, frame by frame.

    Args:
        workspace: Folder of the database.
        wanted: For each camera its id (which is its rig's id too) and the frame indices.
        options: Number of features.
        context: Threads and progress.

    Source: Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004, as
        OpenCV implements them.
    """
    import pycolmap

    total = sum(len(frames) for _, _, frames in wanted)
    colours = workspace / _COLOURS
    colours.mkdir(exist_ok=True)
    done = 0
    sift = pycolmap.FeatureExtractorType.SIFT
    with (
        pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database,
        pycolmap.DatabaseTransaction(database),
    ):
        for camera, camera_id, frames in wanted:
            for index, found in features_of(camera, frames, options.features, context):
                image_id = write_image(database, ImageRef(camera.name, index), camera_id)
                database.write_keypoints(image_id, found.keypoints)
                descriptors = pycolmap.FeatureDescriptors(sift, found.descriptors)
                database.write_descriptors(image_id, descriptors)
                np.save(colours / f"{image_id}.npy", found.rgb)
                done += 1
                context.progress(done, total, "features")
    context.progress(0, 0, "choosing pairs")


def drop_images(workspace: Path, cameras: Collection[str]) -> None:
    """Write the database anew without some cameras, ids as if they had never been in it.

    Args:
        workspace: Folder of the database: keyframes and their features, nothing matched yet.
        cameras: Names; the features of all others are kept as they are.
    """
    import pycolmap

    colours = workspace / _COLOURS
    before = (workspace / DATABASE_NAME).rename(workspace / f"whole_{DATABASE_NAME}")
    with (
        pycolmap.Database.open(str(before)) as source,
        pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database,
        pycolmap.DatabaseTransaction(database),
    ):
        images = sorted((number, ref) for ref, number in image_ids(source).items())
        lens = {number: int(source.read_image(number).camera_id) for number, _ in images}
        dropped = {lens[number] for number, ref in images if ref.camera in cameras}
        models = sorted(source.read_all_cameras(), key=lambda model: int(model.camera_id))
        new = {int(each.camera_id): each for each in models if each.camera_id not in dropped}
        ids = {number: _write_camera(database, model) for number, model in new.items()}
        for number, ref in images:
            mine = colours / f"{number}.npy"
            if ref.camera in cameras:
                mine.unlink()
                continue
            image_id = write_image(database, ref, ids[lens[number]])
            database.write_keypoints(image_id, source.read_keypoints(number))
            database.write_descriptors(image_id, source.read_descriptors(number))
            mine.rename(colours / f"{image_id}.npy")  # ids only grow smaller: it is free by now
    before.unlink()


def keypoint_colours(workspace: Path, image_id: int) -> npt.NDArray[np.uint8]:
    """(N,3) RGB at each keypoint of an image."""
    return np.asarray(np.load(workspace / _COLOURS / f"{image_id}.npy"), dtype=np.uint8)


def write_image(database: pycolmap.Database, ref: ImageRef, camera_id: int) -> int:
    """Write one keyframe as a frame of its camera's own rig; returns the image id."""
    import pycolmap

    image = pycolmap.Image(name=ref.name, camera_id=camera_id)
    image_id = int(database.write_image(image))
    frame = pycolmap.Frame()
    frame.rig_id = camera_id
    sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)
    frame.add_data_id(pycolmap.data_t(sensor, image_id))
    database.write_frame(frame)
    return image_id
