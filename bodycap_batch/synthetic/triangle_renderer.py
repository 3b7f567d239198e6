"""Render textured triangles.

The library Embree finds the triangle of each pixel. A homography gives the position of the pixel on the
triangle's texture. On a flat triangle with an affine texture, the texture coordinates are a projective
function of the viewing direction. The derivative of this function gives the exact footprint of a pixel.

Pixels at the edge between two surfaces get four samples. To save time, rays are first cast at every second
pixel. If four neighbouring rays of this grid meet the same plane, the pixels between them are assumed to meet
this plane too. Objects thinner than two pixels can therefore be missed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.synthetic.atlas import Atlas, Bytes, Filter, Float32, select_filter
from bodycap_batch.synthetic.lens import RayGrid
from bodycap_batch.synthetic.raycast import NOTHING, RayScene
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
        gain: (F,) brightness factor of each triangle.
    """

    vertices: FloatArray
    faces: npt.NDArray[np.uint32]
    normal: FloatArray
    point: FloatArray
    texel_at_point: FloatArray
    texels_per_m: FloatArray
    plane: IntArray
    surface: IntArray
    gain: Float32


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
        gain=np.ones(len(owner), np.float32),
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
        gain=np.concatenate([first.gain, second.gain]),
    )


def dot(first: Float32 | Sequence[Float32], second: Float32) -> Float32:
    """Return the scalar products (N,) of vectors (3,N)."""
    return np.asarray(first[0] * second[0] + first[1] * second[1] + first[2] * second[2])


def _in_cameras(rotation: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return vectors (F,3) of the world in the axes of B cameras (B,3,3), as an array (3,B,F).

    `np.einsum` gives the same bits, but takes twice as long for the many poses of a rolling shutter.
    """
    axes = rotation.transpose(2, 1, 0)[..., None]
    x, y, z = vectors.T[:, None]
    return np.asarray(axes[:, 0] * x + axes[:, 1] * y + axes[:, 2] * z)


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


def shared_filters(
    texels: Texels, lens: Sequence[Float32], size: tuple[int, ...], uniform: BoolArray
) -> tuple[Filter, IntArray]:
    """Return filters for all pixels. Cells of 2×2 pixels share a filter where possible.

    Args:
        texels: Texture coordinates of the H·W pixels.
        lens: Three arrays (3,H·W): the rays, their changes for a step of one pixel to the right, and their
            changes for a step of one pixel down.
        size: Size (H,W) of the image.
        uniform: (H·W,) True for a pixel between four rays that meet the same plane. Only such pixels share
            filters.

    Returns:
        The filters, and the index (H·W,) of each pixel's filter.
    """
    index = np.arange(size[0] * size[1]).reshape(size)
    corners = index[::2, ::2].ravel()
    cell = (index // size[1] // 2 * -(-size[1] // 2) + index % size[1] // 2).ravel()
    single = np.flatnonzero(~uniform)
    cell[single] = len(corners) + np.arange(len(single))
    only = np.concatenate([corners, single])
    return select_filter(texels.footprint(lens[1][:, only], lens[2][:, only], only)), cell


class SceneRenderer:
    """Renderer of images of textured triangles.

    Args:
        triangles: All triangles, in the world frame.
        atlas: Atlas that holds the textures of the triangles.
    """

    def __init__(self, triangles: Triangles, atlas: Atlas) -> None:
        self._triangles = triangles
        self._atlas = atlas
        self._shaded = bool((triangles.gain != 1).any())
        self._scene = RayScene(triangles.vertices, triangles.faces)

    def image(self, grid: RayGrid, world_from_cam: FloatArray, rows: slice) -> Bytes:
        """Render consecutive rows of an image.

        Args:
            grid: Viewing rays of the lens.
            world_from_cam: (4,4) camera pose of all rows, or (rows,4,4) camera pose of each row.
            rows: Range of the rows to render.

        Returns:
            (rows,W,3) RGB image, 0 to 255, without noise.
        """
        poses = world_from_cam.reshape(-1, 4, 4)
        size = grid.valid[rows].shape
        vectors = grid.planes[:, rows].reshape(9, -1)
        lens = [vectors[:3], vectors[3:6], vectors[6:]]
        pose_of = np.repeat(np.arange(size[0]), size[1]) if len(poses) > 1 else None
        tables = self._homographies(poses)
        faces, uniform = self._hit_grid(lens[0], size, poses, pose_of)
        texels = self._texels(faces, pose_of, tables, lens[0])
        colours = self._colours(texels, *shared_filters(texels, lens, size, uniform))
        owner = np.append(self._triangles.surface, NOTHING)[faces.reshape(size)]
        edge = np.flatnonzero(find_edges(owner))
        if len(edge):
            rays, right, down = (part[:, edge] for part in lens)
            near = [rays + np.float32(x) * right + np.float32(y) * down for x, y in SUBPIXELS]
            count = len(SUBPIXELS)
            fine, fine_pose_of = np.concatenate(near, axis=1), None
            if pose_of is not None:
                fine_pose_of = np.tile(pose_of[edge], count)
            texels = self._texels(self._hit(fine, poses, fine_pose_of), fine_pose_of, tables, fine)
            steps = np.tile(right, count), np.tile(down, count)
            samples = self._colours(texels, select_filter(texels.footprint(*steps)), None)
            colours[edge] = samples.reshape(count, -1, 3).mean(axis=0)
        colours[~grid.valid[rows].reshape(-1)] = 0
        return np.asarray(colours.reshape(*size, 3))

    def _homographies(self, poses: FloatArray) -> Float32:
        """Return a homography (9,B·F) for each of B poses and F triangles.

        Each homography maps a direction in the camera frame to homogeneous atlas coordinates (u·w, v·w, w).
        """
        shape, out = self._triangles, np.empty((3, 3, len(poses), len(self._triangles.faces)))
        rotation, centre = poses[:, :3, :3], poses[:, :3, 3]
        normal = _in_cameras(rotation, shape.normal)
        offset = shape.point[None] - centre[:, None]
        depth = np.einsum("fj,bfj->bf", shape.normal, offset)
        for axis in range(2):
            gradient = shape.texels_per_m[:, axis]
            here = shape.texel_at_point[:, axis] - np.einsum("fj,bfj->bf", gradient, offset)
            out[axis] = here * normal + depth * _in_cameras(rotation, gradient)
        out[2] = normal
        return out.reshape(9, -1).astype(np.float32)

    def _hit_grid(
        self, rays: Float32, size: tuple[int, int], poses: FloatArray, pose_of: IntArray | None
    ) -> tuple[IntArray, BoolArray]:
        """Return the index (H·W,) of the first triangle on each ray (3,H·W) of an image, or `NOTHING`.

        Only a part of the rays is cast. Also return a mask (H·W,): True for a pixel between four cast rays
        that meet the same plane.
        """
        faces = np.full(size[0] * size[1], NOTHING, np.int64)
        index = np.arange(len(faces)).reshape(size)

        def cast(at: IntArray) -> None:
            faces[at] = self._hit(rays[:, at], poses, None if pose_of is None else pose_of[at])

        coarse = index[::2, ::2]
        cast(coarse.ravel())
        plane = np.append(self._triangles.plane, NOTHING)[faces[coarse]]
        corners = plane[:-1, :-1], plane[:-1, 1:], plane[1:, :-1], plane[1:, 1:]
        uniform = np.logical_and.reduce([corners[0] == other for other in corners[1:]])
        known = np.zeros(size, dtype=bool)
        inside = np.repeat(np.repeat(uniform, 2, axis=0), 2, axis=1)
        known[: inside.shape[0], : inside.shape[1]] = inside
        copied = np.repeat(np.repeat(faces[coarse], 2, axis=0), 2, axis=1)[: size[0], : size[1]]
        faces[known.ravel()] = copied[known]
        sampled = known.copy()
        sampled[::2, ::2] = True
        cast(index[~sampled])
        return faces, known.ravel()

    def _hit(self, rays: Float32, poses: FloatArray, pose_of: IntArray | None) -> IntArray:
        """Return the index (N,) of the first triangle on each ray (3,N), or `NOTHING`."""
        rotation, centre = poses[:, :3, :3].astype(np.float32), poses[:, :3, 3].astype(np.float32)
        origin_and_ray = np.empty((rays.shape[1], 6), np.float32)
        if pose_of is None:
            # Do not use `@` here: BLAS would start additional threads in each rendering thread.
            turned, start = np.einsum("ij,jn->in", rotation[0], rays), centre[0][:, None]
        else:
            turned, start = np.einsum("nij,jn->in", rotation[pose_of], rays), centre[pose_of].T
        origin_and_ray[:, 3:] = turned.T
        origin_and_ray[:, :3] = (start + np.float32(NEAR_M) * turned).T
        return self._scene.first_face(origin_and_ray)

    def _texels(self, faces: IntArray, pose_of: IntArray | None, tables: Float32, rays: Float32) -> Texels:
        """Return the texture coordinates of rays (3,N) that meet the triangles `faces` (N,)."""
        found = np.maximum(faces, 0)
        entry = found if pose_of is None else pose_of * len(self._triangles.faces) + found
        rows = np.take(tables, entry, axis=1, mode="clip")
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            inverse = np.float32(1) / dot(rows[6:], rays)
            at = np.stack([dot(rows[:3], rays), dot(rows[3:6], rays)]) * inverse
        missed = faces < 0
        if missed.any():
            at[:, missed], inverse[missed] = 0.0, 0.0
        return Texels(faces=faces, rows=rows, inverse=inverse, at=at)

    def _colours(self, texels: Texels, filters: Filter, cell: IntArray | None) -> Bytes:
        """Return the filtered and shaded colours (N,3) of N rays. Rays that meet no triangle are black."""
        colours = self._atlas.sample(texels.at, filters, cell)
        if self._shaded:
            gain = self._triangles.gain[np.maximum(texels.faces, 0)]
            colours = np.clip(colours * gain[:, None], 0, 255).astype(np.uint8)
        colours[texels.faces < 0] = 0
        return colours


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
