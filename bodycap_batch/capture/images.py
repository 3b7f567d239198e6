"""From a decoded frame to the image a stage works on."""

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
"""Range and matrix of luma and chroma, as FFmpeg numbers them."""

# Formats whose first plane is 8-bit luma and can be taken as it is.
_LUMA_FORMATS = frozenset(
    f"{family}{layout}" for family in ("yuv", "yuvj") for layout in ("420p", "422p", "444p", "440p", "411p")
) | {"nv12", "nv21", "nv16", "gray"}
_FULL_RANGE = 2
# Studio range to full range (ITU-R BT.601: black 16, white 235).
_STUDIO_TO_FULL = np.clip(np.round((np.arange(256) - 16.0) * (255.0 / 219.0)), 0, 255).astype(np.uint8)


def work_image(
    frame: VideoFrame,
    orientation: Orientation,
    size: tuple[int, int],
    *,
    colour: bool,
    shown: tuple[int, int] | None = None,
) -> Image:
    """Grey (H,W) or RGB (H,W,3), upright, at (width, height), full range; an own, contiguous array.

    Args:
        frame: As it was decoded.
        orientation: How it is turned.
        size: Width and height wanted.
        colour: RGB instead of grey.
        shown: Width and height of what counts of it, where it was filled up to even sides.
    """
    width, height = shown or (frame.width, frame.height)
    if colour or frame.format.name not in _LUMA_FORMATS:
        picture = np.asarray(frame.to_ndarray(format="rgb24" if colour else "gray"), dtype=np.uint8)
        return _resize_upright(picture[:height, :width], orientation, size)
    image = _resize_upright(_plane_array(frame, 0)[:height, :width], orientation, size)
    return image if _is_full_range(frame) else _expand_range(image)


def grey_from_planes(planes: tuple[Planes, Colours], size: tuple[int, int]) -> Image:
    """Grey (H,W), full range, of what `work_planes` made."""
    luma = np.ascontiguousarray(planes[0][: size[1], : size[0]])
    return luma if planes[1][0] == _FULL_RANGE else _expand_range(luma)


def _expand_range(luma: Image) -> Image:
    """Luma of studio range in full range."""
    import cv2

    return np.asarray(cv2.LUT(luma, _STUDIO_TO_FULL), dtype=np.uint8)


def work_planes(frame: VideoFrame, orientation: Orientation, size: tuple[int, int]) -> tuple[Planes, Colours]:
    """Luma and halved chroma, upright, at (width, height) filled up to even sides, in the frame's own range.

    Where the size is the frame's own and it has 8 bits and halved chroma already (4:2:0), they are its
    planes, unchanged; of another format luma is within one level.
    """
    full = _is_full_range(frame)
    colours = (_FULL_RANGE if full else int(frame.color_range), int(frame.colorspace))
    if frame.format.name not in ("yuv420p", "yuvj420p"):
        # Left to itself it makes studio range of grey and of what only its format tells to be full.
        frame = frame.reformat(format="yuv420p", dst_color_range=_FULL_RANGE if full else None)
    half = ((size[0] + 1) // 2, (size[1] + 1) // 2)
    luma = _resize_upright(_plane_array(frame, 0), orientation, size)
    luma = np.pad(luma, ((0, size[1] % 2), (0, size[0] % 2)), mode="edge")
    chroma = [
        _resize_upright(_plane_array(frame, number), orientation, half).reshape(-1) for number in (1, 2)
    ]
    flat = np.concatenate([luma.reshape(-1), *chroma])
    return flat.reshape(-1, luma.shape[1]), colours


def _is_full_range(frame: VideoFrame) -> bool:
    return frame.format.name.startswith(("yuvj", "gray")) or frame.color_range == _FULL_RANGE


def _plane_array(frame: VideoFrame, number: int) -> Image:
    """A view of a plane, without the padding of its rows."""
    plane = frame.planes[number]
    rows = np.asarray(memoryview(plane), dtype=np.uint8).reshape(-1, plane.line_size)
    return rows[: plane.height, : plane.width]


def _resize_upright(image: Image, orientation: Orientation, size: tuple[int, int]) -> Image:
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
