"""Textured triangles, and the texture coordinates of rays that meet them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.synthetic.atlas import Float32
from bodycap_batch.synthetic.surfaces import Surface

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
        faces: (N,) indices of the triangles that the rays meet, or `NOTHING`.
        rows: (9,N) homographies from viewing directions to the textures of these triangles, row by row.
        inverse: (N,) 1/w, where w is the third homogeneous coordinate that the homography gives for the ray.
        at: (2,N) texel coordinates (x, y) of the points.
    """

    faces: IntArray
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
    edge = np.zeros(owner.shape, dtype=bool)
    across, along = owner[:, 1:] != owner[:, :-1], owner[1:] != owner[:-1]
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= along
    edge[:-1] |= along
    return edge
