"""Tracks of points, parts of the picture that are fixed to the camera, and the lens from tracks."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import cv2
import numpy as np
import pytest

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.capture.masks import without_regions
from bodycap_batch.core import mechanisms
from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.optical_flow import GreyImage
from bodycap_batch.model.point_tracks import PointTracks
from bodycap_batch.tasks.keyframes import regions_and_lens
from bodycap_batch.tracks import (
    PointTracker,
    find_fixed_regions,
    fixed_notes,
)

WIDTH, HEIGHT, FPS = 320, 240, 30


def room() -> GreyImage:
    """Return a large random texture, of which the pictures show a part."""
    noise = np.random.default_rng(3).uniform(0, 255, (90, 120)).astype(np.float32)
    return np.asarray(cv2.resize(noise, (960, 720), interpolation=cv2.INTER_CUBIC).clip(0, 255), np.uint8)


def picture(texture: GreyImage, shift: FloatArray) -> GreyImage:
    """Return the part of a texture that begins at a position (x, y), px."""
    moved = np.array([[1.0, 0.0, -shift[0]], [0.0, 1.0, -shift[1]]])
    return np.asarray(cv2.warpAffine(texture, moved, (WIDTH, HEIGHT)), np.uint8)


def with_hand(image: GreyImage) -> GreyImage:
    """Return a picture whose lower left quarter is a texture that is fixed to the camera."""
    hand = cv2.resize(
        np.random.default_rng(9).uniform(0, 255, (30, 40)).astype(np.float32), (WIDTH // 2, HEIGHT // 2)
    )
    out = image.copy()
    out[HEIGHT // 2 :, : WIDTH // 2] = hand.astype(np.uint8)
    return out


def path(count: int, directions: int) -> FloatArray:
    """Return positions (N,2), px, of a view that moves along one or two directions."""
    time = np.arange(count) / FPS
    x, y = 300 + 100 * np.sin(2 * np.pi * time), 240 + 80 * np.sin(2 * np.pi * time / 1.7)
    return np.column_stack([x, y if directions == 2 else np.full(count, 240.0)])


def tracked(images: list[GreyImage], mask: BoolArray | None = None) -> PointTracks:
    tracker = PointTracker(camera="palm", width_px=WIDTH, height_px=HEIGHT, mask=mask)
    for index, image in enumerate(images):
        tracker.add(index, image)
    return tracker.tracks(len(images))


def times(count: int) -> np.ndarray:
    return (np.arange(count) * 1e9 / FPS).astype(np.int64)


def test_points_follow_the_picture_to_a_tenth_of_a_pixel() -> None:
    texture, shifts = room(), path(20, 2)
    tracks = tracked([picture(texture, shift) for shift in shifts])
    _, first, last = tracks.between(2, 12)
    assert len(first) > 80
    error = last - first - (shifts[2] - shifts[12])
    # A random texture is tracked to some hundredths of a pixel a frame.
    assert np.median(np.linalg.norm(error, axis=1)) < 0.1


def test_points_are_followed_through_a_sudden_turn() -> None:
    texture = room()
    shifts = np.array([[300.0, 240.0]] * 3 + [[400.0, 240.0]] * 3)  # 100 px, a third of the picture
    tracks = tracked([picture(texture, shift) for shift in shifts])
    _, first, last = tracks.between(2, 3)
    assert len(first) > 40
    assert np.median(np.abs(last - first + [100.0, 0.0])) < 0.2


def test_masked_pixels_have_no_new_points() -> None:
    mask = np.ones((HEIGHT, WIDTH), dtype=bool)
    mask[:, : WIDTH // 2] = False
    tracks = tracked([picture(room(), np.array([300.0, 240.0]))], mask)
    assert len(tracks.px) > 50
    assert (tracks.px[:, 0] >= WIDTH // 2).all()


def test_a_hand_in_view_is_found_while_the_camera_turns() -> None:
    texture, count = room(), 90
    tracks = tracked([with_hand(picture(texture, shift)) for shift in path(count, 2)])
    regions = find_fixed_regions(tracks, times(count))
    rows, columns = regions.shape
    # No tracks begin at the border of the hand.
    assert regions[rows // 2 + 3 : rows - 1, 1 : columns // 2 - 6].mean() > 0.9
    assert regions[: rows // 2 - 2].mean() < 0.02
    assert "is left out" in fixed_notes("palm", regions)[0]
    mask = without_regions(None, regions, (WIDTH, HEIGHT))
    assert mask is not None
    assert not mask[HEIGHT - 30, 40]
    assert mask[20, 40]
    outside = tracks.outside(regions)
    _, px = outside.at(0)
    assert 0 < len(px) < len(tracks.at(0)[1])
    assert not ((px[:, 0] < WIDTH // 4) & (px[:, 1] > 3 * HEIGHT // 4)).any()


@pytest.mark.parametrize("directions", [1, 2])
def test_nothing_is_fixed_in_a_picture_of_the_room(directions: int) -> None:
    texture, count = room(), 90
    tracks = tracked([picture(texture, shift) for shift in path(count, directions)])
    regions = find_fixed_regions(tracks, times(count))
    assert not regions.any()
    assert fixed_notes("palm", regions) == []
    assert without_regions(None, regions, (WIDTH, HEIGHT)) is None


def test_a_thing_that_moves_in_front_of_a_still_camera_does_not_mask_the_room() -> None:
    still, thing, count = picture(room(), np.array([300.0, 240.0])), room()[:80, :80], 90
    images = []
    for x, y in (path(count, 2) - [300, 240]) * 0.6 + [120, 80]:
        image = still.copy()
        image[int(y) : int(y) + 80, int(x) : int(x) + 80] = thing
        images.append(image)
    assert not find_fixed_regions(tracked(images), times(count)).any()


def wrist_camera(count: int, read: list[int]) -> CaptureCamera:
    """Return a wrist camera with a hand in view; it records which frames are read."""
    texture, shifts = room(), path(count, 2)

    def read_decodable(indices: np.ndarray) -> Generator[tuple[int, GreyImage], None, None]:
        for index in indices.tolist():
            read.append(index)
            yield index, with_hand(picture(texture, shifts[index]))

    lens = Camera(
        model="SIMPLE_RADIAL",
        width_px=WIDTH,
        height_px=HEIGHT,
        params=np.array([250.0, WIDTH / 2, HEIGHT / 2, 0.0]),
    )
    camera = SimpleNamespace(
        name="palm", camera=lens, mask=None, times_ns=times(count), read_decodable=read_decodable
    )
    return cast(CaptureCamera, camera)


def test_the_hand_of_a_wrist_camera_is_found_in_the_whole_video(tmp_path: Path) -> None:
    read: list[int] = []
    shown = regions_and_lens(wrist_camera(90, read), StageContext(work_dir=tmp_path))
    regions, lens = shown.fixed, shown.lens
    assert lens is None, "the lens is given"
    assert read == list(range(90))
    assert regions[regions.shape[0] // 2 + 3 : -1, 1 : regions.shape[1] // 2 - 6].mean() > 0.9


@pytest.mark.parametrize("count", [0, 1])
def test_a_video_of_fewer_than_two_frames_shows_neither_regions_nor_a_lens(
    count: int, tmp_path: Path
) -> None:
    camera = wrist_camera(count, [])
    camera.camera = replace(camera.camera, refine=True)  # type: ignore[misc]
    shown = regions_and_lens(camera, StageContext(work_dir=tmp_path))
    regions, moving, lens = shown.fixed, shown.moving, shown.lens
    assert not regions.any()
    assert not moving.size
    assert lens is None


def test_nothing_is_read_if_the_mechanisms_are_switched_off(tmp_path: Path) -> None:
    read: list[int] = []
    mechanisms.begin_task({mechanisms.KEY_OPTION: ["fixed_regions", "moving_regions"]})
    try:
        shown = regions_and_lens(wrist_camera(90, read), StageContext(work_dir=tmp_path))
        regions, moving, lens = shown.fixed, shown.moving, shown.lens
        assert not regions.any()
        assert not moving.size
        assert lens is None
    finally:
        mechanisms.begin_task({})
    assert read == []
