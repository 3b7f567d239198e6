"""The inputs and the result of the merging stage. Export and the pipeline use them too."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, set_array
from bodycap_batch.model.camera_clock import CameraClock
from bodycap_batch.model.fill_data import FillReport
from bodycap_batch.model.geometry import Similarity
from bodycap_batch.model.inertial_camera import ForceWindows
from bodycap_batch.model.merge_report import MergeReport
from bodycap_batch.model.picture_turns import PictureTurns
from bodycap_batch.model.scene import Trajectory
from bodycap_batch.model.skeleton import Motion, Mount, SkeletonModel

Activity = Literal["walk", "generic"]

_STANDING_SPEED_M_PER_S = 0.05
"""Sigma, m/s, of the speed of the ankle of a standing foot, on a timeline of `_STANDING_RATE_HZ`.

The sigma is not zero, because the shin rolls over the standing foot and moves the ankle. Evidence: none.
"""
_STANDING_RATE_HZ = 30.0
"""Rate, Hz, of the timeline for which `_STANDING_SPEED_M_PER_S` holds."""
ON_TICK_TOLERANCE_NS = 1_000_000
"""Maximum time, nanoseconds, between a measured pose and a tick at which the pose is used as it is.

In a millisecond, a hand at 3 m/s moves 3 mm. In the motion graph, a pose at a larger distance gets a state of
its own. In the projection to a rigid skeleton, it is interpolated.
"""
SLIP_HUBER_SIGMAS = 2.0
"""Threshold of the Huber loss for the movement of a standing foot, in sigmas.

A larger movement is treated as slipping. The motion graph and the projection to a rigid skeleton use the same
threshold. Evidence: none.
"""


def standing_sigma_m(fps: float) -> float:
    """Return the sigma, metres, of the movement of a standing foot's ankle from one tick to the next.

    The sigma is proportional to 1 / √fps. Therefore the sigma of the whole movement in one second is the same
    for any number of ticks per second.

    Args:
        fps: Ticks per second of the timeline.
    """
    return _STANDING_SPEED_M_PER_S / math.sqrt(_STANDING_RATE_HZ * fps)


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardView:
    """An observation of a marker board in one keyframe.

    Attributes:
        camera: Camera name.
        frame: Index of the keyframe in the camera's trajectory.
        board_m: (N,3) corners in the frame of the board, metres; z is 0.
        rays: (N,2) observed corners as undistorted image coordinates at depth 1.
        cam_from_board: (4,4) pose of the board in the camera frame, metres, estimated from this keyframe
            only.
    """

    camera: str
    frame: int
    board_m: FloatArray
    rays: FloatArray
    cam_from_board: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class MergeInputs:
    """The inputs of the merging stage.

    Attributes:
        trajectories: One trajectory per camera, in the gauge of the map in which the camera was localised.
        clocks: By camera name, the clock of the camera.
        skeleton: The skeleton in its zero pose, metres: a preset scaled to the stature, or the user's file.
        mounts: One mount per camera, used as the prior: the nominal pose with a large sigma, or the pose
            given in the job with a small sigma.
        skeleton_is_measured: True if the bone lengths were measured on the subject. The skeleton then
            determines the metric scale.
        height_m: Stature of the subject, metres; None if it is not given.
        activity: ``walk`` adds the soft rules of walking; ``generic`` adds no rules.
        map_points: By gauge, the (P,3) points of the map in this gauge. Planes and the floor are found in
            these points.
        row_fraction: By camera name, (N,) mean image row of the observations that each pose was estimated
            from, as a fraction of the image height; NaN if the frame is not localised. Without an entry for
            the camera, each pose is valid at the exposure of the middle row.
        board_views: Observations of the job's marker board in keyframes.
        force_windows: By camera name, what the camera's accelerometer measures along the trajectory, in the
            gauge of the trajectory. Only cameras with a usable accelerometer have an entry.
        picture_turns: By camera name, how the camera turned its pictures relative to its lens. Only cameras
            with stabilised pictures have an entry. Trajectories and observations of the board have the axes
            of the pictures; mounts have those of the lens.
        not_worn: The trajectories of the cameras that nobody wears, in the gauges of their maps. They have no
            mount, and the body never uses them.
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
    board_views: tuple[BoardView, ...] = ()
    force_windows: Mapping[str, ForceWindows] = field(default_factory=dict)
    picture_turns: Mapping[str, PictureTurns] = field(default_factory=dict)
    not_worn: tuple[Trajectory, ...] = ()

    def __post_init__(self) -> None:
        cameras = [trajectory.camera for trajectory in self.trajectories]
        if len(set(cameras)) != len(cameras):
            raise ValueError("trajectories: one per camera")
        mounted = {mount.camera for mount in self.mounts}
        missing = [name for name in cameras if name not in mounted or name not in self.clocks]
        if missing:
            raise ValueError(f"no mount or no clock for {', '.join(missing)}")

    def mount_of(self, camera: str) -> Mount:
        """Return the mount prior of a camera."""
        return next(mount for mount in self.mounts if mount.camera == camera)

    def mount_by_camera(self) -> dict[str, Mount]:
        """Return the mount priors by camera name."""
        return {mount.camera: mount for mount in self.mounts}


@dataclass(frozen=True, slots=True, kw_only=True)
class SolvedBody:
    """The solution of the factor graph for the body, in the world (metres, z up).

    The joints have slack: the ends of two bones that meet at a joint can be millimetres apart.

    Attributes:
        skeleton: The skeleton that was solved, with J joints.
        fps: Ticks per second.
        start_ns: Common time of tick 0, nanoseconds.
        graph_world_from_joint: (T,J,4,4) pose of every joint in the world. If `solved` is True for a joint,
            its pose is the solution of the graph. Any other joint has its rest rotation relative to the
            parent.
        solved: (J,) True if the joint was a variable of the graph.
        observed: (T,J) True if cameras measured the joint at the tick.
        trajectories: The trajectories of the cameras in use, in the gauge "world". The camera centres were
            solved together with the body (`MergeOptions.camera_paths`). The covariances describe the
            measurements, not the solution; lengths are in metres. Poses with gross errors are removed and
            have the status POSE_JUMP. Last come the cameras that nobody wears, if their map is in the world.
        mounts: The solved mounts, with their sigmas.
        standing: (T,J) True if the joint is the ankle of a foot that stands at the tick. None if foot contact
            was not detected.
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
        """Return the common time (T,) of each tick, nanoseconds."""
        ticks = np.arange(len(self.graph_world_from_joint))
        return np.asarray(self.start_ns + np.round(ticks * (1e9 / self.fps)), dtype=np.int64)


@dataclass(frozen=True, slots=True, kw_only=True)
class MergeResult(SolvedBody):
    """The result of the merging stage: the body and the cameras in the world (metres, z up).

    The report, the preview and all exported files show `motion`. The joint poses from the factor graph are
    kept only to compute figures about the solution of the graph.

    Attributes:
        motion: The motion of the skeleton with rigid bones that is nearest to the solution of the graph.
        projection_gap: Differences between `motion` and the solution of the graph, as JSON values: distances
            from the joints of the graph, distances from the cameras, and the sliding speed of standing feet.
        world_from_map: By gauge, the similarity from the map to the world. A gauge with an unknown similarity
            has no entry.
        unused_cameras: By camera name, the reason why the camera's map could not be linked to the body. Only
            cameras with such a map have an entry.
        report: Sources, values, residuals and doubts. It is stored as plain JSON values.
        joint_covariance_m2: (T,J,3,3) covariance of the position of each joint relative to the first solved
            joint, in world axes. It contains the errors of measurements, mounts and scale, but not the error
            of the world axes. NaN if the joint was not solved.
        flexion_sigma_rad: (T,J) sigma of the flexion of each elbow and knee that was solved, radians; NaN for
            other joints. It contains the same errors.
        fill: How the joints without cameras are posed in `motion`; None before the stage `fill`.
    """

    motion: Motion
    projection_gap: Mapping[str, Any]
    world_from_map: Mapping[str, Similarity]
    unused_cameras: Mapping[str, str]
    report: MergeReport
    joint_covariance_m2: FloatArray | None = None
    flexion_sigma_rad: FloatArray | None = None
    fill: FillReport | None = None

    def __post_init__(self) -> None:
        # With slots=True, the dataclass decorator makes a new class. super() without arguments would refer to
        # the original class and fail.
        SolvedBody.__post_init__(self)
        if self.motion.local_rotation.shape[:2] != self.observed.shape:
            raise ValueError("motion: its ticks and joints are not those of the graph")
        if self.joint_covariance_m2 is not None:
            set_array(self, "joint_covariance_m2", (*self.observed.shape, 3, 3), finite=False)
        if self.flexion_sigma_rad is not None:
            set_array(self, "flexion_sigma_rad", self.observed.shape, finite=False)

    def joint_sigma_m(self) -> FloatArray:
        """Return the sigmas (T,J) of the joint positions, metres per axis.

        The positions are relative to the first solved joint. The sigma of a joint that was not solved is NaN.
        """
        if self.joint_covariance_m2 is None:
            return np.full(self.observed.shape, np.nan)
        return np.asarray(np.sqrt(np.trace(self.joint_covariance_m2, axis1=2, axis2=3) / 3.0))


def filled_joints(merge: MergeResult) -> BoolArray:
    """Return which joints (J,) the stage `fill` posed; none before this stage."""
    return np.zeros(len(merge.solved), dtype=bool) if merge.fill is None else merge.fill.filled
