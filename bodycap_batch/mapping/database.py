"""COLMAP's database of keyframes: cameras, images and SIFT features, ids in a fixed order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from bodycap_batch.arrays import IntArray
from bodycap_batch.capture import CaptureCamera
from bodycap_batch.config import MapOptions
from bodycap_batch.context import StageContext

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


def add_camera(database: pycolmap.Database, camera: CaptureCamera) -> int:
    """Write one camera with a rig of its own (no synchrony is assumed); returns the camera id."""
    import pycolmap

    model = camera.camera.to_pycolmap()
    model.has_prior_focal_length = camera.calibrated
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

    Source: Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004, with
        RootSIFT normalisation (Arandjelović, Zisserman, CVPR 2012), both as COLMAP implements them.
    """
    import pycolmap

    total = sum(len(frames) for _, _, frames in wanted)
    colours = workspace / _COLOURS
    colours.mkdir(exist_ok=True)
    done = 0
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        for camera, camera_id, frames in wanted:
            for index, keypoints, descriptors, rgb in _features(camera, frames, options, context):
                ref = ImageRef(camera.name, index)
                image_id = write_image(database, ref, camera_id)
                database.write_keypoints(image_id, keypoints)
                database.write_descriptors(image_id, descriptors)
                np.save(colours / f"{image_id}.npy", rgb)
                done += 1
                context.progress(done, total, "features")


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


def _features(
    camera: CaptureCamera, frames: IntArray, options: MapOptions, context: StageContext
) -> Iterator[tuple[int, Any, Any, npt.NDArray[np.uint8]]]:
    """Yield (frame, keypoints (N,4), descriptors, RGB (N,3)) in frame order, extracted in parallel."""
    import cv2
    import pycolmap

    settings = pycolmap.FeatureExtractionOptions()
    settings.num_threads = 1
    settings.use_gpu = False
    settings.sift.max_num_features = options.features
    settings.sift.first_octave = 0
    extractors = [
        pycolmap.FeatureExtractor.create(settings, pycolmap.Device.cpu) for _ in range(context.threads)
    ]

    def extract(slot: int, rgb: npt.NDArray[np.uint8]) -> tuple[Any, Any, npt.NDArray[np.uint8]]:
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        points, descriptors = extractors[slot].extract_from_uint8_array(grey)
        keypoints = np.asarray(pycolmap.keypoints_to_matrix(points), dtype=np.float32).reshape(-1, 4)
        if camera.mask is not None:
            seen = camera.sees_room(keypoints[:, :2])
            keypoints = keypoints[seen]
            descriptors = pycolmap.FeatureDescriptors(descriptors.type, descriptors.data[seen])
        column = np.clip(keypoints[:, 0].astype(int), 0, grey.shape[1] - 1)
        row = np.clip(keypoints[:, 1].astype(int), 0, grey.shape[0] - 1)
        return keypoints, descriptors, rgb[row, column]

    with ThreadPoolExecutor(len(extractors)) as pool:
        batch: list[tuple[int, Any]] = []
        for index, rgb in camera.read(frames, colour=True):
            context.check_cancelled()
            batch.append((index, pool.submit(extract, len(batch), rgb)))
            if len(batch) == len(extractors):
                yield from ((frame, *job.result()) for frame, job in batch)
                batch = []
        yield from ((frame, *job.result()) for frame, job in batch)
