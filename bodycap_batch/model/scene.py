"""The results of keyframe selection, mapping and registration: maps, trajectories and their observations.

Every map has a separate gauge: a frame of reference with arbitrary origin, axes and scale. Each `Map` and
each `Trajectory` names its gauge. Poses in different gauges must not be combined.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, set_array
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.copied_frames import Pictures
from bodycap_batch.model.frame_matches import FrameMatches
from bodycap_batch.model.gyro_rates import GyroRates
from bodycap_batch.model.lens_estimate import LensEstimate
from bodycap_batch.model.map_diagnostics import MapDiagnostics
from bodycap_batch.model.rotation_chain import RotationChain

_FEATURE_STRIDE = 1 << 24
"""Factor of the frame index in a key that combines frame and feature: key = frame · factor + feature.
Derivation: the factor is larger than the number of SIFT features of any image. Keys of 2^39 frames still fit
into 64 bits."""


class FrameStatus(StrEnum):
    """The status of a frame: localised, or lost for a given reason.

    KEYFRAME: The frame is a keyframe of the map.
    REGISTERED: The pose was estimated from the frame's own observations.
    INERTIAL: The frame itself gave no pose. The pose follows from the inertial sensor of the camera, between
        localised frames before and after.
    ROTATION_ONLY: Not localised. The frame has a rotation, but the camera hardly moves and shows no position.
    BLUR: Lost; too few tracks reach the frame, and the image is blurred.
    FEW_TRACKS: Lost; too few tracks reach the frame, although the image is sharp.
    FEW_INLIERS: Lost; too few observations agree with any pose.
    UNCONSTRAINED: Lost; the observations do not determine the pose well enough.
    POSE_JUMP: Lost; the estimated pose was rejected as an outlier of the trajectory.
    UNCONFIRMED: Lost; few observations support the estimated pose, and no neighbouring frame confirms it.
    CONTRADICTED: Lost; the pose was withdrawn, because the keyframes around the frame contradict the map, or
        because the tracks of the video contradict the pose.
    NO_MAP: Lost; no map contains this camera.
    OTHER_MAP: Lost in the camera's map; localised in another map, whose place in the camera's map is unknown.
    DAMAGED: Lost; the frame cannot be decoded, or the decoder reports that its data are damaged.
    FROZEN: Lost; the recording repeats an earlier picture although the camera moves.
    """

    KEYFRAME = "KEYFRAME"
    REGISTERED = "REGISTERED"
    INERTIAL = "INERTIAL"
    ROTATION_ONLY = "ROTATION_ONLY"
    BLUR = "BLUR"
    FEW_TRACKS = "FEW_TRACKS"
    FEW_INLIERS = "FEW_INLIERS"
    UNCONSTRAINED = "UNCONSTRAINED"
    POSE_JUMP = "POSE_JUMP"
    UNCONFIRMED = "UNCONFIRMED"
    CONTRADICTED = "CONTRADICTED"
    NO_MAP = "NO_MAP"
    OTHER_MAP = "OTHER_MAP"
    DAMAGED = "DAMAGED"
    FROZEN = "FROZEN"

    @property
    def localised(self) -> bool:
        """True if the frame has a measured pose."""
        return self in (
            FrameStatus.KEYFRAME,
            FrameStatus.REGISTERED,
            FrameStatus.INERTIAL,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyframeSelection:
    """The keyframes that were selected from one camera's video.

    Attributes:
        camera: Camera name.
        frames: (K,) frame indices of the keyframes, increasing.
        frame_count: Number N of frames of the video.
        sharpness: (N,) sharpness of each frame in an arbitrary unit; a larger value means a sharper frame.
        noise_px: Standard deviation, pixels, of the error of tracked positions. It is measured by tracking
            points forwards and back.
        damaged: (D,) indices of the frames that cannot be decoded, or whose data are damaged. They are lost.
        frozen: (N,) True for each frozen frame: a frame that repeats an earlier picture although the camera
            moves. An empty array means that no frame is frozen.
        motion_px: Largest median displacement of corners since a keyframe, pixels of an image with a long
            side of 640 px. It is infinity if it is unknown.
        matches: Matches between adjacent frames; None if the camera is known to have a global shutter and
            no telemetry is used.
        gyro: Angular velocities that the gyroscope of the camera measured; None if it cannot be used.
        pictures: The frames that are no copies of the frame before; None if the video has no copies. Then all
            indices in this selection count these frames only.
        fixed_regions: (R,C) mask of cells that divide the picture evenly, True where the picture is fixed to
            the camera, for example by the own hand. An empty array means that nothing is fixed.
        moving_regions: (N,R,C) mask of such cells in each frame, True where something moves by itself, for
            example a hand. An empty array means that nothing does.
        lens: The lens as the tracks of the video determine it; None for a given lens, or with too little
            motion.
        rotation_chain: How the camera turns, by the tracks of the video; None without a lens.
    """

    camera: str
    frames: IntArray
    frame_count: int
    sharpness: FloatArray
    noise_px: float
    damaged: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    frozen: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    motion_px: float = float("inf")
    matches: FrameMatches | None = None
    gyro: GyroRates | None = None
    pictures: Pictures | None = None
    fixed_regions: BoolArray = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))
    moving_regions: BoolArray = field(default_factory=lambda: np.zeros((0, 0, 0), dtype=bool))
    lens: LensEstimate | None = None
    rotation_chain: RotationChain | None = None

    def __post_init__(self) -> None:
        set_array(self, "fixed_regions", (None, None), np.bool_)
        set_array(self, "moving_regions", (None, None, None), np.bool_)
        set_array(self, "frames", (None,), np.int64)
        set_array(self, "damaged", (None,), np.int64)
        set_array(self, "sharpness", (self.frame_count,))
        if len(self.frozen) == 0:
            object.__setattr__(self, "frozen", np.zeros(self.frame_count, dtype=bool))
        set_array(self, "frozen", (self.frame_count,), np.bool_)
        if len(self.moving_regions) not in (0, self.frame_count):
            raise ValueError("moving_regions: there must be a mask for each frame, or none")
        if len(self.frames) and (
            self.frames[0] < 0 or self.frames[-1] >= self.frame_count or (np.diff(self.frames) <= 0).any()
        ):
            raise ValueError("frames: indices must increase and lie inside the video")

    def only(self, pictures: Pictures | None) -> KeyframeSelection:
        """Return the selection from the video without its copies; unchanged for None.

        The selection must not have moving regions yet.

        Args:
            pictures: The frames that are no copies, by their indices in this selection.
        """
        if pictures is None:
            return self
        kept = np.isin(np.arange(self.frame_count), pictures.frames)
        index, matches = np.cumsum(kept) - 1, self.matches
        if matches is not None:
            # The next frame of a copy is the next frame of its original.
            own = kept[matches.frame + 1]
            first_px, second_px = matches.first_px[own], matches.second_px[own]
            frame = index[matches.frame[own]]
            matches = replace(matches, frame=frame, first_px=first_px, second_px=second_px)
        return replace(
            self,
            frames=np.unique(index[self.frames]),
            frame_count=int(kept.sum()),
            sharpness=self.sharpness[kept],
            damaged=index[self.damaged[kept[self.damaged]]],
            frozen=self.frozen[kept],
            matches=matches,
            pictures=pictures,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Map:
    """A sparse reconstruction: keyframe poses, points and observations in one gauge.

    The map has K keyframes, P points and M observations. In names such as ``map_from_cam``, ``map`` is the
    frame of reference of the map. The work size is the image size that all stages work at.

    Attributes:
        gauge: Identifier of the gauge. Each adjustment of the map creates a new gauge.
        cameras: By camera name, the intrinsics after mapping, at the work size.
        keyframe_camera: (K,) camera name of each keyframe.
        keyframe_frame: (K,) frame index of each keyframe in the video of its camera.
        map_from_cam: (K,4,4) poses of the keyframes. For a camera with a rolling shutter, each pose is valid
            at the exposure of the middle row.
        points: (P,3) points in the map frame, in the unit of the gauge.
        colors: (P,3) colours of the points, uint8 RGB.
        point_error_px: (P,) mean reprojection error of each point.
        obs_keyframe: (M,) keyframe index of each observation.
        obs_point: (M,) point index of each observation.
        obs_feature: (M,) index of the observed feature in its keyframe.
        obs_px: (M,2) observed pixels at the work size, with COLMAP's origin. They are not corrected for a
            rolling shutter.
        readout_s: By camera name, the readout time, seconds, that the adjustment of the map used. A camera
            without an entry was treated as a camera with a global shutter.
        readout_sigma_s: By camera name, the standard deviation of an estimated readout time, seconds. A
            readout time without an entry is exact.
        keyframe_covariance: (K,6,6) covariance of each keyframe's pose, as in `Trajectory`, relative to the
            other keyframes: in the gauge in which the mean variance of all keyframes is least. An empty array
            means that it is unknown.
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
    readout_sigma_s: Mapping[str, float] = field(default_factory=dict)
    keyframe_covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 6, 6)))

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
        known = keyframes if len(self.keyframe_covariance) else 0
        set_array(self, "keyframe_covariance", (known, 6, 6))

    def keyframes_of(self, camera: str) -> IntArray:
        """Return the indices of the keyframes of one camera in this map, ordered by frame index."""
        keyframes = np.flatnonzero(np.array([name == camera for name in self.keyframe_camera], dtype=bool))
        order = np.argsort(self.keyframe_frame[keyframes], kind="stable")
        return np.asarray(keyframes[order], dtype=np.int64)

    def points_of(self, camera: str, frame: IntArray, feature: IntArray) -> IntArray:
        """Find the map points that features of a camera's keyframes observe.

        Args:
            camera: Camera name.
            frame: (N,) frame index of the keyframe that contains each feature.
            feature: (N,) index of each feature in its keyframe.

        Returns:
            (N,) index of the map point of each feature; −1 if the feature is not an observation of the map.
        """
        observed = np.isin(self.obs_keyframe, self.keyframes_of(camera))
        keys = self.keyframe_frame[self.obs_keyframe[observed]] * _FEATURE_STRIDE + self.obs_feature[observed]
        if len(keys) == 0:
            return np.full(len(frame), -1, np.int64)
        order = np.argsort(keys, kind="stable")
        queries = frame * _FEATURE_STRIDE + feature
        found = order[np.minimum(np.searchsorted(keys, queries, sorter=order), len(keys) - 1)]
        return np.asarray(np.where(keys[found] == queries, self.obs_point[observed][found], -1))

    def mean_error_px(self) -> float:
        """Return the mean reprojection error, pixels; NaN if the map has no observations.

        The mean is taken over all observations. The error of an observation is taken as the mean error of its
        point.
        """
        return float(self.point_error_px[self.obs_point].mean()) if len(self.obs_point) else float("nan")


@dataclass(frozen=True, slots=True, kw_only=True)
class Trajectory:
    """The poses and the status of the N frames of one camera.

    Attributes:
        camera: Camera name.
        gauge: Identifier of the gauge of the map that the poses refer to. After merging, it is "world"
            (metres, Z up).
        frame_numbers: (N,) number of each frame in the video, counted from 0.
        times_ns: (N,) timestamp of each frame on the clock of the camera, nanoseconds.
        gauge_from_cam: (N,4,4) camera poses in the gauge; NaN for lost frames. A frame with the status
            ROTATION_ONLY has a rotation, and NaN as its position.
        covariance: (N,6,6) covariance of each pose in the axes of the camera: rotation (rad) first, then
            translation (unit of the gauge). As in GTSAM's Pose3, the perturbation multiplies the pose from
            the right. NaN for lost frames. With the status ROTATION_ONLY, the part of the
            rotation is known.
        status: (N,) status of each frame.
        inliers: (N,) number of PnP inliers of each frame.
        error_px: (N,) mean reprojection error of the inliers, pixels; NaN for a frame without inliers.
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
        if not np.isfinite(self.gauge_from_cam[self.rotation_only, :3, :3]).all():
            raise ValueError("status and poses disagree on which frames have a rotation")

    def without(self, frames: BoolArray, status: FrameStatus) -> Trajectory:
        """Return the trajectory without the poses of some frames.

        Args:
            frames: (N,) True for the frames that lose their pose.
            status: The status of those of them that had one.
        """
        new = np.where(frames & self.localised, status, self.status)
        return replace(
            self,
            gauge_from_cam=np.where(frames[:, None, None], np.nan, self.gauge_from_cam),
            covariance=np.where(frames[:, None, None], np.nan, self.covariance),
            status=tuple(map(FrameStatus, new)),
        )

    @property
    def localised(self) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Mask (N,) that is True for the frames with a measured pose."""
        return np.array([status.localised for status in self.status], dtype=bool)

    @property
    def rotation_only(self) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Mask (N,) that is True for the frames with a measured rotation and no position."""
        return np.array([status is FrameStatus.ROTATION_ONLY for status in self.status], dtype=bool)

    def poses_at_origin(self) -> FloatArray:
        """Return the poses (N,4,4) for files that need a position: zeros where only the rotation is known."""
        poses = self.gauge_from_cam.copy()
        poses[self.rotation_only, :3, 3] = 0.0
        return poses

    @property
    def registered(self) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Mask (N,) that is True for the frames with a pose from pictures, not from an inertial sensor."""
        return np.array(
            [status.localised and status is not FrameStatus.INERTIAL for status in self.status], dtype=bool
        )

    @property
    def seconds(self) -> FloatArray:
        """Time (N,) of each frame on the clock of the camera, seconds."""
        return np.asarray(self.times_ns * 1e-9, dtype=np.float64)


@dataclass(frozen=True, slots=True, kw_only=True)
class OtherPaths:
    """The poses of frames of one camera in other maps than the map of its path.

    Attributes:
        trajectories: One trajectory for each of these maps. No frame has a pose in two of them, or in one of
            them and in the camera's path.
    """

    trajectories: tuple[Trajectory, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class MapResult:
    """The result of mapping.

    Attributes:
        maps: The maps, the largest map first. Each map has a separate gauge.
        workspace: Folder with COLMAP's ``database.db`` and the models ``sparse/<n>``. They are needed to add
            keyframes to the map later.
        log: Diagnostics as plain JSON values: the initial pairs that were tried, the models, the image pairs
            that were matched, and the keyframes without a pose.
    """

    maps: tuple[Map, ...]
    workspace: Path
    log: Mapping[str, Any]

    @property
    def diagnostics(self) -> MapDiagnostics:
        """The content of the log as typed fields."""
        return MapDiagnostics.from_log(self.log)


@dataclass(frozen=True, slots=True, kw_only=True)
class Registration:
    """The result of registration for one camera: its trajectory in a map, and the tracked observations.

    Attributes:
        trajectory: Pose and status of each frame.
        obs_frame: (M,) index of the frame that contains each tracked observation.
        obs_keyframe: (M,) frame index of the keyframe in which the track of each observation starts.
        obs_feature: (M,) index of the feature in the keyframe `obs_keyframe` at which the track of each
            observation starts. `obs_keyframe` and `obs_feature` together identify the track. They remain
            valid after the map has changed.
        obs_px: (M,2) tracked pixels, float32, with COLMAP's origin.
        wanted_keyframes: (W,) indices of the frames that mapping should add to the map as keyframes. These
            are frames where tracking failed, and misregistered keyframes whose pose should be estimated
            again.
        tried_keyframes: (V,) indices of the frames of this camera that mapping has already tried as
            keyframes.
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
