"""Draw overlays into RGB images."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.camera import CV2_PIXEL_OFFSET_PX
from bodycap_batch.overlay.bones import BoneLine
from bodycap_batch.overlay.camera_views import ObservedPoints

RgbImage = npt.NDArray[np.uint8]
Colour = tuple[int, int, int]

LEFT_COLOUR, RIGHT_COLOUR, MIDDLE_COLOUR = (86, 180, 233), (240, 150, 20), (250, 250, 250)
"""RGB colours of bones on the left, on the right and in the middle: sky blue, orange and white.

Colour-blind people can distinguish them.
Source: M. Okabe, K. Ito, Color Universal Design."""
_OUTLINE_COLOUR = (20, 20, 20)
"""RGB colour of the dark border around bones."""
_SMALL_ERROR_COLOUR, _LARGE_ERROR_COLOUR = np.array([60.0, 220.0, 120.0]), np.array([235.0, 60.0, 60.0])
"""RGB colours of points without an error and of points with an error of at least `_LARGE_ERROR_PX`: green and
red."""
_LARGE_ERROR_PX = 3.0
"""Pixels at 640 px image width: minimum reprojection error that is drawn fully red. Evidence: none."""
_COLOUR_STEPS = 6
"""Number of colours from green to red. The number is small, because OpenCV is called separately for each
colour."""
SUBPIXEL_BITS = 4
"""Number of fractional bits in OpenCV's fixed-point coordinates: sixteenths of a pixel."""


def side_colour(side: str) -> Colour:
    """Return the colour of a bone from its side of the body.

    Args:
        side: "Left", "Right", or any other text for the middle.
    """
    return {"Left": LEFT_COLOUR, "Right": RIGHT_COLOUR}.get(side, MIDDLE_COLOUR)


def draw_overlay(
    image: RgbImage,
    width_px: int,
    points: ObservedPoints | None,
    lines: Sequence[BoneLine],
    sides: Sequence[str],
) -> RgbImage:
    """Draw points and bones into a copy of an image.

    A dot marks the pixel to which the solved pose projects a point. It is green if the error is small and red
    if the error is large. A thin line connects the dot with the observed pixel. Measured bones are solid.
    Inferred bones are thinner and dashed.

    Args:
        image: (H,W,3) RGB image of any size.
        width_px: Image width of the lens, to which the pixels of `points` and `lines` refer.
        points: Observed points from `CameraView.inliers_at`; None for no points.
        lines: Visible parts of bones from `project_bones`.
        sides: Side of each bone, from `BoneMotion.sides`.

    Returns:
        (H,W,3) the new image.
    """
    drawn = np.ascontiguousarray(image).copy()
    scale = image.shape[1] / width_px
    if points is not None:
        _draw_points(drawn, points, scale, _LARGE_ERROR_PX * width_px / 640.0)
    thickness = max(1, round(image.shape[1] / 420))
    for is_outline in (True, False):
        for line in lines:
            colour = _OUTLINE_COLOUR if is_outline else side_colour(sides[line.bone])
            _draw_bone(drawn, line, scale, colour, thickness + (2 if is_outline else 0))
    return drawn


def _draw_points(image: RgbImage, points: ObservedPoints, scale: float, large_error_px: float) -> None:
    """Draw points. All points of one colour need only two OpenCV calls.

    A dot is a line of length zero. The line to the observed pixel is omitted if the dot covers that pixel.
    """
    import cv2

    error_share = np.clip(points.error_px / large_error_px, 0.0, 1.0)
    step_of_point = np.round(error_share * (_COLOUR_STEPS - 1)).astype(int)
    projected, observed = _fixed_point(points.px, scale), _fixed_point(points.observed_px, scale)
    diameter = 1 + 2 * max(1, round(image.shape[1] / 480))
    outside_dot = np.linalg.norm(observed - projected, axis=1) > 0.5 * diameter * (1 << SUBPIXEL_BITS)
    for step in range(_COLOUR_STEPS):
        in_step = step_of_point == step
        if not in_step.any():
            continue
        share = step / (_COLOUR_STEPS - 1)
        colour = np.round((1.0 - share) * _SMALL_ERROR_COLOUR + share * _LARGE_ERROR_COLOUR)
        rgb = colour.astype(int).tolist()
        error_lines = np.stack([projected, observed], axis=1)[in_step & outside_dot]
        dots = np.stack([projected[in_step], projected[in_step]], axis=1)
        cv2.polylines(image, list(error_lines), False, rgb, 1, cv2.LINE_AA, SUBPIXEL_BITS)
        cv2.polylines(image, list(dots), False, rgb, diameter, cv2.LINE_AA, SUBPIXEL_BITS)


def _draw_bone(image: RgbImage, line: BoneLine, scale: float, colour: Colour, thickness: int) -> None:
    import cv2

    px = _fixed_point(line.px, scale)
    pieces = [px] if line.observed else [px[start : start + 2] for start in range(0, len(px) - 1, 2)]
    thickness += int(line.observed)
    cv2.polylines(image, pieces, False, colour, thickness, cv2.LINE_AA, SUBPIXEL_BITS)
    if line.observed:
        joints = [px[[0, 0]], px[[-1, -1]]]
        cv2.polylines(image, joints, False, colour, thickness + 2, cv2.LINE_AA, SUBPIXEL_BITS)


def _fixed_point(px: FloatArray, scale: float) -> npt.NDArray[np.int32]:
    """Convert COLMAP pixels to OpenCV's fixed-point pixels of an image that is `scale` times as large."""
    return np.asarray(np.round((px * scale - CV2_PIXEL_OFFSET_PX) * (1 << SUBPIXEL_BITS)), dtype=np.int32)
