"""Convert a decoded frame to an image at the work size."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from bodycap_batch.capture.video import Orientation

if TYPE_CHECKING:
    from av.video.frame import VideoFrame

Image = npt.NDArray[np.uint8]
Planes = npt.NDArray[np.uint8]
"""Luma and halved chroma (1.5·H,W), sides even."""
Colours = tuple[int, int]
"""Range and matrix of luma and chroma, in FFmpeg's numbers."""

_LUMA_FORMATS = frozenset(
    f"{family}{layout}" for family in ("yuv", "yuvj") for layout in ("420p", "422p", "444p", "440p", "411p")
) | {"nv12", "nv21", "nv16", "gray"}
"""Formats with 8-bit luma as their first plane, which is used directly."""
_FULL_RANGE = 2
"""FFmpeg's number of the full colour range."""
_STUDIO_TO_FULL = np.clip(np.round((np.arange(256) - 16.0) * (255.0 / 219.0)), 0, 255).astype(np.uint8)
"""Table from studio range to full range (ITU-R BT.601: black 16, white 235)."""


def work_image(
    frame: VideoFrame,
    orientation: Orientation,
    size: tuple[int, int],
    *,
    colour: bool,
    shown: tuple[int, int] | None = None,
) -> Image:
    """Return an upright image at the work size: grey (H,W) or RGB (H,W,3), full range, contiguous.

    Args:
        frame: The decoded frame.
        orientation: Its display matrix.
        size: Width and height of the result.
        colour: RGB instead of grey.
        shown: Width and height of the part of the frame that holds the image, if it was padded to even sides.
    """
    width, height = shown or (frame.width, frame.height)
    if colour or frame.format.name not in _LUMA_FORMATS:
        picture = np.asarray(frame.to_ndarray(format="rgb24" if colour else "gray"), dtype=np.uint8)
        return _resize_upright(picture[:height, :width], orientation, size)
    image = _resize_upright(_plane_array(frame, 0)[:height, :width], orientation, size)
    return image if _is_full_range(frame) else _expand_range(image)


def grey_from_planes(planes: tuple[Planes, Colours], size: tuple[int, int]) -> Image:
    """Return the grey image (H,W), full range, of planes from `work_planes`."""
    luma = np.ascontiguousarray(planes[0][: size[1], : size[0]])
    return luma if planes[1][0] == _FULL_RANGE else _expand_range(luma)


def _expand_range(luma: Image) -> Image:
    """Convert luma from studio range to full range."""
    import cv2

    return np.asarray(cv2.LUT(luma, _STUDIO_TO_FULL), dtype=np.uint8)


def work_planes(frame: VideoFrame, orientation: Orientation, size: tuple[int, int]) -> tuple[Planes, Colours]:
    """Return luma and halved chroma, upright, padded to even sides, in the frame's own range.

    At the frame's own size, and if it has 8 bits and halved chroma (4:2:0), the planes are unchanged. In
    other formats the luma is correct to one level.

    Args:
        frame: The decoded frame.
        orientation: Its display matrix.
        size: Width and height of the result, before padding.

    Returns:
        The planes, and their range and matrix.
    """
    is_full = _is_full_range(frame)
    colours = (_FULL_RANGE if is_full else int(frame.color_range), int(frame.colorspace))
    if frame.format.name not in ("yuv420p", "yuvj420p"):
        # Without an explicit range FFmpeg converts grey, and formats that are full-range by name, to studio
        # range.
        frame = frame.reformat(format="yuv420p", dst_color_range=_FULL_RANGE if is_full else None)
    half_size = ((size[0] + 1) // 2, (size[1] + 1) // 2)
    luma = _resize_upright(_plane_array(frame, 0), orientation, size)
    luma = np.pad(luma, ((0, size[1] % 2), (0, size[0] % 2)), mode="edge")
    chroma = [
        _resize_upright(_plane_array(frame, number), orientation, half_size).reshape(-1) for number in (1, 2)
    ]
    flat = np.concatenate([luma.reshape(-1), *chroma])
    return flat.reshape(-1, luma.shape[1]), colours


def _is_full_range(frame: VideoFrame) -> bool:
    """Return True if the luma of a frame has the full range."""
    return frame.format.name.startswith(("yuvj", "gray")) or frame.color_range == _FULL_RANGE


def _plane_array(frame: VideoFrame, number: int) -> Image:
    """Return a view of a plane without the padding of its rows."""
    plane = frame.planes[number]
    rows = np.asarray(memoryview(plane), dtype=np.uint8).reshape(-1, plane.line_size)
    return rows[: plane.height, : plane.width]


def _resize_upright(image: Image, orientation: Orientation, size: tuple[int, int]) -> Image:
    """Turn an image upright and resize it."""
    upright = turn_upright(image, orientation)
    if (upright.shape[1], upright.shape[0]) == size:
        return np.array(upright, order="C")
    import cv2

    # Averaging over the source pixels keeps edges in place and aliases least.
    return np.asarray(cv2.resize(np.ascontiguousarray(upright), size, interpolation=cv2.INTER_AREA))


def turn_upright(image: npt.NDArray[np.uint8], orientation: Orientation) -> npt.NDArray[np.uint8]:
    """Turn a stored image (H,W) or (H,W,3) as a player shows it."""
    (m00, m01), (m10, m11) = orientation
    if m00:
        sign_x, sign_y = m00, m11
    else:
        image, sign_x, sign_y = image.swapaxes(0, 1), m01, m10
    return image[::sign_y, ::sign_x]
