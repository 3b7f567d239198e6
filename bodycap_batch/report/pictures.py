"""Small pictures of what the cameras saw: a series for the time slider, and a sheet of the lost frames."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.report.packing import thinned

SERIES_BUDGET = 6_000_000
"""Characters of all series together, some tenths of it the marks drawn into them."""
_MARKS_EACH = 1_300
_SERIES_PX = 320
_LARGEST = 50_000
"""Characters of 320×240 of nothing but noise: where such fit, none is decoded to see how large they are."""
_SHEET_PX = 240
_QUALITY = 60
_PROBES = 6
_PER_SECOND = 5.0
"""More pictures a second than this only make the page larger: the motion itself is drawn at every tick."""
_NEAR_S = 1.0
"""How far from where it is wanted a kept frame may lie: keyframes are half a second apart at most."""
_DARK = 30.0
_CORNER_QUALITY = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """A frame as a small JPEG.

    Attributes:
        index: Frame index in its camera.
        jpeg: The file, base64.
        width: Pixels.
        height: Pixels.
    """

    index: int
    jpeg: str
    width: int
    height: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """What a frame looks like, in numbers.

    Attributes:
        picture: The frame.
        grey: Mean brightness, 0 to 255.
        corners: Distinct corners found in it, at most `MOST_CORNERS`.
    """

    picture: Picture
    grey: float
    corners: int

    @property
    def dark(self) -> bool:
        """True where hardly any light reached the camera."""
        return self.grey < _DARK


MOST_CORNERS = 300


def series(
    camera: CaptureCamera, times_s: FloatArray, budget: int, context: StageContext
) -> tuple[Picture, ...]:
    """Pictures evenly spread over a camera's video, as many as the budget allows.

    Args:
        camera: The video.
        times_s: (N,) common time of each frame.
        budget: Characters of base64 and marks.
        context: Cancelling.
    """
    count = len(camera.frame_numbers)
    if count == 0:
        return ()
    length_s = float(times_s[-1] - times_s[0])
    most = 1 + int(_PER_SECOND * length_s)
    if most * (_LARGEST + _MARKS_EACH) > budget:
        probes = _read(camera, _cheap(camera, thinned(count, _PROBES)), _SERIES_PX, context)
        if not probes:
            return ()
        each = float(np.mean([len(picture.jpeg) for picture in probes])) + _MARKS_EACH
        most = min(int(0.95 * budget / each), most)
    pictures = _read(camera, _cheap(camera, thinned(count, most)), _SERIES_PX, context)
    return tuple(_within(pictures, budget))


def looks(camera: CaptureCamera, indices: Sequence[int], context: StageContext) -> dict[int, Look]:
    """Pictures of chosen frames with their brightness and texture."""
    import cv2

    out = {}
    wanted = np.unique(np.asarray(indices, dtype=np.int64))
    for index, image in _frames(camera, wanted, context):
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        small = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        found = cv2.goodFeaturesToTrack(small, MOST_CORNERS, _CORNER_QUALITY, 5.0)
        corners = 0 if found is None else len(_contrasted(small, found.reshape(-1, 2)))
        out[index] = Look(picture=_picture(index, image, _SHEET_PX), grey=float(grey.mean()), corners=corners)
    return out


def _contrasted(grey: Any, corners: FloatArray) -> FloatArray:
    """Corners that stand out from sensor noise: goodFeaturesToTrack's threshold is relative to the best."""
    import cv2

    spread = cv2.dilate(grey, np.ones((5, 5), np.uint8)).astype(int) - cv2.erode(
        grey, np.ones((5, 5), np.uint8)
    )
    column, row = corners.astype(int).T
    return np.asarray(corners[spread[row, column] > 20])


def _cheap(camera: CaptureCamera, indices: IntArray) -> IntArray:
    """The same spread on the nearest frames that are kept: between keyframes little new comes into view.

    Where none are, on frames that decode without their neighbours; where no such is near, as they are.
    """
    keys = camera.key_indices() if camera.kept is None else camera.kept.frames
    if len(indices) < 3 or len(keys) == 0:
        return indices
    half = 0.5 * float(np.median(np.diff(indices)))
    if camera.kept is not None:
        half = max(half, _NEAR_S * camera.nominal_fps)
    right = np.clip(np.searchsorted(keys, indices), 0, len(keys) - 1)
    left = np.maximum(right - 1, 0)
    nearest = np.where(np.abs(keys[left] - indices) <= np.abs(keys[right] - indices), keys[left], keys[right])
    return np.unique(np.where(np.abs(nearest - indices) < half, nearest, indices))


def _within(pictures: list[Picture], budget: int) -> list[Picture]:
    """Every second picture left out until the rest fits."""
    while len(pictures) > 2 and sum(len(each.jpeg) + _MARKS_EACH for each in pictures) > budget:
        pictures = pictures[::2]
    return pictures


def _read(camera: CaptureCamera, indices: IntArray, side_px: int, context: StageContext) -> list[Picture]:
    return [_picture(index, image, side_px) for index, image in _frames(camera, indices, context)]


def _frames(camera: CaptureCamera, indices: IntArray, context: StageContext) -> list[tuple[int, Any]]:
    """Colour frames; those after the first that does not decode are missing from the page, not an error."""
    frames = []
    try:
        for index, image in camera.read(indices, colour=True):
            context.check_cancelled()
            frames.append((index, image))
    except CaptureError:
        return frames
    return frames


def _picture(index: int, image: Any, side_px: int) -> Picture:
    import cv2

    factor = min(1.0, side_px / max(image.shape[:2]))
    size = (max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor)))
    small = cv2.cvtColor(cv2.resize(image, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2BGR)
    _, encoded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    text = base64.b64encode(encoded.tobytes()).decode("ascii")
    return Picture(index=index, jpeg=text, width=size[0], height=size[1])
