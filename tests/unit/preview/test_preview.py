"""The times that the preview shows, the layout of its parts, and the view of the room."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.capture import open_capture
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.formats.mp4_writer import yuv420_from_rgb
from bodycap_batch.model.scene import FrameStatus
from bodycap_batch.overlay import ObservedPoints
from bodycap_batch.preview.layout import HEIGHT, ROOM_WIDTH, WIDTH, Box, lay_out_videos
from bodycap_batch.preview.preview_timeline import MAX_FRAMES, make_timeline
from bodycap_batch.preview.room_drawing import (
    BACKGROUND,
    ColouredPoints,
    blank_image,
    draw_lines,
    draw_points,
    floor_grid,
)
from bodycap_batch.preview.tiles import describe_status, resize_image
from bodycap_batch.preview.viewpoint import Viewpoint, follow_target
from bodycap_batch.tasks.preview import _trunk_first
from tests.bodies import merged, reaching
from tests.videos import textured_frame, write_video

SECOND = 1_000_000_000


@pytest.mark.parametrize(
    ("seconds", "fps", "shown_fps", "speed"),
    [
        (10.0, 30.0, 15.0, 1.0),
        (10.0, 20.0, 20.0, 1.0),
        (10.0, 24.0, 12.0, 1.0),
        (10.0, 120.0, 15.0, 1.0),
        (40.0, 30.0, 15.0, 1.0),
        (59.0, 29.97, 12.0, 1.2),  # every third frame: 9.99 per second, played at 12
        (59.0, 10.0, 10.0, 1.0),
        (70.0, 10.0, 10.0, 2.0),  # 701 frames would take 70 s: every second of them
        (600.0, 1.0, 1.0, 11.0),  # 601 frames, every eleventh of them
        (3600.0, 60.0, 12.0, 60.2),  # 216,001 frames, every 301st of them
    ],
)
def test_at_most_a_minute_is_shown_evenly_and_faster_only_if_necessary(
    seconds: float, fps: float, shown_fps: float, speed: float
) -> None:
    start = 5 * SECOND
    timeline = make_timeline(start, start + round(seconds * SECOND), fps)
    assert len(timeline.times_ns) <= MAX_FRAMES
    assert len(timeline.times_ns) / timeline.fps <= 60
    assert float(timeline.fps) == pytest.approx(shown_fps, rel=0.002)
    assert timeline.speed == pytest.approx(speed, rel=0.01)
    steps = np.diff(timeline.times_ns)
    assert np.ptp(steps) <= 1, "evenly spaced, to the nanosecond"
    assert timeline.times_ns[0] == start
    last = start + round(seconds * SECOND)
    assert last - steps[0] < timeline.times_ns[-1] <= last + 1


def test_a_single_time_is_one_frame() -> None:
    timeline = make_timeline(7, 7, 30.0)
    assert timeline.times_ns.tolist() == [7]
    assert timeline.fps == Fraction(15)


@pytest.mark.parametrize("count", [1, 2, 3, 5, 8, 11, 16])
@pytest.mark.parametrize("aspect", [16 / 9, 4 / 3, 9 / 16])
def test_videos_fit_next_to_the_room_without_overlap(count: int, aspect: float) -> None:
    boxes = [box for pair in lay_out_videos([aspect] * count) for box in pair]
    assert len(boxes) == 2 * count
    coverage = np.zeros((HEIGHT, WIDTH), dtype=int)
    for box in boxes:
        assert box.x >= ROOM_WIDTH
        assert box.x + box.width <= WIDTH
        assert 0 <= box.y <= box.y + box.height <= HEIGHT
        coverage[box.y : box.y + box.height, box.x : box.x + box.width] += 1
    assert coverage.max() == 1
    for picture in boxes[::2]:
        # Boxes have whole pixels, so width and height differ by less than one.
        assert abs(picture.width - aspect * picture.height) <= 1 + aspect


def test_the_trunks_video_is_first_and_that_of_a_camera_without_mount_last(tmp_path: Path) -> None:
    result, _ = merged(reaching(10))
    for name in ("a_camera_on_a_table", *(mount.camera for mount in result.mounts)):
        write_video(tmp_path / f"{name}.mp4", [textured_frame(index) for index in range(4)])
    cameras = tuple(CameraConfig(name=path.stem, video=(path,)) for path in sorted(tmp_path.glob("*.mp4")))
    capture = open_capture(CaptureConfig(cameras=cameras))
    names = [camera.name for camera in _trunk_first(capture, result).cameras]
    assert names[0] == next(mount.camera for mount in result.mounts if mount.role == "Spine1")
    assert names[-1] == "a_camera_on_a_table"
    assert _trunk_first(capture, None) is capture


def test_of_three_videos_one_is_large_above_two_small_ones() -> None:
    first, second, third = (picture for picture, _ in lay_out_videos([4 / 3] * 3))
    assert first.width > 1.9 * second.width
    assert second.y == third.y > first.y + first.height
    eleven = [picture for picture, _ in lay_out_videos([4 / 3] * 11)]
    assert eleven[0].width >= max(picture.width for picture in eleven), "the first is the largest"
    five = [picture for picture, _ in lay_out_videos([4 / 3] * 5)]
    assert min(picture.width for picture in five) > 200, "none is too small to read"
    assert five[0].width > 1.9 * five[1].width, "the first is the largest"
    assert lay_out_videos([]) == []
    assert isinstance(first, Box)


NO_POINTS = np.zeros((0, 3))


def walk(frames: int = 200) -> tuple[np.ndarray, np.ndarray]:
    seconds = np.arange(frames) / 30.0
    return np.stack([0 * seconds, -1.2 * seconds, 0 * seconds + 0.9], axis=1), seconds


def test_the_view_keeps_the_whole_walking_body_in_the_picture() -> None:
    target, seconds = walk()
    views = follow_target(target, seconds, (ROOM_WIDTH, HEIGHT), 1.05, NO_POINTS)
    for position, view in zip(target, views, strict=True):
        # Feet, head and both hands of a person 1.8 m high.
        body = position + np.array([[0, 0, -0.9], [0, 0, 0.9], [0.6, 0, 0.4], [-0.6, 0, 0.4]])
        px, depth = view.project(body)
        assert (depth > 0).all()
        assert (px >= 0).all()
        assert (px <= [ROOM_WIDTH, HEIGHT]).all()
        assert np.ptp(px[:, 1]) > 0.35 * HEIGHT, "large enough to judge"


def test_the_view_does_not_follow_the_steps_of_the_body() -> None:
    target, seconds = walk()
    with_steps = target + np.stack(
        [0 * seconds, 0 * seconds, 0.03 * np.sin(2 * np.pi * 1.8 * seconds)], axis=1
    )
    without_step_views = [
        view.cam_from_room for view in follow_target(target, seconds, (640, 640), 1.0, NO_POINTS)
    ]
    with_step_views = [
        view.cam_from_room for view in follow_target(with_steps, seconds, (640, 640), 1.0, NO_POINTS)
    ]
    middle = slice(60, -60)  # two seconds from the ends, where the Gaussian is not truncated
    moved = np.linalg.norm(
        np.array(without_step_views)[middle, :3, 3] - np.array(with_step_views)[middle, :3, 3], axis=1
    )
    # A Gaussian of 1 s keeps exp(-(2 pi 1.8)^2 / 2) of the steps, which is nothing. The distance may change.
    assert np.ptp(moved) < 1e-3


def is_in_front(room_points: np.ndarray) -> bool:
    """Return whether the viewpoint is in front of a body that faces -Y."""
    target, seconds = walk()
    view = follow_target(target, seconds, (640, 640), 1.0, room_points)[0]
    return bool(np.linalg.inv(view.cam_from_room)[1, 3] < target[0, 1])


def test_the_viewpoint_is_in_front_unless_the_room_is_not_behind_the_body() -> None:
    rng = np.random.default_rng(3)
    on_all_sides = rng.uniform(-6, 6, (2000, 3))
    assert is_in_front(NO_POINTS)
    assert is_in_front(on_all_sides)
    assert not is_in_front(on_all_sides - [0, 16.0, 0]), "all points are in front of the body"


def looking_down_z(distance: float = 4.0) -> Viewpoint:
    pose = np.eye(4)
    pose[2, 3] = distance
    return Viewpoint(size=(100, 80), focal_px=100.0, cam_from_room=pose, distance=distance)


def test_near_points_hide_far_ones_and_points_at_the_viewer_are_omitted() -> None:
    image = blank_image((100, 80))
    points = np.array([[0.0, 0, 0], [0, 0, 3.0], [0, 0, -3.5], [0, 0, -6.0]])
    colours = np.array([[250, 0, 0], [0, 250, 0], [0, 0, 250], [250, 250, 250]], dtype=np.uint8)
    draw_points(image, looking_down_z(), ColouredPoints(points=points, colours=colours))
    red, green, blue = image[40, 50].astype(int)
    assert red > 150
    assert max(green, blue) < 60


def test_large_clouds_are_thinned_evenly() -> None:
    cloud = ColouredPoints(
        points=np.arange(300_000).reshape(-1, 3) * 1.0, colours=np.zeros((100_000, 3), np.uint8)
    )
    thinned = cloud.thinned()
    assert len(thinned.points) == len(thinned.colours)
    assert 30_000 < len(thinned.points) <= 40_000
    assert np.ptp(np.diff(thinned.points[:, 0])) == 0


def test_the_floor_is_at_zero_and_extends_beyond_the_walk() -> None:
    grid = floor_grid(np.array([[0.0, 0.0, 0.9], [3.0, -4.0, 0.9]]))
    assert (grid[..., 2] == 0).all()
    assert grid[..., :2].min(axis=(0, 1)).tolist() == [-2, -6]
    assert grid[..., :2].max(axis=(0, 1)).tolist() == [5, 2]
    np.testing.assert_allclose(np.linalg.norm(np.diff(grid, axis=1), axis=-1), 1.0)


def test_lines_behind_the_viewer_are_not_drawn() -> None:
    image = blank_image((100, 80))
    draw_lines(image, looking_down_z(), np.array([[[0, 0, -9.0], [1, 0, -9.0]]]), (255, 255, 255))
    assert (image == BACKGROUND).all()
    draw_lines(image, looking_down_z(), np.array([[[-1, 0, 0.0], [1, 0, 0.0]]]), (255, 255, 255))
    assert image[40, 40:60].min() > 100


def test_images_have_the_colours_of_a_conversion_with_ffmpeg() -> None:
    import av

    rng = np.random.default_rng(0)
    colours = rng.integers(0, 256, (6, 8, 3), dtype=np.uint8)
    image = np.ascontiguousarray(colours.repeat(16, axis=0).repeat(16, axis=1))
    planes = yuv420_from_rgb(image)
    frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format="yuv420p")
    difference = np.abs(planes.astype(int) - frame.to_ndarray())
    assert difference[:96].max() <= 1  # rounding
    # Chroma is rounded twice, and at the borders of a block another filter mixes it.
    blocks = difference[96:].reshape(2, 6, 8, 8, 8)[:, :, 2:6, :, 2:6]
    assert blocks.max() <= 2


@pytest.mark.parametrize(
    ("status", "points", "says"),
    [
        (FrameStatus.REGISTERED, 3, "3 points, 0.5 px"),
        (FrameStatus.KEYFRAME, 3, "keyframe · 3 points, 0.5 px"),
        (FrameStatus.INERTIAL, 3, "pose from the inertial sensor"),
        (FrameStatus.KEYFRAME, 0, "keyframe"),
        (FrameStatus.REGISTERED, 0, "found again"),
    ],
)
def test_the_text_of_a_frame_describes_its_pose(status: FrameStatus, points: int, says: str) -> None:
    px = np.zeros((points, 2))
    seen = ObservedPoints(
        point=np.arange(points), px=px, observed_px=px, depth=np.ones(points), error_px=np.full(points, 0.5)
    )
    assert describe_status(status, seen)[0] == says


@pytest.mark.parametrize("size", [(572, 429), (286, 214), (641, 480), (90, 67), (600, 30), (2, 2)])
def test_a_resized_image_shows_the_whole_image(size: tuple[int, int]) -> None:
    ramp = np.linspace(0.0, 255.0, 640)[None, :, None] * np.ones((480, 1, 3))
    image = resize_image(np.round(ramp).astype(np.uint8), size)
    assert image.shape == (size[1], size[0], 3)
    # A pixel shows the middle of its share of the width, up to rounding and halves of odd widths.
    middle = (np.arange(size[0]) + 0.5) / size[0] * 640 - 0.5
    expected = np.interp(middle, np.arange(640), ramp[0, :, 0])
    assert np.abs(image.astype(float) - expected[None, :, None]).max() <= 255.0 / size[0] / 2 + 1.5


def test_a_reduced_image_does_not_alias() -> None:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (480, 640, 3)).astype(np.uint8)
    # One pixel is the mean of 2.24 by 2.24 pixels with 1 / 2.24 of their sigma; 0.6 allows for skipped ones.
    assert resize_image(noise, (286, 214)).std() < 0.6 * noise.std()
