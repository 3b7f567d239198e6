"""Estimate the relative pose of two cameras that are mounted on one bone, from all frames of both cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray, set_array
from bodycap_batch.model.geometry import (
    invert,
    make_transform,
    nearest_rotation,
    poses_at,
    rotation_angle_rad,
    so3_exp,
    so3_log,
)
from bodycap_batch.model.scene import Trajectory

_MAX_ITERATIONS = 100
"""Maximum number of iterations for the average of rotations."""
_CONVERGED_RAD = 1e-9
"""Smallest angle, radians, that is distinguished from zero in the iterative average of rotations.

The iterations end after a step with a smaller angle. Residuals with a smaller angle are replaced by this
angle, so that the weight 1/residual stays finite."""
MIN_INSTANTS = 30
"""Minimum number of instants with a pose of both cameras: the frames of one second. Fewer instants do not
determine the relative pose."""
_MAX_SPREAD_RATIO = 1.5
"""Maximum scatter of the relative rotation, divided by the scatter that is expected from the covariances.

Two cameras with a larger ratio are not a rigid rig. In a rigid rig, the ratio is even below 1. The reason is
that the covariances also contain the error of the map, and this error is common to both cameras. Evidence:
docs/decisions/registration.md."""
_MEDIAN_NORM_3D = 1.538
"""Median length of a vector of three independent standard normal variables."""
_SAME_INSTANT_RATIO = 0.25
"""Maximum time difference between two frames that were exposed at the same instant in a synchronised rig, as
a fraction of the frame interval. Derivation: the timestamps are rounded, and the next exposure is a whole
frame interval later."""
_MAX_INTERPOLATION_FRAMES = 1.5
"""Maximum time between two poses, in frame intervals, for interpolation between them. With this limit, only
poses of successive frames are interpolated."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RelativePose:
    """The pose of one camera relative to another camera, and the figures that show whether it is constant.

    Attributes:
        cameras: Names of the first and the second camera.
        first_from_second: (4,4) pose of the second camera in the frame of the first camera, with the
            translation in the unit of the gauge. NaN if there is no instant with a pose of both cameras.
        instants: Number of instants with a pose of both cameras.
        spread_rad: Median angle, radians, between the relative rotation at single instants and the mean
            relative rotation.
        explained_rad: Value of `spread_rad`, radians, that is expected from the covariances of both
            trajectories.
        spread: Median distance between the relative translation at single instants and the mean relative
            translation, in the unit of the gauge.
    """

    cameras: tuple[str, str]
    first_from_second: FloatArray
    instants: int
    spread_rad: float
    explained_rad: float
    spread: float

    def __post_init__(self) -> None:
        set_array(self, "first_from_second", (4, 4), finite=False)

    @property
    def is_rigid(self) -> bool:
        """True if enough instants show that the cameras are mounted rigidly and exposed at the same time."""
        return self.instants >= MIN_INSTANTS and self.spread_rad < _MAX_SPREAD_RATIO * self.explained_rad


def estimate_relative_pose(first: Trajectory, second: Trajectory, offset_ns: int) -> RelativePose:
    """Estimate the mean pose of a second camera relative to a first camera, robustly.

    The mean is taken over all instants with a pose of both cameras. The second trajectory is interpolated at
    the times of the first trajectory.

    Args:
        first: Trajectory of the first camera.
        second: Trajectory of the second camera. If the two trajectories have different gauges, there is no
            instant with a pose of both cameras.
        offset_ns: Nanoseconds to add to the times of the second camera to convert them to the clock of the
            first camera.

    Source: rotations by Hartley, Aftab, Trumpf, "L1 rotation averaging using the Weiszfeld algorithm", CVPR
        2011; translations by their median along each axis.
    """
    names, samples = (first.camera, second.camera), np.zeros((0, 4, 4))
    if first.gauge == second.gauge and first.localised.any() and second.localised.any():
        times_ns, frame_ns = second.times_ns[second.localised], _frame_interval_ns(second.times_ns)
        poses, is_valid = poses_at(
            times_ns,
            second.gauge_from_cam[second.localised],
            first.times_ns[first.localised] - offset_ns,
            max_gap_ns=round(_MAX_INTERPOLATION_FRAMES * frame_ns),
            snap_ns=round(_SAME_INSTANT_RATIO * frame_ns),
        )
        samples = invert(first.gauge_from_cam[first.localised][is_valid]) @ poses[is_valid]
    if len(samples) == 0:
        return RelativePose(
            cameras=names,
            first_from_second=np.full((4, 4), np.nan),
            instants=0,
            spread_rad=np.nan,
            explained_rad=np.nan,
            spread=np.nan,
        )
    rotation, translation = mean_rotation(samples[:, :3, :3]), np.median(samples[:, :3, 3], axis=0)
    variance = sum(_rotation_variance(path) for path in (first, second))
    return RelativePose(
        cameras=names,
        first_from_second=make_transform(rotation, translation),
        instants=len(samples),
        spread_rad=float(np.median(rotation_angle_rad(rotation.T @ samples[:, :3, :3]))),
        explained_rad=_MEDIAN_NORM_3D * float(np.sqrt(variance)),
        spread=float(np.median(np.linalg.norm(samples[:, :3, 3] - translation, axis=1))),
    )


def _rotation_variance(path: Trajectory) -> float:
    """Return the variance, rad², of a pose's rotation about one axis: the median of all poses."""
    covariance = path.covariance[path.localised][:, :3, :3]
    return float(np.median(np.trace(covariance, axis1=1, axis2=2))) / 3.0


def mean_rotation(rotations: FloatArray) -> FloatArray:
    """Return the rotation (3,3) with the smallest sum of angles to the given rotations (N,3,3).

    This mean is robust: nearly half of the given rotations may be wrong.
    """
    mean = nearest_rotation(np.median(rotations, axis=0))
    for _ in range(_MAX_ITERATIONS):
        rotvec = so3_log(mean.T @ rotations)
        weight = 1.0 / np.maximum(np.linalg.norm(rotvec, axis=1), _CONVERGED_RAD)
        step = weight @ rotvec / weight.sum()
        mean = mean @ so3_exp(step)
        if np.linalg.norm(step) < _CONVERGED_RAD:
            break
    return np.asarray(mean)


def _frame_interval_ns(times_ns: IntArray) -> float:
    """Return the median frame interval in nanoseconds."""
    return float(np.median(np.diff(times_ns))) if len(times_ns) > 1 else 0.0
