"""The series of pictures on the page: a short video is decoded once, a long one is sampled first."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bodycap_batch.capture import KeptFrames
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.camera import Camera
from bodycap_batch.report.frame_pictures import MAX_JPEG_CHARACTERS, picture_series


class NoiseVideo:
    """A camera with three seconds of noise at 30 frames per second; it counts how often it is read."""

    def __init__(self, levels: int = 64, kept: KeptFrames | None = None) -> None:
        self.levels = levels
        self.kept = kept
        self.frame_numbers = np.arange(90)
        self.damaged = np.zeros(0, np.int64)
        self.nominal_fps = 30.0
        self.passes = 0
        params = np.array([300.0, 300.0, 160.0, 120.0])
        self.camera = Camera(model="PINHOLE", width_px=320, height_px=240, params=params)

    def is_unmasked(self, px: np.ndarray, frame: int) -> np.ndarray:
        """Return True but for the right half of frame 0."""
        return np.asarray((px[:, 0] < 160) | (frame > 0))

    def key_indices(self) -> np.ndarray:
        return np.array([0])

    def read(self, indices: np.ndarray, *, colour: bool) -> Iterator[tuple[int, np.ndarray]]:
        self.passes += 1
        for index in indices.tolist():
            rng = np.random.default_rng(index)
            yield index, rng.integers(0, self.levels, (240, 320, 3)).astype(np.uint8)


def test_pictures_that_fit_at_any_size_are_decoded_once(tmp_path: Path) -> None:
    times, context = np.arange(90) / 30.0, StageContext(work_dir=tmp_path)
    videos: list[Any] = [NoiseVideo(), NoiseVideo(), NoiseVideo()]
    # 1 + 5 pictures per second for 2.97 s are 15 pictures.
    large_budget = picture_series(videos[0], times, 15 * 51_300, context)
    medium_budget = picture_series(videos[1], times, 15 * 51_000, context)
    small_budget = picture_series(videos[2], times, 15 * 10_000, context)
    assert [video.passes for video in videos] == [1, 2, 2]
    assert len(large_budget) == 15
    assert medium_budget == large_budget
    assert 1 < len(small_budget) < 15
    assert sum(len(picture.jpeg) for picture in small_budget) < 15 * 10_000


def test_no_picture_of_noise_exceeds_the_assumed_size(tmp_path: Path) -> None:
    video: Any = NoiseVideo(levels=256)
    context = StageContext(work_dir=tmp_path)
    noisy = picture_series(video, np.arange(90) / 30.0, 15 * 60_000, context)
    assert 45_000 < max(len(picture.jpeg) for picture in noisy) < MAX_JPEG_CHARACTERS


def test_kept_frames_are_used_instead_of_the_video(tmp_path: Path) -> None:
    kept = KeptFrames(path=tmp_path, frames=np.arange(3, 90, 12), width_px=320, height_px=240, group=1)
    video: Any = NoiseVideo(kept=kept)
    found = picture_series(video, np.arange(90) / 30.0, 15 * 60_000, StageContext(work_dir=tmp_path))
    assert [picture.index for picture in found] == kept.frames.tolist()


def test_the_video_is_read_where_no_frames_are_kept(tmp_path: Path) -> None:
    """No frames of the second half are kept, as with a second chapter that is outside their range."""
    kept = KeptFrames(path=tmp_path, frames=np.arange(3, 30, 6), width_px=320, height_px=240, group=1)
    video: Any = NoiseVideo(kept=kept)
    found = picture_series(video, np.arange(90) / 30.0, 15 * 60_000, StageContext(work_dir=tmp_path))
    assert {3, 15, 27} < {picture.index for picture in found}
    assert sum(picture.index > 57 for picture in found) == 5
    assert found[-1].index == 89


def test_what_is_left_out_is_shaded(tmp_path: Path) -> None:
    video: Any = NoiseVideo(levels=256)
    found = picture_series(video, np.arange(90) / 30.0, 15 * 60_000, StageContext(work_dir=tmp_path))
    first, later = (
        np.asarray(cv2.imdecode(np.frombuffer(base64.b64decode(each.jpeg), np.uint8), cv2.IMREAD_COLOR))
        for each in (found[0], found[1])
    )
    shade = first[:, 170:].reshape(-1, 3).mean(axis=0)
    assert shade[1] < 0.7 * min(shade[0], shade[2])
    for room in (first[:, :150], later):
        mean = room.reshape(-1, 3).mean(axis=0)
        assert np.ptp(mean) < 0.1 * mean.mean()
