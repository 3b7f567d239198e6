"""Render rigid parts that move against one another, with another instant for every row of the image.

The room and each limb of the wearer are parts. Each part has its triangles in a frame of its own. Viewing
rays are converted to this frame with the pose of the camera at the instant of the ray. So one tree of
triangles for each part serves all instants.

The library Embree finds the triangle of each ray. A homography gives the position of the pixel on the
triangle's texture. On a flat triangle with an affine texture, the texture coordinates are a projective
function of the viewing direction. The derivative of this function gives the exact footprint of a pixel.
Pixels at the edge between two surfaces get four samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.synthetic.atlas import Atlas, Bytes, Filter, Float32, select_filter
from bodycap_batch.synthetic.lens import RayGrid
from bodycap_batch.synthetic.raycast import NOTHING, RayScene
from bodycap_batch.synthetic.triangles import (
    NEAR_M,
    SUBPIXELS,
    Texels,
    Triangles,
    concatenate_triangles,
    dot,
    find_edges,
)

_Array = TypeVar("_Array", BoolArray, IntArray, Float32)

ROOM = -1
"""Number of the joint of a part that does not move."""
_CONE_MARGIN_RAD = 0.02
"""Angle (radians) by which the cone around a part is widened, for rays that are not exactly of unit
length. Evidence: none."""


_CELLS, _FINE_CELLS = (4, 2, 1), (2, 1)
"""Sides (px) of the cells at whose corners rays are cast, and of those of a fine image. Objects thinner than
2 px can be missed, and isolated ones smaller than 4 px if the image is not fine."""


class MovingPart:
    """One rigid part of a scene.

    Args:
        joint: Number of the joint that carries the part, or `ROOM`.
        triangles: Triangles of the part, in the frame of the joint; in the world frame for `ROOM`.
    """

    def __init__(self, joint: int, triangles: Triangles) -> None:
        self.joint, self.triangles = joint, triangles
        self.scene = RayScene(triangles.vertices, triangles.faces)
        low, high = triangles.vertices.min(axis=0), triangles.vertices.max(axis=0)
        self.centre = (low + high) / 2
        self.radius_m = float(np.linalg.norm(triangles.vertices - self.centre, axis=1).max())


@dataclass(frozen=True, slots=True, kw_only=True)
class Hits:
    """What N rays meet first.

    Attributes:
        faces: (N,) indices of the triangles over all parts, or `NOTHING`.
        distance: (N,) distances in the unit of the lengths of the rays.
    """

    faces: IntArray
    distance: Float32


class MovingScene:
    """Renderer of rigid parts at many instants.

    Args:
        parts: The parts. The first one is the room.
        atlas: Atlas that holds the textures of all parts.
        fine: True: each pixel has exact texture coordinates. False: they are interpolated over cells of 4 px
            away from edges, which is faster, and enough for a frame that is blurred or read out row by row.
    """

    def __init__(self, parts: Sequence[MovingPart], atlas: Atlas, *, fine: bool = False) -> None:
        self.parts, self._atlas, self._fine = tuple(parts), atlas, fine
        triangles = parts[0].triangles
        for part in parts[1:]:
            triangles = concatenate_triangles(triangles, part.triangles)
        self.triangles = triangles
        counts = [len(part.triangles.faces) for part in parts]
        self._starts = np.concatenate([[0], np.cumsum(counts)])
        self.part_of_face = np.repeat(np.arange(len(parts)), counts)

    def sharp(self, grid: RayGrid, part_from_cam: FloatArray, gain: Float32) -> tuple[Bytes, Hits]:
        """Render an image without motion blur.

        Args:
            grid: Viewing rays of the lens.
            part_from_cam: (P,B,4,4) poses of the camera in the frames of the parts; B is 1, or the number of
                rows.
            gain: (F,) brightness factors of all triangles.

        Returns:
            (H,W,3) RGB image without noise, and what the rays of the H·W pixels meet.
        """
        size = grid.valid.shape
        vectors = grid.planes.reshape(9, -1)
        lens = [vectors[:3], vectors[3:6], vectors[6:]]
        rows = np.arange(size[0]) if part_from_cam.shape[1] > 1 else np.zeros(size[0], np.int64)
        at = np.repeat(rows, size[1])
        hits, smooth = self._hit_grid(lens[0], size, part_from_cam, at)
        texel, filters, cell = self._texels_of_image(lens, hits.faces, at, part_from_cam, smooth, size)
        colours = self._colours(texel, hits.faces, filters, cell, gain)
        surface = np.append(self.triangles.surface, NOTHING)[hits.faces.reshape(size)]
        edge = np.flatnonzero(find_edges(surface))
        if len(edge):
            rays, right, down = (part[:, edge] for part in lens)
            count = len(SUBPIXELS)
            near = [rays + np.float32(x) * right + np.float32(y) * down for x, y in SUBPIXELS]
            fine, fine_at = np.concatenate(near, axis=1), np.tile(at[edge], count)
            found = self.hit(fine, part_from_cam, fine_at)
            texels = self._texels(found.faces, fine_at, part_from_cam, fine)
            filters = select_filter(texels.footprint(np.tile(right, count), np.tile(down, count)))
            samples = self._colours(texels.at, found.faces, filters, None, gain)
            colours[edge] = samples.reshape(count, -1, 3).sum(axis=0, dtype=np.uint16) // count
        colours[~grid.valid.reshape(-1)] = 0
        return np.asarray(colours.reshape(*size, 3)), hits

    def hit(self, rays: Float32, part_from_cam: FloatArray, at: IntArray) -> Hits:
        """Return what rays (3,N) in the camera frame meet first, each at its instant `at` (N,)."""
        faces, distance = (
            np.full(rays.shape[1], NOTHING, np.int64),
            np.full(rays.shape[1], np.inf, np.float32),
        )
        view = rays.mean(axis=1)
        view /= max(float(np.linalg.norm(view)), 1e-9)
        widest = float(np.arccos(np.clip(dot(view, rays).min(initial=1.0), -1, 1)))
        only = np.arange(rays.shape[1])
        for index, part in enumerate(self.parts):
            if index > 0:
                axis, angle = _cone_around(part, part_from_cam[index])
                if np.arccos(np.clip(axis @ view, -1, 1)) > angle + widest:
                    continue
                only = np.flatnonzero(dot(axis, rays) > np.float32(np.cos(min(angle, np.pi))))
                if not len(only):
                    continue
            near, instants = (rays, at) if index == 0 else (rays[:, only], at[only])
            turned, start = rays_in_part(near, part_from_cam[index], instants)
            origin_and_ray = np.empty((turned.shape[1], 6), np.float32)
            origin_and_ray[:, 3:] = turned.T
            turned *= np.float32(NEAR_M)
            turned += start
            origin_and_ray[:, :3] = turned.T
            found, far = part.scene.first_hit(origin_and_ray)
            found[found >= 0] += self._starts[index]
            if index == 0:
                faces, distance = found, far
            else:
                nearer = np.flatnonzero(far < distance[only])
                faces[only[nearer]], distance[only[nearer]] = found[nearer], far[nearer]
        return Hits(faces=faces, distance=distance + np.float32(NEAR_M))

    def _hit_grid(
        self, rays: Float32, size: tuple[int, ...], part_from_cam: FloatArray, at: IntArray
    ) -> tuple[Hits, BoolArray]:
        """Return what the rays (3,H·W) of an image meet. Only a part of the rays is cast.

        Rays are cast at the corners of large cells, then of smaller ones. All pixels of a cell are assumed to
        meet the plane that all four corners meet. Also return a mask (R,C) of the large cells for which this
        holds. The distance in such a cell is that at its first corner.
        """
        count = size[0] * size[1]
        faces, distance = np.full(count, NOTHING, np.int64), np.zeros(count, np.float32)
        index = np.arange(count).reshape(size)
        known = np.zeros(size, dtype=bool)
        smooth = known
        planes = np.append(self.triangles.plane, NOTHING)
        cells = _FINE_CELLS if self._fine else _CELLS
        for side in cells:
            corners = index[::side, ::side]
            wanted = corners[~known[::side, ::side]]
            found = self.hit(rays[:, wanted], part_from_cam, at[wanted])
            faces[wanted], distance[wanted] = found.faces, found.distance
            if side == 1:
                break
            known[::side, ::side] = True
            plane = planes[faces[corners]]
            one = np.ones(plane.shape, dtype=bool)
            one[:-1, :-1] = (plane[:-1, :-1] == plane[:-1, 1:]) & (plane[:-1, :-1] == plane[1:, :-1])
            one[:-1, :-1] &= plane[:-1, :-1] == plane[1:, 1:]
            one[-1], one[:, -1] = False, False
            if side == _CELLS[0]:
                # A corner of an object can lie inside a cell, but then its edges cross the cells around it.
                one = cv2.erode(one.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
            if side == cells[0]:
                smooth = one
            filled = _enlarged(one, side, size) & ~known
            np.copyto(faces.reshape(size), _enlarged(faces[corners], side, size), where=filled)
            np.copyto(distance.reshape(size), _enlarged(distance[corners], side, size), where=filled)
            known |= filled
        return Hits(faces=faces, distance=distance), smooth

    def _texels_of_image(
        self,
        lens: list[Float32],
        faces: IntArray,
        at: IntArray,
        part_from_cam: FloatArray,
        smooth: BoolArray,
        size: tuple[int, ...],
    ) -> tuple[Float32, Filter, IntArray]:
        """Return texel coordinates (2,H·W) of all pixels, filters, and the filter (H·W,) of each pixel.

        In the cells of the mask `smooth` (R,C) all pixels share the filter of the first corner, and if the
        image is not fine, their coordinates are interpolated between the corners.
        """
        side = (_FINE_CELLS if self._fine else _CELLS)[0]
        index = np.arange(len(faces)).reshape(size)
        corners = index[::side, ::side].ravel()
        single = np.flatnonzero(~_enlarged(smooth, side, size))
        cell = _enlarged(np.arange(len(corners)).reshape(smooth.shape), side, size).flatten()
        cell[single] = len(corners) + np.arange(len(single))
        only = np.concatenate([corners, single])
        right, down = lens[1][:, only], lens[2][:, only]
        if self._fine:
            texels = self._texels(faces, at, part_from_cam, lens[0])
            return texels.at, select_filter(texels.footprint(right, down, only)), cell
        texels = self._texels(faces[only], at[only], part_from_cam, lens[0][:, only])
        grid = texels.at[:, : len(corners)].reshape(2, *smooth.shape)
        matrix = np.array([[1.0 / side, 0, 0], [0, 1.0 / side, 0]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        texel = np.stack([cv2.warpAffine(part, matrix, size[::-1], flags=flags).ravel() for part in grid])
        texel[:, single] = texels.at[:, len(corners) :]
        return texel, select_filter(texels.footprint(right, down)), cell

    def _texels(self, faces: IntArray, at: IntArray, part_from_cam: FloatArray, rays: Float32) -> Texels:
        """Return the texture coordinates of rays (3,N) that meet triangles `faces` (N,) at instants (N,).

        Homographies are computed only for the pairs of triangle and instant that occur.
        """
        found = np.maximum(faces, 0)
        key = at * len(self.part_of_face) + found
        occurs = np.zeros(part_from_cam.shape[1] * len(self.part_of_face), np.bool_)
        occurs[key] = True
        pairs = np.flatnonzero(occurs)
        place = np.empty(len(occurs), np.int32)
        place[pairs] = np.arange(len(pairs))
        instant, face = np.divmod(pairs, len(self.part_of_face))
        table = self._homographies(face, part_from_cam[self.part_of_face[face], instant])
        rows = np.take(table, place[key], axis=1, mode="clip")
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            inverse = np.float32(1) / dot(rows[6:], rays)
            texel = np.stack([dot(rows[:3], rays), dot(rows[3:6], rays)]) * inverse
        missed = faces < 0
        if missed.any():
            texel[:, missed], inverse[missed] = 0.0, 0.0
        return Texels(rows=rows, inverse=inverse, at=texel)

    def _homographies(self, face: IntArray, poses: FloatArray) -> Float32:
        """Return homographies (9,K) from directions in the camera frame to the textures of triangles (K,).

        Args:
            face: (K,) indices of the triangles.
            poses: (K,4,4) poses of the camera in the frame of each triangle's part.
        """
        shape, rotation = self.triangles, poses[:, :3, :3]
        out = np.empty((3, 3, len(face)))
        normal = shape.normal[face]
        offset = shape.point[face] - poses[:, :3, 3]
        depth = (normal * offset).sum(axis=1)
        in_cam = np.einsum("kij,ki->jk", rotation, normal)
        for axis in range(2):
            gradient = shape.texels_per_m[face, axis]
            here = shape.texel_at_point[face, axis] - (gradient * offset).sum(axis=1)
            out[axis] = here * in_cam + depth * np.einsum("kij,ki->jk", rotation, gradient)
        out[2] = in_cam
        return out.reshape(9, -1).astype(np.float32)

    def _colours(
        self, texel: Float32, faces: IntArray, filters: Filter, cell: IntArray | None, gain: Float32
    ) -> Bytes:
        """Return the filtered and shaded colours (N,3) of N rays. Rays that meet no triangle are black.

        Args:
            texel: (2,N) texel coordinates.
            faces: (N,) indices of the triangles.
            filters: Filters of the texture.
            cell: (N,) index of the filter of each ray; None if ray number i uses filter number i.
            gain: (F,) brightness factors of all triangles.
        """
        colours = self._atlas.sample(texel, filters, cell)
        dimmed = np.flatnonzero(faces >= self._starts[1])
        if len(dimmed):
            shaded = colours[dimmed] * gain[faces[dimmed], None]
            colours[dimmed] = np.clip(shaded, 0, 255).astype(np.uint8)
        colours[faces < 0] = 0
        return colours


def _enlarged(cells: _Array, side: int, size: tuple[int, ...]) -> _Array:
    """Return an array (H,W) in which each value of an array (R,C) fills a cell of `side` pixels."""
    return cells.repeat(side, axis=1)[:, : size[1]].repeat(side, axis=0)[: size[0]]


def rays_in_part(rays: Float32, part_from_cam: FloatArray, at: IntArray) -> tuple[Float32, Float32]:
    """Return rays (3,N) of the camera frame in the frame of a part, and their origins (3,N), metres.

    Args:
        rays: (3,N) directions in the camera frame.
        part_from_cam: (B,4,4) poses of the camera at B instants.
        at: (N,) instant of each ray.
    """
    if len(part_from_cam) == 1:
        pose = part_from_cam[0].astype(np.float32)
        # Do not use `@` here: BLAS would start additional threads in each rendering thread.
        return np.einsum("ij,jn->in", pose[:3, :3], rays), np.broadcast_to(pose[:3, 3:], rays.shape)
    table = part_from_cam.astype(np.float32).reshape(len(part_from_cam), 16).T
    turned, start = np.empty_like(rays), np.empty_like(rays)
    for axis in range(3):
        row = table[4 * axis : 4 * axis + 4]
        turned[axis] = dot([row[j].take(at) for j in range(3)], rays)
        start[axis] = row[3].take(at)
    return turned, start


def _cone_around(part: MovingPart, part_from_cam: FloatArray) -> tuple[Float32, float]:
    """Return the axis (3,) in the camera frame and half of the angle (radians) of a cone around a part.

    The cone holds the part at all instants of `part_from_cam` (B,4,4).
    """
    seen = np.einsum("bji,bj->bi", part_from_cam[:, :3, :3], part.centre - part_from_cam[:, :3, 3])
    distance = np.linalg.norm(seen, axis=1)
    direction = seen / np.maximum(distance, 1e-9)[:, None]
    axis = direction[len(direction) // 2]
    if distance.min() <= part.radius_m:
        return axis.astype(np.float32), np.pi
    spread = np.arccos(np.clip((direction @ axis).min(), -1, 1))
    angle = np.arcsin(part.radius_m / distance.min()) + spread + _CONE_MARGIN_RAD
    return axis.astype(np.float32), float(angle)
