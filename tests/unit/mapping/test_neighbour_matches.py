"""Keyframes get as many features, and neighbours as near, as their matching needs."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pytest

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core import mechanisms
from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping.matching.neighbour_matches import MORE_FEATURES, features_for_neighbours
from bodycap_batch.model.camera import Camera

WIDTH, HEIGHT, FRAMES, COUNT = 480, 360, 25, 128
LENS = Camera(
    model="PINHOLE", width_px=WIDTH, height_px=HEIGHT, params=np.array([400.0, 400.0, WIDTH / 2, HEIGHT / 2])
)


class Pan:
    """A camera that moves along a textured wall by a constant number of pixels a frame."""

    name, shows_only_room, camera, calibrated = "torso", True, LENS, True

    def __init__(self, step_px: float, *, plain: bool = False) -> None:
        self.step_px = step_px
        self.read_frames: list[int] = []
        noise = np.random.default_rng(4).uniform(0, 255, (120, 1000)).astype(np.float32)
        self.wall = cv2.resize(noise, (4000, 480), interpolation=cv2.INTER_CUBIC).clip(0, 255)
        if plain:
            self.wall[:] = 128.0

    def is_unmasked(self, px: np.ndarray, frame: int | None = None) -> np.ndarray:
        return np.ones(len(px), dtype=bool)

    def read(self, frames: np.ndarray, *, colour: bool) -> Any:
        assert colour
        for frame in frames.tolist():
            self.read_frames.append(frame)
            moved = np.array([[1.0, 0.0, -self.step_px * frame], [0.0, 1.0, -20.0]])
            grey = cv2.warpAffine(self.wall, moved, (WIDTH, HEIGHT)).astype(np.uint8)
            yield frame, np.repeat(grey[:, :, None], 3, axis=2)


def found(camera: Pan, folder: Path, keyframes: list[int]) -> dict[int, int]:
    """Return the number of features of each keyframe."""
    sharpness = np.ones(FRAMES)
    sharpness[11] = 2.0
    sharpness[12] = np.nan
    context = StageContext(work_dir=folder, threads=1)
    features = features_for_neighbours(
        cast(CaptureCamera, camera), np.array(keyframes), sharpness, COUNT, context
    )
    return {frame: len(each.keypoints) for frame, each in features.items()}


def test_neighbours_with_many_matches_are_left_alone(tmp_path: Path) -> None:
    camera = Pan(1.0)
    assert max(found(camera, tmp_path, [0, 12, 24]).values()) <= COUNT
    assert camera.read_frames == [0, 12, 24]


def test_neighbours_with_few_matches_get_more_features_and_a_frame_between_them(tmp_path: Path) -> None:
    camera = Pan(18.0)
    counts = found(camera, tmp_path, [0, 24])
    assert next(iter(counts)) == 0
    assert list(counts)[-1] == 24
    assert 11 in counts, "the sharpest frame of the middle third that can be a keyframe"
    assert 12 not in counts
    assert counts[0] > COUNT
    assert max(counts.values()) <= MORE_FEATURES * COUNT
    assert list(counts) == sorted(counts)


def test_a_plain_wall_does_not_get_more_keyframes(tmp_path: Path) -> None:
    camera = Pan(18.0, plain=True)
    assert found(camera, tmp_path, [0, 24]) == {0: 0, 24: 0}
    assert camera.read_frames == [0, 24]


@pytest.mark.parametrize("step_px", [18.0])
def test_nothing_is_added_if_the_mechanism_is_switched_off(step_px: float, tmp_path: Path) -> None:
    mechanisms.begin_task({mechanisms.KEY_OPTION: ["neighbour_matches"]})
    try:
        camera = Pan(step_px)
        assert max(found(camera, tmp_path, [0, 24]).values()) <= COUNT
    finally:
        mechanisms.begin_task({})
    assert camera.read_frames == [0, 24]


def test_the_search_can_be_stopped(tmp_path: Path) -> None:
    context = SimpleNamespace(threads=1, progress=lambda *_: None, check_cancelled=_stop)
    with pytest.raises(KeyboardInterrupt):
        features_for_neighbours(
            cast(CaptureCamera, Pan(18.0)), np.array([0, 24]), np.ones(FRAMES), COUNT, cast(Any, context)
        )


def _stop() -> None:
    raise KeyboardInterrupt
