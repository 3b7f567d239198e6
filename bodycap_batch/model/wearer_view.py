"""The wearer's body in the pictures of a camera.

Each bone is surrounded by a capsule: a cone with rounded ends. A pixel shows the body if its viewing ray hits
a capsule. The rays follow from the camera model, so that lens distortion is exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, set_array
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.optical_flow import unit_directions

_GRID = (24, 18)
"""Number of columns and rows of viewing rays with which the share of the body in a picture is measured."""
_TINY = 1e-12
"""Smallest divisor, for bones without length and rays along a bone."""
_BLOCK_RAYS = 20_000
"""Maximum number of rays that are tested at a time. It limits the memory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WearerView:
    """The capsules of the wearer's body as one camera sees them.

    Attributes:
        camera: Camera name.
        lens: Intrinsics of the camera, at the work size (the image size that all stages work at).
        world_from_cam: (N,4,4) predicted pose of each frame in the world, metres; NaN if it is unknown. It is
            the measured pose of a localised frame, and follows from the solved body for other frames.
        ends_in_cam_m: (N,B,2,3) start and end of each bone in the camera frame, metres; NaN if unknown.
        radius_m: (N,B,2) radius of each capsule at start and end, metres, with its dilation; 0 for the bone
            that carries the camera.
    """

    camera: str
    lens: Camera
    world_from_cam: FloatArray
    ends_in_cam_m: FloatArray
    radius_m: FloatArray

    def __post_init__(self) -> None:
        frames, bones = np.shape(self.radius_m)[:2]
        set_array(self, "world_from_cam", (frames, 4, 4), finite=False)
        set_array(self, "ends_in_cam_m", (frames, bones, 2, 3), finite=False)
        set_array(self, "radius_m", (frames, bones, 2))

    @property
    def is_known(self) -> BoolArray:
        """Mask (N,) of the frames in which the place of the body is known."""
        return np.asarray(np.isfinite(self.ends_in_cam_m).all(axis=(1, 2, 3)))

    def covers(self, px: FloatArray, frame: IntArray) -> BoolArray:
        """Return a mask (M,) of the pixels that show the body; False in a frame where its place is unknown.

        Args:
            px: (M,2) pixels at the work size.
            frame: (M,) frame index of each pixel.
        """
        return np.isfinite(self.depth_along_ray(self.lens.unproject(px), frame))

    def depth_along_ray(self, rays: FloatArray, frame: IntArray) -> FloatArray:
        """Return the distance (M,) of the body from the camera along each ray, metres; infinity without body.

        The distance is that of the point on the ray that is nearest to the bone.

        Args:
            rays: (M,2) viewing rays: x and y at depth 1.
            frame: (M,) frame index of each ray.
        """
        out = np.full(len(rays), np.inf)
        for first in range(0, len(rays), _BLOCK_RAYS):
            part = slice(first, first + _BLOCK_RAYS)
            directions = _components(unit_directions(rays[part])[:, None])
            out[part] = self._depth(directions, self.ends_in_cam_m[frame[part]], self.radius_m[frame[part]])
        return out

    @staticmethod
    def _depth(directions: FloatArray, ends: FloatArray, radius: FloatArray) -> FloatArray:
        """Return the distance (...) of the body along rays, metres; infinity without body.

        Args:
            directions: (3,...,1) components of the directions of the rays.
            ends: (...,B,2,3) start and end of each bone, for each ray or for all rays of a frame.
            radius: (...,B,2) radius of each capsule at start and end, like `ends`.
        """
        start, end = _components(ends[..., 0, :]), _components(ends[..., 1, :])
        distance, along, share = _nearest_on_bones(directions, start, end)
        limit = (1.0 - share) * radius[..., 0] + share * radius[..., 1]
        # Comparisons with NaN are False: a frame without a known body has no body.
        hit = (distance < limit) & (along > 0.0)
        return np.asarray(np.where(hit, along, np.inf).min(axis=-1, initial=np.inf))

    def share(self) -> FloatArray:
        """Return the share (N,) of each picture that the body covers, 0 to 1; NaN if it is unknown."""
        columns, rows = _GRID
        x = (np.arange(columns) + 0.5) / columns * self.lens.width_px
        y = (np.arange(rows) + 0.5) / rows * self.lens.height_px
        rays = self.lens.unproject(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
        rays = rays[np.isfinite(rays).all(axis=1)]
        known = np.flatnonzero(self.is_known)
        directions = _components(unit_directions(rays)[None, :, None])
        out = np.full(len(self.radius_m), np.nan)
        step = max(1, _BLOCK_RAYS // max(1, len(rays)))
        for first in range(0, len(known), step):
            frames = known[first : first + step]
            depth = self._depth(directions, self.ends_in_cam_m[frames, None], self.radius_m[frames, None])
            out[frames] = np.isfinite(depth).mean(axis=1)
        return out


def _components(vectors: FloatArray) -> FloatArray:
    """Return vectors (...,3) as (3,...). Sums over a short last axis are slow."""
    return np.ascontiguousarray(np.moveaxis(vectors, -1, 0))


def _dot(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return the scalar products (...) of vectors (3,...)."""
    return np.asarray(one[0] * other[0] + one[1] * other[1] + one[2] * other[2])


def _nearest_on_bones(
    ray: FloatArray, start: FloatArray, end: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Find where rays from the camera centre come nearest to bones.

    Args:
        ray: (3,...,1) components of the directions of the rays, of length 1.
        start: (3,...,B) components of the start of each bone.
        end: (3,...,B) components of the end of each bone.

    Returns:
        The distance (...,B) between ray and bone, the position (...,B) of the nearest point along the ray,
        and its position (...,B) along the bone, 0 at the start and 1 at the end.
    """
    bone = end - start
    bone_bone = np.maximum(_dot(bone, bone), _TINY)
    ray_bone, ray_start = _dot(ray, bone), _dot(ray, start)
    bone_start = _dot(bone, start)
    across = np.maximum(bone_bone - ray_bone**2, _TINY)
    share = np.clip((ray_bone * ray_start - bone_start) / across, 0.0, 1.0)
    along = ray_start + share * ray_bone
    # If the nearest point is behind the camera, the ray starts at its nearest point.
    behind = along < 0.0
    share = np.where(behind, np.clip(-bone_start / bone_bone, 0.0, 1.0), share)
    along = np.maximum(along, 0.0)
    gap = np.stack([s + share * b - along * r for s, b, r in zip(start, bone, ray, strict=True)])
    return np.sqrt(_dot(gap, gap)), along, share
