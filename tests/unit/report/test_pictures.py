"""The series of pictures on the page: a short video is decoded once, a long one is first looked at."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.capture import KeptFrames
from bodycap_batch.core.context import StageContext
from bodycap_batch.report.pictures import _LARGEST, series


class Film:
    """Three seconds of noise at 30 frames a second; counts how often it is read."""

    def __init__(self, levels: int = 64, kept: KeptFrames | None = None) -> None:
        self.levels = levels
        self.kept = kept
        self.frame_numbers = np.arange(90)
        self.nominal_fps = 30.0
        self.passes = 0

    def key_indices(self) -> np.ndarray:
        return np.array([0])

    def read(self, indices: np.ndarray, *, colour: bool) -> Iterator[tuple[int, np.ndarray]]:
        self.passes += 1
        for index in indices.tolist():
            rng = np.random.default_rng(index)
            yield index, rng.integers(0, self.levels, (240, 320, 3)).astype(np.uint8)


def test_pictures_that_fit_at_any_size_are_decoded_once(tmp_path: Path) -> None:
    times, context = np.arange(90) / 30.0, StageContext(work_dir=tmp_path)
    films: list[Any] = [Film(), Film(), Film()]
    # 1 + 5 a second for 2.97 s make 15 pictures
    roomy = series(films[0], times, 15 * 51_300, context)
    close = series(films[1], times, 15 * 51_000, context)
    tight = series(films[2], times, 15 * 10_000, context)
    assert [film.passes for film in films] == [1, 2, 2]
    assert len(roomy) == 15
    assert close == roomy
    assert 1 < len(tight) < 15
    assert sum(len(picture.jpeg) for picture in tight) < 15 * 10_000


def test_nothing_is_larger_than_noise_of_all_levels(tmp_path: Path) -> None:
    film: Any = Film(levels=256)
    context = StageContext(work_dir=tmp_path)
    noisy = series(film, np.arange(90) / 30.0, 15 * 60_000, context)
    assert 45_000 < max(len(picture.jpeg) for picture in noisy) < _LARGEST


def test_where_frames_are_kept_the_video_is_left_alone(tmp_path: Path) -> None:
    kept = KeptFrames(path=tmp_path, frames=np.arange(3, 90, 12), width_px=320, height_px=240, group=1)
    film: Any = Film(kept=kept)
    found = series(film, np.arange(90) / 30.0, 15 * 60_000, StageContext(work_dir=tmp_path))
    assert [picture.index for picture in found] == kept.frames.tolist()


def test_where_none_are_kept_for_long_the_video_is_read(tmp_path: Path) -> None:
    """As of a second chapter in another range."""
    kept = KeptFrames(path=tmp_path, frames=np.arange(3, 30, 6), width_px=320, height_px=240, group=1)
    film: Any = Film(kept=kept)
    found = series(film, np.arange(90) / 30.0, 15 * 60_000, StageContext(work_dir=tmp_path))
    assert {3, 15, 27} < {picture.index for picture in found}
    assert sum(picture.index > 57 for picture in found) == 5
    assert found[-1].index == 89
