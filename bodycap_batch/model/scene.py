"""What mapping and registration produce: keyframe selections, maps and trajectories."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray, set_array
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.map_diagnostics import MapDiagnostics

_FEATURE_STRIDE = 1 << 24


class FrameStatus(StrEnum):
    """Whether a frame was localised, and if not, why.

    RIG: through the cameras that a hardware-synchronised rig holds beside it; it saw too little itself.
    """

    KEYFRAME = "KEYFRAME"
    REGISTERED = "REGISTERED"
    RIG = "RIG"
    BLUR = "BLUR"
    FEW_TRACKS = "FEW_TRACKS"
    FEW_INLIERS = "FEW_INLIERS"
    UNCONSTRAINED = "UNCONSTRAINED"
    POSE_JUMP = "POSE_JUMP"
    UNCONFIRMED = "UNCONFIRMED"
    NO_MAP = "NO_MAP"

    @property
    def localised(self) -> bool:
        """True where the frame has a measured pose."""
        return self in (FrameStatus.KEYFRAME, FrameStatus.REGISTERED, FrameStatus.RIG)


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyframeSelection:
    """Keyframes of one camera.

    Attributes:
        camera: Camera name.
        frames: (K,) indices into the camera's frames, increasing.
        frame_count: Frames the camera has.
        sharpness: (N,) image sharpness per frame (larger is sharper, arbitrary unit).
        noise_px: Track noise measured by the forward-backward check, one standard deviation.
    """

    camera: str
    frames: IntArray
    frame_count: int
    sharpness: FloatArray
    noise_px: float

    def __post_init__(self) -> None:
        set_array(self, "frames", (None,), np.int64)
        set_array(self, "sharpness", (self.frame_count,))
        if len(self.frames) and (
            self.frames[0] < 0 or self.frames[-1] >= self.frame_count or (np.diff(self.frames) <= 0).any()
        ):
            raise ValueError("frames: indices must increase and lie inside the video")


@dataclass(frozen=True, slots=True, kw_only=True)
class Map:
    """One sparse reconstruction in its own gauge (arbitrary scale, frame ``map``).

    Attributes:
        gauge: Identifies the coordinate frame; a refinement makes a new one.
        cameras: Intrinsics after mapping, by camera name.
        keyframe_camera: (K,) camera name of each keyframe.
        keyframe_frame: (K,) frame index in that camera.
        map_from_cam: (K,4,4) keyframe poses.
        points: (P,3) points in the map frame.
        colors: (P,3) uint8 RGB.
        point_error_px: (P,) mean reprojection error.
        obs_keyframe: (M,) keyframe index of each observation.
        obs_point: (M,) point index of each observation.
        obs_feature: (M,) feature index of each observation in its keyframe.
        obs_px: (M,2) observed pixel, COLMAP origin, work size.
        readout_s: Time from the first row's exposure to the last's that the map was refined for, by
            camera; its poses are those of the middle row's instant, `obs_px` is where the pixels were seen.
    """

    gauge: str
    cameras: Mapping[str, Camera]
    keyframe_camera: tuple[str, ...]
    keyframe_frame: IntArray
    map_from_cam: FloatArray
    points: FloatArray
    colors: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]
    point_error_px: FloatArray
    obs_keyframe: IntArray
    obs_point: IntArray
    obs_feature: IntArray
    obs_px: FloatArray
    readout_s: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        keyframes, points, observations = len(self.keyframe_camera), len(self.points), len(self.obs_px)
        set_array(self, "keyframe_frame", (keyframes,), np.int64)
        set_array(self, "map_from_cam", (keyframes, 4, 4))
        set_array(self, "points", (points, 3))
        set_array(self, "colors", (points, 3), np.uint8)
        set_array(self, "point_error_px", (points,))
        set_array(self, "obs_keyframe", (observations,), np.int64)
        set_array(self, "obs_point", (observations,), np.int64)
        set_array(self, "obs_feature", (observations,), np.int64)
        set_array(self, "obs_px", (observations, 2))

    def keyframes_of(self, camera: str) -> IntArray:
        """Indices (into this map's keyframes) of one camera's keyframes, by frame."""
        mine = np.flatnonzero(np.array([name == camera for name in self.keyframe_camera], dtype=bool))
        return np.asarray(mine[np.argsort(self.keyframe_frame[mine], kind="stable")], dtype=np.int64)

    def points_of(self, camera: str, frame: IntArray, feature: IntArray) -> IntArray:
        """Index of the point behind each (keyframe's frame, feature) of a camera; −1 where there is none."""
        mine = np.isin(self.obs_keyframe, self.keyframes_of(camera))
        known = self.keyframe_frame[self.obs_keyframe[mine]] * _FEATURE_STRIDE + self.obs_feature[mine]
        if len(known) == 0:
            return np.full(len(frame), -1, np.int64)
        order = np.argsort(known, kind="stable")
        wanted = frame * _FEATURE_STRIDE + feature
        at = order[np.minimum(np.searchsorted(known, wanted, sorter=order), len(known) - 1)]
        return np.asarray(np.where(known[at] == wanted, self.obs_point[mine][at], -1))

    def mean_error_px(self) -> float:
        """Mean reprojection error over observations' points."""
        return float(self.point_error_px[self.obs_point].mean()) if len(self.obs_point) else float("nan")


@dataclass(frozen=True, slots=True, kw_only=True)
class Trajectory:
    """Timed poses of one camera, one entry for every frame of its video.

    Attributes:
        camera: Camera name.
        gauge: Gauge id of the map it was solved in, or "world" after merging (metres, Z up).
        frame_numbers: (N,) number of each frame in the video, from 0.
        times_ns: (N,) the camera's own timestamps.
        gauge_from_cam: (N,4,4) poses; NaN where the frame was not localised.
        covariance: (N,6,6) of the pose, rotation (rad) first, then translation (gauge unit), in the
            camera's frame (right perturbation, as GTSAM's Pose3); NaN where not localised.
        status: (N,) a `FrameStatus` per frame.
        inliers: (N,) PnP inliers.
        error_px: (N,) mean reprojection error of the inliers; NaN where there are none.
    """

    camera: str
    gauge: str
    frame_numbers: IntArray
    times_ns: IntArray
    gauge_from_cam: FloatArray
    covariance: FloatArray
    status: tuple[FrameStatus, ...]
    inliers: IntArray
    error_px: FloatArray

    def __post_init__(self) -> None:
        count = len(self.status)
        object.__setattr__(self, "status", tuple(FrameStatus(value) for value in self.status))
        set_array(self, "frame_numbers", (count,), np.int64)
        set_array(self, "times_ns", (count,), np.int64)
        set_array(self, "gauge_from_cam", (count, 4, 4), finite=False)
        set_array(self, "covariance", (count, 6, 6), finite=False)
        set_array(self, "inliers", (count,), np.int64)
        set_array(self, "error_px", (count,), finite=False)
        posed = np.isfinite(self.gauge_from_cam).all(axis=(1, 2))
        if (posed != self.localised).any():
            raise ValueError("status and poses disagree on which frames are localised")

    @property
    def localised(self) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """(N,) True where the frame has a measured pose."""
        return np.array([status.localised for status in self.status], dtype=bool)


@dataclass(frozen=True, slots=True, kw_only=True)
class MapResult:
    """All that mapping leaves behind.

    Attributes:
        maps: The models, largest first; each in its own gauge.
        workspace: Folder with ``database.db`` and ``sparse/<n>``, needed to extend the map.
        log: JSON-able account: initial pairs tried, models, pairs matched, keyframes left out.
    """

    maps: tuple[Map, ...]
    workspace: Path
    log: Mapping[str, Any]

    @property
    def diagnostics(self) -> MapDiagnostics:
        """The typed content of the log."""
        return MapDiagnostics.from_log(self.log)


@dataclass(frozen=True, slots=True, kw_only=True)
class Registration:
    """One camera's frames solved against the maps, with the observations behind each pose.

    Attributes:
        trajectory: A pose and a status for every frame.
        obs_frame: (M,) frame index of each tracked observation.
        obs_keyframe: (M,) frame index of the keyframe whose observation was tracked.
        obs_feature: (M,) feature index in that keyframe (identifies the track after the map changed).
        obs_px: (M,2) float32 tracked pixel, COLMAP origin.
        wanted_keyframes: (W,) frames that should become keyframes where tracking failed, and
            keyframes that the video contradicts, to be placed again.
        tried_keyframes: (V,) frames of this camera that were offered to the map so far.
    """

    trajectory: Trajectory
    obs_frame: IntArray
    obs_keyframe: IntArray
    obs_feature: IntArray
    obs_px: np.ndarray[tuple[int, ...], np.dtype[np.float32]]
    wanted_keyframes: IntArray
    tried_keyframes: IntArray

    def __post_init__(self) -> None:
        count = len(self.obs_px)
        for name in ("obs_frame", "obs_keyframe", "obs_feature"):
            set_array(self, name, (count,), np.int64)
        set_array(self, "obs_px", (count, 2), np.float32)
        set_array(self, "wanted_keyframes", (None,), np.int64)
        set_array(self, "tried_keyframes", (None,), np.int64)
