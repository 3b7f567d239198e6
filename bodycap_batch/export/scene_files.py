"""Files of the room and the cameras: PLY, TUM trajectories, COLMAP models."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.export.export_inputs import ExportInputs
from bodycap_batch.export.target_frames import (
    WORLD,
    ExportedMap,
    main_target_name,
    maps_in_target_frames,
    trajectories_in_target_frames,
)
from bodycap_batch.formats.colmap import write_colmap_model
from bodycap_batch.formats.palette import camera_colours
from bodycap_batch.formats.ply import PointCloud, add_camera_paths, write_ply
from bodycap_batch.formats.tum import TimedPoses, write_tum
from bodycap_batch.model.scene import Trajectory

PATH_SPACING_M = 0.01
_PATH_SPACING_RATIO = 1e-3
"""In a map's own gauge: this share of its points' extent (a room of 10 m: 1 cm)."""


def write_maps(inputs: ExportInputs) -> list[Path]:
    """``map.ply`` in the results' frame; maps in other gauges as ``map_<n>.ply``.

    Raises:
        StoreError: A file cannot be written.
    """
    frame = main_target_name(inputs)
    written = []
    colours = camera_colours(item.camera for item in inputs.trajectories)
    groups: dict[str, list[ExportedMap]] = {}
    for placed in maps_in_target_frames(inputs):
        groups.setdefault(placed.frame, []).append(placed)
    for number, (name, members) in enumerate(groups.items()):
        points = [_points_in_target(member) for member in members]
        cloud = PointCloud(
            points=np.concatenate(points), colors=np.concatenate([member.scene.colors for member in members])
        )
        paths = {
            item.camera: _camera_centres(item)
            for item in trajectories_in_target_frames(inputs)
            if item.gauge == name
        }
        spacing = PATH_SPACING_M if name == WORLD else _PATH_SPACING_RATIO * _extent(cloud.points)
        file = inputs.out_dir / ("map.ply" if name == frame else f"map_{number}.ply")
        write_ply(file, add_camera_paths(cloud, paths, spacing, colours) if paths else cloud)
        written.append(file)
    return written


def write_trajectories(inputs: ExportInputs) -> list[Path]:
    """One TUM file a camera, localised frames only, the camera's own timestamps.

    A camera whose map merging could not place goes to ``trajectories/unplaced/``: its frame is not the
    others'.

    Raises:
        StoreError: A file cannot be written.
    """
    frame = main_target_name(inputs)
    written = []
    for trajectory in trajectories_in_target_frames(inputs):
        kept = trajectory.localised
        folder = inputs.out_dir / "trajectories"
        folder = folder if trajectory.gauge == frame or not kept.any() else folder / "unplaced"
        file = folder / f"{trajectory.camera}.tum"
        poses = TimedPoses(times_ns=trajectory.times_ns[kept], world_from_cam=trajectory.gauge_from_cam[kept])
        write_tum(file, poses, _header_comments(trajectory))
        written.append(file)
    return written


def _header_comments(trajectory: Trajectory) -> list[str]:
    frame = "world_from_camera: metres, Z up, floor at z = 0"
    if trajectory.gauge != WORLD:
        frame = f"map_from_camera: gauge {trajectory.gauge}, its scale and axes are arbitrary"
    return [f"camera {trajectory.camera}", frame, "timestamps: the camera's own clock, seconds"]


def write_colmap(inputs: ExportInputs) -> list[Path]:
    """One COLMAP model a map: ``colmap/0``, ``colmap/1`` ..., the world's first.

    Raises:
        StoreError: A file cannot be written.
    """
    numbers = {item.camera: item.frame_numbers for item in inputs.trajectories}
    written: list[Path] = []
    for index, placed in enumerate(maps_in_target_frames(inputs)):
        folder = inputs.out_dir / "colmap" / str(index)
        written += write_colmap_model(folder, placed.scene, placed.target_from_map, numbers)
    return written


def _points_in_target(placed: ExportedMap) -> FloatArray:
    points = placed.scene.points
    return points if placed.target_from_map is None else placed.target_from_map.apply(points)


def _camera_centres(trajectory: Trajectory) -> FloatArray:
    """(N,3) camera centres, NaN where not localised."""
    return np.asarray(trajectory.gauge_from_cam[:, :3, 3])


def _extent(points: FloatArray) -> float:
    """Size of the cloud without its farthest points, 1 for an empty one."""
    if len(points) < 2:
        return 1.0
    low, high = np.percentile(points, [5, 95], axis=0)
    return float(np.linalg.norm(high - low)) or 1.0
