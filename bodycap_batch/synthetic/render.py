"""Images of textured triangles: Embree finds what each pixel sees, a homography per triangle where on it.

Every triangle is flat and its texture affine on it, so texture coordinates are a projective function of the
viewing direction; its derivative gives each pixel's footprint exactly. Pixels on the edge between two
surfaces are sampled four times. Where four rays two pixels apart meet one plane, so do those between them:
what is thinner than two pixels may be missed there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.synthetic.atlas import Atlas, Bytes, Filter, Float32, filter_for
from bodycap_batch.synthetic.lens import RayGrid
from bodycap_batch.synthetic.raycast import NOTHING, RayScene
from bodycap_batch.synthetic.surfaces import Surface

_NEAR_M = 0.03
_SUBPIXELS = ((-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125))
"""A rotated grid: four samples with four different rows and columns."""


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
        plane: (F,) the same number for triangles that continue each other in one plane with one texture.
        surface: (F,) which surface each belongs to.
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


def triangles_of(surfaces: Sequence[Surface], origins: FloatArray) -> Triangles:
    """Two triangles for each rectangle; `origins` (N,2) is where its image lies in the atlas."""
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


def joined(first: Triangles, second: Triangles) -> Triangles:
    """Both sets of triangles in one."""
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
    """Scalar products (N,) of (3,N) vectors."""
    return np.asarray(first[0] * second[0] + first[1] * second[1] + first[2] * second[2])


@dataclass(frozen=True, slots=True, kw_only=True)
class _Texels:
    """Where N rays meet the atlas.

    Attributes:
        faces: (N,) the triangles, or `NOTHING`.
        rows: (9,N) their homographies.
        inverse: (N,) one over the homographies' third component.
        at: (2,N) texel coordinates.
    """

    faces: IntArray
    rows: Float32
    inverse: Float32
    at: Float32

    def footprint(self, right: Float32, down: Float32, only: IntArray | None = None) -> Float32:
        """(4,M) derivatives of `at` for steps (3,M) of the rays, for all rays or `only` some (M,)."""
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
    texels: _Texels, lens: Sequence[Float32], size: tuple[int, ...], alike: BoolArray
) -> tuple[Filter, IntArray]:
    """One filter for 2×2 pixels in one plane, one each for the others; and (N,) which is whose."""
    index = np.arange(size[0] * size[1]).reshape(size)
    corners = index[::2, ::2].ravel()
    cell = (index // size[1] // 2 * -(-size[1] // 2) + index % size[1] // 2).ravel()
    single = np.flatnonzero(~alike)
    cell[single] = len(corners) + np.arange(len(single))
    only = np.concatenate([corners, single])
    return filter_for(texels.footprint(lens[1][:, only], lens[2][:, only], only)), cell


class View:
    """Triangles ready to be looked at.

    Args:
        triangles: Everything in the world frame.
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
            grid: The lens.
            world_from_cam: (4,4) pose of all rows, or (rows,4,4), one for each.
            rows: Which rows.

        Returns:
            (rows,W,3) RGB, 0 … 255, no noise.
        """
        poses = world_from_cam.reshape(-1, 4, 4)
        size = grid.valid[rows].shape
        vectors = grid.planes[:, rows].reshape(9, -1)
        lens = [vectors[:3], vectors[3:6], vectors[6:]]
        pose_of = np.repeat(np.arange(size[0]), size[1]) if len(poses) > 1 else None
        tables = self._homographies(poses)
        faces, alike = self._hit_grid(lens[0], size, poses, pose_of)
        texels = self._texels(faces, pose_of, tables, lens[0])
        colours = self._colours(texels, *_shared_filters(texels, lens, size, alike))
        edge = np.flatnonzero(self._edges(faces.reshape(size)))
        if len(edge):
            rays, right, down = (part[:, edge] for part in lens)
            near = [rays + np.float32(x) * right + np.float32(y) * down for x, y in _SUBPIXELS]
            again = len(_SUBPIXELS)
            fine, fine_pose_of = np.concatenate(near, axis=1), None
            if pose_of is not None:
                fine_pose_of = np.tile(pose_of[edge], again)
            texels = self._texels(self._hit(fine, poses, fine_pose_of), fine_pose_of, tables, fine)
            steps = np.tile(right, again), np.tile(down, again)
            samples = self._colours(texels, filter_for(texels.footprint(*steps)), None)
            colours[edge] = samples.reshape(again, -1, 3).mean(axis=0)
        colours[~grid.valid[rows].reshape(-1)] = 0
        return np.asarray(colours.reshape(*size, 3))

    def _homographies(self, poses: FloatArray) -> Float32:
        """(9,B·F): direction in the camera -> (u·w, v·w, w), row by row, for each pose and triangle."""
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
        """First triangles (H·W,) of a whole grid of rays (3,H·W), most of them without a ray of their own.

        Also returns (H·W,) True where a pixel lies between four rays that met one plane.
        """
        faces = np.full(size[0] * size[1], NOTHING, np.int64)
        index = np.arange(len(faces)).reshape(size)

        def shoot(at: IntArray) -> None:
            faces[at] = self._hit(rays[:, at], poses, None if pose_of is None else pose_of[at])

        coarse = index[::2, ::2]
        shoot(coarse.ravel())
        plane = np.append(self._triangles.plane, NOTHING)[faces[coarse]]
        corners = plane[:-1, :-1], plane[:-1, 1:], plane[1:, :-1], plane[1:, 1:]
        alike = np.logical_and.reduce([corners[0] == other for other in corners[1:]])
        known = np.zeros(size, dtype=bool)
        inside = np.repeat(np.repeat(alike, 2, axis=0), 2, axis=1)
        known[: inside.shape[0], : inside.shape[1]] = inside
        copied = np.repeat(np.repeat(faces[coarse], 2, axis=0), 2, axis=1)[: size[0], : size[1]]
        faces[known.ravel()] = copied[known]
        sampled = known.copy()
        sampled[::2, ::2] = True
        shoot(index[~sampled])
        return faces, known.ravel()

    def _hit(self, rays: Float32, poses: FloatArray, pose_of: IntArray | None) -> IntArray:
        """(N,) the triangle each ray (3,N) meets first, or −1."""
        rotation, centre = poses[:, :3, :3].astype(np.float32), poses[:, :3, 3].astype(np.float32)
        origin_and_ray = np.empty((rays.shape[1], 6), np.float32)
        if pose_of is None:
            # Not a matrix product: BLAS would wake its own threads in every one of ours.
            turned, start = np.einsum("ij,jn->in", rotation[0], rays), centre[0][:, None]
        else:
            turned, start = np.einsum("nij,jn->in", rotation[pose_of], rays), centre[pose_of].T
        origin_and_ray[:, 3:] = turned.T
        origin_and_ray[:, :3] = (start + np.float32(_NEAR_M) * turned).T
        return self._scene.first_face(origin_and_ray)

    def _texels(self, faces: IntArray, pose_of: IntArray | None, tables: Float32, rays: Float32) -> _Texels:
        """Where rays (3,N) meet their triangles (N,) in the atlas."""
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

    def _colours(self, texels: _Texels, chosen: Filter, cell: IntArray | None) -> Bytes:
        """(N,3) filtered texture, shaded; black where a ray met nothing."""
        colours = self._atlas.sample(texels.at, chosen, cell)
        if self._shaded:
            gain = self._triangles.gain[np.maximum(texels.faces, 0)]
            colours = np.clip(colours * gain[:, None], 0, 255).astype(np.uint8)
        colours[texels.faces < 0] = 0
        return colours

    def _edges(self, faces: IntArray) -> npt.NDArray[np.bool_]:
        """(H,W) True where a neighbouring pixel shows another surface."""
        owner = np.append(self._triangles.surface, NOTHING)[faces]
        edge = np.zeros(owner.shape, dtype=bool)
        across, along = owner[:, 1:] != owner[:, :-1], owner[1:] != owner[:-1]
        edge[:, 1:] |= across
        edge[:, :-1] |= across
        edge[1:] |= along
        edge[:-1] |= along
        return edge
