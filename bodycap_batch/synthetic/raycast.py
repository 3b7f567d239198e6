"""Find the first triangle on each ray. Open3D does this with the library Embree."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.formats.open3d_loader import load_open3d

NOTHING = -1
"""Value that replaces the face index if a ray meets no triangle."""

_Float32 = npt.NDArray[np.float32]


class RayScene:
    """A set of triangles that can be intersected with rays.

    Each call uses one thread. Several threads may call the methods at the same time.

    Args:
        vertices: (V,3) positions of the vertices.
        faces: (F,3) vertex indices of the triangles.
    """

    def __init__(self, vertices: FloatArray, faces: npt.NDArray[np.uint32]) -> None:
        open3d = load_open3d()
        self._tensor = open3d.core.Tensor
        self._scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(self._tensor(vertices.astype(np.float32)), self._tensor(faces))

    def first_hit(self, rays: _Float32) -> tuple[IntArray, _Float32]:
        """Return the index (N,) of the first face on each ray, or `NOTHING`, and the distances (N,).

        Args:
            rays: (N,6) origin and direction vector of each ray. The unit of the distances is the length of
                the direction vector; the distance of `NOTHING` is infinite.
        """
        answer = self._scene.cast_rays(self._tensor.from_numpy(rays), nthreads=1)
        faces = np.asarray(answer["primitive_ids"].numpy(), dtype=np.int64)
        distance = np.asarray(answer["t_hit"].numpy(), dtype=np.float32)
        faces[~np.isfinite(distance)] = NOTHING
        return faces, distance

    def is_occluded(self, rays: _Float32, limit: float) -> BoolArray:
        """Return a mask (N,): True for each ray that meets a face within a maximum distance.

        Args:
            rays: (N,6) origin and direction vector of each ray.
            limit: Maximum distance, as a multiple of the length of the direction vector.
        """
        found = self._scene.test_occlusions(self._tensor.from_numpy(rays), tnear=0.0, tfar=limit, nthreads=1)
        return np.asarray(found.numpy(), dtype=np.bool_)
