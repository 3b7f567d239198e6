"""Render textured triangles: Embree finds each pixel's triangle, a homography the position on its texture.

Each triangle is flat and its texture is affine on it. So texture coordinates are a projective function of the
viewing direction, and the derivative of this function gives the exact footprint of a pixel. Pixels at the
edge of two surfaces get four samples. If four rays two pixels apart meet one plane, the pixels between them
are taken to meet it too. Objects thinner than two pixels may be missed there.
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

_NEAR_M = 0.03
"""Distance from the camera below which nothing is rendered, metres."""
_SUBPIXELS = ((-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125))
"""Offsets of the samples of a pixel, px: a rotated grid, with four different rows and columns."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Triangles:
    """Triangles with their planes and textures, all in one frame.

    Attributes:
        vertices: (V,3) positions (m).
        faces: (F,3) vertex indices.
        normal: (F,3) unit normals.
        point: (F,3) a point on each plane.
        texel_at_point: (F,2) atlas coordinates there.
        texels_per_m: (F,2,3) gradient of the atlas coordinates.
        plane: (F,) the same number for adjacent triangles in one plane with one texture.
        surface: (F,) number of the surface that each belongs to.
        gain: (F,) brightness factor.
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
    """Return two triangles for each of N rectangles, given their images' origins (N,2) in the atlas."""
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
    """Return two sets of triangles as one."""
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


def _dot(first: Float32, second: Float32) -> Float32:
    """Return the scalar products (N,) of vectors (3,N)."""
    return np.asarray(first[0] * second[0] + first[1] * second[1] + first[2] * second[2])


@dataclass(frozen=True, slots=True, kw_only=True)
class _Texels:
    """Texture coordinates of N rays.

    Attributes:
        faces: (N,) triangles that the rays meet, or `NOTHING`.
        rows: (9,N) homographies of these triangles.
        inverse: (N,) one over the homographies' third component.
        at: (2,N) texel coordinates.
    """

    faces: IntArray
    rows: Float32
    inverse: Float32
    at: Float32

    def footprint(self, right: Float32, down: Float32, only: IntArray | None = None) -> Float32:
        """Return the derivatives (4,M) of `at` for steps of the rays.

        Args:
            right: (3,M) change of a ray by one pixel to the right.
            down: (3,M) change by one pixel down.
            only: (M,) rows of the rays; all by default.
        """
        rows, inverse, at = self.rows, self.inverse, self.at
        if only is not None:
            rows, inverse, at = rows[:, only], inverse[only], at[:, only]
        out = np.empty((4, len(inverse)), np.float32)
        with np.errstate(invalid="ignore", over="ignore"):
            for index, step in enumerate((right, down)):
                change = _dot(rows[6:], step)
                out[2 * index] = (_dot(rows[:3], step) - at[0] * change) * inverse
                out[2 * index + 1] = (_dot(rows[3:6], step) - at[1] * change) * inverse
        return out


def _shared_filters(
    texels: _Texels, lens: Sequence[Float32], size: tuple[int, ...], uniform: BoolArray
) -> tuple[Filter, IntArray]:
    """Return filters shared by 2×2 pixels, and each pixel's filter.

    Args:
        texels: Texture coordinates of the H·W pixels.
        lens: Rays (3,H·W) and their changes by one pixel to the right and down.
        size: (H,W).
        uniform: (H·W,) True for pixels between four rays that meet one plane; the others get their own
            filter.

    Returns:
        The filters; (H·W,) index of each pixel's filter.
    """
    index = np.arange(size[0] * size[1]).reshape(size)
    corners = index[::2, ::2].ravel()
    cell = (index // size[1] // 2 * -(-size[1] // 2) + index % size[1] // 2).ravel()
    single = np.flatnonzero(~uniform)
    cell[single] = len(corners) + np.arange(len(single))
    only = np.concatenate([corners, single])
    return select_filter(texels.footprint(lens[1][:, only], lens[2][:, only], only)), cell


class SceneRenderer:
    """Renders images of triangles.

    Args:
        triangles: All triangles, in the world.
        atlas: Their textures.
    """

    def __init__(self, triangles: Triangles, atlas: Atlas) -> None:
        self._triangles = triangles
        self._atlas = atlas
        self._shaded = bool((triangles.gain != 1).any())
        self._scene = RayScene(triangles.vertices, triangles.faces)

    def image(self, grid: RayGrid, world_from_cam: FloatArray, rows: slice) -> Bytes:
        """Render some rows of an image.

        Args:
            grid: Viewing rays of the lens.
            world_from_cam: (4,4) pose of all rows, or (rows,4,4) pose of each row.
            rows: The rows to render.

        Returns:
            (rows,W,3) RGB, 0 … 255, without noise.
        """
        poses = world_from_cam.reshape(-1, 4, 4)
        size = grid.valid[rows].shape
        vectors = grid.planes[:, rows].reshape(9, -1)
        lens = [vectors[:3], vectors[3:6], vectors[6:]]
        pose_of = np.repeat(np.arange(size[0]), size[1]) if len(poses) > 1 else None
        tables = self._homographies(poses)
        faces, uniform = self._hit_grid(lens[0], size, poses, pose_of)
        texels = self._texels(faces, pose_of, tables, lens[0])
        colours = self._colours(texels, *_shared_filters(texels, lens, size, uniform))
        edge = np.flatnonzero(self._edges(faces.reshape(size)))
        if len(edge):
            rays, right, down = (part[:, edge] for part in lens)
            near = [rays + np.float32(x) * right + np.float32(y) * down for x, y in _SUBPIXELS]
            count = len(_SUBPIXELS)
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
        """Return homographies (9,B·F) of each pose and triangle: direction in the camera to (u·w, v·w, w)."""
        shape, out = self._triangles, np.empty((3, 3, len(poses), len(self._triangles.faces)))
        rotation, centre = poses[:, :3, :3], poses[:, :3, 3]
        normal = np.einsum("bji,fj->ibf", rotation, shape.normal)
        offset = shape.point[None] - centre[:, None]
        depth = np.einsum("fj,bfj->bf", shape.normal, offset)
        for axis in range(2):
            gradient = shape.texels_per_m[:, axis]
            here = shape.texel_at_point[:, axis] - np.einsum("fj,bfj->bf", gradient, offset)
            out[axis] = here * normal + depth * np.einsum("bji,fj->ibf", rotation, gradient)
        out[2] = normal
        return out.reshape(9, -1).astype(np.float32)

    def _hit_grid(
        self, rays: Float32, size: tuple[int, int], poses: FloatArray, pose_of: IntArray | None
    ) -> tuple[IntArray, BoolArray]:
        """Return the first triangles (H·W,) that a whole grid of rays (3,H·W) meets; only some rays are cast.

        Also return a mask (H·W,) of the pixels between four rays that met one plane.
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
        """Return the triangle (N,) that each ray (3,N) meets first, or −1."""
        rotation, centre = poses[:, :3, :3].astype(np.float32), poses[:, :3, 3].astype(np.float32)
        origin_and_ray = np.empty((rays.shape[1], 6), np.float32)
        if pose_of is None:
            # Not a matrix product: BLAS would start its own threads in each of these threads.
            turned, start = np.einsum("ij,jn->in", rotation[0], rays), centre[0][:, None]
        else:
            turned, start = np.einsum("nij,jn->in", rotation[pose_of], rays), centre[pose_of].T
        origin_and_ray[:, 3:] = turned.T
        origin_and_ray[:, :3] = (start + np.float32(_NEAR_M) * turned).T
        return self._scene.first_face(origin_and_ray)

    def _texels(self, faces: IntArray, pose_of: IntArray | None, tables: Float32, rays: Float32) -> _Texels:
        """Return the texture coordinates of rays (3,N) on their triangles (N,)."""
        found = np.maximum(faces, 0)
        entry = found if pose_of is None else pose_of * len(self._triangles.faces) + found
        rows = np.take(tables, entry, axis=1, mode="clip")
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            inverse = np.float32(1) / _dot(rows[6:], rays)
            at = np.stack([_dot(rows[:3], rays), _dot(rows[3:6], rays)]) * inverse
        missed = faces < 0
        if missed.any():
            at[:, missed], inverse[missed] = 0.0, 0.0
        return _Texels(faces=faces, rows=rows, inverse=inverse, at=at)

    def _colours(self, texels: _Texels, filters: Filter, cell: IntArray | None) -> Bytes:
        """Return the filtered and shaded texture (N,3); black for rays that met nothing."""
        colours = self._atlas.sample(texels.at, filters, cell)
        if self._shaded:
            gain = self._triangles.gain[np.maximum(texels.faces, 0)]
            colours = np.clip(colours * gain[:, None], 0, 255).astype(np.uint8)
        colours[texels.faces < 0] = 0
        return colours

    def _edges(self, faces: IntArray) -> npt.NDArray[np.bool_]:
        """Return a mask (H,W) of the pixels with a neighbour that shows another surface."""
        owner = np.append(self._triangles.surface, NOTHING)[faces]
        edge = np.zeros(owner.shape, dtype=bool)
        across, along = owner[:, 1:] != owner[:, :-1], owner[1:] != owner[:-1]
        edge[:, 1:] |= across
        edge[:, :-1] |= across
        edge[1:] |= along
        edge[:-1] |= along
        return edge
