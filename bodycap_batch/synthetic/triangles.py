"""Flat rectangles with textures, textured triangles, and the texture coordinates of rays that meet them.

The synthetic room consists of such rectangles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.synthetic.atlas import Float32

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

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height, metres."""
        return float(np.linalg.norm(self.across)), float(np.linalg.norm(self.down))

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


NEAR_M = 0.03
"""Minimum distance (metres) between the camera and a rendered surface."""
SUBPIXELS = ((-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125))
"""Offsets (x, y; px) of the four samples of a pixel from its centre. They form a rotated grid with four
different rows and columns."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Triangles:
    """Triangles that can be rendered: their planes and textures, all in the same coordinate frame.

    Attributes:
        vertices: (V,3) positions of the vertices, metres.
        faces: (F,3) vertex indices of the triangles.
        normal: (F,3) unit normals of the triangles.
        point: (F,3) a point on the plane of each triangle, metres.
        texel_at_point: (F,2) atlas coordinates (texels) at `point`.
        texels_per_m: (F,2,3) gradient of the atlas coordinates with respect to the position, texels per
            metre.
        plane: (F,) number of the textured plane that holds each triangle. Adjacent triangles have the same
            number if they lie in one plane and share a texture.
        surface: (F,) number of the surface that holds each triangle.
    """

    vertices: FloatArray
    faces: npt.NDArray[np.uint32]
    normal: FloatArray
    point: FloatArray
    texel_at_point: FloatArray
    texels_per_m: FloatArray
    plane: IntArray
    surface: IntArray


def triangles_from_surfaces(surfaces: Sequence[Surface], origins: FloatArray) -> Triangles:
    """Return two triangles for each of N rectangles.

    Args:
        surfaces: The N rectangles.
        origins: (N,2) atlas coordinates (texels) of the top left corners of the rectangles' images.
    """
    corners = np.array([surface.corners() for surface in surfaces])
    quads = np.arange(len(surfaces))[:, None, None] * 4
    faces = (quads + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    edges = np.array([[surface.across, surface.down] for surface in surfaces])
    texels = np.array([surface.image.shape[1::-1] for surface in surfaces], dtype=np.float64)
    gradient = edges * (texels / (edges**2).sum(axis=2))[..., None]
    owner = np.repeat(np.arange(len(surfaces)), 2)
    return Triangles(
        vertices=corners.reshape(-1, 3),
        faces=faces.astype(np.uint32),
        normal=np.array([surface.normal for surface in surfaces])[owner],
        point=corners[owner, 0],
        texel_at_point=origins[owner],
        texels_per_m=gradient[owner],
        plane=owner,
        surface=owner,
    )


def concatenate_triangles(first: Triangles, second: Triangles) -> Triangles:
    """Return one set of triangles that holds all triangles of two sets."""
    return Triangles(
        vertices=np.concatenate([first.vertices, second.vertices]),
        faces=np.concatenate([first.faces, second.faces + np.uint32(len(first.vertices))]),
        normal=np.concatenate([first.normal, second.normal]),
        point=np.concatenate([first.point, second.point]),
        texel_at_point=np.concatenate([first.texel_at_point, second.texel_at_point]),
        texels_per_m=np.concatenate([first.texels_per_m, second.texels_per_m]),
        plane=np.concatenate([first.plane, second.plane + first.plane.max(initial=0) + 1]),
        surface=np.concatenate([first.surface, second.surface + first.surface.max(initial=0) + 1]),
    )


def dot(first: Float32 | Sequence[Float32], second: Float32) -> Float32:
    """Return the scalar products (N,) of vectors (3,N)."""
    return np.asarray(first[0] * second[0] + first[1] * second[1] + first[2] * second[2])


@dataclass(frozen=True, slots=True, kw_only=True)
class Texels:
    """Texture coordinates of the points that N rays meet.

    Attributes:
        rows: (9,N) homographies from viewing directions to the textures of these triangles, row by row.
        inverse: (N,) 1/w, where w is the third homogeneous coordinate that the homography gives for the ray.
        at: (2,N) texel coordinates (x, y) of the points.
    """

    rows: Float32
    inverse: Float32
    at: Float32

    def footprint(self, right: Float32, down: Float32, only: IntArray | None = None) -> Float32:
        """Return the derivatives (4,M) of the texel coordinates `at` with respect to pixel steps.

        Args:
            right: (3,M) change of each ray for a step of one pixel to the right.
            down: (3,M) change of each ray for a step of one pixel down.
            only: (M,) indices of the rays to evaluate; None for all rays.
        """
        rows, inverse, at = self.rows, self.inverse, self.at
        if only is not None:
            rows, inverse, at = rows[:, only], inverse[only], at[:, only]
        out = np.empty((4, len(inverse)), np.float32)
        with np.errstate(invalid="ignore", over="ignore"):
            for index, step in enumerate((right, down)):
                change = dot(rows[6:], step)
                out[2 * index] = (dot(rows[:3], step) - at[0] * change) * inverse
                out[2 * index + 1] = (dot(rows[3:6], step) - at[1] * change) * inverse
        return out


def find_edges(owner: IntArray) -> BoolArray:
    """Return a mask (H,W): True for a pixel with a direct neighbour on another surface.

    Args:
        owner: (H,W) number of the surface at each pixel.
    """
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    return np.asarray(cv2.morphologyEx(owner.astype(np.float32), cv2.MORPH_GRADIENT, cross) > 0)
