"""Add keyframes with their SIFT features to the database of a workspace."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
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
from bodycap_batch.mapping.matching.database import (
    COLOURS_FOLDER,
    DATABASE_NAME,
    DETECTED_FOLDER,
    ImageRef,
    read_image_ids,
    read_keypoint_colours,
    write_image,
)
from bodycap_batch.mapping.matching.neighbour_matches import features_for_neighbours
from bodycap_batch.mapping.matching.sift import SiftFeatures, extract_features
from bodycap_batch.model.rotation_path import TurningShutter

if TYPE_CHECKING:
    import pycolmap

_COPY_NAME = "earlier.db"
"""Name of the copy of an earlier map's database, in the work folder."""


@dataclass(frozen=True, slots=True)
class CameraKeyframes:
    """Keyframes of one camera, to be added to a database.

    Attributes:
        camera: The camera.
        camera_id: Database id of the camera. The camera's rig has the same id.
        frames: (K,) frame indices, increasing.
        sharpness: (N,) sharpness of each frame of the video, NaN for a frame that cannot be a keyframe. Where
            neighbours have few matches, keyframes are added. None: no keyframes are added.
        shutter: Moves the keypoints to the instant of the middle row; None for a global shutter.
        earlier: Workspace of an earlier map that was made from the same pictures of the camera, with the same
            mask and the same maximum number of features. The features that it holds are copied. None: all
            features are extracted.
    """

    camera: CaptureCamera
    camera_id: int
    frames: IntArray
    sharpness: FloatArray | None = None
    shutter: TurningShutter | None = None
    earlier: Path | None = None


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
    colours = workspace / COLOURS_FOLDER
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
                context.progress(min(done, total), total, "features")
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
        if keyframes.sharpness is None:
            yield from extract_features(keyframes.camera, keyframes.frames, count, context)
        else:
            yield from features_for_neighbours(
                keyframes.camera, keyframes.frames, keyframes.sharpness, count, context
            ).items()
        return
    with _opened_copy(keyframes.earlier, context) as database:
        ids = {ref.frame: number for ref, number in _images_of(database, keyframes.camera.name).items()}
        missing = np.array([frame for frame in keyframes.frames if int(frame) not in ids], dtype=np.int64)
        extracted = extract_features(keyframes.camera, missing, count, context)
        for frame in sorted({*map(int, keyframes.frames), *ids}):
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
    detected = workspace / DETECTED_FOLDER / f"{image_id}.npy"
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
    folder = workspace / DETECTED_FOLDER
    folder.mkdir(exist_ok=True)
    np.save(folder / f"{image_id}.npy", px)
