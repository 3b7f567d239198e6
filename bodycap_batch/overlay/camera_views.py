"""Collect the poses of each camera and the map points that each of its frames observed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray, set_array
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.camera_clock import CameraClock
from bodycap_batch.model.geometry import invert, transform_points
from bodycap_batch.model.merge_data import MergeResult
from bodycap_batch.model.scene import FrameStatus, Map, Registration

_MAX_INLIER_ERROR_PX = 4.0
"""Pixels at 640 px image width: maximum reprojection error of an inlier.

Origin: for tracks with a noise of 0.5 px, registration uses about the same limit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ObservedPoints:
    """Map points that one frame observed. Pixels refer to the image size of the lens, with COLMAP's origin.

    Attributes:
        point: (K,) index of the point in its map.
        px: (K,2) projection of the point with the solved pose.
        observed_px: (K,2) observed pixel.
        depth: (K,) depth of the point along the optical axis, in the unit of the frame of reference.
        error_px: (K,) distance between projection and observed pixel.
    """

    point: IntArray
    px: FloatArray
    observed_px: FloatArray
    depth: FloatArray
    error_px: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraView:
    """The results of one camera for overlays and the preview. Poses and points have one frame of reference.

    Attributes:
        camera: Camera name.
        reference_frame: "world" (metres, Z up), or the gauge of a map that is not placed in the world.
        lens: Intrinsics from the map, at the work size (the image size that all stages work at).
        times_ns: (N,) common time of each frame, nanoseconds.
        frame_from_cam: (N,4,4) poses in the frame of reference; NaN for a lost frame.
        status: (N,) status of each frame.
        points: (P,3) all points of the camera's map, in the frame of reference.
        observation_start: (N+1,) index of each frame's first observation in `observed_point` and
            `observed_px`. The last value is the number of observations.
        observed_point: (M,) point index of each observation.
        observed_px: (M,2) pixel of each observation, with COLMAP's origin.
    """

    camera: str
    reference_frame: str
    lens: Camera
    times_ns: IntArray
    frame_from_cam: FloatArray
    status: tuple[FrameStatus, ...]
    points: FloatArray
    observation_start: IntArray
    observed_point: IntArray
    observed_px: FloatArray

    def __post_init__(self) -> None:
        frames, observations = len(self.status), len(self.observed_px)
        set_array(self, "times_ns", (frames,), np.int64)
        set_array(self, "frame_from_cam", (frames, 4, 4), finite=False)
        set_array(self, "points", (None, 3))
        set_array(self, "observation_start", (frames + 1,), np.int64)
        set_array(self, "observed_point", (observations,), np.int64)
        set_array(self, "observed_px", (observations, 2))

    def cam_from_frame(self, index: int) -> FloatArray | None:
        """Return the pose (4,4) from the frame of reference into the camera; None for a lost frame."""
        pose = self.frame_from_cam[index]
        return invert(pose) if np.isfinite(pose).all() else None

    def inliers_at(self, index: int) -> ObservedPoints:
        """Return the inliers among the map points that a frame observed; no points for a lost frame.

        With a rolling shutter, the pose refers to the exposure of the middle row. Points in other rows
        therefore have an error. The error grows with the distance of the point's row from the middle row.
        """
        cam_from_frame = self.cam_from_frame(index)
        first, stop = self.observation_start[index : index + 2].tolist()
        observations = slice(first, first if cam_from_frame is None else stop)
        point, observed_px = self.observed_point[observations], self.observed_px[observations]
        pose = np.eye(4) if cam_from_frame is None else cam_from_frame
        x_in_cam = transform_points(pose, self.points[point])
        px = self.lens.project(x_in_cam)
        error_px = np.nan_to_num(np.linalg.norm(px - observed_px, axis=1), nan=np.inf)
        inlier = error_px <= _MAX_INLIER_ERROR_PX * self.lens.width_px / 640.0
        return ObservedPoints(
            point=point[inlier],
            px=px[inlier],
            observed_px=observed_px[inlier],
            depth=x_in_cam[inlier, 2],
            error_px=error_px[inlier],
        )


def make_camera_views(
    registrations: Sequence[Registration],
    maps: Sequence[Map],
    clocks: Mapping[str, CameraClock],
    merge: MergeResult | None = None,
) -> tuple[CameraView, ...]:
    """Make one view for each camera.

    If merging placed the camera in the world, its view is in the world. Otherwise the view is in the gauge of
    the camera's map.

    Args:
        registrations: Registrations of all cameras.
        maps: The maps in which the cameras were registered.
        clocks: Clocks of the cameras, by camera name.
        merge: Result of merging; None if there is none.

    Returns:
        Views in the order of `registrations`. A camera without a map has no view.
    """
    map_by_gauge = {scene.gauge: scene for scene in maps}
    merged_paths = {} if merge is None else {path.camera: path for path in merge.trajectories}
    views = []
    for registration in registrations:
        registered = registration.trajectory
        scene = map_by_gauge.get(registered.gauge)
        if scene is None or registered.camera not in scene.cameras:
            continue
        world_from_map = None if merge is None else merge.world_from_map.get(registered.gauge)
        in_world = registered.camera in merged_paths and world_from_map is not None
        path = merged_paths[registered.camera] if in_world else registered
        frame, point, px = _observations(registration, scene)
        views.append(
            CameraView(
                camera=registered.camera,
                reference_frame=path.gauge,
                lens=scene.cameras[registered.camera],
                times_ns=clocks[registered.camera].common_times_ns(registered.times_ns),
                frame_from_cam=path.gauge_from_cam,
                status=registered.status,
                points=world_from_map.apply(scene.points) if in_world and world_from_map else scene.points,
                observation_start=np.searchsorted(frame, np.arange(len(registered.status) + 1)),
                observed_point=point,
                observed_px=px,
            )
        )
    return tuple(views)


def _observations(registration: Registration, scene: Map) -> tuple[IntArray, IntArray, FloatArray]:
    """Return the frame, point and pixel of each observation of a camera, sorted by frame.

    These are the tracked observations and the observations of the camera's own keyframes.

    Returns:
        Frame indices (M,), point indices (M,) and pixels (M,2).
    """
    camera = registration.trajectory.camera
    tracked = scene.points_of(camera, registration.obs_keyframe, registration.obs_feature)
    in_map = tracked >= 0
    of_keyframes = np.isin(scene.obs_keyframe, scene.keyframes_of(camera))
    frame = np.concatenate(
        [scene.keyframe_frame[scene.obs_keyframe[of_keyframes]], registration.obs_frame[in_map]]
    )
    point = np.concatenate([scene.obs_point[of_keyframes], tracked[in_map]])
    px = np.concatenate([scene.obs_px[of_keyframes], registration.obs_px[in_map].astype(np.float64)])
    order = np.argsort(frame, kind="stable")
    return frame[order], point[order], px[order]
