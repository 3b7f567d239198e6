"""Render the preview film, image by image."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bodycap_batch.capture import Capture
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.formats.atomic_files import atomic_replacement
from bodycap_batch.formats.mp4_writer import VideoWriter
from bodycap_batch.formats.palette import camera_colours
from bodycap_batch.model.frame_choice import nearest_frames
from bodycap_batch.overlay import BoneMotion, CameraView, RgbImage
from bodycap_batch.preview.labels import AMBER, GREY, draw_text, shorten_to_width
from bodycap_batch.preview.layout import HEIGHT, ROOM_WIDTH, WIDTH, lay_out_videos
from bodycap_batch.preview.preview_timeline import PreviewTimeline, make_timeline
from bodycap_batch.preview.room_drawing import (
    GRID_COLOUR,
    ColouredPoints,
    blank_image,
    draw_body,
    draw_camera,
    draw_lines,
    draw_path,
    draw_points,
    floor_grid,
)
from bodycap_batch.preview.tiles import WORLD, VideoTile, draw_tile
from bodycap_batch.preview.viewpoint import Viewpoint, follow_target

_BODY_RADIUS_M = 1.05
"""Metres: radius of the region around the middle of the body that must be visible. This region includes the
head, and the hand of a stretched arm."""
_PATH_PIECES = 1500
"""Minimum number of straight pieces in the drawing of a long camera path. The maximum number is about twice
as large. Evidence: none."""
_MAX_CLOCK_S = 1e8
"""Seconds: maximum common time that the caption shows unchanged. A larger time comes from a clock that counts
from 1970. The caption shows such a time relative to the start."""
_STROKE_LEGEND = "solid lines: measured · dashed lines: inferred"
_DOT_LEGEND = "dots: map points, green if they agree with the pose, else red"


@dataclass(frozen=True, slots=True, kw_only=True)
class PreviewInputs:
    """Everything that the preview shows, and the file to write.

    Attributes:
        path: The file to write.
        capture: The videos.
        views: Poses and observations of each camera.
        reference_frame: Frame of reference of the room: "world", or the gauge of a map.
        points: (P,3) points of the room in that frame of reference.
        colours: (P,3) uint8 RGB colours of the points.
        bone_motion: The solved motion; None if there is none.
        note: Reason why there is no body although the job requires one; "" otherwise.
    """

    path: Path
    capture: Capture
    views: tuple[CameraView, ...]
    reference_frame: str
    points: FloatArray
    colours: RgbImage
    bone_motion: BoneMotion | None = None
    note: str = ""


def render_preview(inputs: PreviewInputs, context: StageContext) -> Path:
    """Write the preview, 1280×720, and return its path.

    The preview is at most `MAX_SECONDS` long. A long capture is shown with evenly spaced frames. If
    necessary, the preview is played faster than the capture was filmed.

    Raises:
        CaptureError: A frame cannot be decoded.
        StoreError: The file cannot be written.
    """
    timeline = _choose_timeline(inputs)
    tiles = make_tiles(inputs, timeline)
    room = _RoomView.build(inputs, timeline, tiles)
    count = len(timeline.times_ns)
    background = blank_image((WIDTH, HEIGHT))
    with ExitStack() as stack:
        streams = [stack.enter_context(closing(tile.images())) for tile in tiles]
        temporary = stack.enter_context(atomic_replacement(inputs.path))
        video = stack.enter_context(VideoWriter(temporary, float(timeline.fps), (WIDTH, HEIGHT), "small"))
        add = stack.enter_context(_encoder(video, context.threads))
        for index, now in enumerate(timeline.times_ns.tolist()):
            context.check_cancelled()
            if index % 15 == 0:
                context.progress(index, count, "pictures")
            image = background.copy()
            room.draw(image[:, :ROOM_WIDTH], index, now)
            for tile, stream in zip(tiles, streams, strict=True):
                draw_tile(image, tile, next(stream), int(tile.frames[index]), inputs.bone_motion)
            _draw_captions(image, inputs, timeline, index)
            add(image)
    context.progress(count, count, "")
    return inputs.path


@contextmanager
def _encoder(video: VideoWriter, threads: int) -> Iterator[Callable[[RgbImage], None]]:
    """Yield the function that encodes an image.

    With more than one thread, an image is encoded while the next image is drawn.
    """
    if threads == 1:
        yield video.add
        return
    # The encoder releases the interpreter's lock, so a thread is sufficient; no process is needed.
    with ThreadPoolExecutor(max_workers=1) as pool:
        encoding: Future[None] | None = None

        def add(image: RgbImage) -> None:
            nonlocal encoding
            if encoding is not None:
                encoding.result()
            encoding = pool.submit(video.add, image)

        yield add
        if encoding is not None:
            encoding.result()


def _choose_timeline(inputs: PreviewInputs) -> PreviewTimeline:
    """Return the timeline of the motion, or the timeline of the videos if there is no motion."""
    if inputs.bone_motion is not None and len(inputs.bone_motion.times_ns) > 1:
        times = inputs.bone_motion.times_ns
        fps = 1e9 * (len(times) - 1) / float(times[-1] - times[0])
        return make_timeline(int(times[0]), int(times[-1]), fps)
    cameras = [camera for camera in inputs.capture.cameras if len(camera.times_ns)]
    camera_times = [camera.common_times_ns() for camera in cameras]
    fps = float(np.median([camera.nominal_fps for camera in cameras]))
    return make_timeline(
        int(min(times[0] for times in camera_times)), int(max(times[-1] for times in camera_times)), fps
    )


def make_tiles(inputs: PreviewInputs, timeline: PreviewTimeline) -> list[VideoTile]:
    """Return a tile for each camera, with its position in the image and its colour."""
    views = {view.camera: view for view in inputs.views}
    cameras = inputs.capture.cameras
    colours = camera_colours(camera.name for camera in cameras)
    boxes = lay_out_videos([camera.camera.width_px / camera.camera.height_px for camera in cameras])
    return [
        VideoTile(
            camera=camera,
            view=views.get(camera.name),
            frames=nearest_frames(camera.common_times_ns(), timeline.times_ns, camera.nominal_fps),
            video_box=video_box,
            label_box=label_box,
            colour=colours[camera.name],
        )
        for camera, (video_box, label_box) in zip(cameras, boxes, strict=True)
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class _RoomView:
    """Draws the room. Holds the constant content and the viewpoint of each frame of the preview."""

    cloud: ColouredPoints
    grid: FloatArray | None
    tiles: tuple[VideoTile, ...]
    viewpoints: list[Viewpoint]
    bone_motion: BoneMotion | None
    camera_size: float

    @staticmethod
    def build(inputs: PreviewInputs, timeline: PreviewTimeline, tiles: Sequence[VideoTile]) -> _RoomView:
        tiles_in_room = tuple(
            tile
            for tile in tiles
            if tile.view is not None and tile.view.reference_frame == inputs.reference_frame
        )
        poses = [tile.view.frame_from_cam for tile in tiles_in_room if tile.view is not None]
        all_poses = np.concatenate(poses) if poses else np.zeros((0, 4, 4))
        all_poses = all_poses[np.isfinite(all_poses).all(axis=(1, 2))]
        upright_from_room = np.eye(4)
        if inputs.reference_frame != WORLD:
            upright_from_room[:3, :3] = _rotation_to_z_up(all_poses)
        rotation = upright_from_room[:3, :3]
        target, reach = _find_target(inputs.bone_motion, timeline, all_poses[:, :3, 3] @ rotation.T)
        seconds = np.arange(len(target)) / float(timeline.fps)
        cloud = ColouredPoints(points=inputs.points, colours=inputs.colours).thinned()
        viewpoints = follow_target(target, seconds, (ROOM_WIDTH, HEIGHT), reach, cloud.points @ rotation.T)
        return _RoomView(
            cloud=cloud,
            grid=floor_grid(target) if inputs.bone_motion is not None else None,
            tiles=tiles_in_room,
            viewpoints=[
                replace(view, cam_from_room=view.cam_from_room @ upright_from_room) for view in viewpoints
            ],
            bone_motion=inputs.bone_motion,
            camera_size=0.1 * reach,
        )

    def draw(self, image: RgbImage, index: int, now_ns: int) -> None:
        """Draw the room at one common time into the left part of the preview's image."""
        view = self.viewpoints[index]
        if self.grid is not None:
            draw_lines(image, view, self.grid, GRID_COLOUR)
        draw_points(image, view, self.cloud)
        for tile in self.tiles:
            poses, frame = tile.poses(), int(tile.frames[index])
            stride = max(1, len(poses) // _PATH_PIECES)
            draw_path(image, view, poses[: frame + 1 : stride, :3, 3], tile.colour)
            if frame >= 0 and np.isfinite(poses[frame]).all():
                draw_camera(image, view, poses[frame], self.camera_size, tile.colour)
        bones = None if self.bone_motion is None else self.bone_motion.bones_at(now_ns)
        if bones is not None and self.bone_motion is not None:
            draw_body(image, view, bones, self.bone_motion.sides)


def _rotation_to_z_up(poses: FloatArray) -> FloatArray:
    """Return the rotation (3,3) that rotates the mean upward direction of the images to the Z axis.

    Args:
        poses: (N,4,4) camera poses.
    """
    up = -poses[:, :3, 1].sum(axis=0)
    length = np.linalg.norm(up)
    if length < 1e-9:
        return np.eye(3)
    z = up / length
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def _find_target(
    bone_motion: BoneMotion | None, timeline: PreviewTimeline, centres: FloatArray
) -> tuple[FloatArray, float]:
    """Return the position (F,3) to look at in each frame, and the radius around it that must be visible.

    Args:
        bone_motion: The solved motion; None if there is none.
        timeline: Times of the preview's frames.
        centres: (N,3) camera centres. They determine the result if there is no motion.
    """
    if bone_motion is not None and len(bone_motion.times_ns):
        ends = bone_motion.ends_in_world
        middle = 0.5 * (ends.min(axis=(1, 2)) + ends.max(axis=(1, 2)))
        target = [np.interp(timeline.times_ns, bone_motion.times_ns, middle[:, axis]) for axis in range(3)]
        return np.stack(target, axis=1), _BODY_RADIUS_M
    if not len(centres):
        return np.zeros((len(timeline.times_ns), 3)), 1.0
    low, high = np.percentile(centres, [2, 98], axis=0)
    radius = 0.7 * float(np.linalg.norm(high - low)) or 1.0
    return np.tile(0.5 * (low + high), (len(timeline.times_ns), 1)), radius


def _draw_captions(image: RgbImage, inputs: PreviewInputs, timeline: PreviewTimeline, index: int) -> None:
    """Draw the time, the speed and the note above the room, and the legend below it."""
    seconds = timeline.times_ns[index] * 1e-9
    since_start = seconds - timeline.times_ns[0] * 1e-9
    clock = f"+{since_start:.2f} s" if seconds > _MAX_CLOCK_S else f"{seconds:.2f} s"
    speed = "" if timeline.speed <= 1.001 else f"   shown {timeline.speed:.1f}× faster"
    clock_end = draw_text(image, clock, (14, 30), size=20)
    draw_text(image, speed, (clock_end, 30), GREY, 16)
    if inputs.note:
        draw_text(image, shorten_to_width(inputs.note, ROOM_WIDTH - 28), (14, 52), AMBER)
    legend = [_STROKE_LEGEND, _DOT_LEGEND] if inputs.bone_motion is not None else [_DOT_LEGEND]
    draw_text(image, shorten_to_width(" · ".join(legend), ROOM_WIDTH - 28, 13), (14, HEIGHT - 12), GREY, 13)
