"""Features of an earlier map are copied; they equal the features that would be extracted again."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import pycolmap
import pytest

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.config import MapOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping.matching.database import (
    DATABASE_NAME,
    read_detected_px,
    read_image_ids,
    read_keypoint_colours,
)
from bodycap_batch.mapping.matching.keyframe_features import CameraKeyframes, add_keyframes
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.rotation_path import RotationPath, TurningShutter

LENS = Camera(model="PINHOLE", width_px=320, height_px=240, params=np.array([210.0, 210.0, 160.0, 120.0]))
FRAMES = np.array([0, 2, 3, 5])


class _Blots:
    """A camera whose pictures are irregular blots; it records which frames are read."""

    name, shows_only_room = "torso", True

    def __init__(self) -> None:
        self.read_frames: list[int] = []

    def is_unmasked(self, px: np.ndarray, frame: int | None = None) -> np.ndarray:
        return np.ones(len(px), dtype=bool)

    def read(self, frames: np.ndarray, *, colour: bool) -> Any:
        assert colour
        for frame in map(int, frames):
            self.read_frames.append(frame)
            noise = np.random.default_rng(frame).integers(0, 255, (240, 320, 3)).astype(np.uint8)
            yield frame, cv2.GaussianBlur(noise, (0, 0), 2.0)


def _shutter() -> TurningShutter:
    """A shutter of a camera that turns to the right at a constant rate."""
    step = np.tile(so3_exp([0.0, -0.05, 0.0]), (5, 1, 1))
    path = RotationPath.from_steps(np.arange(6) * 33_333_333, step, np.ones(5, bool))
    return TurningShutter(LENS, path, 0.02)


def _workspace(folder: Path, frames: np.ndarray, **options: Any) -> _Blots:
    """Write the keyframes `frames` into the database of a new folder; return the camera that was read."""
    folder.mkdir()
    camera = _Blots()
    with pycolmap.Database.open(str(folder / DATABASE_NAME)) as database:
        rig = pycolmap.Rig()
        rig.add_ref_sensor(
            pycolmap.sensor_t(pycolmap.SensorType.CAMERA, database.write_camera(LENS.to_pycolmap()))
        )
        database.write_rig(rig)
    keyframes = [CameraKeyframes(cast(CaptureCamera, camera), 1, frames, **options)]
    add_keyframes(folder, keyframes, MapOptions(features=128), StageContext(work_dir=folder, threads=1))
    return camera


def _content(folder: Path) -> list[tuple[object, ...]]:
    """Return everything that the workspace holds about its pictures."""
    with pycolmap.Database.open(str(folder / DATABASE_NAME)) as database:
        return [
            (
                ref,
                number,
                np.asarray(database.read_keypoints(number)).tobytes(),
                np.asarray(database.read_descriptors(number).data).tobytes(),
                read_keypoint_colours(folder, number).tobytes(),
                None if (px := read_detected_px(folder, number)) is None else px.tobytes(),
            )
            for ref, number in sorted(read_image_ids(database).items())
        ]


def _files(folder: Path) -> dict[str, bytes]:
    """Return the content of all files in a folder, by name."""
    return {str(path): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.parametrize("shutter", [None, _shutter()], ids=["global", "rolling"])
def test_copied_features_equal_extracted_features(tmp_path: Path, shutter: TurningShutter | None) -> None:
    assert _workspace(tmp_path / "first", FRAMES, shutter=shutter).read_frames == [0, 2, 3, 5]
    earlier = tmp_path / "first"
    before = _files(earlier)
    camera = _workspace(tmp_path / "second", FRAMES, shutter=shutter, earlier=earlier)
    assert camera.read_frames == []
    assert _files(earlier) == before, "a stored result must not change"
    assert len(_content(tmp_path / "first")) == len(FRAMES)
    assert _content(tmp_path / "second") == _content(tmp_path / "first")


def test_only_pictures_that_the_earlier_map_lacks_are_read(tmp_path: Path) -> None:
    _workspace(tmp_path / "first", FRAMES[[0, 2]])
    camera = _workspace(tmp_path / "second", FRAMES, earlier=tmp_path / "first")
    assert camera.read_frames == [2, 5]
    _workspace(tmp_path / "alone", FRAMES)
    assert _content(tmp_path / "second") == _content(tmp_path / "alone")
