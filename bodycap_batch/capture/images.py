"""Convert a decoded frame to an image at the work size, the image size that all stages work at."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from bodycap_batch.capture.video import Orientation

if TYPE_CHECKING:
    from av.video.frame import VideoFrame

Image = npt.NDArray[np.uint8]
Planes = npt.NDArray[np.uint8]
"""Planes of an image with even width W and height H, in one array (1.5·H,W).

The luma comes first, then both chroma planes at half resolution."""
Colours = tuple[int, int]
"""Colour range and colour matrix of an image in luma and chroma, each given as FFmpeg's number."""

_LUMA_FORMATS = frozenset(
    f"{family}{layout}" for family in ("yuv", "yuvj") for layout in ("420p", "422p", "444p", "440p", "411p")
) | {"nv12", "nv21", "nv16", "gray"}
"""Pixel formats whose first plane is the luma with 8 bits. This plane is used as the grey image."""
_FULL_RANGE = 2
"""FFmpeg's number for the full colour range."""
_STUDIO_TO_FULL = np.clip(np.round((np.arange(256) - 16.0) * (255.0 / 219.0)), 0, 255).astype(np.uint8)
"""Look-up table from luma in studio range to luma in full range. Source: ITU-R BT.601, in which black is 16
and white is 235."""


def work_image(
    frame: VideoFrame,
    orientation: Orientation,
    size: tuple[int, int],
    *,
    colour: bool,
    shown: tuple[int, int] | None = None,
) -> Image:
    """Convert a decoded frame to an upright image at the work size.

    Args:
        frame: The decoded frame.
        orientation: Display matrix of the frame.
        size: Width and height of the result, pixels.
        colour: True for an RGB image, False for a grey image.
        shown: Width and height of the image without padding, pixels, if the frame was padded to even sides.
            None if the frame is not padded.

    Returns:
        The image in full range, contiguous: (H,W,3) for RGB or (H,W) for grey.
    """
    width, height = shown or (frame.width, frame.height)
    if colour or frame.format.name not in _LUMA_FORMATS:
        picture = np.asarray(frame.to_ndarray(format="rgb24" if colour else "gray"), dtype=np.uint8)
        return _resize_upright(picture[:height, :width], orientation, size)
    image = _resize_upright(_plane_array(frame, 0)[:height, :width], orientation, size)
    return image if _is_full_range(frame) else _expand_range(image)


def grey_from_planes(planes: tuple[Planes, Colours], size: tuple[int, int]) -> Image:
    """Return the grey image (H,W) of planes from `work_planes`, in full range.

    Args:
        planes: The planes, with their colour range and colour matrix.
        size: Width and height of the image without padding, pixels.
    """
    luma = np.ascontiguousarray(planes[0][: size[1], : size[0]])
    return luma if planes[1][0] == _FULL_RANGE else _expand_range(luma)


def _expand_range(luma: Image) -> Image:
    """Convert luma from studio range to full range."""
    import cv2

    return np.asarray(cv2.LUT(luma, _STUDIO_TO_FULL), dtype=np.uint8)


def work_planes(frame: VideoFrame, orientation: Orientation, size: tuple[int, int]) -> tuple[Planes, Colours]:
    """Convert a decoded frame to upright planes at the work size, padded to even sides.

    The planes keep the colour range of the frame. If the frame has the work size, 8 bits and chroma at half
    resolution (4:2:0), the planes contain exactly the values of the frame. For other formats, the error of
    the luma is at most one grey level.

    Args:
        frame: The decoded frame.
        orientation: Display matrix of the frame.
        size: Width and height of the result before padding, pixels.

    Returns:
        The planes, with their colour range and colour matrix.
    """
    is_full = _is_full_range(frame)
    colours = (_FULL_RANGE if is_full else int(frame.color_range), int(frame.colorspace))
    if frame.format.name not in ("yuv420p", "yuvj420p"):
        # Without an explicit target range, FFmpeg would convert two kinds of frames to studio range: grey
        # frames, and frames in a format whose name implies full range.
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
    """Return a view of one plane of a frame, without the padding at the ends of the rows."""
    plane = frame.planes[number]
    rows = np.asarray(memoryview(plane), dtype=np.uint8).reshape(-1, plane.line_size)
    return rows[: plane.height, : plane.width]


def _resize_upright(image: Image, orientation: Orientation, size: tuple[int, int]) -> Image:
    """Rotate and mirror an image to its upright orientation, and resize the image."""
    upright = turn_upright(image, orientation)
    if (upright.shape[1], upright.shape[0]) == size:
        return np.array(upright, order="C")
    import cv2

    # The mean over the source pixels (INTER_AREA) keeps edges in place and has the least aliasing.
    return np.asarray(cv2.resize(np.ascontiguousarray(upright), size, interpolation=cv2.INTER_AREA))


def turn_upright(image: npt.NDArray[np.uint8], orientation: Orientation) -> npt.NDArray[np.uint8]:
    """Rotate and mirror a stored image (H,W) or (H,W,3) to the orientation that a player shows."""
    (m00, m01), (m10, m11) = orientation
    if m00:
        sign_x, sign_y = m00, m11
    else:
        image, sign_x, sign_y = image.swapaxes(0, 1), m01, m10
    return image[::sign_y, ::sign_x]
