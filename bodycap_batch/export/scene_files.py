"""Write the files of the map and the cameras: PLY point clouds, TUM trajectories and COLMAP models."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.export.export_inputs import ExportInputs
from bodycap_batch.export.far_points import is_far
from bodycap_batch.export.target_frames import (
    WORLD,
    ExportedMap,
    describe_target,
    main_target_name,
    maps_in_target_frames,
    target_numbers,
    trajectories_in_target_frames,
)
from bodycap_batch.formats.colmap import write_colmap_model
from bodycap_batch.formats.palette import camera_colours
from bodycap_batch.formats.ply import PointCloud, add_camera_paths, write_ply
from bodycap_batch.formats.tum import TimedPoses, write_tum
from bodycap_batch.model.scene import Trajectory

PATH_SPACING_M = 0.01
"""Distance (metres) between neighbouring points that draw a camera path in the world.

Evidence: none; with this distance the points look like a line.
"""

_PATH_SPACING_RATIO = 1e-3
"""Distance between neighbouring points that draw a camera path in a map's own gauge.

It is a ratio to the extent of the map's points. Derivation: 1 cm in a room of 10 m.
"""


def write_maps(inputs: ExportInputs, left_out: list[str]) -> list[Path]:
    """Write one point cloud for each target frame, with the maps and the camera paths in this frame.

    The file of the main target frame is ``map.ply``. The file of each other target frame is ``map_<n>.ply``.
    Far points are in files of their own, ``map_far.ply`` and ``map_<n>_far.ply``, so that programs show the
    room when they show everything. A cloud without points is left out.

    Args:
        inputs: The results of the earlier stages.
        left_out: Receives a sentence for the user about each part that is left out, because it is empty.

    Returns:
        The paths of the written files.

    Raises:
        StoreError: A file cannot be written.
    """
    written = []
    colours = camera_colours(item.camera for item in inputs.trajectories)
    groups: dict[str, list[ExportedMap]] = {}
    for exported in maps_in_target_frames(inputs):
        groups.setdefault(exported.target, []).append(exported)
    for name, number in target_numbers(inputs).items():
        members = groups[name]
        far = np.concatenate([is_far(member.scene) for member in members])
        points = np.concatenate([member.points() for member in members])
        colors = np.concatenate([member.scene.colors for member in members])
        cloud = PointCloud(points=points[~far], colors=colors[~far])
        paths = {
            item.camera: _camera_centres(item)
            for item in (*trajectories_in_target_frames(inputs), *inputs.other_paths)
            if item.gauge == name
        }
        spacing = PATH_SPACING_M if name == WORLD else _PATH_SPACING_RATIO * _extent(cloud.points)
        file = inputs.out_dir / (f"map_{number}.ply" if number else "map.ply")
        drawn = add_camera_paths(cloud, paths, spacing, colours) if paths else cloud
        if not len(points):
            rest = "shows camera paths only" if len(drawn.points) else "is not written"
            left_out.append(f"{file.name} {rest}: its map has no points")
        if len(drawn.points):
            write_ply(file, drawn)
            written.append(file)
        if far.any():
            written.append(file.with_name(f"{file.stem}_far.ply"))
            write_ply(written[-1], PointCloud(points=points[far], colors=colors[far]))
    return written


def write_trajectories(inputs: ExportInputs, left_out: list[str]) -> list[Path]:
    """Write one TUM file for each camera, with the camera's localised frames and own timestamps.

    A frame with the status ROTATION_ONLY has its rotation, and the origin as its position, because the format
    has no place for an unknown one. A comment says so.

    The files are in ``trajectories/``. If the poses of a camera are not in the main target frame, the file is
    in ``trajectories/unplaced/``. Poses of lost frames in the further map number n are in
    ``trajectories/map_<n>/``. A camera without localised frames has a file without poses, because an
    evaluation counts this camera, too.

    Args:
        inputs: The results of the earlier stages.
        left_out: Receives a sentence for the user about each camera without localised frames.

    Returns:
        The paths of the written files.

    Raises:
        StoreError: A file cannot be written.
    """
    main_target, top = main_target_name(inputs), inputs.out_dir / "trajectories"
    numbers = target_numbers(inputs)
    written = []
    for trajectory in inputs.other_paths:
        written.append(_write_path(top / f"map_{numbers[trajectory.gauge]}", trajectory))
    for trajectory in trajectories_in_target_frames(inputs):
        has_rows = (trajectory.localised | trajectory.rotation_only).any()
        folder = top if trajectory.gauge == main_target or not has_rows else top / "unplaced"
        written.append(file := _write_path(folder, trajectory))
        if not has_rows:
            left_out.append(f"trajectories/{file.name} has no poses: no frame of this camera was localised")
    return written


def _write_path(folder: Path, trajectory: Trajectory) -> Path:
    """Write the frames of a trajectory with a rotation to a TUM file in a folder, and return its path."""
    rows = trajectory.localised | trajectory.rotation_only
    poses = TimedPoses(times_ns=trajectory.times_ns[rows], world_from_cam=trajectory.poses_at_origin()[rows])
    file = folder / f"{trajectory.camera}.tum"
    write_tum(file, poses, _header_comments(trajectory))
    return file


def _header_comments(trajectory: Trajectory) -> list[str]:
    """Return the comments at the top of a TUM file: camera, frame of reference and clock."""
    source = "world_from_camera" if trajectory.gauge == WORLD else "map_from_camera"
    poses = f"{source}: {describe_target(trajectory.gauge)}"
    out = [f"camera {trajectory.camera}", poses, "timestamps: the camera's own clock, seconds"]
    if count := int(trajectory.rotation_only.sum()):
        out.append(f"{count} frames have a rotation only (ROTATION_ONLY in frames.csv): 0 0 0 is no position")
    return out


def write_colmap(inputs: ExportInputs) -> list[Path]:
    """Write one COLMAP model for each map, in the folder ``colmap/<n>``; n is counted from 0.

    The maps in the world come first.

    Returns:
        The paths of the written files.

    Raises:
        StoreError: A file cannot be written.
    """
    numbers = {item.camera: item.frame_numbers for item in inputs.trajectories}
    written: list[Path] = []
    for index, exported in enumerate(maps_in_target_frames(inputs)):
        folder = inputs.out_dir / "colmap" / str(index)
        written += write_colmap_model(folder, exported.scene, exported.target_from_map, numbers)
    return written


def _camera_centres(trajectory: Trajectory) -> FloatArray:
    """Return the camera centres (N,3) of a trajectory, in the trajectory's gauge; NaN for lost frames."""
    return np.asarray(trajectory.gauge_from_cam[:, :3, 3])


def _extent(points: FloatArray) -> float:
    """Return the extent of points (N,3): the diagonal of the box from the 5th to the 95th percentile.

    The result is 1 if there are fewer than two points, or if the box has no extent.
    """
    if len(points) < 2:
        return 1.0
    low, high = np.percentile(points, [5, 95], axis=0)
    return float(np.linalg.norm(high - low)) or 1.0
