"""Keyframes that move along a bumpy wall, as a database of features."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.mapping.matching.database import (
    COLOURS_FOLDER,
    DATABASE_NAME,
    ImageRef,
    add_camera,
    write_image,
)
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert, make_transform, so3_exp

KEYFRAMES = 16
LENS = Camera(model="PINHOLE", width_px=640, height_px=480, params=np.array([420.0, 420.0, 320.0, 240.0]))
CAMERA = CaptureCamera(
    name="cam",
    chapters=(),
    camera=LENS,
    calibrated=True,
    frame_numbers=np.arange(99),
    times_ns=np.arange(99) * 10**8,
    nominal_fps=10.0,
    rolling_shutter_s=0.0,
)


def wall_poses() -> FloatArray:
    """Return cam_from_map of keyframes that move sideways along a wall at a distance of 4."""
    out = []
    for step in range(KEYFRAMES):
        turn = so3_exp(np.array([0.0, 0.1 * np.sin(step), 0.02 * step]))
        out.append(invert(make_transform(turn, np.array([0.25 * step, 0.1 * np.cos(step), 0.0]))))
    return np.array(out)


def write_wall(folder: Path) -> FloatArray:
    """Write keyframes with features of a bumpy wall (half a pixel of noise), and return their true poses."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-3, -3, 3), (7, 3, 5), (900, 3))
    raw = rng.exponential(1.0, (len(points), 128))
    descriptors = np.round(512 * np.sqrt(raw / raw.sum(axis=1, keepdims=True))).clip(0, 255).astype(np.uint8)
    poses = wall_poses()
    colours = folder / COLOURS_FOLDER
    colours.mkdir()
    with pycolmap.Database.open(str(folder / DATABASE_NAME)) as database:
        camera_id = add_camera(database, CAMERA)
        for frame, pose in enumerate(poses):
            pixels = LENS.project(points @ pose[:3, :3].T + pose[:3, 3])
            seen = np.flatnonzero(((pixels > 0) & (pixels < (640, 480))).all(axis=1))
            image_id = write_image(database, ImageRef("cam", frame), camera_id)
            noisy = pixels[seen] + rng.normal(0, 0.5, (len(seen), 2))
            keypoints = np.column_stack([noisy, np.ones((len(seen), 2))])
            database.write_keypoints(image_id, keypoints.astype(np.float32))
            kind = pycolmap.FeatureExtractorType.SIFT
            np.save(colours / f"{image_id}.npy", np.zeros((len(seen), 3), np.uint8))
            database.write_descriptors(image_id, pycolmap.FeatureDescriptors(kind, descriptors[seen]))
    return poses
