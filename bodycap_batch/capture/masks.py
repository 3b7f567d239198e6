"""Read a mask image, which marks the part of a camera's picture where the room is visible."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import BoolArray
from bodycap_batch.core.errors import CaptureError

_WHITE_LEVEL = 128
"""Minimum grey level of a pixel that is treated as white."""
_ASPECT_TOLERANCE = 0.01
"""Maximum relative difference between the aspect ratios of mask and picture. Origin: image sizes are rounded
to even numbers. Evidence: none."""
_MIN_WHITE_RATIO = 0.05
"""Minimum fraction of the pixels of a mask that are white. Evidence: none."""


def read_mask(path: Path, size: tuple[int, int], stored_size: tuple[int, int] | None = None) -> BoolArray:
    """Read a mask image that is white where the room is visible.

    Args:
        path: Path of the mask image. It may have any size, with the aspect ratio of the picture.
        size: Width and height of the picture, pixels.
        stored_size: Width and height in stored pixels, if they are not square. The mask may have this shape.

    Returns:
        Read-only mask (H,W) that is True where the room is visible.

    Raises:
        CaptureError: The mask is missing, is not an image, has another aspect ratio than the picture, or is
            almost completely black.
    """
    import cv2

    def error_because(reason: str, hint: str) -> CaptureError:
        return CaptureError(reason, path=path, field="mask", hint=hint)

    if not path.is_file():
        raise error_because(
            "there is no such mask file",
            "correct the path of the mask in the job; a relative path starts at the folder of the job file",
        )
    image = cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise error_because("the mask cannot be read as a picture", "save the mask as a PNG picture")
    height, width = image.shape
    shapes = (size, stored_size or size)
    if all(abs(width * high / (height * wide) - 1.0) > _ASPECT_TOLERANCE for wide, high in shapes):
        raise error_because(
            f"the mask is {width}×{height}, but the picture is {size[0]}×{size[1]}: their aspect ratios "
            "differ",
            "paint the mask over one frame of the video, in the orientation that a video player shows",
        )
    mask: BoolArray = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA) >= _WHITE_LEVEL)
    if mask.mean() < _MIN_WHITE_RATIO:
        raise error_because(
            f"the mask leaves only {100 * mask.mean():.1f} % of the picture visible",
            "paint the room white and the wearer black; the mask may be inverted",
        )
    mask.flags.writeable = False
    return mask


def without_regions(mask: BoolArray | None, regions: BoolArray, size: tuple[int, int]) -> BoolArray | None:
    """Return a mask in which some regions are not part of the room.

    Args:
        mask: (H,W) True where the room is visible; None if it is visible everywhere.
        regions: (R,C) mask of cells that divide the picture evenly, True for each cell to leave out.
        size: Width and height of the picture, pixels.

    Returns:
        Mask (H,W), True where the room is visible; `mask` itself if there are no regions.
    """
    import cv2

    if not regions.any():
        return mask
    cells = cv2.resize(regions.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) == 0
    return np.asarray(cells if mask is None else mask & cells)
