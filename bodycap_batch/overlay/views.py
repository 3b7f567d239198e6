"""What each camera saw of the map, frame by frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray, set_array
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert, transform_points
from bodycap_batch.model.merge_data import CameraClock, MergeResult
from bodycap_batch.model.scene import FrameStatus, Map, Registration

_INLIER_PX = 4.0
"""Largest reprojection error of an inlier at 640 px width: registration's threshold is four times a track's
noise, which is 0.3 to 1 px."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenPoints:
    """Map points seen in one frame, pixels at the lens's size, COLMAP origin.

    Attributes:
        point: (K,) index of the point in its map.
        px: (K,2) where the solved pose says it is.
        observed_px: (K,2) where the picture shows it.
        depth: (K,) along the optical axis.
        error_px: (K,) distance of the two.
    """

    point: IntArray
    px: FloatArray
    observed_px: FloatArray
    depth: FloatArray
    error_px: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraView:
    """One camera: its lens, poses and the map points it saw, in one frame of reference.

    Attributes:
        camera: Camera name.
        frame: "world" (metres, Z up), or the gauge of a map that merging did not place.
        lens: Intrinsics at the work size, as the map knows them.
        times_ns: (N,) common time of each frame.
        frame_from_cam: (N,4,4) poses; NaN where the frame was not localised.
        status: (N,) whether it was, and if not, why.
        points: (P,3) all points of the map it was solved in.
        seen_from: (N+1,) index of each frame's first observation below, and after the last frame's last.
        seen_point: (M,) point index.
        seen_px: (M,2) observed pixel, COLMAP origin.
    """

    camera: str
    frame: str
    lens: Camera
    times_ns: IntArray
    frame_from_cam: FloatArray
    status: tuple[FrameStatus, ...]
    points: FloatArray
    seen_from: IntArray
    seen_point: IntArray
    seen_px: FloatArray

    def __post_init__(self) -> None:
        frames, seen = len(self.status), len(self.seen_px)
        set_array(self, "times_ns", (frames,), np.int64)
        set_array(self, "frame_from_cam", (frames, 4, 4), finite=False)
        set_array(self, "points", (None, 3))
        set_array(self, "seen_from", (frames + 1,), np.int64)
        set_array(self, "seen_point", (seen,), np.int64)
        set_array(self, "seen_px", (seen, 2))

    def nearest_frame(self, common_ns: int) -> int | None:
        """Index of the frame nearest to a common time; None beyond the video's ends by half a frame."""
        count = len(self.times_ns)
        if count == 0:
            return None
        after = min(int(np.searchsorted(self.times_ns, common_ns)), count - 1)
        before = max(after - 1, 0)
        nearest = min((before, after), key=lambda index: abs(int(self.times_ns[index]) - common_ns))
        interval = int(np.median(np.diff(self.times_ns))) if count > 1 else 0
        distance = abs(int(self.times_ns[nearest]) - common_ns)
        inside = self.times_ns[0] <= common_ns <= self.times_ns[-1]
        return nearest if inside or 2 * distance <= interval else None

    def cam_from_frame(self, index: int) -> FloatArray | None:
        """The pose (4,4) of a frame into the camera, or None where it was not localised."""
        pose = self.frame_from_cam[index]
        return invert(pose) if np.isfinite(pose).all() else None

    def points_at(self, index: int) -> SeenPoints:
        """The inlier map points of a frame; none where it was not localised.

        A rolling shutter's pose holds for the middle row: points of other rows lie off by their row's delay.
        """
        cam_from_frame = self.cam_from_frame(index)
        first, stop = self.seen_from[index : index + 2].tolist()
        seen = slice(first, first if cam_from_frame is None else stop)
        point, observed = self.seen_point[seen], self.seen_px[seen]
        pose = np.eye(4) if cam_from_frame is None else cam_from_frame
        x_in_cam = transform_points(pose, self.points[point])
        px = self.lens.project(x_in_cam)
        error = np.nan_to_num(np.linalg.norm(px - observed, axis=1), nan=np.inf)
        kept = error <= _INLIER_PX * self.lens.width_px / 640.0
        return SeenPoints(
            point=point[kept],
            px=px[kept],
            observed_px=observed[kept],
            depth=x_in_cam[kept, 2],
            error_px=error[kept],
        )


def camera_views(
    registrations: Sequence[Registration],
    maps: Sequence[Map],
    clocks: Mapping[str, CameraClock],
    merge: MergeResult | None = None,
) -> tuple[CameraView, ...]:
    """One view a camera, in the world where merging placed the camera, else in its map's gauge.

    Args:
        registrations: One per camera.
        maps: The maps they were solved in.
        clocks: By camera name.
        merge: The body in the world, if there is one.

    Returns:
        In the order of `registrations`; a camera that no map took has no view.
    """
    scenes = {scene.gauge: scene for scene in maps}
    placed = {} if merge is None else {item.camera: item for item in merge.trajectories}
    out = []
    for found in registrations:
        solved = found.trajectory
        scene = scenes.get(solved.gauge)
        if scene is None or solved.camera not in scene.cameras:
            continue
        world_from_map = None if merge is None else merge.world_from_map.get(solved.gauge)
        in_world = solved.camera in placed and world_from_map is not None
        path = placed[solved.camera] if in_world else solved
        frame, point, px = _seen(found, scene)
        out.append(
            CameraView(
                camera=solved.camera,
                frame=path.gauge,
                lens=scene.cameras[solved.camera],
                times_ns=clocks[solved.camera].common_times_ns(solved.times_ns),
                frame_from_cam=path.gauge_from_cam,
                status=solved.status,
                points=world_from_map.apply(scene.points) if in_world and world_from_map else scene.points,
                seen_from=np.searchsorted(frame, np.arange(len(solved.status) + 1)),
                seen_point=point,
                seen_px=px,
            )
        )
    return tuple(out)


def _seen(found: Registration, scene: Map) -> tuple[IntArray, IntArray, FloatArray]:
    """Frame, point and pixel of all that a camera saw of a map: tracked, and its keyframes' own features."""
    camera = found.trajectory.camera
    tracked = scene.points_of(camera, found.obs_keyframe, found.obs_feature)
    kept = tracked >= 0
    own = np.isin(scene.obs_keyframe, scene.keyframes_of(camera))
    frame = np.concatenate([scene.keyframe_frame[scene.obs_keyframe[own]], found.obs_frame[kept]])
    point = np.concatenate([scene.obs_point[own], tracked[kept]])
    px = np.concatenate([scene.obs_px[own], found.obs_px[kept].astype(np.float64)])
    order = np.argsort(frame, kind="stable")
    return frame[order], point[order], px[order]
