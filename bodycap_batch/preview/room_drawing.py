"""Draw the room from outside: points, floor, cameras and the body, from far to near."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.overlay import Bones, Colour, RgbImage
from bodycap_batch.overlay.drawing import SUBPIXEL_BITS, side_colour
from bodycap_batch.preview.viewpoint import Viewpoint

BACKGROUND = np.array([26, 28, 34], dtype=np.uint8)
"""RGB colour of the dark background. The colours of cameras and limbs are chosen for this background."""
GRID_COLOUR, _SHADOW_COLOUR = (70, 76, 90), (12, 13, 16)
"""RGB colours of the floor's grid and of the body's shadow on the floor."""
_OUTLINE_COLOUR = (15, 16, 19)
"""RGB colour of the dark border around measured bones."""
_MAX_POINTS = 40_000
"""Maximum number of points drawn in each image. These points are drawn in a few milliseconds."""
_BONE_RADIUS_M = 0.022
"""Metres: radius of a drawn bone. Evidence: none."""
_MIN_POINT_DEPTH, _MIN_LINE_DEPTH = 0.35, 0.05
"""Minimum depth of points and minimum depth of lines, as a fraction of the target's distance.

Nearer points would cover the body. A line to a point behind the viewer has no meaningful projection."""
_MAX_LINE_PX = 8192
"""Pixels: maximum coordinate of a drawn line. OpenCV's fixed-point coordinates overflow at 2^15 or more."""
_DASH_PX = 9.0
"""Pixels: length of a dash of an inferred bone together with the gap after it. Evidence: none."""
_FRUSTUM = np.array([[0, 0, 0], [-0.6, -0.45, 1], [0.6, -0.45, 1], [0.6, 0.45, 1], [-0.6, 0.45, 1.0]])
"""Corners (5,3) of a camera's symbol: the camera centre and the corners of a 4:3 image at depth 1."""
_FRUSTUM_EDGES = ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1))
"""Pairs of corners that are connected by a line."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ColouredPoints:
    """Points of the room.

    Attributes:
        points: (P,3) positions in the room.
        colours: (P,3) RGB colours.
    """

    points: FloatArray
    colours: RgbImage

    def thinned(self) -> ColouredPoints:
        """Return at most `_MAX_POINTS` points, evenly selected."""
        stride = -(-len(self.points) // _MAX_POINTS) or 1
        return ColouredPoints(points=self.points[::stride], colours=self.colours[::stride])


def blank_image(size: tuple[int, int]) -> RgbImage:
    """Return an image (H,W,3) of the background. The argument `size` is its width and its height, pixels."""
    return np.full((size[1], size[0], 3), BACKGROUND, dtype=np.uint8)


def draw_points(image: RgbImage, view: Viewpoint, cloud: ColouredPoints) -> None:
    """Draw points from far to near.

    The points fade with distance. Points close to the viewer are omitted.
    """
    px, depth = view.project(cloud.points)
    pixel = np.round(px).astype(np.int64)
    height, width = image.shape[:2]
    visible = (depth > _MIN_POINT_DEPTH * view.distance) & (pixel >= 1).all(axis=1)
    visible &= (pixel[:, 0] < width - 2) & (pixel[:, 1] < height - 2)
    order = np.flatnonzero(visible)
    order = order[np.argsort(-depth[order], kind="stable")]
    opacity = np.clip(1.3 - 0.15 * depth[order] / view.distance, 0.5, 1.0)[:, None]
    colours = (opacity * cloud.colours[order] + (1.0 - opacity) * BACKGROUND).astype(np.uint8)
    x, y = pixel[order].T
    for dx, dy in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        image[y + dy, x + dx] = colours
    image[y, x] = colours


def floor_grid(positions: FloatArray, spacing: float = 1.0) -> FloatArray:
    """Return short lines (L,2,3) of a grid on the floor z = 0.

    Args:
        positions: (N,3) positions. The grid extends at least two cells beyond them.
        spacing: Side of a cell.
    """
    low = np.floor(positions[:, :2].min(axis=0) / spacing - 2).astype(int)
    high = np.ceil(positions[:, :2].max(axis=0) / spacing + 2).astype(int)
    lines = []
    for axis in (0, 1):
        for offset in range(low[axis], high[axis] + 1):
            for start in range(low[1 - axis], high[1 - axis]):
                ends = np.zeros((2, 3))
                ends[:, axis], ends[:, 1 - axis] = offset, (start, start + 1)
                lines.append(ends)
    return np.array(lines) * spacing


def draw_lines(
    image: RgbImage, view: Viewpoint, lines: FloatArray, colour: Colour, thickness: int = 1
) -> None:
    """Draw straight lines (L,2,3). A line is omitted if one of its ends is behind the viewer."""
    px, depth = view.project(lines)
    min_depth = _MIN_LINE_DEPTH * view.distance
    drawable = (depth > min_depth).all(axis=1) & (np.abs(px) < _MAX_LINE_PX).all(axis=(1, 2))
    _draw_px(image, px[drawable], colour, thickness)


def draw_camera(
    image: RgbImage, view: Viewpoint, room_from_cam: FloatArray, size: float, colour: Colour
) -> None:
    """Draw a small pyramid that opens in the camera's viewing direction."""
    corners = (room_from_cam[:3, :3] @ (size * _FRUSTUM).T).T + room_from_cam[:3, 3]
    draw_lines(image, view, corners[np.array(_FRUSTUM_EDGES)], colour, 1)


def draw_path(image: RgbImage, view: Viewpoint, centres: FloatArray, colour: Colour) -> None:
    """Draw a line through camera centres (N,3). The line is interrupted at unknown centres (NaN)."""
    pieces = np.stack([centres[:-1], centres[1:]], axis=1)
    draw_lines(image, view, pieces[np.isfinite(pieces).all(axis=(1, 2))], colour)


def draw_body(image: RgbImage, view: Viewpoint, bones: Bones, sides: Sequence[str]) -> None:
    """Draw the shadow of the bones, and then the bones from far to near.

    Measured bones are solid. Inferred bones are thin and dashed.
    """
    shadow = bones.ends_in_world.copy()
    shadow[..., 2] = 0.0
    draw_lines(image, view, shadow, _SHADOW_COLOUR, 3)
    px, depth = view.project(bones.ends_in_world)
    order = np.argsort(-depth.mean(axis=1), kind="stable")
    for bone in order.tolist():
        if (depth[bone] <= _MIN_LINE_DEPTH * view.distance).any():
            continue
        width = max(2, round(2 * _BONE_RADIUS_M * view.focal_px / float(depth[bone].mean())))
        _draw_bone(image, px[bone], width, side_colour(sides[bone]), solid=bool(bones.observed[bone]))


def _draw_bone(image: RgbImage, ends: FloatArray, width: int, colour: Colour, *, solid: bool) -> None:
    if solid:
        _draw_px(image, ends[None], _OUTLINE_COLOUR, width + 4)
        _draw_px(image, ends[None], colour, width)
        _draw_px(image, ends[:, None].repeat(2, axis=1), colour, width + 3)  # the joints
        return
    count = max(2, round(float(np.linalg.norm(ends[1] - ends[0])) / _DASH_PX))
    share = np.linspace(0.0, 1.0, 2 * count)[:, None]
    dashes = ((1.0 - share) * ends[0] + share * ends[1]).reshape(count, 2, 2)
    red, green, blue = (round(0.75 * part) for part in colour)
    _draw_px(image, dashes, (red, green, blue), max(2, width // 3))


def _draw_px(image: RgbImage, lines_px: FloatArray, colour: Colour, thickness: int) -> None:
    """Draw straight lines (L,2,2) between pixels."""
    import cv2

    fixed_point = np.round(lines_px * (1 << SUBPIXEL_BITS)).astype(np.int32)
    cv2.polylines(image, list(fixed_point), False, colour, thickness, cv2.LINE_AA, SUBPIXEL_BITS)
