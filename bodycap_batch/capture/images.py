"""From a decoded frame to the image a stage works on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from bodycap_batch.capture.video import Orientation

if TYPE_CHECKING:
    from av.video.frame import VideoFrame

Image = npt.NDArray[np.uint8]

# Formats whose first plane is 8-bit luma and can be taken as it is.
_LUMA_FORMATS = frozenset(
    f"{family}{layout}" for family in ("yuv", "yuvj") for layout in ("420p", "422p", "444p", "440p", "411p")
) | {"nv12", "nv21", "nv16", "gray"}
_FULL_RANGE = 2
# Studio range to full range (ITU-R BT.601: black 16, white 235).
_EXPAND = np.clip(np.round((np.arange(256) - 16.0) * (255.0 / 219.0)), 0, 255).astype(np.uint8)


def work_image(frame: VideoFrame, orientation: Orientation, size: tuple[int, int], *, colour: bool) -> Image:
    """Grey (H,W) or RGB (H,W,3), upright, at (width, height), full range; an own, contiguous array."""
    if colour:
        return _resized(np.asarray(frame.to_ndarray(format="rgb24"), dtype=np.uint8), orientation, size)
    if frame.format.name not in _LUMA_FORMATS:
        return _resized(np.asarray(frame.to_ndarray(format="gray"), dtype=np.uint8), orientation, size)
    image = _resized(_luma(frame), orientation, size)
    if frame.format.name.startswith(("yuvj", "gray")) or frame.color_range == _FULL_RANGE:
        return image
    import cv2

    return np.asarray(cv2.LUT(image, _EXPAND), dtype=np.uint8)


def _luma(frame: VideoFrame) -> Image:
    """A view of the first plane, without the padding of its rows."""
    plane = frame.planes[0]
    rows = np.asarray(memoryview(plane), dtype=np.uint8).reshape(-1, plane.line_size)
    return rows[: frame.height, : frame.width]


def _resized(image: Image, orientation: Orientation, size: tuple[int, int]) -> Image:
    upright = turn_upright(image, orientation)
    if (upright.shape[1], upright.shape[0]) == size:
        return np.array(upright, order="C")
    import cv2

    # Averaging over the source pixels keeps edges where they are and aliases least.
    return np.asarray(cv2.resize(np.ascontiguousarray(upright), size, interpolation=cv2.INTER_AREA))


def turn_upright(image: npt.NDArray[np.uint8], orientation: Orientation) -> npt.NDArray[np.uint8]:
    """Turn a stored image (H,W) or (H,W,3) the way a player shows it."""
    (m00, m01), (m10, m11) = orientation
    if m00:
        sign_x, sign_y = m00, m11
    else:
        image, sign_x, sign_y = image.swapaxes(0, 1), m01, m10
    return image[::sign_y, ::sign_x]
