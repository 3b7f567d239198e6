"""The preview's pictures, one after the other."""

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
from bodycap_batch.formats.mp4 import VideoWriter
from bodycap_batch.formats.palette import camera_colours
from bodycap_batch.overlay import Body, CameraView
from bodycap_batch.preview import room
from bodycap_batch.preview.layout import HEIGHT, ROOM_WIDTH, WIDTH, place_videos
from bodycap_batch.preview.room import Cloud
from bodycap_batch.preview.text import AMBER, GREY, shortened, write
from bodycap_batch.preview.tiles import WORLD, Tile, draw_tile, frames_at
from bodycap_batch.preview.timeline import Timeline, make_timeline
from bodycap_batch.preview.viewpoint import Viewpoint, follow

_BODY_REACH_M = 1.05
"""From the hips to what has to be seen: head, and a hand stretched out."""
_PATH_PIECES = 1500
"""A path is drawn in at most about twice so many pieces, however long the video."""
_UNIX_S = 1e8
_STROKES = "solid: measured · dashed: inferred"
_DOTS = "dots: map points, green where they fit, red where not"


@dataclass(frozen=True, slots=True, kw_only=True)
class PreviewInputs:
    """All that the preview shows.

    Attributes:
        path: The file.
        capture: The videos.
        views: What each camera saw.
        frame: The room's frame of reference: "world", or a map's gauge.
        points: (P,3) the room in that frame.
        colours: (P,3) uint8 RGB.
        body: The solved motion; None where there is none.
        note: Why there is no body although one was asked for, or "".
    """

    path: Path
    capture: Capture
    views: tuple[CameraView, ...]
    frame: str
    points: FloatArray
    colours: room.Picture
    body: Body | None = None
    note: str = ""


def render_preview(inputs: PreviewInputs, context: StageContext) -> Path:
    """Write the preview, 1280×720, at most a minute long, and return its path.

    Beyond a minute the capture is shown faster, in evenly spaced pictures.

    Raises:
        CaptureError: A frame cannot be decoded.
        StoreError: The file cannot be written.
    """
    timeline = _timeline(inputs)
    tiles = film_tiles(inputs, timeline)
    stage = _Room.build(inputs, timeline, tiles)
    count = len(timeline.times_ns)
    empty = room.blank((WIDTH, HEIGHT))
    with ExitStack() as opened:
        streams = [opened.enter_context(closing(tile.images())) for tile in tiles]
        temporary = opened.enter_context(atomic_replacement(inputs.path))
        video = opened.enter_context(VideoWriter(temporary, float(timeline.fps), (WIDTH, HEIGHT), "small"))
        add = opened.enter_context(_encoder(video, context.threads))
        for index, now in enumerate(timeline.times_ns.tolist()):
            context.check_cancelled()
            if index % 15 == 0:
                context.progress(index, count, "pictures")
            image = empty.copy()
            stage.draw(image[:, :ROOM_WIDTH], index, now)
            for tile, stream in zip(tiles, streams, strict=True):
                draw_tile(image, tile, next(stream), int(tile.frames[index]), inputs.body)
            _write_lines(image, inputs, timeline, index)
            add(image)
    context.progress(count, count, "")
    return inputs.path


@contextmanager
def _encoder(video: VideoWriter, threads: int) -> Iterator[Callable[[room.Picture], None]]:
    """What takes the pictures; with a second thread the next one is drawn while one is encoded."""
    if threads == 1:
        yield video.add
        return
    # The encoder lets go of the interpreter.
    with ThreadPoolExecutor(max_workers=1) as pool:
        encoding: Future[None] | None = None

        def add(image: room.Picture) -> None:
            nonlocal encoding
            if encoding is not None:
                encoding.result()
            encoding = pool.submit(video.add, image)

        yield add
        if encoding is not None:
            encoding.result()


def _timeline(inputs: PreviewInputs) -> Timeline:
    """The motion's time where there is one, else that of the videos."""
    if inputs.body is not None and len(inputs.body.times_ns) > 1:
        times = inputs.body.times_ns
        fps = 1e9 * (len(times) - 1) / float(times[-1] - times[0])
        return make_timeline(int(times[0]), int(times[-1]), fps)
    cameras = [camera for camera in inputs.capture.cameras if len(camera.times_ns)]
    own = [camera.common_times_ns() for camera in cameras]
    fps = float(np.median([camera.nominal_fps for camera in cameras]))
    return make_timeline(int(min(each[0] for each in own)), int(max(each[-1] for each in own)), fps)


def film_tiles(inputs: PreviewInputs, timeline: Timeline) -> list[Tile]:
    """Every camera, where its video stands in the picture, and its colour."""
    views = {view.camera: view for view in inputs.views}
    cameras = inputs.capture.cameras
    colours = camera_colours(camera.name for camera in cameras)
    boxes = place_videos([camera.camera.width_px / camera.camera.height_px for camera in cameras])
    return [
        Tile(
            camera=camera,
            view=views.get(camera.name),
            frames=frames_at(camera, timeline.times_ns),
            picture=picture,
            bar=bar,
            colour=colours[camera.name],
        )
        for camera, (picture, bar) in zip(cameras, boxes, strict=True)
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Room:
    """What the view of the room needs for every picture."""

    cloud: Cloud
    grid: FloatArray | None
    tiles: tuple[Tile, ...]
    viewpoints: list[Viewpoint]
    body: Body | None
    camera_size: float

    @staticmethod
    def build(inputs: PreviewInputs, timeline: Timeline, tiles: Sequence[Tile]) -> _Room:
        placed = tuple(tile for tile in tiles if tile.view is not None and tile.view.frame == inputs.frame)
        poses = [tile.view.frame_from_cam for tile in placed if tile.view is not None]
        stacked = np.concatenate(poses) if poses else np.zeros((0, 4, 4))
        stacked = stacked[np.isfinite(stacked).all(axis=(1, 2))]
        upright = np.eye(4)
        if inputs.frame != WORLD:
            upright[:3, :3] = _upright(stacked)
        target, reach = _target(inputs.body, timeline, stacked[:, :3, 3] @ upright[:3, :3].T)
        seconds = np.arange(len(target)) / float(timeline.fps)
        cloud = Cloud(points=inputs.points, colours=inputs.colours).thinned()
        return _Room(
            cloud=cloud,
            grid=room.floor_grid(target) if inputs.body is not None else None,
            tiles=placed,
            viewpoints=[
                replace(each, cam_from_room=each.cam_from_room @ upright)
                for each in follow(
                    target, seconds, (ROOM_WIDTH, HEIGHT), reach, cloud.points @ upright[:3, :3].T
                )
            ],
            body=inputs.body,
            camera_size=0.1 * reach,
        )

    def draw(self, image: room.Picture, index: int, now: int) -> None:
        """Draw the room at one instant into an empty picture."""
        view = self.viewpoints[index]
        if self.grid is not None:
            room.draw_lines(image, view, self.grid, room.GRID)
        room.draw_cloud(image, view, self.cloud)
        for tile in self.tiles:
            poses, frame = tile.poses(), int(tile.frames[index])
            stride = max(1, len(poses) // _PATH_PIECES)
            room.draw_path(image, view, poses[: frame + 1 : stride, :3, 3], tile.colour)
            if frame >= 0 and np.isfinite(poses[frame]).all():
                room.draw_camera(image, view, poses[frame], self.camera_size, tile.colour)
        bones = None if self.body is None else self.body.at(now)
        if bones is not None and self.body is not None:
            room.draw_body(image, view, bones, self.body.side)


def _upright(poses: FloatArray) -> FloatArray:
    """Rotation (3,3) that brings Z up, by what the cameras (N,4,4) hold for up."""
    up = -poses[:, :3, 1].sum(axis=0)
    length = np.linalg.norm(up)
    if length < 1e-9:
        return np.eye(3)
    z = up / length
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def _target(body: Body | None, timeline: Timeline, centres: FloatArray) -> tuple[FloatArray, float]:
    """What to look at in each picture (F,3), and how much around it."""
    if body is not None and len(body.times_ns):
        middle = 0.5 * (body.ends_in_world.min(axis=(1, 2)) + body.ends_in_world.max(axis=(1, 2)))
        at = [np.interp(timeline.times_ns, body.times_ns, middle[:, axis]) for axis in range(3)]
        return np.stack(at, axis=1), _BODY_REACH_M
    if not len(centres):
        return np.zeros((len(timeline.times_ns), 3)), 1.0
    low, high = np.percentile(centres, [2, 98], axis=0)
    reach = 0.7 * float(np.linalg.norm(high - low)) or 1.0
    return np.tile(0.5 * (low + high), (len(timeline.times_ns), 1)), reach


def _write_lines(image: room.Picture, inputs: PreviewInputs, timeline: Timeline, index: int) -> None:
    """Time and speed above the room; what the strokes mean below it."""
    seconds = timeline.times_ns[index] * 1e-9
    speed = "" if timeline.speed <= 1.001 else f"   shown {timeline.speed:.1f}× faster"
    since = seconds - timeline.times_ns[0] * 1e-9
    # Clocks that count from 1970 are shown from the start.
    text = f"+{since:.2f} s" if seconds > _UNIX_S else f"{seconds:.2f} s"
    start = write(image, text, (14, 30), size=20)
    write(image, speed, (start, 30), GREY, 16)
    if inputs.note:
        write(image, shortened(inputs.note, ROOM_WIDTH - 28), (14, 52), AMBER)
    legend = [_STROKES, _DOTS] if inputs.body is not None else [_DOTS]
    write(image, shortened(" · ".join(legend), ROOM_WIDTH - 28, 13), (14, HEIGHT - 12), GREY, 13)
