"""One camera's video with everything solved drawn into it, and a line that says how its frame went."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.model.scene import FrameStatus
from bodycap_batch.overlay import Body, CameraView, SeenPoints, bone_lines, draw_overlay
from bodycap_batch.preview.layout import Box
from bodycap_batch.preview.text import AMBER, GREEN, GREY, RED, Colour, shortened, width_of, write

Picture = npt.NDArray[np.uint8]

WORLD = "world"
_REASONS = {
    FrameStatus.BLUR: "blurred",
    FrameStatus.FEW_TRACKS: "too little could be followed",
    FrameStatus.FEW_INLIERS: "too few points agree",
    FrameStatus.UNCONSTRAINED: "the points do not fix the pose",
    FrameStatus.POSE_JUMP: "the pose jumped",
    FrameStatus.UNCONFIRMED: "no neighbour confirms it",
    FrameStatus.NO_MAP: "not in the map",
}
_DIMMED = 0.45


@dataclass(frozen=True, slots=True, kw_only=True)
class Tile:
    """One camera's place in the preview.

    Attributes:
        camera: Its video.
        view: What it saw; None where no map took it.
        frames: (F,) index of the frame shown in each picture, −1 where the video has none.
        picture: Where the video stands.
        bar: Where the text stands.
        colour: The colour of its path in the room.
    """

    camera: CaptureCamera
    view: CameraView | None
    frames: IntArray
    picture: Box
    bar: Box
    colour: Colour

    def poses(self) -> FloatArray:
        """(N,4,4) the camera's poses, NaN where there is none; nothing where no map took it."""
        return np.zeros((0, 4, 4)) if self.view is None else self.view.frame_from_cam

    def images(self) -> Generator[Picture | None, None, None]:
        """The video's picture (H,W,3) at the tile's size for each picture of the preview."""
        size = (self.picture.width, self.picture.height)
        wanted = np.unique(self.frames[self.frames >= 0])
        index, image = -1, None
        with closing(self.camera.read(wanted, colour=True)) as stream:
            for frame in self.frames.tolist():
                while index < frame:
                    index, full = next(stream)
                    image = resized(full, size)
                yield image if frame >= 0 else None


def resized(image: Picture, size: tuple[int, int]) -> Picture:
    """A picture (H,W,3) at (width, height): halved while it is twice as large, then interpolated.

    Averaging right to the size, which aliases hardly less, takes 3 ms for 640×480, this a fifth of it.
    """
    import cv2

    height, width = image.shape[:2]
    while width >= 2 * size[0] and height >= 2 * size[1]:
        width, height = width // 2, height // 2
        image = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)


def frames_at(camera: CaptureCamera, times_ns: IntArray) -> IntArray:
    """(F,) the frame nearest to each common time, −1 before the video's first and after its last."""
    own = camera.common_times_ns()
    if not len(own):
        return np.full(len(times_ns), -1, dtype=np.int64)
    after = np.clip(np.searchsorted(own, times_ns), 1, max(1, len(own) - 1))
    after = np.minimum(after, len(own) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(own[before] - times_ns) <= np.abs(own[after] - times_ns), before, after)
    interval = np.median(np.diff(own)) if len(own) > 1 else 1e9 / camera.nominal_fps
    inside = (times_ns >= own[0] - 0.5 * interval) & (times_ns <= own[-1] + 0.5 * interval)
    return np.asarray(np.where(inside, nearest, -1), dtype=np.int64)


def draw_tile(image: Picture, tile: Tile, shown: Picture | None, frame: int, body: Body | None) -> None:
    """Draw a camera's picture and its line of text into the preview's picture."""
    status = FrameStatus.NO_MAP if tile.view is None or frame < 0 else tile.view.status[frame]
    points = None if tile.view is None or frame < 0 else tile.view.points_at(frame)
    box = tile.picture
    if shown is not None:
        painted = _painted(shown, tile.view, frame, points, body)
        if not status.localised:
            painted = (painted * _DIMMED).astype(np.uint8)
        image[box.y : box.y + box.height, box.x : box.x + box.width] = painted
    if shown is None:
        text, colour = "no picture at this time", GREY
    else:
        text, colour = status_line(status, points)
    _frame(image, box, colour)
    base = (tile.bar.x + 2, tile.bar.y + 16)
    image[base[1] - 9 : base[1], base[0] : base[0] + 9] = tile.colour
    name = shortened(tile.camera.name, tile.bar.width // 2)
    start = write(image, name, (base[0] + 14, base[1])) + 10
    room = tile.bar.x + tile.bar.width - start
    text = next(
        (each for each in (text, text.partition(",")[0]) if width_of(each) < room), shortened(text, room)
    )
    write(image, text, (start + room - width_of(text) - 2, base[1]), colour)


def _painted(
    shown: Picture, view: CameraView | None, frame: int, points: SeenPoints | None, body: Body | None
) -> Picture:
    if view is None or points is None:
        return shown
    cam_from_frame = view.cam_from_frame(frame)
    if cam_from_frame is None:
        return shown
    bones = body.at(int(view.times_ns[frame])) if body is not None and view.frame == WORLD else None
    lines = [] if bones is None else bone_lines(view.lens, cam_from_frame, bones)
    return draw_overlay(shown, view.lens.width_px, points, lines, () if body is None else body.side)


def status_line(status: FrameStatus, points: SeenPoints | None) -> tuple[str, Colour]:
    """What the line below a frame says of its pose."""
    if not status.localised or points is None:
        return f"lost: {_REASONS.get(status, status.value)}", RED
    name = {FrameStatus.KEYFRAME: "keyframe", FrameStatus.RIG: "carried by the rig"}.get(status, "")
    if not len(points.px):  # what a second look found is not kept point by point
        return name or "found again", AMBER
    text = f"{len(points.px)} points, {float(points.error_px.mean()):.1f} px"
    return f"{name} · {text}" if name else text, GREEN


def _frame(image: Picture, box: Box, colour: Colour) -> None:
    import cv2

    corner = (box.x + box.width, box.y + box.height)
    cv2.rectangle(image, (box.x - 1, box.y - 1), corner, colour, 1)
