"""What goes into the skeleton stage and what comes out of it; shared with export and the pipeline."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, set_array
from bodycap_batch.model.geometry import Similarity
from bodycap_batch.model.scene import Trajectory
from bodycap_batch.model.skeleton import Motion, Mount, SkeletonModel

Activity = Literal["walk", "generic"]

_STANDING_SPEED_M_PER_S, _STANDING_RATE_HZ = 0.05, 30.0
"""Speed of a standing foot's ankle, one sigma at 30 ticks a second: the shin rolls over the foot."""


def standing_sigma_m(fps: float) -> float:
    """How far a standing foot's ankle moves from tick to tick, one sigma.

    Per tick the square root of the rate less: over a second a foot is held as firmly at every rate.
    """
    return _STANDING_SPEED_M_PER_S / math.sqrt(_STANDING_RATE_HZ * fps)


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraClock:
    """How a camera's timestamps relate to the common clock.

    Attributes:
        nominal_fps: The camera's nominal rate (dropped frames do not change it).
        offset_s: Common time = camera time + offset.
        rolling_shutter_s: Time from the first row's exposure to the last row's.
    """

    nominal_fps: float
    offset_s: float = 0.0
    rolling_shutter_s: float = 0.0

    def __post_init__(self) -> None:
        if not self.nominal_fps > 0.0:
            raise ValueError(f"nominal_fps must be positive, not {self.nominal_fps}")

    def common_times_ns(self, times_ns: IntArray, row_fraction: FloatArray | None = None) -> IntArray:
        """Common time (N,) of poses with the camera's own timestamps (N,).

        Args:
            times_ns: (N,) camera time of each frame.
            row_fraction: (N,) mean image row of the observations a pose rests on, over the image height.
                Without it the pose is that of the middle row, whose exposure is the frame time.
        """
        shift_s = np.full(len(times_ns), self.offset_s)
        if row_fraction is not None:
            shift_s += (row_fraction - 0.5) * self.rolling_shutter_s
        return np.asarray(times_ns + np.round(shift_s * 1e9), dtype=np.int64)


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardView:
    """A marker board in one keyframe.

    Attributes:
        camera: Camera name.
        frame: Index of the frame in the camera's trajectory.
        board_m: (N,3) corners on the board, metres, z = 0.
        rays: (N,2) where they were seen, undistorted, at depth 1.
        cam_from_board: (4,4) the board's pose from this view alone.
    """

    camera: str
    frame: int
    board_m: FloatArray
    rays: FloatArray
    cam_from_board: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class MergeInputs:
    """Everything the skeleton stage works on.

    Attributes:
        trajectories: One per camera, each in the gauge of the map it was solved in.
        clocks: By camera name.
        skeleton: Zero pose, metres: a preset scaled to the height, or the user's own file.
        mounts: One per camera, the prior: nominal pose with a large sigma, or the job's with a small one.
        skeleton_is_measured: True when the skeleton is the subject's own (metric scale follows it).
        height_m: The subject's stature, if given.
        activity: ``walk`` adds walking's soft rules.
        map_points: (P,3) points by gauge; the floor is looked for in them.
        row_fraction: By camera, (N,) mean row of the observations behind each pose over the image height
            (NaN where not localised); a camera that is missing is taken at the middle row.
        board: Where keyframes see the marker board the job names.
    """

    trajectories: tuple[Trajectory, ...]
    clocks: Mapping[str, CameraClock]
    skeleton: SkeletonModel
    mounts: tuple[Mount, ...]
    skeleton_is_measured: bool = False
    height_m: float | None = None
    activity: Activity = "generic"
    map_points: Mapping[str, FloatArray] = field(default_factory=dict)
    row_fraction: Mapping[str, FloatArray] = field(default_factory=dict)
    board: tuple[BoardView, ...] = ()

    def __post_init__(self) -> None:
        cameras = [trajectory.camera for trajectory in self.trajectories]
        if len(set(cameras)) != len(cameras):
            raise ValueError("trajectories: one per camera")
        mounted = {mount.camera for mount in self.mounts}
        missing = [name for name in cameras if name not in mounted or name not in self.clocks]
        if missing:
            raise ValueError(f"no mount or no clock for {', '.join(missing)}")

    def mount_of(self, camera: str) -> Mount:
        """The mount prior of a camera."""
        return next(mount for mount in self.mounts if mount.camera == camera)


@dataclass(frozen=True, slots=True, kw_only=True)
class SolvedBody:
    """The body as the factor graph solved it, in the world (metres, z up). Its joints have slack.

    Attributes:
        skeleton: The skeleton that was solved, with J joints.
        fps: Ticks per second.
        start_ns: Common time of tick 0.
        graph_world_from_joint: (T,J,4,4) a pose for every joint: the graph's if ``solved`` (its joints have
            millimetres of slack), else the rest rotation relative to the parent.
        solved: (J,) True if the joint was a variable of the graph.
        observed: (T,J) True if cameras measured the joint at that tick.
        trajectories: The trajectories of the cameras in use, gauge "world", covariance of the measurements in
            metres, centres as solved with the body (`MergeOptions.camera_paths`). Poses that proved to be
            gross errors are removed, with the status POSE_JUMP.
        mounts: The solved mounts with their sigmas.
        standing: (T,J) True if a foot stands on its ankle, this joint. None if foot contact was not detected.
    """

    skeleton: SkeletonModel
    fps: float
    start_ns: int
    graph_world_from_joint: FloatArray
    solved: BoolArray
    observed: BoolArray
    trajectories: tuple[Trajectory, ...]
    mounts: tuple[Mount, ...]
    standing: BoolArray | None = None

    def __post_init__(self) -> None:
        ticks, joints = len(self.graph_world_from_joint), len(self.skeleton.joints)
        set_array(self, "graph_world_from_joint", (ticks, joints, 4, 4))
        set_array(self, "solved", (joints,), np.bool_)
        set_array(self, "observed", (ticks, joints), np.bool_)
        if self.standing is not None:
            set_array(self, "standing", (ticks, joints), np.bool_)

    def times_ns(self) -> IntArray:
        """Return the common time (T,) of each tick."""
        ticks = np.arange(len(self.graph_world_from_joint))
        return np.asarray(self.start_ns + np.round(ticks * (1e9 / self.fps)), dtype=np.int64)


@dataclass(frozen=True, slots=True, kw_only=True)
class MergeResult(SolvedBody):
    """The body and the cameras in the world (metres, z up).

    Every output shows `motion`: the page, the video and all files. The graph's poses are kept for figures
    about the solution itself.

    Attributes:
        motion: The motion of the rigid skeleton that is nearest to the graph's solution.
        projection_gap: JSON values: how far `motion` is from the graph's joints and from the cameras, and how
            fast standing feet slide in it.
        world_from_map: By gauge; a gauge whose place is unknown is missing.
        unused_cameras: Cameras whose map could not be linked to the body, with the reason.
        report: Plain JSON values: sources and values of scale, vertical and floor, residuals, outliers.
        joint_covariance_m2: (T,J,3,3) covariance of each joint's centre minus the centre of the first solved
            joint, world axes: measurement noise, mounts and scale together; not the world's own axes. NaN if
            the joint was not solved.
    """

    motion: Motion
    projection_gap: Mapping[str, Any]
    world_from_map: Mapping[str, Similarity]
    unused_cameras: Mapping[str, str]
    report: Mapping[str, Any]
    joint_covariance_m2: FloatArray | None = None

    def __post_init__(self) -> None:
        # With slots, the decorator makes a new class, which super() without arguments does not know.
        SolvedBody.__post_init__(self)
        if self.motion.local_rotation.shape[:2] != self.observed.shape:
            raise ValueError("motion: its ticks and joints are not those of the graph")
        if self.joint_covariance_m2 is not None:
            set_array(self, "joint_covariance_m2", (*self.observed.shape, 3, 3), finite=False)

    def joint_sigma_m(self) -> FloatArray:
        """Return the sigma (T,J) per axis of each joint's centre relative to the first solved joint's.

        NaN if the joint was not solved.
        """
        if self.joint_covariance_m2 is None:
            return np.full(self.observed.shape, np.nan)
        return np.asarray(np.sqrt(np.trace(self.joint_covariance_m2, axis1=2, axis2=3) / 3.0))
