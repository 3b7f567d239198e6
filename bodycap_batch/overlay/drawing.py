"""Overlays drawn into an RGB picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.camera import CV2_PIXEL_OFFSET_PX
from bodycap_batch.overlay.projection import BoneLine
from bodycap_batch.overlay.views import SeenPoints

Picture = npt.NDArray[np.uint8]
Colour = tuple[int, int, int]

LEFT, RIGHT, MIDDLE = (86, 180, 233), (240, 150, 20), (250, 250, 250)
"""Sky blue, orange and white: told apart by the colour-blind (M. Okabe, K. Ito, Color Universal Design)."""
_OUTLINE = (20, 20, 20)
_GOOD, _BAD = np.array([60.0, 220.0, 120.0]), np.array([235.0, 60.0, 60.0])
_BAD_PX = 3.0
"""Error at 640 px width that is drawn fully red."""
_SHADES = 6
_SUBPIXEL = 4


def side_colour(side: str) -> Colour:
    """The colour of a bone: left, right, or the middle of the body."""
    return {"Left": LEFT, "Right": RIGHT}.get(side, MIDDLE)


def draw_overlay(
    image: Picture,
    width_px: int,
    points: SeenPoints | None,
    lines: Sequence[BoneLine],
    sides: Sequence[str],
) -> Picture:
    """Draw into a copy of a picture.

    Points stand where the solved pose projects them, green where that is right and red where it is off,
    with a hair to where the picture shows them. Measured bones are solid, inferred ones dashed and thinner.

    Args:
        image: (H,W,3) RGB, any size.
        width_px: Width of the pictures that `points` and `lines` speak of (the lens's).
        points: From `CameraView.points_at`.
        lines: From `bone_lines`.
        sides: Side of each bone, as `Body.side`.
    """
    out = np.ascontiguousarray(image).copy()
    scale = image.shape[1] / width_px
    if points is not None:
        _draw_points(out, points, scale, _BAD_PX * width_px / 640.0)
    thin = max(1, round(image.shape[1] / 420))
    for outline in (True, False):
        for line in lines:
            colour = _OUTLINE if outline else side_colour(sides[line.bone])
            _draw_bone(out, line, scale, colour, thin + (2 if outline else 0))
    return out


def _draw_points(image: Picture, points: SeenPoints, scale: float, bad_px: float) -> None:
    """One call for all points of a shade: a dot is a line of no length, and hides a hair that ends in it."""
    import cv2

    shade = np.round(np.clip(points.error_px / bad_px, 0.0, 1.0) * (_SHADES - 1)).astype(int)
    there, seen = _fixed(points.px, scale), _fixed(points.observed_px, scale)
    width = 1 + 2 * max(1, round(image.shape[1] / 480))
    outside = np.linalg.norm(seen - there, axis=1) > 0.5 * width * (1 << _SUBPIXEL)
    for step in range(_SHADES):
        mine = shade == step
        if not mine.any():
            continue
        share = step / (_SHADES - 1)
        colour = np.round((1.0 - share) * _GOOD + share * _BAD).astype(int).tolist()
        hairs = np.stack([there, seen], axis=1)[mine & outside]
        dots = np.stack([there[mine], there[mine]], axis=1)
        cv2.polylines(image, list(hairs), False, colour, 1, cv2.LINE_AA, _SUBPIXEL)
        cv2.polylines(image, list(dots), False, colour, width, cv2.LINE_AA, _SUBPIXEL)


def _draw_bone(image: Picture, line: BoneLine, scale: float, colour: Colour, thickness: int) -> None:
    import cv2

    at = _fixed(line.px, scale)
    pieces = [at] if line.observed else [at[start : start + 2] for start in range(0, len(at) - 1, 2)]
    thickness += int(line.observed)
    cv2.polylines(image, pieces, False, colour, thickness, cv2.LINE_AA, _SUBPIXEL)
    if line.observed:
        joints = [at[[0, 0]], at[[-1, -1]]]
        cv2.polylines(image, joints, False, colour, thickness + 2, cv2.LINE_AA, _SUBPIXEL)


def _fixed(px: FloatArray, scale: float) -> npt.NDArray[np.int32]:
    """COLMAP pixels of another size as OpenCV's fixed-point coordinates."""
    return np.asarray(np.round((px * scale - CV2_PIXEL_OFFSET_PX) * (1 << _SUBPIXEL)), dtype=np.int32)
