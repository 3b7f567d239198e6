"""Make small pictures of video frames: a series for the time slider, and pictures of lost frames."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import FloatArray, IntArray, evenly_spaced
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.report.loss_causes import DARK_BRIGHTNESS

SERIES_BUDGET = 6_000_000
"""Maximum number of characters of all picture series together, including their overlays.

This is less than half of the page's maximum size.
"""
_OVERLAY_CHARACTERS = 1_300
"""Estimated number of characters of one picture's overlays (points and bones). Evidence: none."""
_SERIES_SIDE_PX = 320
"""Maximum length (pixels) of the longer side of a picture in a series. Evidence: none."""
MAX_JPEG_CHARACTERS = 50_000
"""Maximum number of base64 characters of one picture in a series.

A picture of 320×240 pixels that contains only noise has this size. If the budget suffices for pictures of
this size, no frame is decoded to estimate the actual size.
"""
_LOST_SIDE_PX = 240
"""Maximum length (pixels) of the longer side of a lost frame's picture. Evidence: none."""
_JPEG_QUALITY = 60
"""JPEG quality on the scale from 0 to 100. Evidence: none."""
_PROBED_FRAMES = 6
"""Number of frames that are encoded to estimate the size of a picture. Evidence: none."""
_SHADE_BGR, _SHADE_DIVISOR = np.array([90, 20, 90], np.uint8), 3
"""Colour that is added to what is left out of a picture, after its brightness is divided: a dark violet.
Evidence: none."""
_MAX_PICTURES_PER_S = 5.0
"""Maximum number of pictures per second of video.

The 3D viewer draws the motion at every tick anyway, so more pictures would only enlarge the page.
"""
_MAX_SHIFT_S = 1.0
"""Maximum time (seconds) between an evenly spaced frame and the stored frame that replaces it.

If half the time between two pictures is longer than this value, half the time between two pictures is the
maximum. Keyframes are at most half a second apart.
"""
MAX_CORNERS = 300
"""Maximum number of corners that are counted in a frame. Evidence: none."""
_CORNER_QUALITY = 0.02
"""Minimum ratio of a corner's strength to the strength of the strongest corner (`goodFeaturesToTrack`).

Evidence: none.
"""
_MIN_CORNER_CONTRAST = 20
"""Minimum range of grey levels (of 255) in the pixels around a corner.

The range of sensor noise is smaller. Evidence: none.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class FramePicture:
    """A video frame as a small JPEG.

    Attributes:
        index: Index of the frame in its camera.
        jpeg: Content of the JPEG file as base64 text.
        width: Width of the picture, pixels.
        height: Height of the picture, pixels.
    """

    index: int
    jpeg: str
    width: int
    height: int


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameAppearance:
    """A video frame's picture, with measurements of its image.

    Attributes:
        picture: The frame as a small JPEG.
        brightness: Mean brightness of the frame, 0 to 255.
        corners: Number of distinct corners in the frame, at most `MAX_CORNERS`.
    """

    picture: FramePicture
    brightness: float
    corners: int

    @property
    def is_dark(self) -> bool:
        """True if hardly any light reached the camera."""
        return self.brightness < DARK_BRIGHTNESS


def picture_series(
    camera: CaptureCamera, times_s: FloatArray, budget: int, context: StageContext
) -> tuple[FramePicture, ...]:
    """Return evenly spaced pictures of a camera's video, as many as the budget allows.

    Args:
        camera: The camera with its videos.
        times_s: (N,) common time of each frame, seconds.
        budget: Maximum number of characters of all pictures (base64) and overlays.
        context: The context of the stage, through which the stage can be cancelled.
    """
    count = len(camera.frame_numbers)
    if count == 0:
        return ()
    length_s = float(times_s[-1] - times_s[0])
    most = 1 + int(_MAX_PICTURES_PER_S * length_s)
    if most * (MAX_JPEG_CHARACTERS + _OVERLAY_CHARACTERS) > budget:
        probes = _read_pictures(
            camera, _prefer_cheap_frames(camera, evenly_spaced(count, _PROBED_FRAMES)), context
        )
        if not probes:
            return ()
        characters = float(np.mean([len(picture.jpeg) for picture in probes])) + _OVERLAY_CHARACTERS
        most = min(int(0.95 * budget / characters), most)
    indices = _prefer_cheap_frames(camera, evenly_spaced(count, max(most, 2)))
    return tuple(_thin_to_budget(_read_pictures(camera, indices, context), budget))


def measure_appearance(
    camera: CaptureCamera, indices: Sequence[int], context: StageContext
) -> dict[int, FrameAppearance]:
    """Measure the picture, the brightness and the number of corners of frames.

    Args:
        camera: The camera with its videos.
        indices: Indices of the frames, in any order.
        context: The context of the stage, through which the stage can be cancelled.

    Returns:
        The appearance of each frame, by frame index. Frames that cannot be decoded are missing.
    """
    import cv2

    measured = {}
    unique_indices = np.unique(np.asarray(indices, dtype=np.int64))
    for index, image in _decode_frames(camera, unique_indices, context):
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        half_size = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        found = cv2.goodFeaturesToTrack(half_size, MAX_CORNERS, _CORNER_QUALITY, 5.0)
        corners = 0 if found is None else len(_corners_above_noise(half_size, found.reshape(-1, 2)))
        picture = _encode_picture(camera, index, image, _LOST_SIDE_PX)
        measured[index] = FrameAppearance(picture=picture, brightness=float(grey.mean()), corners=corners)
    return measured


def _corners_above_noise(grey: Any, corners: FloatArray) -> FloatArray:
    """Return the corners whose surroundings have more contrast than sensor noise.

    The threshold of `goodFeaturesToTrack` is relative to the strongest corner. The function therefore also
    finds corners in an image of pure noise.
    """
    import cv2

    contrast = cv2.dilate(grey, np.ones((5, 5), np.uint8)).astype(int) - cv2.erode(
        grey, np.ones((5, 5), np.uint8)
    )
    column, row = corners.astype(int).T
    return np.asarray(corners[contrast[row, column] > _MIN_CORNER_CONTRAST])


def _prefer_cheap_frames(camera: CaptureCamera, indices: IntArray) -> IntArray:
    """Replace evenly spaced frames by nearby frames that are cheaper to read.

    If copies of frames are stored, frames with a stored copy are preferred. The keyframes have a stored copy,
    and little new comes into view between two keyframes. If no copies are stored, frames that decode without
    their neighbours are preferred. A frame without a cheap frame nearby is not replaced.

    Args:
        camera: The camera with its videos.
        indices: (N,) indices of the evenly spaced frames.

    Returns:
        (M,) indices of the frames to read, increasing. M is at most N.
    """
    cheap = camera.key_indices() if camera.kept is None else camera.kept.frames
    if len(indices) < 3 or len(cheap) == 0:
        return indices
    max_shift = 0.5 * float(np.median(np.diff(indices)))
    if camera.kept is not None:
        max_shift = max(max_shift, _MAX_SHIFT_S * camera.nominal_fps)
    right = np.clip(np.searchsorted(cheap, indices), 0, len(cheap) - 1)
    left = np.maximum(right - 1, 0)
    left_is_nearer = np.abs(cheap[left] - indices) <= np.abs(cheap[right] - indices)
    nearest = np.where(left_is_nearer, cheap[left], cheap[right])
    return np.unique(np.where(np.abs(nearest - indices) < max_shift, nearest, indices))


def _thin_to_budget(pictures: list[FramePicture], budget: int) -> list[FramePicture]:
    """Remove every second picture, repeatedly, until the remaining pictures fit into the budget."""
    while len(pictures) > 2 and sum(len(each.jpeg) + _OVERLAY_CHARACTERS for each in pictures) > budget:
        pictures = pictures[::2]
    return pictures


def _read_pictures(camera: CaptureCamera, indices: IntArray, context: StageContext) -> list[FramePicture]:
    return [
        _encode_picture(camera, index, image, _SERIES_SIDE_PX)
        for index, image in _decode_frames(camera, indices, context)
    ]


def _decode_frames(camera: CaptureCamera, indices: IntArray, context: StageContext) -> list[tuple[int, Any]]:
    """Return the index and the colour image of each frame before the first frame that cannot be decoded.

    Frames that are known to be damaged are omitted. If another frame cannot be decoded, all later frames are
    missing on the page, but the report does not fail.
    """
    frames = []
    try:
        for index, image in camera.read(np.setdiff1d(indices, camera.damaged), colour=True):
            context.check_cancelled()
            frames.append((index, image))
    except CaptureError:
        return frames
    return frames


def _encode_picture(camera: CaptureCamera, index: int, image: Any, side_px: int) -> FramePicture:
    """Return a small JPEG of a frame. What is masked or is not the room is shaded."""
    import cv2

    factor = min(1.0, side_px / max(image.shape[:2]))
    size = (max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor)))
    small = cv2.cvtColor(cv2.resize(image, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2BGR)
    lens = camera.camera
    x, y = np.meshgrid(*((np.arange(n) + 0.5) / n for n in size))
    px = np.column_stack([x.ravel() * lens.width_px, y.ravel() * lens.height_px])
    left_out = ~camera.is_unmasked(px, index).reshape(small.shape[:2])
    small[left_out] = _SHADE_BGR + small[left_out] // _SHADE_DIVISOR
    _, encoded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    text = base64.b64encode(encoded.tobytes()).decode("ascii")
    return FramePicture(index=index, jpeg=text, width=size[0], height=size[1])
