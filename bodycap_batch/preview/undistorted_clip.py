"""Write the video of a camera as its undistorted pinhole camera would show it, one picture for each frame."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.formats.atomic_files import atomic_replacement
from bodycap_batch.formats.mp4_writer import VideoWriter
from bodycap_batch.model.camera import CV2_PIXEL_OFFSET_PX, Camera
from bodycap_batch.model.pinhole import distorted_px

_COLOURS = (1, 5)
"""FFmpeg's numbers of the studio range and of the colour matrix of ITU-R BT.601, which the encoder uses."""
_REPORT_EACH = 15
"""Number of pictures between two reports of the progress. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UndistortedClip:
    """What an undistorted clip shows, and the file to write.

    Attributes:
        path: The file to write.
        camera: The camera; its intrinsics have the size of the clip, and all frames can be decoded.
        lens: The lens as the map has it, at the size of the clip.
        pinhole: The pinhole camera of the clip.
        frames: (T,) index of the frame of the camera that each frame of the clip shows; −1 for a black
            picture.
        rate: Frames per second.
        timecode: Timecode of the first frame; "" for none.
    """

    path: Path
    camera: CaptureCamera
    lens: Camera
    pinhole: Camera
    frames: IntArray
    rate: Fraction
    timecode: str = ""


def write_undistorted_clip(clip: UndistortedClip, context: StageContext) -> Path:
    """Write the clip and return its path.

    The rolling shutter is not corrected: each picture is as the sensor recorded it.

    Raises:
        CaptureError: A frame cannot be decoded.
        StoreError: The file cannot be written.
    """
    import cv2

    size = (clip.pinhole.width_px, clip.pinhole.height_px)
    column, row = (each.astype(np.float32) for each in _source_pixels(clip.lens, clip.pinhole))
    # With fixed-point maps OpenCV takes a third of the time; their resolution is 1/32 px.
    maps = cv2.convertMaps(column, row, cv2.CV_16SC2)
    image = np.zeros((size[1], size[0], 3), dtype=np.uint8)
    shown = -1
    with (
        atomic_replacement(clip.path) as temporary,
        closing(clip.camera.read(np.unique(clip.frames[clip.frames >= 0]), colour=True)) as stream,
        VideoWriter(
            temporary, float(clip.rate), size, "high", colours=_COLOURS, timecode=clip.timecode
        ) as video,
    ):
        for number, frame in enumerate(clip.frames.tolist()):
            context.check_cancelled()
            if number % _REPORT_EACH == 0:
                context.progress(number, len(clip.frames), "pictures")
            while shown < frame:
                shown, picture = next(stream)
                image = np.asarray(cv2.remap(picture, *maps, cv2.INTER_CUBIC), dtype=np.uint8)
            video.add(image if frame >= 0 else np.zeros_like(image))
    context.progress(len(clip.frames), len(clip.frames), "")
    return clip.path


def _source_pixels(lens: Camera, pinhole: Camera) -> tuple[FloatArray, FloatArray]:
    """Return the column and the row (H,W) in the video of each pixel of the clip, with OpenCV's origin."""
    column, row = np.meshgrid(np.arange(pinhole.width_px), np.arange(pinhole.height_px))
    px = np.stack([column.ravel(), row.ravel()], axis=1).astype(np.float64) + CV2_PIXEL_OFFSET_PX
    source = distorted_px(lens, pinhole, px) - CV2_PIXEL_OFFSET_PX
    shape = (pinhole.height_px, pinhole.width_px)
    return source[:, 0].reshape(shape), source[:, 1].reshape(shape)
