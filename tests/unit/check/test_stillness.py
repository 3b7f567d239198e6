"""Static pictures are found in spite of sensor noise; moving pictures give no note."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.capture import open_capture
from bodycap_batch.check import CheckReport, check_path, picture_quality
from bodycap_batch.check.picture_quality import sample_indices
from bodycap_batch.config.job import load_job
from bodycap_batch.core.errors import EstimationError
from tests.videos import Image, textured_frame, write_video

RNG = np.random.default_rng(3)
ROOM = np.kron(RNG.integers(60, 200, (30, 60)), np.ones((8, 8)))
COUNT = 80


def _moving(index: int) -> Image:
    return ROOM[:, 4 * index : 4 * index + 160].astype(np.uint8)


def _still(index: int) -> Image:
    light = 1.0 + 0.2 * np.sin(0.2 * index)
    return np.clip(light * ROOM[:, :160] + RNG.normal(0, 4, (240, 160)), 0, 255).astype(np.uint8)


def _notes(
    root: Path, picture: Callable[[int], Image], gop: int, *, count: int = COUNT, fps: int = 30
) -> list[str]:
    frames = [picture(index) for index in range(count)]
    write_video(root / "left_palm.mp4", frames, gop=gop, fps=fps, bframes=gop < count)
    (camera,) = check_path(root).cameras
    return [note for note in camera.notes if "does not change" in note]


@pytest.mark.parametrize("gop", [8, 1000])
def test_a_camera_on_a_table_is_reported_and_a_moving_one_is_not(tmp_path: Path, gop: int) -> None:
    (note,) = _notes(tmp_path / "table", _still, gop)
    assert "in the whole video" in note
    assert not _notes(tmp_path / "worn", _moving, gop)


def _two_cameras(root: Path, torso: Callable[[int], Image], palm: Callable[[int], Image]) -> CheckReport:
    for name, picture in (("torso", torso), ("left_palm", palm)):
        write_video(root / f"{name}.mp4", [picture(index) for index in range(COUNT)], gop=8)
    return check_path(root)


def test_a_capture_in_which_no_camera_moves_is_refused(tmp_path: Path) -> None:
    # One recording is frozen, the other one is live, with sensor noise.
    report = _two_cameras(tmp_path / "still", lambda index: ROOM[:, 160:320].astype(np.uint8), _still)
    (error,) = report.errors
    assert report.exit_code == EstimationError.exit_code
    assert "no camera moves: the pictures of all 2 cameras stand still" in error.message
    assert error.hint is not None
    assert "freeze" in error.hint
    assert _two_cameras(tmp_path / "worn", _still, _moving).ready


def test_a_person_who_stands_for_most_of_the_time_is_not_refused(tmp_path: Path) -> None:
    def standing(index: int) -> Image:
        return _moving(0) if index % 10 < 6 else _moving(index % 10 - 5)

    assert _two_cameras(tmp_path, standing, lambda index: standing(index)[::-1]).ready


def test_a_movement_between_the_inspected_pictures_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(picture_quality, "_SAMPLES", 5)

    def waving(index: int) -> Image:
        return _moving(6) if 24 < index < 32 else _still(0)

    report = _two_cameras(tmp_path, waving, waving)
    assert all(camera.is_static for camera in report.cameras)
    assert report.ready


def test_the_time_of_the_static_part_is_reported(tmp_path: Path) -> None:
    def stopping(index: int) -> Image:
        return _moving(index) if index < 35 else _still(index)

    (note,) = _notes(tmp_path / "seconds", stopping, 8, fps=10)
    assert "from about 4.8 to 7.9 s (5 pictures" in note
    # The same pictures in a third of the time show a person who waits for a second.
    assert not _notes(tmp_path / "moment", stopping, 8)


def test_the_part_after_the_inspected_pictures_gives_no_note(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As with large pictures, few frames are decoded after a key frame.
    monkeypatch.setattr(picture_quality, "_MAX_DECODED_FRAMES", 25)
    assert not _notes(tmp_path / "ready", lambda index: _moving(max(0, index - 30)), 1000)
    assert not _notes(tmp_path / "slow", lambda index: _wide(0.25 * index), 40)


def _wide(left: float) -> Image:
    whole, part = divmod(left, 1.0)
    first, second = (ROOM[:, int(whole) + step : int(whole) + step + 160] for step in (0, 1))
    return np.round((1.0 - part) * first + part * second).astype(np.uint8)


def test_a_short_clip_is_not_static(tmp_path: Path) -> None:
    assert not _notes(tmp_path / "moving", lambda index: _wide(0.5 * index), 30, count=9)
    assert not _notes(tmp_path / "still", _still, 30, count=9)


def test_black_pictures_are_not_static(tmp_path: Path) -> None:
    black = np.full((240, 160), 16, np.uint8)
    assert not _notes(tmp_path, lambda index: black if index > 20 else _moving(index), 8)


def test_frames_between_rare_key_frames_are_sampled(tmp_path: Path) -> None:
    def samples(name: str, *, gop: int, size: tuple[int, int] = (64, 48)) -> list[int]:
        frames = [textured_frame(index % 40, *size) for index in range(75)]
        write_video(tmp_path / name / "torso.mp4", frames, gop=gop, bframes=False)
        return sample_indices(open_capture(load_job(tmp_path / name).capture).cameras[0], 8).tolist()

    assert samples("single", gop=1000) == [0, 11, 21, 32, 42, 53, 63, 74]
    # Four times the pixels of 640 by 480: a quarter of 250 frames.
    assert samples("large", gop=1000, size=(1280, 960)) == [0, 9, 18, 27, 35, 44, 53, 62]
    assert samples("two", gop=40) == [0, 13, 26, 39, 40, 51, 63, 74]
