"""SIFT features of keyframes: position, order, independence of the number of threads."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import pytest

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping.matching import sift
from bodycap_batch.mapping.matching.sift import SiftFeatures, extract_features

_CENTRES = np.array([(x, y) for y in range(40, 460, 70) for x in range(45, 620, 80)], dtype=np.float64)


class _Blobs:
    """A camera with dark blobs at whole pixels; each frame is shifted by one pixel more."""

    def __init__(self, hidden_left_px: float = 0.0) -> None:
        self._hidden = hidden_left_px
        self.mask = None if not hidden_left_px else np.arange(640) >= np.full((480, 1), hidden_left_px)
        self.shows_only_room = self.mask is None

    def is_unmasked(self, px: np.ndarray, frame: int | None = None) -> np.ndarray:
        return px[:, 0] >= self._hidden

    def read(self, frames: np.ndarray, *, colour: bool) -> Iterator[tuple[int, np.ndarray]]:
        assert colour
        for frame in map(int, frames):
            image = np.full((480, 640, 3), 200, np.uint8)
            for x, y in _CENTRES + frame:
                cv2.circle(image, (int(x), int(y)), 6, (20, 90, 160), -1, cv2.LINE_AA)
            yield frame, cv2.GaussianBlur(image, (0, 0), 2.0)


def _features(tmp_path: Path, frames: list[int], threads: int = 2, hidden: float = 0.0) -> list[SiftFeatures]:
    camera = cast(CaptureCamera, _Blobs(hidden))
    found: list[Any] = list(
        extract_features(camera, np.array(frames), 2048, StageContext(work_dir=tmp_path, threads=threads))
    )
    assert [frame for frame, _ in found] == frames
    return [item for _, item in found]


@pytest.mark.parametrize("frame", [0, 3])
def test_features_sit_on_the_blobs(tmp_path: Path, frame: int) -> None:
    (found,) = _features(tmp_path, [frame])
    true = _CENTRES + frame + 0.5  # OpenCV's pixel (0, 0) has its centre at (0.5, 0.5)
    away = np.linalg.norm(found.keypoints[None, :, :2] - true[:, None], axis=2)
    # A blob without noise is found to a tenth of a pixel of the reduced image.
    assert away.min(axis=1).max() < 0.25
    nearest = away.argmin(axis=1)
    assert np.abs(found.rgb[nearest].astype(int) - (20, 90, 160)).max() < 60
    assert np.abs(np.linalg.norm(found.descriptors.astype(float), axis=1) - 512).max() < 8


def test_threads_and_other_frames_change_nothing(tmp_path: Path) -> None:
    many = _features(tmp_path, list(range(8)), threads=3)
    for frame in (0, 5):
        (alone,) = _features(tmp_path, [frame], threads=1)
        assert (many[frame].keypoints == alone.keypoints).all()
        assert (many[frame].descriptors == alone.descriptors).all()


def test_nothing_is_found_under_a_mask(tmp_path: Path) -> None:
    (found,) = _features(tmp_path, [0], hidden=300.0)
    assert len(found.keypoints) > 0
    assert len(found.keypoints) == len(found.descriptors) == len(found.rgb)
    assert found.keypoints[:, 0].min() >= 300.0


def test_a_masked_picture_has_as_many_features_in_the_room_as_requested(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    noise = cv2.GaussianBlur(rng.normal(0.0, 1.0, (480, 640)), (0, 0), 4.0)
    # The hidden left half has three times the contrast, so it holds the strongest features of the picture.
    gain = np.where(np.arange(640) < 320, 120.0, 40.0)
    image = np.clip(128 + gain * noise / np.abs(noise).max(), 0, 255).astype(np.uint8)

    class Hand(_Blobs):
        def read(self, frames: np.ndarray, *, colour: bool) -> Iterator[tuple[int, np.ndarray]]:
            yield from ((int(frame), np.repeat(image[..., None], 3, axis=2)) for frame in frames)

    context = StageContext(work_dir=tmp_path)
    ((_, found),) = extract_features(cast(CaptureCamera, Hand(320.0)), np.array([0]), 400, context)
    assert found.keypoints[:, 0].min() >= 320.0
    assert 200 < len(found.keypoints) <= 400


@pytest.mark.parametrize(("contrast", "searched_again"), [(60, False), (14, True)])
def test_frames_with_few_features_are_searched_in_full_size(
    contrast: int, searched_again: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.normal(0.0, 1.0, (480, 640)), (0, 0), 2.5)
    image = np.clip(128 + contrast * noise / np.abs(noise).max(), 0, 255).astype(np.uint8)

    class Wall(_Blobs):
        def read(self, frames: np.ndarray, *, colour: bool) -> Iterator[tuple[int, np.ndarray]]:
            yield from ((int(frame), np.repeat(image[..., None], 3, axis=2)) for frame in frames)

    def features() -> SiftFeatures:
        context = StageContext(work_dir=tmp_path)
        ((_, found),) = extract_features(cast(CaptureCamera, Wall()), np.array([0]), 200, context)
        return found

    with_second_search = features()
    monkeypatch.setattr(sift, "_POOR_RATIO", 0.0)
    without = features()
    if searched_again:
        assert len(with_second_search.keypoints) > 2 * max(1, len(without.keypoints))
    else:
        assert np.array_equal(with_second_search.keypoints, without.keypoints)
