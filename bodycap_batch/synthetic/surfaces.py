"""Flat rectangles with textures. The synthetic room consists of such rectangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import so3_exp

UINT8 = npt.NDArray[np.uint8]
"""An array of uint8, usually an RGB image (H,W,3)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Surface:
    """A flat rectangle with an image as its texture.

    Attributes:
        corner: (3,) world position (m) of the image's top left corner.
        across: (3,) vector (m) from the top left to the top right corner.
        down: (3,) vector (m) from the top left to the bottom left corner.
        image: (H,W,3) RGB texture.
        shines: True for a lamp. The image of a lamp is not multiplied by the light of the room.
    """

    corner: FloatArray
    across: FloatArray
    down: FloatArray
    image: UINT8
    shines: bool = False

    @property
    def normal(self) -> FloatArray:
        """Unit normal (3,) on the front side, where the image does not look mirrored."""
        normal = np.cross(self.down, self.across)
        return np.asarray(normal / np.linalg.norm(normal))

    def corners(self) -> FloatArray:
        """Return the world positions (4,3) of the corners: top left, top right, bottom right, bottom left."""
        edges = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) @ np.stack([self.across, self.down])
        return np.asarray(self.corner + edges)


def surface_facing(
    centre: npt.ArrayLike, normal: npt.ArrayLike, size_m: tuple[float, float], image: UINT8
) -> Surface:
    """Return a vertical rectangle that faces a horizontal direction.

    Args:
        centre: (3,) world position (m) of the centre.
        normal: (3,) horizontal unit normal on the side of the image.
        size_m: Width and height, metres.
        image: (H,W,3) RGB texture.
    """
    normal = np.asarray(normal, dtype=np.float64)
    up = np.array([0.0, 0.0, 1.0])
    across = np.cross(up, normal) * size_m[0]
    down = -up * size_m[1]
    corner = np.asarray(centre, dtype=np.float64) - across / 2 - down / 2
    return Surface(corner=corner, across=across, down=down, image=image)


def box_faces(centre: npt.ArrayLike, size_m: npt.ArrayLike, yaw_deg: float) -> list[Surface]:
    """Return the six faces of a box: four sides, top, bottom. Each image is a single black texel.

    Args:
        centre: (3,) world position (m) of the middle of the box.
        size_m: (3,) sizes (m) along the x and y axes of the box, and along the vertical.
        yaw_deg: Rotation of the box about the vertical, degrees.
    """
    centre, size = np.asarray(centre, dtype=np.float64), np.asarray(size_m, dtype=np.float64)
    turn = so3_exp(np.array([0.0, 0.0, np.radians(yaw_deg)]))
    blank = np.zeros((1, 1, 3), np.uint8)
    faces = []
    for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
        normal = turn[:, axis] * sign
        middle = centre + normal * size[axis] / 2
        faces.append(surface_facing(middle, normal, (float(size[1 - axis]), float(size[2])), blank))
    for top in (1.0, -1.0):
        across, down = turn[:, 0] * size[0], turn[:, 1] * size[1] * -top
        middle = centre + np.array([0, 0, top * size[2] / 2])
        faces.append(Surface(corner=middle - across / 2 - down / 2, across=across, down=down, image=blank))
    return faces
