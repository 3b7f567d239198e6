"""PLY files: a coloured point cloud, to which the paths of the cameras are added as dense points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import FloatArray, set_array
from bodycap_batch.core.errors import StoreError
from bodycap_batch.formats.atomic_files import atomic_replacement
from bodycap_batch.formats.open3d_loader import load_open3d
from bodycap_batch.formats.palette import Colour, camera_colours

Colors = npt.NDArray[np.uint8]


_VERTEX_BYTES = 3 * 8 + 3
"""Number of bytes per point: three doubles for the position and three bytes for the colour."""

_HEADER_BYTES = 512
"""Maximum size of the header, bytes. Derivation: Open3D's header has fewer than 300 bytes."""

_MAX_SAMPLES_PER_STEP = 100
"""Maximum number of points that are added between two successive camera centres. Without this limit, one
wrong pose far away could make the file huge. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PointCloud:
    """A cloud of P coloured points.

    Attributes:
        points: (P,3) positions of the points.
        colors: (P,3) colours of the points, uint8 RGB.
    """

    points: FloatArray
    colors: Colors

    def __post_init__(self) -> None:
        set_array(self, "points", (None, 3))
        set_array(self, "colors", (len(self.points), 3), np.uint8)


def add_camera_paths(
    cloud: PointCloud,
    paths: Mapping[str, FloatArray],
    spacing: float,
    colours: Mapping[str, Colour] | None = None,
) -> PointCloud:
    """Add the path of each camera to a point cloud, as a series of points.

    Args:
        cloud: The point cloud of the map.
        paths: By camera name, (N,3) camera centres in the order of time, in the frame and unit of the cloud;
            NaN for a lost frame.
        spacing: Maximum distance between two neighbouring points of a path, in the unit of the cloud.
        colours: By camera name, the colour of the path. None to assign colours to the cameras of `paths`.
            Give the colours if the job has more cameras than `paths`. Otherwise a camera could have another
            colour than in the other files of the job.

    Returns:
        The point cloud with the paths.
    """
    points, colors = [cloud.points], [cloud.colors]
    colours = colours or camera_colours(paths)
    for name in sorted(paths):
        samples = _sample_polyline(np.asarray(paths[name], dtype=np.float64).reshape(-1, 3), spacing)
        points.append(samples)
        colors.append(np.broadcast_to(np.array(colours[name], dtype=np.uint8), samples.shape))
    return PointCloud(points=np.concatenate(points), colors=np.concatenate(colors))


def _sample_polyline(path: FloatArray, spacing: float) -> FloatArray:
    """Return points along a path: all finite vertices, and further points between successive vertices.

    Neighbouring points have at most the distance `spacing`, but there are at most `_MAX_SAMPLES_PER_STEP`
    points between two vertices. Gaps in the path (NaN) are not filled.

    Args:
        path: (N,3) vertices of the path; NaN in a gap.
        spacing: Maximum distance between neighbouring points, in the unit of the path.
    """
    out = []
    for start, end in pairwise(path):
        if np.isfinite(start).all():
            steps = 1
            if np.isfinite(end).all():
                steps = int(np.ceil(np.linalg.norm(end - start) / spacing))
                steps = max(1, min(_MAX_SAMPLES_PER_STEP, steps))
            out.append(start + np.arange(steps)[:, None] / steps * np.nan_to_num(end - start))
    out.append(path[-1:][np.isfinite(path[-1:]).all(axis=1)])
    return np.concatenate(out)


def write_ply(path: Path, cloud: PointCloud) -> None:
    """Write a binary PLY file with Open3D, read the file back and compare the point clouds.

    Raises:
        StoreError: The file cannot be written, or the point cloud that is read back differs from the given
            point cloud.
    """
    open3d = load_open3d()
    content = open3d.geometry.PointCloud()
    content.points = open3d.utility.Vector3dVector(cloud.points.copy())
    content.colors = open3d.utility.Vector3dVector(cloud.colors / 255.0)
    with atomic_replacement(path) as temporary:
        # If the disk is full, Open3D prints many lines without the reason. Therefore a file of sufficient
        # size is written first. If the disk is full, this write raises the error of the operating system.
        temporary.write_bytes(bytes(_HEADER_BYTES + _VERTEX_BYTES * len(cloud.points)))
        if not open3d.io.write_point_cloud(temporary, content, write_ascii=False):
            hint = "check that the disk is not full"
            raise StoreError("Open3D could not write the point cloud", path=path, hint=hint)
        back = read_ply(temporary)
        same = back.points.shape == cloud.points.shape and np.array_equal(back.points, cloud.points)
        if not same or not np.array_equal(back.colors, cloud.colors):
            hint = "check that the disk is not full"
            raise StoreError(
                "the point cloud in the written file differs from the point cloud of the map",
                path=path,
                hint=hint,
            )


def read_ply(path: Path) -> PointCloud:
    """Read the points and colours of a PLY file. If the file has no colours, the points are black."""
    open3d = load_open3d()
    content = open3d.io.read_point_cloud(path)
    points = np.asarray(content.points, dtype=np.float64)
    colors = np.asarray(content.colors, dtype=np.float64)
    if len(colors) != len(points):
        colors = np.zeros_like(points)
    return PointCloud(points=points, colors=np.round(colors * 255.0).astype(np.uint8))
