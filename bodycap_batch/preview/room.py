"""The room seen from outside: points, floor, cameras and the body, drawn by depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.overlay import Bones
from bodycap_batch.overlay.drawing import side_colour
from bodycap_batch.preview.viewpoint import Viewpoint

Picture = npt.NDArray[np.uint8]
Colour = tuple[int, int, int]

BACKGROUND = np.array([26, 28, 34], dtype=np.uint8)
GRID, _SHADOW = (70, 76, 90), (12, 13, 16)
_OUTLINE = (15, 16, 19)
_MAX_POINTS = 40_000
_SUBPIXEL = 4
_BONE_M = 0.022
_FRUSTUM = np.array([[0, 0, 0], [-0.6, -0.45, 1], [0.6, -0.45, 1], [0.6, 0.45, 1], [-0.6, 0.45, 1.0]])
_FRUSTUM_EDGES = ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1))


@dataclass(frozen=True, slots=True, kw_only=True)
class Cloud:
    """Coloured points: positions (P,3) in the room and colours (P,3)."""

    points: FloatArray
    colours: Picture

    def thinned(self) -> Cloud:
        """At most so many that a picture is drawn in a few milliseconds, evenly taken."""
        stride = -(-len(self.points) // _MAX_POINTS) or 1
        return Cloud(points=self.points[::stride], colours=self.colours[::stride])


def blank(size: tuple[int, int]) -> Picture:
    """An empty picture."""
    return np.full((size[1], size[0], 3), BACKGROUND, dtype=np.uint8)


def draw_cloud(image: Picture, view: Viewpoint, cloud: Cloud) -> None:
    """Points by depth, fading into the background with distance; those right before the lens are left out."""
    px, depth = view.project(cloud.points)
    at = np.round(px).astype(np.int64)
    height, width = image.shape[:2]
    shown = (depth > 0.35 * view.distance) & (at >= 1).all(axis=1)
    shown &= (at[:, 0] < width - 2) & (at[:, 1] < height - 2)
    order = np.flatnonzero(shown)
    order = order[np.argsort(-depth[order], kind="stable")]
    strength = np.clip(1.3 - 0.15 * depth[order] / view.distance, 0.5, 1.0)[:, None]
    colours = (strength * cloud.colours[order] + (1.0 - strength) * BACKGROUND).astype(np.uint8)
    x, y = at[order].T
    for dx, dy in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        image[y + dy, x + dx] = colours
    image[y, x] = colours


def floor_grid(around: FloatArray, spacing: float = 1.0) -> FloatArray:
    """Lines of the floor z = 0 in short pieces (L,2,3), two metres further than some points (N,3)."""
    low = np.floor(around[:, :2].min(axis=0) / spacing - 2).astype(int)
    high = np.ceil(around[:, :2].max(axis=0) / spacing + 2).astype(int)
    pieces = []
    for axis in (0, 1):
        for line in range(low[axis], high[axis] + 1):
            for start in range(low[1 - axis], high[1 - axis]):
                ends = np.zeros((2, 3))
                ends[:, axis], ends[:, 1 - axis] = line, (start, start + 1)
                pieces.append(ends)
    return np.array(pieces) * spacing


def draw_lines(
    image: Picture, view: Viewpoint, lines: FloatArray, colour: Colour, thickness: int = 1
) -> None:
    """Straight pieces (L,2,3); one that reaches behind the viewer is left out."""
    import cv2

    px, depth = view.project(lines)
    near = 0.05 * view.distance
    kept = (depth > near).all(axis=1) & (np.abs(px) < 8192).all(axis=(1, 2))
    cv2.polylines(image, list(_fixed(px[kept])), False, colour, thickness, cv2.LINE_AA, _SUBPIXEL)


def draw_camera(
    image: Picture, view: Viewpoint, room_from_cam: FloatArray, size: float, colour: Colour
) -> None:
    """A small pyramid that looks where a camera looks."""
    corners = (room_from_cam[:3, :3] @ (size * _FRUSTUM).T).T + room_from_cam[:3, 3]
    draw_lines(image, view, corners[np.array(_FRUSTUM_EDGES)], colour, 1)


def draw_path(image: Picture, view: Viewpoint, centres: FloatArray, colour: Colour) -> None:
    """A line through centres (N,3), broken where one is not known (NaN)."""
    pieces = np.stack([centres[:-1], centres[1:]], axis=1)
    draw_lines(image, view, pieces[np.isfinite(pieces).all(axis=(1, 2))], colour)


def draw_body(image: Picture, view: Viewpoint, bones: Bones, sides: Sequence[str]) -> None:
    """Bones by depth over their shadow; measured ones solid, inferred ones thin and dashed."""
    shadow = bones.ends_in_world.copy()
    shadow[..., 2] = 0.0
    draw_lines(image, view, shadow, _SHADOW, 3)
    px, depth = view.project(bones.ends_in_world)
    order = np.argsort(-depth.mean(axis=1), kind="stable")
    for bone in order.tolist():
        if (depth[bone] <= 0.05 * view.distance).any():
            continue
        width = max(2, round(2 * _BONE_M * view.focal_px / float(depth[bone].mean())))
        _draw_bone(image, px[bone], width, side_colour(sides[bone]), solid=bool(bones.observed[bone]))


def _draw_bone(image: Picture, ends: FloatArray, width: int, colour: Colour, *, solid: bool) -> None:
    import cv2

    if solid:
        line = list(_fixed(ends[None]))
        cv2.polylines(image, line, False, _OUTLINE, width + 4, cv2.LINE_AA, _SUBPIXEL)
        cv2.polylines(image, line, False, colour, width, cv2.LINE_AA, _SUBPIXEL)
        joints = list(_fixed(ends[:, None].repeat(2, axis=1)))
        cv2.polylines(image, joints, False, colour, width + 3, cv2.LINE_AA, _SUBPIXEL)
        return
    count = max(2, round(float(np.linalg.norm(ends[1] - ends[0])) / 9.0))
    share = np.linspace(0.0, 1.0, 2 * count)[:, None]
    dashes = ((1.0 - share) * ends[0] + share * ends[1]).reshape(count, 2, 2)
    red, green, blue = (round(0.75 * part) for part in colour)
    cv2.polylines(
        image, list(_fixed(dashes)), False, (red, green, blue), max(2, width // 3), cv2.LINE_AA, _SUBPIXEL
    )


def _fixed(px: FloatArray) -> npt.NDArray[np.int32]:
    return np.asarray(np.round(px * (1 << _SUBPIXEL)), dtype=np.int32)
