"""Transform maps and camera paths into one frame of reference for the 3D viewer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.camera_clock import ClockRelation
from bodycap_batch.model.geometry import Similarity
from bodycap_batch.model.scene import Map, Trajectory
from bodycap_batch.report.report_inputs import ReportInputs


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnPath:
    """A camera's poses in the drawn frame of reference.

    Attributes:
        camera: Camera name.
        poses: (N,4,4) camera pose (drawn frame of reference from camera) of each frame; NaN for a lost frame.
        times_s: (N,) common time of each frame, seconds.
        keyframe: (N,) True for each frame that is a keyframe.
    """

    camera: str
    poses: FloatArray
    times_s: FloatArray
    keyframe: BoolArray


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnScene:
    """Maps and camera paths in the drawn frame of reference.

    The drawn frame of reference is the world. Without a body it is the gauge of the largest map, rotated
    upright.

    Attributes:
        is_metric: True if the drawn frame of reference is the world, in metres with Z up. Otherwise the unit
            of length is arbitrary, and the upward direction is a guess.
        drawn_from_map: Transform of each map into the drawn frame of reference, by the map's gauge.
        maps: The maps with a known transform.
        paths: The paths of the cameras in the maps with a known transform.
        omitted_cameras: Names of the cameras in maps without a known transform.
    """

    is_metric: bool
    drawn_from_map: dict[str, Similarity]
    maps: tuple[Map, ...]
    paths: tuple[DrawnPath, ...]
    omitted_cameras: tuple[str, ...]

    @property
    def has_content(self) -> bool:
        """True if there is anything to draw."""
        return bool(self.maps or self.paths)


def make_drawn_scene(inputs: ReportInputs) -> DrawnScene:
    """Transform maps and camera paths into one frame of reference."""
    merge = inputs.merge
    drawn_from_map = dict(merge.world_from_map) if merge is not None else {}
    if not drawn_from_map and inputs.maps:
        drawn_from_map = {inputs.maps[0].gauge: _upright_from_map(inputs.maps[0])}
    merged_paths = {path.camera: path for path in merge.trajectories} if merge is not None else {}
    paths, omitted = [], []
    for registration in inputs.registrations:
        path = registration.trajectory
        if path.camera in merged_paths:
            paths.append(_draw_path(inputs, merged_paths[path.camera], None))
        elif path.gauge in drawn_from_map:
            paths.append(_draw_path(inputs, path, drawn_from_map[path.gauge]))
        else:
            omitted.append(path.camera)
    return DrawnScene(
        is_metric=merge is not None,
        drawn_from_map=drawn_from_map,
        maps=tuple(scene for scene in inputs.maps if scene.gauge in drawn_from_map),
        paths=tuple(paths),
        omitted_cameras=tuple(omitted),
    )


def common_times_s(inputs: ReportInputs, camera: str, times_ns: IntArray) -> FloatArray:
    """Convert a camera's timestamps into common times.

    The clock of a camera that is not registered comes from the capture. Without a capture, the common time
    is the time of the camera.

    Args:
        inputs: The results of the job.
        camera: Camera name.
        times_ns: (N,) timestamps of the camera's own clock, nanoseconds.

    Returns:
        (N,) common times, seconds.
    """
    clock = inputs.clocks.get(camera)
    if clock is not None:
        return np.asarray(clock.common_times_ns(times_ns) * 1e-9, dtype=np.float64)
    relation = ClockRelation() if inputs.capture is None else inputs.capture.camera(camera).clock
    return np.asarray(relation.common_ns(times_ns) * 1e-9, dtype=np.float64)


def _draw_path(inputs: ReportInputs, path: Trajectory, drawn_from_gauge: Similarity | None) -> DrawnPath:
    poses = path.gauge_from_cam
    return DrawnPath(
        camera=path.camera,
        poses=poses if drawn_from_gauge is None else drawn_from_gauge.apply_to_poses(poses),
        times_s=common_times_s(inputs, path.camera, path.times_ns),
        keyframe=np.array([status.value == "KEYFRAME" for status in path.status], dtype=bool),
    )


def _upright_from_map(scene: Map) -> Similarity:
    """Return the transform that rotates a map upright and centres it.

    The Z axis is the mean upward direction of the keyframes' images. The origin is the median position of the
    keyframes.
    """
    up = -scene.map_from_cam[:, :3, 1].mean(axis=0)
    up = up / max(float(np.linalg.norm(up)), 1e-12)
    side = np.cross(up, [0.0, 0.0, 1.0] if abs(up[2]) < 0.9 else [1.0, 0.0, 0.0])
    side = side / np.linalg.norm(side)
    rotation = np.stack([side, np.cross(up, side), up])
    return Similarity(1.0, rotation, -rotation @ np.median(scene.map_from_cam[:, :3, 3], axis=0))
