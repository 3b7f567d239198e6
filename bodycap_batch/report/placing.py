"""One frame for everything that is drawn in three dimensions: the world, or the largest map set upright."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.model.geometry import Similarity
from bodycap_batch.model.scene import Map, Trajectory
from bodycap_batch.report.inputs import ReportInputs


@dataclass(frozen=True, slots=True, kw_only=True)
class PlacedPath:
    """A camera's poses in the drawn frame.

    Attributes:
        camera: Camera name.
        poses: (N,4,4) of every frame, NaN where it was not localised.
        times_s: (N,) common time of each frame.
        keyframe: (N,) True for the frames of the map.
    """

    camera: str
    poses: FloatArray
    times_s: FloatArray
    keyframe: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Placed:
    """What is drawn, and what is not.

    Attributes:
        metric: True in metres, Z up; else the unit is the map's own and up is a guess.
        drawn_from_map: By gauge.
        maps: The maps that have a place.
        paths: The cameras that have one.
        left_out: Cameras whose map could not be placed beside the others.
    """

    metric: bool
    drawn_from_map: dict[str, Similarity]
    maps: tuple[Map, ...]
    paths: tuple[PlacedPath, ...]
    left_out: tuple[str, ...]

    @property
    def drawn(self) -> bool:
        """True where there is anything to draw."""
        return bool(self.maps or self.paths)


def place(inputs: ReportInputs) -> Placed:
    """Bring maps and camera paths into one frame."""
    merge = inputs.merge
    targets = dict(merge.world_from_map) if merge is not None else {}
    if not targets and inputs.maps:
        targets = {inputs.maps[0].gauge: _upright(inputs.maps[0])}
    merged = {path.camera: path for path in merge.trajectories} if merge is not None else {}
    paths, left_out = [], []
    for registration in inputs.registrations:
        path = registration.trajectory
        if path.camera in merged:
            paths.append(_path(inputs, merged[path.camera], None))
        elif path.gauge in targets:
            paths.append(_path(inputs, path, targets[path.gauge]))
        else:
            left_out.append(path.camera)
    return Placed(
        metric=merge is not None,
        drawn_from_map=targets,
        maps=tuple(scene for scene in inputs.maps if scene.gauge in targets),
        paths=tuple(paths),
        left_out=tuple(left_out),
    )


def common_times_s(inputs: ReportInputs, camera: str, times_ns: IntArray) -> FloatArray:
    """Common time (N,) of a camera's own timestamps (N,), seconds.

    A camera that was never registered has no clock yet: its offset is what the capture states.
    """
    clock = inputs.clocks.get(camera)
    if clock is not None:
        return np.asarray(clock.common_times_ns(times_ns) * 1e-9, dtype=np.float64)
    offset_s = 0.0 if inputs.capture is None else inputs.capture.camera(camera).offset_s
    return np.asarray(times_ns * 1e-9 + offset_s, dtype=np.float64)


def _path(inputs: ReportInputs, path: Trajectory, drawn_from_gauge: Similarity | None) -> PlacedPath:
    poses = path.gauge_from_cam
    return PlacedPath(
        camera=path.camera,
        poses=poses if drawn_from_gauge is None else drawn_from_gauge.apply_to_poses(poses),
        times_s=common_times_s(inputs, path.camera, path.times_ns),
        keyframe=np.array([status.value == "KEYFRAME" for status in path.status], dtype=bool),
    )


def _upright(scene: Map) -> Similarity:
    """A view of a map without a world: the mean picture-up of its keyframes is up, its middle the origin."""
    up = -scene.map_from_cam[:, :3, 1].mean(axis=0)
    up = up / max(float(np.linalg.norm(up)), 1e-12)
    side = np.cross(up, [0.0, 0.0, 1.0] if abs(up[2]) < 0.9 else [1.0, 0.0, 0.0])
    side = side / np.linalg.norm(side)
    rotation = np.stack([side, np.cross(up, side), up])
    return Similarity(1.0, rotation, -rotation @ np.median(scene.map_from_cam[:, :3, 3], axis=0))
