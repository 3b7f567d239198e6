"""A camera whose picture is flipped is found out by what it shares with the others."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pycolmap
import pytest

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.config import MapOptions
from bodycap_batch.context import StageContext
from bodycap_batch.errors import EstimationError
from bodycap_batch.mapping.database import DATABASE_NAME, add_keyframes
from bodycap_batch.mapping.likeness import clear_matches, largest
from bodycap_batch.mapping.mirrored import flipped, mirror_note, without_mirrored
from bodycap_batch.scene import KeyframeSelection

FRAMES = np.arange(6)


def _wall() -> np.ndarray:
    """A wall (480,1600) of blots that are the same in no mirror."""
    rng = np.random.default_rng(5)
    wall = np.full((480, 1600), 120, np.uint8)
    for x, y, shade in zip(
        rng.integers(0, 1600, 700), rng.integers(0, 480, 700), rng.integers(0, 255, 700), strict=True
    ):
        corners = np.add(rng.integers(-28, 28, (4, 2)), (x, y))
        cv2.fillPoly(wall, [corners.astype(np.int32)], int(shade))
    return cv2.GaussianBlur(wall, (0, 0), 1.5)


WALL = _wall()


class _Pan:
    """A camera that pans along the wall, from somewhere, perhaps mirrored; or sees another wall."""

    mask = None

    def __init__(self, name: str, start: int, *, mirrored: bool = False, upside_down: bool = False) -> None:
        self.name, self._start, self._mirrored, self._turned = name, start, mirrored, upside_down

    def read(self, frames: np.ndarray, *, colour: bool) -> Iterator[tuple[int, np.ndarray]]:
        assert colour
        for frame in map(int, frames):
            left = self._start + 60 * frame
            image = WALL[:, left : left + 640]
            image = image[:, ::-1] if self._mirrored else image
            yield (
                frame,
                np.repeat((image[::-1, ::-1] if self._turned else image)[..., None], 3, axis=2).copy(),
            )


def _left(tmp_path: Path, *cameras: _Pan) -> list[str]:
    """Names of the cameras that are not left out."""
    with pycolmap.Database.open(str(tmp_path / DATABASE_NAME)) as database:
        lens = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[420.0, 420.0, 320.0, 240.0])
        ids = [database.write_camera(lens) for _ in cameras]
        for each in ids:
            rig = pycolmap.Rig()
            rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, each))
            database.write_rig(rig)
    wanted = [
        (cast(CaptureCamera, camera), number, FRAMES) for camera, number in zip(cameras, ids, strict=True)
    ]
    add_keyframes(tmp_path, wanted, MapOptions(), StageContext(work_dir=tmp_path, threads=1))
    chosen: list[Any] = [SimpleNamespace(camera=camera.name, frames=FRAMES) for camera in cameras]
    return [item.camera for item in without_mirrored(tmp_path, cast(list[KeyframeSelection], chosen))]


def test_descriptors_of_a_mirrored_picture_are_known_without_it() -> None:
    sift = cv2.SIFT_create(500)
    image = WALL[:, :640]

    def found(picture: np.ndarray, *, mirrored: bool) -> np.ndarray:
        points, raw = sift.detectAndCompute(picture, None)
        rooted = 512 * np.sqrt(raw / raw.sum(axis=1, keepdims=True))
        bytes_ = rooted.round().clip(0, 255).astype(np.uint8)
        shape = np.array([(*each.pt, each.size, each.angle) for each in points], np.float32)
        return largest(flipped(bytes_) if mirrored else bytes_, shape)

    there = found(np.ascontiguousarray(image[:, ::-1]), mirrored=False)
    # Nearly all of 128; features found on one side only and those with two directions are lost.
    assert clear_matches(found(image, mirrored=True), there[None])[0] > 90
    assert clear_matches(found(image, mirrored=False), there[None])[0] < 15


def test_the_mirrored_one_of_three_is_left_out(tmp_path: Path) -> None:
    cameras = _Pan("head", 300), _Pan("left", 0, mirrored=True), _Pan("torso", 150, upside_down=True)
    assert _left(tmp_path, *cameras) == ["head", "torso"]
    assert "camera left shows the room mirrored" in mirror_note("left")


def test_cameras_that_see_the_same_way_round_are_kept(tmp_path: Path) -> None:
    assert _left(tmp_path, _Pan("head", 300), _Pan("left", 0), _Pan("torso", 150)) == [
        "head",
        "left",
        "torso",
    ]


def test_which_of_two_is_mirrored_cannot_be_told(tmp_path: Path) -> None:
    with pytest.raises(EstimationError, match="left and torso see mirror images of each other"):
        _left(tmp_path, _Pan("left", 0, mirrored=True), _Pan("torso", 150))
