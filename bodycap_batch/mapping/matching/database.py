"""Read and write COLMAP's database of a workspace: cameras, keyframes and the keyframes' SIFT features.

Cameras and images are written in a fixed order, so the same input always gives the same ids.
"""

from __future__ import annotations

import shutil
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.config import MapOptions
from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping.matching.sift import SiftFeatures, extract_features
from bodycap_batch.model.rotation_path import TurningShutter

if TYPE_CHECKING:
    import pycolmap

DATABASE_NAME = "database.db"
"""File name of the database in the workspace folder."""
_COPY_NAME = "earlier.db"
"""Name of the copy of an earlier map's database, in the work folder."""
_COLOURS_FOLDER = "colours"
"""Name of the folder with the colours of the keypoints, in the workspace folder. Each image has one file."""
_DETECTED_FOLDER = "detected"
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


@dataclass(frozen=True, slots=True)
class CameraKeyframes:
    """Keyframes of one camera, to be added to a database.

    Attributes:
        camera: The camera.
        camera_id: Database id of the camera. The camera's rig has the same id.
        frames: (K,) frame indices, increasing.
        shutter: Moves the keypoints to the instant of the middle row; None for a global shutter.
        earlier: Workspace of an earlier map that was made from the same pictures of the camera, with the same
            mask and the same maximum number of features. The features that it holds are copied. None: all
            features are extracted.
    """

    camera: CaptureCamera
    camera_id: int
    frames: IntArray
    shutter: TurningShutter | None = None
    earlier: Path | None = None


def read_image_ids(database: pycolmap.Database) -> dict[ImageRef, int]:
    """Return the image id of every keyframe in the database."""
    return {ImageRef.parse(image.name): int(image.image_id) for image in database.read_all_images()}


def read_camera_ids(workspace: Path) -> dict[str, int]:
    """Return the database id of each camera that has keyframes, by camera name."""
    import pycolmap

    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        images = database.read_all_images()
    return {ImageRef.parse(image.name).camera: int(image.camera_id) for image in images}


def count_with_features(workspace: Path, refs: Collection[ImageRef], least: int) -> int:
    """Return how many of some keyframes have at least a number of features."""
    import pycolmap

    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        ids = read_image_ids(database)
        return sum(int(database.num_keypoints_for_image(ids[ref])) >= least for ref in refs)


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


def _write_camera(database: pycolmap.Database, model: pycolmap.Camera) -> int:
    """Write one camera and a separate rig for it, and return the camera's id."""
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
    """Extract the SIFT features of keyframes, and write the keyframes and their features to the database.

    The cameras are processed one after the other. Features that an earlier map holds are copied.

    Args:
        workspace: Folder of the database.
        keyframes: The keyframes of each camera.
        options: The stage's options, with the maximum number of features.
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
            for index, features in _features_of(item, options.features, context):
                image_id = write_image(database, ImageRef(item.camera.name, index), item.camera_id)
                keypoints = features.keypoints
                if item.shutter is not None:
                    _save_detected(workspace, image_id, keypoints[:, :2])
                    keypoints = _at_mid_row(keypoints, index, item.shutter)
                database.write_keypoints(image_id, keypoints)
                descriptors = pycolmap.FeatureDescriptors(sift, features.descriptors)
                database.write_descriptors(image_id, descriptors)
                np.save(colours / f"{image_id}.npy", features.rgb)
                done += 1
                context.progress(done, total, "features")
    context.progress(0, 0, "choosing pairs")


def _features_of(
    keyframes: CameraKeyframes, count: int, context: StageContext
) -> Iterator[tuple[int, SiftFeatures]]:
    """Yield the index and the features of each keyframe, in frame order.

    Args:
        keyframes: The keyframes of one camera.
        count: Maximum number of features of a keyframe.
        context: Work folder, threads and cancellation.
    """
    if keyframes.earlier is None:
        yield from extract_features(keyframes.camera, keyframes.frames, count, context)
        return
    with _opened_copy(keyframes.earlier, context) as database:
        ids = {ref.frame: number for ref, number in _images_of(database, keyframes.camera.name).items()}
        missing = np.array([frame for frame in keyframes.frames if int(frame) not in ids], dtype=np.int64)
        extracted = extract_features(keyframes.camera, missing, count, context)
        for frame in map(int, keyframes.frames):
            context.check_cancelled()
            if frame in ids:
                yield frame, _read_features(keyframes.earlier, database, ids[frame])
            else:
                yield next(extracted)


@contextmanager
def _opened_copy(workspace: Path, context: StageContext) -> Iterator[pycolmap.Database]:
    """Give a copy of the database of an earlier map.

    COLMAP writes to each database that it opens. The earlier map may be a stored result, which never changes.
    """
    import pycolmap

    copied = context.work_dir / _COPY_NAME
    shutil.copyfile(workspace / DATABASE_NAME, copied)
    try:
        with pycolmap.Database.open(str(copied)) as database:
            yield database
    finally:
        copied.unlink()


def _images_of(database: pycolmap.Database, camera: str) -> dict[ImageRef, int]:
    """Return the image id of every keyframe of one camera in the database."""
    return {ref: number for ref, number in read_image_ids(database).items() if ref.camera == camera}


def _read_features(workspace: Path, database: pycolmap.Database, image_id: int) -> SiftFeatures:
    """Return the features of an image as they were extracted, with the detected positions."""
    keypoints = np.asarray(database.read_keypoints(image_id), dtype=np.float32)[:, :4].copy()
    detected = workspace / _DETECTED_FOLDER / f"{image_id}.npy"
    if detected.exists():
        keypoints[:, :2] = np.load(detected)
    return SiftFeatures(
        keypoints=keypoints,
        descriptors=np.asarray(database.read_descriptors(image_id).data, dtype=np.uint8),
        rgb=read_keypoint_colours(workspace, image_id),
    )


def _at_mid_row(
    keypoints: npt.NDArray[np.float32], frame: int, shutter: TurningShutter
) -> npt.NDArray[np.float32]:
    """Return keypoints (N,4) of a frame, moved to the instant of the middle row."""
    moved = keypoints.copy()
    px = keypoints[:, :2].astype(np.float64)
    moved[:, :2] = shutter.px_at_mid_row(np.full(len(px), frame, np.int64), px)
    return moved


def _save_detected(workspace: Path, image_id: int, px: npt.NDArray[np.float32]) -> None:
    """Store the detected positions (N,2) of the keypoints of an image."""
    folder = workspace / _DETECTED_FOLDER
    folder.mkdir(exist_ok=True)
    np.save(folder / f"{image_id}.npy", px)


def read_detected_px(workspace: Path, image_id: int) -> FloatArray | None:
    """Return the detected positions (N,2) of the keypoints of an image, px.

    The result is None if the keypoints of the image were not moved.
    """
    path = workspace / _DETECTED_FOLDER / f"{image_id}.npy"
    return np.asarray(np.load(path), dtype=np.float64) if path.exists() else None


def rewrite_without_cameras(workspace: Path, cameras: Collection[str]) -> None:
    """Rewrite the database without some cameras.

    The new ids are the same as in a database to which these cameras were never added.

    Args:
        workspace: Folder of a database that holds keyframes and features, but no matches yet.
        cameras: Names of the cameras to remove. The features of all other cameras are copied unchanged.
    """
    import pycolmap

    folders = [workspace / name for name in (_COLOURS_FOLDER, _DETECTED_FOLDER)]
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
    return np.asarray(np.load(workspace / _COLOURS_FOLDER / f"{image_id}.npy"), dtype=np.uint8)


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
