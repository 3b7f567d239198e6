"""Draw one camera's video into the preview, with overlays and a line of text about each frame's pose."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.model.scene import FrameStatus
from bodycap_batch.overlay import (
    BoneMotion,
    CameraView,
    Colour,
    ObservedPoints,
    RgbImage,
    draw_overlay,
    project_bones,
)
from bodycap_batch.preview.labels import AMBER, GREEN, GREY, RED, draw_text, shorten_to_width, text_width_px
from bodycap_batch.preview.layout import Box

WORLD = "world"
_LOSS_REASONS = {
    FrameStatus.BLUR: "blurred",
    FrameStatus.FEW_TRACKS: "too few points could be tracked",
    FrameStatus.FEW_INLIERS: "too few points agree with the pose",
    FrameStatus.UNCONSTRAINED: "the points do not determine the pose",
    FrameStatus.POSE_JUMP: "the pose jumped",
    FrameStatus.UNCONFIRMED: "no neighbouring frame confirms the pose",
    FrameStatus.CONTRADICTED: "this part contradicts the map",
    FrameStatus.NO_MAP: "camera not in the map",
    FrameStatus.OTHER_MAP: "in another map",
    FrameStatus.DAMAGED: "damaged in the video",
    FrameStatus.FROZEN: "the recording is frozen",
}
_LOST_BRIGHTNESS = 0.45
"""Factor on the brightness of lost frames. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoTile:
    """One camera's video in the preview.

    Attributes:
        camera: The camera with its videos.
        view: Poses and observations of the camera; None if no map contains the camera.
        frames: (F,) index of the video frame that each frame of the preview shows; −1 if there is none.
        video_box: Position of the video in the preview's image.
        label_box: Position of the line of text in the preview's image.
        colour: Colour of the camera's path in the room.
    """

    camera: CaptureCamera
    view: CameraView | None
    frames: IntArray
    video_box: Box
    label_box: Box
    colour: Colour

    def poses(self) -> FloatArray:
        """Return the camera's poses (N,4,4), NaN for lost frames; N is zero if no map contains the camera."""
        return np.zeros((0, 4, 4)) if self.view is None else self.view.frame_from_cam

    def images(self) -> Generator[RgbImage | None, None, None]:
        """Yield the video's image for each frame of the preview.

        The image (H,W,3) has the size of the tile. None is yielded if there is no video frame at this time. A
        damaged frame is replaced by the frame that was shown before.
        """
        size = (self.video_box.width, self.video_box.height)
        is_shown = (self.frames >= 0) & ~np.isin(self.frames, self.camera.damaged)
        shown = np.unique(self.frames[is_shown])
        index, image = -1, None
        with closing(self.camera.read(shown, colour=True)) as stream:
            for frame, is_readable in zip(self.frames.tolist(), is_shown.tolist(), strict=True):
                while is_readable and index < frame:
                    index, full_image = next(stream)
                    image = resize_image(full_image, size)
                yield image if frame >= 0 else None


def resize_image(image: RgbImage, size: tuple[int, int]) -> RgbImage:
    """Return an image (H,W,3) resized to the width and height in `size`.

    The image is halved while it is at least twice as large as `size`. It is then interpolated to its final
    size. Averaging the image directly to the final size reduces aliasing only slightly more, and takes five
    times as long: 3 ms for 640×480.
    """
    import cv2

    height, width = image.shape[:2]
    while width >= 2 * size[0] and height >= 2 * size[1]:
        width, height = width // 2, height // 2
        image = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)


def draw_tile(
    image: RgbImage,
    tile: VideoTile,
    video_image: RgbImage | None,
    frame: int,
    bone_motion: BoneMotion | None,
) -> None:
    """Draw a camera's video frame and its line of text into the preview's image.

    Args:
        image: (H,W,3) image of the preview, changed in place.
        tile: The camera's video and its position.
        video_image: The video frame at the size of the tile; None if there is none at this time.
        frame: Index of the video frame; −1 if there is none.
        bone_motion: The solved motion; None if there is none.
    """
    status = FrameStatus.NO_MAP if tile.view is None or frame < 0 else tile.view.status[frame]
    points = None if tile.view is None or frame < 0 else tile.view.inliers_at(frame)
    box = tile.video_box
    if video_image is not None:
        painted = _with_overlay(video_image, tile.view, frame, points, bone_motion)
        if not status.localised and status is not FrameStatus.ROTATION_ONLY:
            painted = (painted * _LOST_BRIGHTNESS).astype(np.uint8)
        image[box.y : box.y + box.height, box.x : box.x + box.width] = painted
    if video_image is None:
        text, colour = "no picture at this time", GREY
    else:
        text, colour = describe_status(status, points)
    _draw_border(image, box, colour)
    label_box = tile.label_box
    x, baseline = label_box.x + 2, label_box.y + 16
    image[baseline - 9 : baseline, x : x + 9] = tile.colour
    name = shorten_to_width(tile.camera.name, label_box.width // 2)
    text_start = draw_text(image, name, (x + 14, baseline)) + 10
    free_px = label_box.x + label_box.width - text_start
    text = next(
        (words for words in (text, text.partition(",")[0]) if text_width_px(words) < free_px),
        shorten_to_width(text, free_px),
    )
    draw_text(image, text, (text_start + free_px - text_width_px(text) - 2, baseline), colour)


def _with_overlay(
    video_image: RgbImage,
    view: CameraView | None,
    frame: int,
    points: ObservedPoints | None,
    bone_motion: BoneMotion | None,
) -> RgbImage:
    if view is None or points is None:
        return video_image
    cam_from_frame = view.cam_from_frame(frame)
    if cam_from_frame is None:
        return video_image
    bones = None
    if bone_motion is not None and view.reference_frame == WORLD:
        bones = bone_motion.bones_at(int(view.times_ns[frame]))
    lines = [] if bones is None else project_bones(view.lens, cam_from_frame, bones)
    sides = () if bone_motion is None else bone_motion.sides
    return draw_overlay(video_image, view.lens.width_px, points, lines, sides)


def describe_status(status: FrameStatus, points: ObservedPoints | None) -> tuple[str, Colour]:
    """Return the text about a frame's pose, and the colour of this text."""
    if status is FrameStatus.ROTATION_ONLY:
        return "rotation only, no position", AMBER
    if not status.localised or points is None:
        return f"lost: {_LOSS_REASONS.get(status, status.value)}", RED
    if status is FrameStatus.INERTIAL:
        return "pose from the inertial sensor", AMBER
    name = "keyframe" if status is FrameStatus.KEYFRAME else ""
    if not len(points.px):  # recovery stores no observations for the frames that it poses
        return name or "found again", AMBER
    text = f"{len(points.px)} points, {float(points.error_px.mean()):.1f} px"
    return f"{name} · {text}" if name else text, GREEN


def _draw_border(image: RgbImage, box: Box, colour: Colour) -> None:
    import cv2

    corner = (box.x + box.width, box.y + box.height)
    cv2.rectangle(image, (box.x - 1, box.y - 1), corner, colour, 1)
