"""The peers' database: COLMAP's own features and matches of every frame, independent of our own."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap

from bodycap_batch.capture import Capture, CaptureCamera
from bodycap_batch.model.optical_flow import pixel_scale
from tests.bench.peer_pairs import pairs_of
from tests.bench.retrieval import similarity

DATABASE_NAME = "database.db"
FEATURES = 2048


def name_of(camera: str, frame: int) -> str:
    """Return the image name of a frame."""
    return f"{camera}/{frame:07d}"


def write_features(capture: Capture, workspace: Path, threads: int) -> None:
    """Write the cameras with the given intrinsics, and SIFT features of every frame from octave 0."""
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        for camera in capture.cameras:
            model = camera.camera.to_pycolmap()
            model.has_prior_focal_length = camera.calibrated
            camera_id = database.write_camera(model)
            sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)
            rig = pycolmap.Rig()
            rig.add_ref_sensor(sensor)
            rig_id = database.write_rig(rig)
            for index, keypoints, descriptors in _extracted(camera, threads):
                image = pycolmap.Image(name=name_of(camera.name, index), camera_id=camera_id)
                image_id = database.write_image(image)
                frame = pycolmap.Frame()
                frame.rig_id = rig_id
                frame.add_data_id(pycolmap.data_t(sensor, image_id))
                database.write_frame(frame)
                database.write_keypoints(image_id, keypoints)
                database.write_descriptors(image_id, descriptors)


def _extracted(camera: CaptureCamera, threads: int) -> Iterator[tuple[int, Any, Any]]:
    """Yield frame, keypoints (N,4) and descriptors in order, extracted in parallel."""
    settings = pycolmap.FeatureExtractionOptions()
    settings.num_threads = 1
    settings.use_gpu = False
    settings.sift.max_num_features = FEATURES
    settings.sift.first_octave = 0
    extractors = [pycolmap.FeatureExtractor.create(settings, pycolmap.Device.cpu) for _ in range(threads)]

    def extract(slot: int, image: npt.NDArray[np.uint8]) -> tuple[Any, Any]:
        points, descriptors = extractors[slot].extract_from_uint8_array(image)
        return np.asarray(pycolmap.keypoints_to_matrix(points), np.float32).reshape(-1, 4), descriptors

    frames = camera.grey_frames()
    with ThreadPoolExecutor(threads) as pool:
        # One extractor per thread, because an extractor is not thread-safe.
        while batch := list(islice(frames, threads)):
            slots = range(len(batch))
            results = pool.map(extract, slots, [image for _, image in batch])
            for (index, _), (keypoints, descriptors) in zip(batch, results, strict=True):
                yield index, keypoints, descriptors


def choose(capture: Capture, workspace: Path) -> list[tuple[str, str]]:
    """Return the peers' common list of pairs, by image name."""
    frames = [(camera, index) for camera in capture.cameras for index in range(len(camera.times_ns))]
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        names = [name_of(camera.name, index) for camera, index in frames]
        descriptors = [np.asarray(database.read_descriptors(ids[name]).data) for name in names]
    common = {camera.name: camera.common_times_ns() for camera in capture.cameras}
    times = np.array([common[camera.name][index] for camera, index in frames], dtype=np.int64)
    cameras = np.array([camera.name for camera, _ in frames])
    pairs = pairs_of(cameras, times, similarity(descriptors, 0))
    return [(names[first], names[second]) for first, second in pairs]


def match(capture: Capture, workspace: Path, pairs: list[tuple[str, str]], threads: int) -> None:
    """Run COLMAP's matcher and geometric verification on the list of pairs."""
    listed = workspace / "pairs.txt"
    listed.write_text("".join(f"{first} {second}\n" for first, second in pairs), encoding="utf-8")
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = threads
    matching.use_gpu = False
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(listed)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    sizes = [pixel_scale(c.camera.width_px, c.camera.height_px) for c in capture.cameras]
    verification.ransac.max_error *= max(sizes)
    verification.filter_stationary_matches = False
    pycolmap.match_image_pairs(
        str(workspace / DATABASE_NAME), matching, pairing, verification, pycolmap.Device.cpu
    )
